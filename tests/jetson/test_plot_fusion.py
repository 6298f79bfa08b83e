"""The strip of nodes and kernels: every node is where the analysis puts it, and the words say what is drawn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
from tests.jetson.graph_builders import model, node

from robotbrain.errors import InputError
from robotbrain.jetson.graph import analyse
from robotbrain.jetson.plot_fusion import fusion, plot_fusion
from robotbrain.jetson.plots import alt_text
from robotbrain.pipeline.brain import default_model


def small(path: Path, convolutions: int = 2) -> Path:
    """Convolutions with ReLU on one image, joined with it, and an Identity of the weights."""
    nodes, last = [node("Identity", "stored", "w")], "image"
    for index in range(convolutions):
        nodes.append(node("Conv", f"{last} w", f"conv{index}", pads=[1, 1, 1, 1]))
        nodes.append(node("Relu", f"conv{index}", f"relu{index}"))
        last = f"relu{index}"
    nodes.append(node("Concat", f"{last} image", "join", axis=1))
    onnx.save(model(nodes, {"image": [1, 4, 8, 8]}, ["join"], {"stored": np.ones((4, 4, 3, 3), np.float32)}), str(path))
    return path


def test_every_node_has_the_kernel_that_it_runs_in(tmp_path: Path) -> None:
    nodes, graph = fusion(small(tmp_path / "net.onnx"))
    assert [operator for operator, _ in nodes] == ["Identity", "Conv", "Relu", "Conv", "Relu", "Concat"]
    homes = [home for _, home in nodes]
    assert homes[0] is None and homes[1] == homes[2] and homes[3] == homes[4] and homes[1] != homes[3]
    for name, (_, home) in zip(("w", "conv0", "relu0", "conv1", "relu1", "join"), nodes, strict=True):
        assert (home is None) == all(name not in kernel.layers for kernel in graph.kernels)
        assert home is None or name in graph.kernels[home].layers


def test_the_picture_has_a_box_for_each_node_and_each_kernel(tmp_path: Path) -> None:
    paths = {"small": small(tmp_path / "a.onnx"), "ours": default_model()}
    figure = plot_fusion(paths)
    assert len(figure.axes) == 2
    for axes, (name, path) in zip(figure.axes, paths.items(), strict=True):
        nodes, kernels = onnx.load(path).graph.node, analyse(path).kernels
        assert len(axes.patches) == len(nodes) + len(kernels)
        words = f"{name}: {len(nodes)} ONNX nodes"
        assert words in alt_text(figure) and axes.get_title(loc="left").startswith(words)
        numbers = {text.get_text() for text in axes.texts if text.get_text().isdigit()}
        assert numbers == {str(index + 1) for index in range(len(kernels))}


def test_what_cannot_be_drawn_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="0 nodes"):
        plot_fusion({})
    with pytest.raises(InputError, match="1 to 10 nodes"):
        plot_fusion({"long": small(tmp_path / "long.onnx", convolutions=6)}, longest=10)
    with pytest.raises(InputError):
        plot_fusion({"none": tmp_path / "missing.onnx"})
