"""What the exporter writes, as far as it can be judged without Isaac Lab (the rest: tests/conformance_isaaclab)."""

from __future__ import annotations

import argparse
import ast
import builtins
import math
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from robotbrain.errors import InputError
from robotbrain.rl import mdp
from robotbrain.rl.isaaclab.commands import export_isaaclab_arguments, export_isaaclab_main
from robotbrain.rl.isaaclab.export import export_isaaclab
from robotbrain.rl.managers import ObservationTermCfg, RewardTermCfg, SceneEntityCfg
from robotbrain.rl.robots import arm_mjcf
from robotbrain.rl.tasks.reach import ReachEnvCfg
from robotbrain.rl.tasks.velocity import VelocityEnvCfg
from tests.conformance_isaaclab.student_task import StudentEnvCfg, StudentPPOCfg


def export(cfg: Any, folder: Path, **kwargs: Any) -> str:
    return export_isaaclab(cfg, folder, **kwargs)[0].read_text(encoding="utf-8")


def undefined(source: str) -> set[str]:
    """Names that the module uses and does not define, annotations aside."""
    tree = ast.parse(source)
    names = {n.id for n in ast.walk(tree) if isinstance(n, ast.Name)}
    defined = {n.id for n in ast.walk(tree) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
    defined |= {n.arg for n in ast.walk(tree) if isinstance(n, ast.arg)}
    defined |= {n.name for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.ClassDef)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            defined |= {(a.asname or a.name).partition(".")[0] for a in node.names}
    return {n for n in names - defined if not hasattr(builtins, n) and n != "__file__" and n != "__name__"}


@pytest.fixture(scope="module")
def student(tmp_path_factory: pytest.TempPathFactory) -> str:
    return export(StudentEnvCfg(), tmp_path_factory.mktemp("student"), name="student", agent=StudentPPOCfg())


def test_the_file_stands_alone(student: str) -> None:
    code = student.partition('"""\n')[2]
    assert "robotbrain" not in code.partition('"""')[2].replace("exported from robotbrain", "")
    assert undefined(student) == set()
    compile(student, "student", "exec")


def test_own_terms_are_copied_with_what_they_need_and_others_named(student: str) -> None:
    tree = ast.parse(student)
    defined = [n.name for n in tree.body if isinstance(n, ast.FunctionDef | ast.ClassDef)]
    for name in ("hand_points_down", "_hand_axis", "near_bonus", "held_still", "InputError", "body_pos_b",
                 "CommandDelay", "HeldRelativeJointPositionAction", "randomize_motor_strength"):  # fmt: skip
        assert defined.count(name) == 1, name
    assert defined.index("_hand_axis") < defined.index("hand_points_down")
    assert "BONUS_RADIUS = 0.05" in student and "AXIS = torch.tensor([0.0, 0.0, -1.0]" in student
    assert "mdp.position_command_error(env, command_name, asset_cfg) < BONUS_RADIUS" in student
    assert "func=mdp.joint_pos_rel" in student and "position_command_error" not in defined
    assert "import isaaclab_tasks.core.velocity.mdp as mdp" in student


def test_a_reset_event_puts_the_robot_back_first(student: str) -> None:
    events = student[student.index("class EventsCfg") :]
    assert events.index("mdp.reset_scene_to_default") < events.index("randomize_action_latency")


def test_the_robots_file_is_the_robot_alone(tmp_path: Path) -> None:
    written = export_isaaclab(StudentEnvCfg(), tmp_path, name="student")
    model = mujoco.MjModel.from_xml_path(str(written[1]))
    whole = mujoco.MjModel.from_xml_string(arm_mjcf())
    assert model.nu == 0 and model.nlight == 0 and model.nbody == whole.nbody
    assert [model.joint(j).name for j in range(model.njnt)] == [whole.joint(j).name for j in range(whole.njnt)]
    np.testing.assert_allclose(model.body_mass, whole.body_mass)
    np.testing.assert_allclose(model.jnt_range, whole.jnt_range)
    assert model.ngeom == whole.ngeom - 1  # the floor


def test_equal_configurations_give_equal_bytes(tmp_path: Path) -> None:
    first = [p.read_bytes() for p in export_isaaclab(VelocityEnvCfg(), tmp_path / "a", name="velocity")]
    second = [p.read_bytes() for p in export_isaaclab(VelocityEnvCfg(), tmp_path / "b", name="velocity")]
    assert first == second
    assert b"only_positive_rewards" in first[0] and b"FL_hip_joint" in first[2]


def _closure(limit: float) -> Any:
    def term(env: Any) -> torch.Tensor:
        return env.scene["robot"].data.joint_pos.torch.sum(1) > limit

    return term


def peeks_below(env: Any) -> torch.Tensor:
    return torch.from_numpy(env.scene.world.qpos).sum(1)


def uses_the_kit(env: Any) -> torch.Tensor:
    return torch.full((env.num_envs,), len(arm_mjcf()))


exec("def typed_in(env):\n    return env.episode_length_buf")  # a function that has no file


@pytest.mark.parametrize(
    ("func", "words"),
    [
        (lambda env: env.episode_length_buf, "top of a module"),
        (_closure(1.0), "top of a module"),
        (peeks_below, "scene.world"),
        (uses_the_kit, "Isaac Lab has too"),
        (globals()["typed_in"], "source Python can find"),
    ],
)
def test_terms_that_cannot_be_copied_are_named(func: Any, words: str, tmp_path: Path) -> None:
    cfg = ReachEnvCfg()
    cfg.rewards.mine = RewardTermCfg(func=func, weight=1.0)
    with pytest.raises(InputError, match=words) as caught:
        export(cfg, tmp_path)
    assert "rewards.mine.func" in caught.value.what
    assert not list(tmp_path.iterdir())  # nothing half-written


def test_values_that_are_no_code_are_refused(tmp_path: Path) -> None:
    cfg = ReachEnvCfg()
    cfg.observations.policy.extra = ObservationTermCfg(
        func=mdp.joint_pos, params={"asset_cfg": SceneEntityCfg("robot", joint_ids=torch.tensor([1]))}
    )
    with pytest.raises(InputError, match="tolist"):
        export(cfg, tmp_path)
    with pytest.raises(InputError, match="identifier"):
        export(ReachEnvCfg(), tmp_path, name="my task")


def test_special_numbers_and_texts_survive(tmp_path: Path) -> None:
    cfg = ReachEnvCfg()
    cfg.observations.policy.extra = ObservationTermCfg(func=mdp.joint_pos, clip=(-math.inf, 1e-9), scale=(1.0,) * 7)
    text = export(cfg, tmp_path)
    assert "clip=(-math.inf, 1e-09)" in text and "import math" in text


def test_the_command_exports_tasks_and_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    parser = argparse.ArgumentParser()
    export_isaaclab_arguments(parser)
    assert export_isaaclab_main(parser.parse_args(["velocity", "--out", str(tmp_path / "v")])) == 0
    assert "VelocityPPORunnerCfg" in (tmp_path / "v" / "velocity_isaaclab.py").read_text(encoding="utf-8")
    mine = tmp_path / "my_task.py"
    mine.write_text("from tests.conformance_isaaclab.student_task import StudentEnvCfg as MyEnvCfg\n", encoding="utf-8")
    assert (
        export_isaaclab_main(parser.parse_args([f"{mine}:MyEnvCfg", "--name", "mine", "--out", str(tmp_path / "m")]))
        == 0
    )
    assert (tmp_path / "m" / "mine_isaaclab.py").exists()
    assert "mine_isaaclab.py" in capsys.readouterr().out
    with pytest.raises(InputError, match="a file that exists"):
        export_isaaclab_main(parser.parse_args([str(tmp_path / "none.py") + ":X"]))
