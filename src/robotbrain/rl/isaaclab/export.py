"""A task of this kit as a file that genuine Isaac Lab runs: ``robotbrain rl export-isaaclab``.

Terms that Isaac Lab has are named, terms of one's own are copied by source. The robot goes along as MJCF, which Isaac
Lab's ``MjcfFileCfg`` imports, and the physics is its Newton backend with MuJoCo Warp, which is nearest to the MuJoCo
here. Nothing of it needs Isaac Lab; the conformance tests run the result with the genuine wheel.
"""

from __future__ import annotations

import ast
import math
import sys
from pathlib import Path
from typing import Any

import torch

from robotbrain.errors import InputError
from robotbrain.files import write_text
from robotbrain.rl.envs import ManagerBasedRLEnvCfg
from robotbrain.rl.isaaclab._emit import Emitter
from robotbrain.rl.isaaclab._robot import RobotFiles, robot_files
from robotbrain.rl.isaaclab._source import Sources
from robotbrain.rl.isaaclab._texts import header, order_notes, pascal
from robotbrain.rl.mdp.events import reset_scene_to_default
from robotbrain.rl.ppo_cfg import RslRlOnPolicyRunnerCfg, usual_runner_cfg
from robotbrain.rl.scene.interactive_scene import InteractiveScene
from robotbrain.rl.scene.scene_cfg import ArticulationCfg, ContactSensorCfg, LidarCfg, entities

_CONTAINERS = ("observations", "actions", "commands", "rewards", "terminations", "events", "curriculum")
_SCENE_IMPORTS = (
    "import isaaclab.sim as sim_utils",
    "from isaaclab.actuators import ImplicitActuatorCfg",
    "from isaaclab.assets import ArticulationCfg, AssetBaseCfg",
    "from isaaclab.envs import ManagerBasedRLEnvCfg",
    "from isaaclab.scene import InteractiveSceneCfg",
    "from isaaclab.sim import SimulationCfg",
    "from isaaclab.utils import configclass",
    "from isaaclab_newton.physics import MJWarpSolverCfg, NewtonCfg",
    "import gymnasium",
    "from pathlib import Path",
)


def export_isaaclab(
    cfg: ManagerBasedRLEnvCfg,
    out_dir: str | Path,
    *,
    name: str = "task",
    agent: RslRlOnPolicyRunnerCfg | None = None,
) -> list[Path]:
    """Write a task for genuine Isaac Lab 3.0.

    Args:
        cfg: the task.
        out_dir: folder for the files, made when it is not there; files of the same names are replaced.
        name: of the task, a Python identifier; the module is ``<name>_isaaclab.py``, the task ``RobotBrain-<Name>``.
        agent: PPO's configuration, which goes along as that of rsl-rl; None: a common one to begin with.

    Returns:
        The files: the module, the robots' MJCF, and notes about the order of observations and actions.

    Raises:
        InputError: something that cannot be exported: values that are no code, functions without source, terms that
            Isaac Lab has no counterpart of.
    """
    if not name.isidentifier():
        raise InputError("name", given=name, expected="a Python identifier", fix="Give e.g. name='reach'.")
    cfg = cfg.copy()
    cfg.validate()
    small = cfg.scene.copy()
    small.num_envs = 1
    scene = InteractiveScene(small, cfg.sim, num_threads=1)
    robots = {
        key: robot_files(member, scene.articulations[key])
        for key, member in entities(cfg.scene).items()
        if isinstance(member, ArticulationCfg)
    }
    if len(robots) != 1:
        raise InputError("scene", given=sorted(robots), expected="one articulation", fix="Export tasks with one robot.")
    sources = Sources()
    sources.imports.update(_SCENE_IMPORTS)
    emitter = Emitter(sources)
    parts = [_scene_code(cfg, robots, scene, emitter)]
    parts += [_container_code(field, getattr(cfg, field), emitter) for field in _CONTAINERS if _has(cfg, field)]
    parts.append(_env_code(name, cfg, scene))
    if agent is None:
        groups = cfg.observations if isinstance(cfg.observations, dict) else vars(cfg.observations)
        agent = usual_runner_cfg(name, next(iter(groups), "policy"))
    agent.validate()
    parts += [_agent_code(name, agent, emitter), _registration(name)]
    module = "\n\n".join([header(name, cfg, robots), *_preamble(sources), *(part.strip("\n") + "\n" for part in parts)])
    ast.parse(module)  # a mistake of the exporter shall show here, not on the GPU owner's machine
    out = Path(out_dir)
    out.mkdir(parents=True, exist_ok=True)
    written = [write_text(out / f"{name}_isaaclab.py", module)]
    written += [write_text(out / f"{key}.xml", robot.mjcf) for key, robot in robots.items()]
    written.append(write_text(out / "ORDER.md", order_notes(name, cfg, robots)))
    return written


def _has(cfg: ManagerBasedRLEnvCfg, field: str) -> bool:
    return getattr(cfg, field) is not None or field == "events"


def _class_name(field: str) -> str:
    return field.capitalize() + "Cfg"


def _container_code(field: str, container: Any, emitter: Emitter) -> str:
    if field == "observations":
        return _observations_code(container, emitter)
    terms = dict(container.items() if isinstance(container, dict) else vars(container or object).items())
    terms = {key: term for key, term in terms.items() if hasattr(term, "__dataclass_fields__")}
    if field == "events" and not any(t.func is reset_scene_to_default for t in terms.values()):
        # Here a reset starts from the default state by itself; there an event has to put it back.
        from robotbrain.rl.managers import EventTermCfg

        default = EventTermCfg(func=reset_scene_to_default, mode="reset", params={"reset_joint_targets": True})
        terms = {"reset_scene": default, **terms}
    return emitter.terms(_class_name(field), terms, field)


def _observations_code(container: Any, emitter: Emitter) -> str:
    emitter.sources.imports.add("from isaaclab.managers import ObservationGroupCfg")
    groups = container.items() if isinstance(container, dict) else vars(container).items()
    code, lines = [], []
    for key, group in groups:
        if group is None:
            continue
        kind = "".join(part.capitalize() for part in key.split("_")) + "ObservationsCfg"
        code.append(emitter.terms(kind, group, f"observations.{key}", base="ObservationGroupCfg"))
        lines.append(f"    {key}: {kind} = {kind}()")
    return "\n\n".join([*code, "@configclass\nclass ObservationsCfg:\n" + "\n".join(lines) + "\n"])


def _scene_code(
    cfg: ManagerBasedRLEnvCfg, robots: dict[str, RobotFiles], scene: InteractiveScene, emitter: Emitter
) -> str:
    ((robot_name, robot),) = robots.items()
    lines = [
        "@configclass",
        "class SceneCfg(InteractiveSceneCfg):",
        "    ground = AssetBaseCfg(",
        '        prim_path="/World/ground",',
        "        spawn=sim_utils.GroundPlaneCfg(",
        "            physics_material=sim_utils.RigidBodyMaterialCfg(",
        f"                static_friction={robot.friction!r}, dynamic_friction={robot.friction!r}, restitution=0.0",
        "            )",
        "        ),",
        "    )",
        "    light = AssetBaseCfg(",
        '        prim_path="/World/light", spawn=sim_utils.DomeLightCfg(intensity=2000.0, color=(0.75, 0.75, 0.75))',
        "    )",
        f"    {robot_name}: ArticulationCfg = ROBOT_CFG",
    ]
    for key, member in entities(cfg.scene).items():
        if isinstance(member, ContactSensorCfg):
            bodies = scene.sensors[key].body_names
            emitter.sources.imports.add("from isaaclab.sensors import ContactSensorCfg")
            lines += [
                f"    {key} = ContactSensorCfg(",
                f'        prim_path="{{ENV_REGEX_NS}}/Robot/(.*/)?({"|".join(bodies)})",',
                "        history_length=1,",
                f"        track_air_time={member.track_air_time!r},",
                f"        force_threshold={member.force_threshold!r},",
                "    )",
            ]
        elif isinstance(member, LidarCfg):
            lines += _lidar_code(key, member, emitter)
    return _robot_code(robot_name, robot, cfg, emitter) + "\n\n" + "\n".join(lines)


def _robot_code(name: str, robot: RobotFiles, cfg: ManagerBasedRLEnvCfg, emitter: Emitter) -> str:
    state = {k: v for k, v in robot.init_state.items() if not (robot.fixed and k in ("lin_vel", "ang_vel"))}
    arguments = ",\n".join(f"        {k}={emitter.value(v, f'robot.{k}', 8)}" for k, v in state.items())
    servos = ",\n".join(
        f"            {k}={emitter.value(v, f'robot.{k}', 12)}" for k, v in robot.servos.items() if v is not None
    )
    return f'''ROBOT_CFG = ArticulationCfg(
    prim_path="{{ENV_REGEX_NS}}/Robot",
    spawn=sim_utils.MjcfFileCfg(
        asset_path=str(HERE / "{name}.xml"),
        fix_base={robot.fixed!r},
        self_collision=False,
        activate_contact_sensors=True,
    ),
    init_state=ArticulationCfg.InitialStateCfg(
{arguments},
    ),
    actuators={{
        "servos": ImplicitActuatorCfg(
{servos},
        )
    }},
    soft_joint_pos_limit_factor={robot.soft_limit_factor!r},
    # The order of the actions and observations in the kit, whatever the importer makes of the tree.
    joint_ordering={emitter.value(robot.joint_names, "joint_names", 4)},
)'''


def _lidar_code(key: str, lidar: LidarCfg, emitter: Emitter) -> list[str]:
    angles = torch.tensor(lidar.angles, dtype=torch.float64)
    steps = angles.diff()
    if len(angles) < 2 or (steps - steps[0]).abs().max() > 1e-6:
        raise InputError(
            f"scene.{key}.angles",
            given=list(lidar.angles),
            expected="evenly spaced angles, as Isaac Lab's lidar pattern has them",
            fix="Space the rays evenly.",
        )
    emitter.sources.imports.add("from isaaclab.sensors import RayCasterCfg, patterns")
    step = math.degrees(float(steps[0]))
    first, last = math.degrees(float(angles[0])), math.degrees(float(angles[-1]))
    if abs(last - first + step - 360.0) < 1e-3:
        last = first + 360.0  # a full turn: Isaac Lab leaves the last ray out itself
    return [
        "    # A ray caster sees the meshes it is told of, here the ground: add the obstacles of your scene.",
        f"    {key} = RayCasterCfg(",
        f'        prim_path="{{ENV_REGEX_NS}}/Robot/{lidar.body}",',
        f"        offset=RayCasterCfg.OffsetCfg(pos={tuple(lidar.offset)!r}),",
        '        ray_alignment="base",',
        "        pattern_cfg=patterns.LidarPatternCfg(",
        "            channels=1,",
        "            vertical_fov_range=(0.0, 0.0),",
        f"            horizontal_fov_range=({round(first, 6)!r}, {round(last, 6)!r}),",
        f"            horizontal_res={round(step, 6)!r},",
        "        ),",
        f"        max_distance={float(lidar.max_range)!r},",
        '        mesh_prim_paths=["/World/ground"],',
        "    )",
    ]


def _env_code(name: str, cfg: ManagerBasedRLEnvCfg, scene: InteractiveScene) -> str:
    option = scene.world.model.opt
    integrator = ("euler", "rk4", "implicit", "implicitfast")[int(option.integrator)]
    fields = "\n".join(
        f"    {field}: {_class_name(field)} = {_class_name(field)}()" for field in _CONTAINERS if _has(cfg, field)
    )
    settings = {
        "decimation": cfg.decimation,
        "episode_length_s": cfg.episode_length_s,
        "is_finite_horizon": cfg.is_finite_horizon,
        "compute_final_obs": cfg.compute_final_obs,
        "seed": cfg.seed,
    }
    lines = "\n".join(f"        self.{key} = {value!r}" for key, value in settings.items())
    return f'''@configclass
class {pascal(name)}EnvCfg(ManagerBasedRLEnvCfg):
    sim: SimulationCfg = SimulationCfg(
        dt={cfg.sim.dt!r},
        gravity={tuple(cfg.sim.gravity)!r},
        physics=NewtonCfg(
            solver_cfg=MJWarpSolverCfg(
                njmax=300,
                nconmax=100,
                iterations={int(option.iterations)},
                ls_iterations={int(option.ls_iterations)},
                integrator="{integrator if integrator != "rk4" else "implicitfast"}",
                cone="{"elliptic" if int(option.cone) else "pyramidal"}",
                impratio={float(option.impratio)!r},
            ),
        ),
    )
    scene: SceneCfg = SceneCfg(num_envs={cfg.scene.num_envs!r}, env_spacing={cfg.scene.env_spacing!r})
{fields}

    def __post_init__(self):
{lines}
        self.sim.render_interval = self.decimation'''


def _agent_code(name: str, agent: RslRlOnPolicyRunnerCfg, emitter: Emitter) -> str:
    emitter.sources.imports.add("from isaaclab_rl.rsl_rl import RslRlOnPolicyRunnerCfg")
    lines = []
    for field, spec in RslRlOnPolicyRunnerCfg.__dataclass_fields__.items():
        value = getattr(agent, field)
        default = spec.default_factory() if callable(spec.default_factory) else spec.default
        if value is not default and value != default:
            lines.append(f"    {field} = {emitter.value(value, f'agent.{field}', 4)}")
    return f"@configclass\nclass {pascal(name)}PPORunnerCfg(RslRlOnPolicyRunnerCfg):\n" + "\n".join(lines)


def _registration(name: str) -> str:
    return f'''TASK = "RobotBrain-{pascal(name)}"


def register():
    """Tell Gymnasium of the task; Isaac Lab's scripts call this through --external_callback."""
    if TASK not in gymnasium.registry:
        gymnasium.register(
            id=TASK,
            entry_point="isaaclab.envs:ManagerBasedRLEnv",
            disable_env_checker=True,
            kwargs={{
                "env_cfg_entry_point": f"{{__name__}}:{pascal(name)}EnvCfg",
                "rsl_rl_cfg_entry_point": f"{{__name__}}:{pascal(name)}PPORunnerCfg",
                "default_agent": "rsl_rl",
            }},
        )
    return sys.argv[1:]


register()
'''


def _preamble(sources: Sources) -> list[str]:
    future = "from __future__ import annotations"
    imports = {*sources.imports, "import sys", "from typing import TYPE_CHECKING"}
    if not sources.type_imports:
        imports.remove("from typing import TYPE_CHECKING")
    standard = _merged({i for i in imports if i.split()[1].partition(".")[0] in sys.stdlib_module_names})
    others = _merged({i for i in imports if i.split()[1].partition(".")[0] not in sys.stdlib_module_names})
    types = _merged(sources.type_imports)
    checked = ["if TYPE_CHECKING:\n" + "\n".join("    " + line for line in types)] if types else []
    heads = [future, "\n".join(standard), "\n".join(others), *checked, "HERE = Path(__file__).resolve().parent"]
    copied = [source.rstrip("\n") + "\n" for source in sources.definitions.values()]
    plain = [source for source in copied if "\n" not in source.strip()]
    rest = [source for source in copied if "\n" in source.strip()]
    note = ["# The task's own terms, copied."] if rest else []
    return (
        ["\n\n".join(heads) + "\n", "".join(plain), *note, *rest]
        if plain
        else ["\n\n".join(heads) + "\n", *note, *rest]
    )


def _merged(imports: set[str]) -> list[str]:
    """Import lines, one for each module, in the order linters want."""
    plain = sorted(i for i in imports if i.startswith("import "))
    names: dict[str, set[str]] = {}
    for line in imports - set(plain):
        module, _, given = line.removeprefix("from ").partition(" import ")
        names.setdefault(module, set()).update(given.split(", "))
    return [*plain, *(f"from {module} import {', '.join(sorted(names[module]))}" for module in sorted(names))]
