"""``robotbrain drive --network --precision``: the network that is named sees, and is the one that is paid for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from robotbrain import cli
from robotbrain.jetson import load_profile
from robotbrain.pipeline import brain, commands
from robotbrain.pipeline.brain import default_model, drive


class Asked(Exception):  # noqa: N818
    """What the command asked of ``drive``."""


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a function that runs the command and returns what it asks of ``drive``, without driving."""

    def stop(*_: object, **keywords: object) -> None:
        raise Asked(keywords)

    def ask(*words: object) -> dict[str, Any]:
        monkeypatch.setattr(brain, "drive", stop)
        with pytest.raises(Asked) as caught:
            cli.main(["drive", *map(str, words)])
        return dict(caught.value.args[0])

    return ask


def student(folder: Path, classes: int = 4) -> Path:
    """Return the path of a segmentation network of one convolution that takes every pixel for floor."""
    bias = numpy_helper.from_array(np.eye(classes, dtype=np.float32)[1], "b")
    weight = numpy_helper.from_array(np.zeros((classes, 3, 1, 1), np.float32), "w")
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, ["n", 3, 64, 64])
    logits = helper.make_tensor_value_info("logits", TensorProto.FLOAT, ["n", classes, 64, 64])
    nodes = [helper.make_node("Conv", ["image", "w", "b"], ["logits"])]
    graph = helper.make_graph(nodes, "g", [image], [logits], [weight, bias])
    path = folder / f"student{classes}.onnx"
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8), path)
    return path


def test_a_default_drive_is_what_it_was(asked: Any) -> None:
    found = asked("--seeds", "6000")
    assert found["deployment"] is None and found["model"] is None
    plain, named = (drive(5, time_limit=2.0, model=model) for model in (None, default_model()))
    assert plain.log_sha256 == named.log_sha256


def test_the_named_network_sees_and_is_paid_for(asked: Any, tmp_path: Path) -> None:
    path = student(tmp_path)
    found = asked("--network", path, "--precision", "int8")
    assert found["model"] == path and found["deployment"].precision == "int8" and found["deployment"].network is None
    usual, run = drive(5, time_limit=2.0), drive(5, time_limit=2.0, model=path, deployment=found["deployment"])
    assert run.log_sha256 != usual.log_sha256


def test_a_deployment_for_large_images_pays_for_the_named_network_there(asked: Any, tmp_path: Path) -> None:
    path = student(tmp_path)
    usual = asked("--deployment", "detector")["deployment"]
    found = asked("--deployment", "detector", "--network", path)["deployment"]
    assert usual.network is not None and found.network is None
    assert found.image_size == usual.image_size == (640, 480)
    assert asked("--deployment", "detector", "--precision", "fp32")["deployment"].network == usual.network
    profile = load_profile("nano-4gb")
    slow, fast = (drive(5, time_limit=2.0, profile=profile, model=path, deployment=d) for d in (usual, found))
    gap = profile.network_ms(usual.network, "fp16", (640, 480)) - profile.network_ms(path, "fp16", (640, 480))
    assert gap > 20  # ms
    assert np.median(slow.perception_ms) - np.median(fast.perception_ms) == pytest.approx(gap, rel=0.1)


def test_precision_alone_changes_the_cost_only(asked: Any) -> None:
    found = asked("--precision", "fp32")
    assert found["model"] is None and found["deployment"].precision == "fp32"


def test_what_is_no_network_for_this_robot_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "text.onnx").write_text("text")
    for path, word in ((student(tmp_path, classes=7), "floor"), (tmp_path / "text.onnx", "valid ONNX"),
                       (tmp_path / "missing.onnx", "missing.onnx")):  # fmt: skip
        assert cli.main(["drive", "--network", str(path)]) == 2
        assert word in capsys.readouterr().err
    assert cli.main(["drive", "--robot", "ros", "--network", str(student(tmp_path))]) == 2
    assert "--network" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        cli.main(["drive", "--precision", "int4"])
    assert {"network", "precision"} <= set(commands.SIMULATED_ONLY)
