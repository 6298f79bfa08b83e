"""Replays: places against MuJoCo's, shapes against their geoms' sizes, refusals."""

from __future__ import annotations

import base64
import itertools
import json
import re
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from robotbrain import rl
from robotbrain.errors import InputError
from robotbrain.rl.robots import arm_mjcf, quadruped_mjcf
from robotbrain.rl.view import Motion, MotionReplay, shapes

pytest.importorskip("meshcat")
umsgpack = pytest.importorskip("umsgpack")


def _commands(page: str) -> list[dict[str, Any]]:
    data = re.search(r"for \(const text of (\[.*?\])\)", page, re.S)
    assert data is not None
    return [umsgpack.unpackb(base64.b64decode(text)) for text in json.loads(data.group(1))]


def _arm(steps: int = 12) -> tuple[mujoco.MjModel, np.ndarray]:
    model = mujoco.MjModel.from_xml_string(arm_mjcf())
    swing = np.sin(np.arange(steps) / 4)[:, None] * np.linspace(0.2, 0.8, 7)
    return model, model.qpos0 + swing


def test_the_page_moves_every_link_as_mujoco_does() -> None:
    model, qpos = _arm()
    page = MotionReplay([Motion("arm", model, qpos, 0.04, targets=(0.5, 0.0, 0.3), trace="ee")]).static_html()
    commands = _commands(page)
    clips = next(c for c in commands if c["type"] == "set_animation")["animations"]
    data = mujoco.MjData(model)
    checked = 0
    for clip in clips:
        match = re.search(r"motion0/body(\d+)$", clip["path"])
        if not match:
            continue
        keys = {track["name"]: track["keys"] for track in clip["clip"]["tracks"]}
        places, turns = keys[".position"], keys[".quaternion"]
        assert len(places) == len(qpos) + 1  # the last moment is held
        for step, (place, turn) in enumerate(zip(places[:-1], turns[:-1], strict=True)):
            data.qpos[:] = qpos[step]
            mujoco.mj_kinematics(model, data)
            body = int(match.group(1))
            assert place["time"] == pytest.approx(step * 0.04)
            np.testing.assert_allclose(place["value"], data.xpos[body], atol=1e-4)
            wxyz = np.array(turn["value"])[[3, 0, 1, 2]]
            assert abs(np.dot(wxyz, data.xquat[body])) == pytest.approx(1.0, abs=1e-4)
        signs = [np.dot(a["value"], b["value"]) for a, b in itertools.pairwise(turns)]
        assert min(signs) > 0.0  # no spin by a jump of sign
        checked += 1
    assert checked == 8  # seven links and the hand
    assert any("target" in c.get("path", "") for c in commands)
    assert any(c.get("path", "").endswith("path") for c in commands)


def test_robots_stand_side_by_side_and_the_caption_says_who() -> None:
    model, qpos = _arm(3)
    page = MotionReplay(
        [Motion("simulation", model, qpos, 0.04), Motion("<surrogate> 7", model, qpos, 0.04)]
    ).static_html()
    assert "simulation | &lt;surrogate&gt; 7 (left to right)" in page
    roots = {c["path"].strip("/").split("/")[-1]: c["matrix"] for c in _commands(page) if c["type"] == "set_transform"}
    # seen from +x, left is -y; the matrix is column by column
    assert roots["motion0"][13] < roots["motion1"][13] - 0.5


def test_same_motion_same_bytes(tmp_path: Path) -> None:
    model, qpos = _arm(3)
    files = [MotionReplay([Motion("a", model, qpos, 0.04)]).to_html(tmp_path / f"{i}.html") for i in range(2)]
    assert files[0].read_bytes() == files[1].read_bytes()
    assert 500_000 < files[0].stat().st_size < 2_000_000


def test_the_quadruped_shows_in_a_notebook() -> None:
    model = mujoco.MjModel.from_xml_string(quadruped_mjcf())
    assert "<iframe" in MotionReplay([Motion("quadruped", model, model.qpos0[None], 0.02)])._repr_html_()


def test_shapes_have_the_geoms_sizes() -> None:
    size = np.array([0.1, 0.2, 0.3])
    ((box, _),) = shapes(int(mujoco.mjtGeom.mjGEOM_BOX), size)
    assert list(box.lengths) == [0.2, 0.4, 0.6]
    capsule = shapes(int(mujoco.mjtGeom.mjGEOM_CAPSULE), size)
    assert [type(s).__name__ for s, _ in capsule] == ["Cylinder", "Sphere", "Sphere"]
    assert capsule[0][0].height == 0.4
    # meshcat's cylinder stands along y: its axis must become z
    np.testing.assert_allclose(capsule[0][1][:3, :3] @ [0.0, 1.0, 0.0], [0.0, 0.0, 1.0])
    assert sorted(float(m[2, 3]) for _, m in capsule[1:]) == [-0.2, 0.2]
    assert shapes(int(mujoco.mjtGeom.mjGEOM_PLANE), size) == []


@pytest.mark.parametrize(
    "changes",
    [
        {"qpos": np.zeros((3, 6))},
        {"qpos": np.zeros((0, 7))},
        {"qpos": np.full((3, 7), np.nan)},
        {"dt_s": 0.0},
        {"targets": np.zeros((2, 3))},
        {"trace": "elbow"},
    ],
)
def test_bad_motions_are_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        Motion(**{"label": "arm", "model": arm_mjcf(), "qpos": np.zeros((3, 7)), "dt_s": 0.04, **changes})


def test_a_navigating_robot_is_seen_among_its_own_obstacles() -> None:
    from robotbrain.rl.recording import record_task

    motion = record_task(Path(rl.__file__).parent / "weights" / "navigation.onnx", seconds=1.0, seed=3)
    model = motion.model
    assert isinstance(model, mujoco.MjModel)
    places = model.body_pos[np.flatnonzero(model.body_mocapid >= 0), :2]
    assert len(np.unique(places.round(3), axis=0)) > 3  # not all where the model file parks them
    qpos = np.asarray(motion.qpos)
    assert motion.dt_s * (len(qpos) - 1) == pytest.approx(1.0, abs=motion.dt_s)
    assert np.linalg.norm(qpos[-1, :2] - qpos[0, :2]) > 0.05  # it drove


def test_no_motion_is_refused() -> None:
    with pytest.raises(InputError):
        MotionReplay([])
