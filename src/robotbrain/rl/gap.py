"""The gap between simulation and reality, measured: policies trained with and without randomisation, on surrogates.

Every policy is trained in simulation only, exported to ONNX, and run by the code that runs on a robot, on the nominal
robot and on a population of surrogates. The same targets and start poses are used everywhere. ``robotbrain rl gap``
shows the shipped study; ``--train`` makes it anew.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from robotbrain.errors import InputError
from robotbrain.rl.gap_report import GapReport, Measurement

if TYPE_CHECKING:
    from robotbrain.rl.deployment import Policy
    from robotbrain.rl.view import Motion

TERMS = ("latency", "load", "friction", "motor", "mass", "noise")
"""Groups of randomisation, see :mod:`robotbrain.rl.gap_variants`; each can be left out."""
VARIANTS: dict[str, tuple[str, ...]] = {
    "plain": (),
    "randomised": TERMS,
    **{f"only {name}": (name,) for name in TERMS},
    **{f"all but {name}": tuple(t for t in TERMS if t != name) for name in TERMS},
}
"""What is randomised in the training of each variant."""
SERIALS = range(1000, 1100)
"""Surrogates of the study."""
DISSECTED = 50
"""The first so many of them are used to ask which difference matters."""
EVALUATION_SEED = 5
STEPS = 80_000
RECIPE: dict[str, Any] = {
    "updates_per_step": 1 / 8,
    "gamma": 0.9,
    "tau": 0.01,
    "actor_lr": 1e-3,
    "critic_lr": 1e-3,
    "actor_every": 1,
    "noise_std": 0.1,
    "averaged": False,
}
"""What the study's trainings have other than the quick recipe of the reach task: smaller steps, and more of them."""

WEIGHTS = Path(__file__).parent / "weights"
RESULTS = Path(__file__).parent / "results"


@dataclass(frozen=True)
class StudyOptions:
    """What a study does.

    Args:
        variants: names of VARIANTS.
        seeds: of the trainings; one policy per variant and seed.
        steps: environment steps of each training.
        serials: surrogates to evaluate on.
        episodes: per policy and surrogate, and as many in simulation.
    """

    variants: Sequence[str] = ("plain", "randomised")
    seeds: Sequence[int] = tuple(range(5))
    steps: int = STEPS
    serials: Sequence[int] = SERIALS
    episodes: int = 2

    def __post_init__(self) -> None:
        for name in self.variants:
            if name not in VARIANTS:
                raise InputError("variant", given=name, expected=", ".join(VARIANTS), fix="Check the spelling.")
        for name in ("variants", "seeds", "serials"):
            if not len(getattr(self, name)):
                raise InputError(name, given=(), expected="at least one", fix="Leave it out for the default.")
        if self.steps < 1 or self.episodes < 1:
            raise InputError("steps, episodes", given=(self.steps, self.episodes), expected=">= 1", fix="Add some.")


def train_policy(
    path: str | Path,
    *,
    randomise: Collection[str] = (),
    seed: int = 0,
    steps: int = STEPS,
    progress: bool = True,
    **config: Any,
) -> Path:
    """Train DDPG on the reach task with these groups of randomisation and write the policy as ONNX.

    The same arguments give the same file on the same machine.

    Args:
        path: of the file.
        randomise: names of :data:`TERMS`.
        seed: of everything random.
        steps: environment steps, over all environments.
        progress: show a progress bar.
        config: other fields of :class:`robotbrain.rl.ddpg.DDPGConfig`.
    """
    from robotbrain.rl.ddpg import train_ddpg
    from robotbrain.rl.envs.gym import TaskVectorEnv
    from robotbrain.rl.export import export_policy
    from robotbrain.rl.gap_variants import reach_cfg, reach_meta
    from robotbrain.rl.tasks.reach import reach_ddpg_config

    cfg = reach_cfg(randomise)
    cfg.seed = seed
    env = TaskVectorEnv(cfg, num_threads=1)
    meta = reach_meta(
        env.env, algorithm="ddpg", randomise=[t for t in TERMS if t in randomise], seed=seed, steps=steps, **config
    )
    settings = reach_ddpg_config(**{**RECIPE, "total_steps": steps, **config})
    result = train_ddpg(lambda: env, settings, seed=seed, progress=progress)
    return export_policy(result.agent.actor, path, meta)


def measure(
    policy: Policy, serials: Sequence[int] = SERIALS, *, episodes: int = 2, seed: int = EVALUATION_SEED
) -> dict[str, Measurement]:
    """Return how a policy does in simulation and on surrogates, at the same targets and start poses.

    Args:
        policy: with metadata.
        serials: of the surrogates.
        episodes: per surrogate, and as many in simulation.
        seed: of targets, start poses and sensor noise.
    """
    from robotbrain.rl.surrogate import SurrogateReachEnv, neutral

    nominal = SurrogateReachEnv(serials, seed, params=[neutral(7)] * len(serials), ramp_s=0.0)
    places = {"simulation": nominal, "surrogate": SurrogateReachEnv(serials, seed)}
    return {place: Measurement.from_episodes(env.run(policy, episodes)) for place, env in places.items()}


def dissect(
    policy: Policy, serials: Sequence[int] = SERIALS, *, episodes: int = 1, seed: int = EVALUATION_SEED
) -> dict[str, float]:
    """Return the share of targets that a policy reaches when the robots differ from the nominal one in one way only.

    Keys are those of :data:`robotbrain.rl.surrogate.parameters.DIFFERENCES`, and ``"interpolation"``: the time that a
    robot's trajectory controller takes to a new target.
    """
    from robotbrain.rl.surrogate import RANGES, SurrogateReachEnv, draw
    from robotbrain.rl.surrogate.parameters import DIFFERENCES
    from robotbrain.rl.surrogate.reach import RAMP_S

    found = {}
    for kind, kept in {"interpolation": (), **DIFFERENCES}.items():
        others = [name for name in RANGES["arm"] if name not in kept]
        params = [draw(serial).with_nominal(*others) for serial in serials]
        ramp = RAMP_S if kind == "interpolation" else 0.0
        done = SurrogateReachEnv(serials, seed, params=params, ramp_s=ramp).run(policy, episodes)
        found[kind] = round(float(done.success.mean()), 6)
    return found


def study(
    options: StudyOptions | None = None, folder: str | Path = "gap", say: Callable[[str], None] = print
) -> GapReport:
    """Train what is missing in ``folder``, measure every policy, and return the report.

    Trained policies stay in the folder as ``<variant>_<seed>.onnx``: an interrupted study goes on where it was.
    """
    from robotbrain.rl.onnx_policy import OnnxPolicy

    options, folder = options or StudyOptions(), Path(folder)
    rows: dict[str, dict[int, dict[str, Measurement]]] = {}
    dissection: dict[str, dict[int, dict[str, float]]] = {}
    for seed in options.seeds:
        for variant in options.variants:
            path = folder / f"{variant.replace(' ', '_')}_{seed}.onnx"
            if not path.exists():
                say(f"training {variant}, seed {seed}")
                train_policy(path, randomise=VARIANTS[variant], seed=seed, steps=options.steps)
            policy = OnnxPolicy(path)
            rows.setdefault(variant, {})[seed] = measure(policy, options.serials, episodes=options.episodes)
            dissection.setdefault(variant, {})[seed] = dissect(policy, options.serials[:DISSECTED])
            found = rows[variant][seed]
            say(f"{variant}, seed {seed}: " + ", ".join(f"{p} {m.success:.0%}" for p, m in found.items()))
    recipe = {
        "steps": options.steps,
        "seeds": list(options.seeds),
        "serials": list(options.serials),
        "episodes": options.episodes,
        "evaluation_seed": EVALUATION_SEED,
        "randomise": {v: list(VARIANTS[v]) for v in options.variants},
    }
    return GapReport(rows, recipe, dissection)


def shipped_policy() -> Path:
    """Return the file of the shipped reaching policy, trained with randomisation."""
    return WEIGHTS / "reach_randomised.onnx"


def shipped_report() -> GapReport:
    """Return the report of the shipped study."""
    return GapReport.load(RESULTS / "reach_gap.json")


def record_reach(
    policy: str | Path | None = None, *, serial: int | None = None, episodes: int = 5, seed: int = 0
) -> Motion:
    """Let a policy reach on a surrogate, or on the nominal robot, and return the motion to watch.

    Args:
        policy: ONNX file; None for the shipped policy.
        serial: of the surrogate; None for the nominal robot.
        episodes: how many, one after the other.
        seed: of targets and start poses.
    """
    from robotbrain.rl.onnx_policy import OnnxPolicy
    from robotbrain.rl.surrogate import SurrogateReachEnv, neutral
    from robotbrain.rl.view import Motion

    if serial is None:
        env = SurrogateReachEnv([0], seed, params=[neutral(7)], ramp_s=0.0)
    else:
        env = SurrogateReachEnv([serial], seed)
    done = env.run(OnnxPolicy(policy or shipped_policy()), episodes, record=True)
    assert done.qpos is not None
    label = "simulation" if serial is None else f"surrogate {serial}"
    label += f": {int(done.success.sum())} of {episodes} reached"
    qpos = done.qpos.reshape(-1, done.qpos.shape[-1])
    targets = np.repeat(done.target, done.distance.shape[1], axis=0)
    return Motion(label, env.fleet.body.model, qpos, 0.04, targets, trace="ee")


def gap_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``robotbrain rl gap``."""
    parser.add_argument("policies", type=Path, nargs="*", help="ONNX policies to measure (default: the shipped study)")
    parser.add_argument("--train", type=Path, metavar="FOLDER", help="train the study's policies into this folder")
    parser.add_argument("--variants", nargs="+", default=["plain", "randomised"], help="what to train (see --list)")
    parser.add_argument("--list", action="store_true", help="list the variants and what they randomise")
    parser.add_argument("--seeds", type=int, default=5, help="trainings per variant (default 5)")
    parser.add_argument("--steps", type=int, default=STEPS, help=f"of each training (default {STEPS})")
    parser.add_argument("--episodes", type=int, default=2, help="per surrogate (default 2)")
    parser.add_argument("--json", type=Path, help="write the report to this file")
    parser.add_argument("--plot", type=Path, help="write the figure to this file (png, svg or pdf)")


def gap_main(arguments: argparse.Namespace) -> int:
    """Show the gap between simulation and surrogates."""
    if arguments.list:
        for name, terms in VARIANTS.items():
            print(f"{name:20} {', '.join(terms) or 'nothing'}")
        return 0
    if arguments.policies:
        from robotbrain.rl.onnx_policy import OnnxPolicy

        rows = {path.stem: {0: measure(OnnxPolicy(path), episodes=arguments.episodes)} for path in arguments.policies}
        report = GapReport(rows, {"serials": list(SERIALS), "episodes": arguments.episodes})
    elif arguments.train is not None:
        options = StudyOptions(
            arguments.variants, tuple(range(arguments.seeds)), arguments.steps, episodes=arguments.episodes
        )
        report = study(options, arguments.train)
    else:
        report = shipped_report()
    print(report.table())
    if arguments.json:
        print(report.save(arguments.json))
    if arguments.plot:
        from robotbrain.figures import save

        print(save(report.plot(), arguments.plot))
    return 0
