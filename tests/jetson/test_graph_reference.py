"""The analyser against other tools: kernel lists made from torch graphs, published figures, ONNX Runtime, torch."""

from __future__ import annotations

import importlib.util
import io
import json
import logging
import math
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from torch import nn
from torch.nn import functional
from torch.utils.flop_counter import FlopCounterMode

from robotbrain.jetson.graph import analyse
from robotbrain.jetson.kernels import KernelGraph

REPO = Path(__file__).resolve().parents[2]
GRAPHS = sorted((REPO / "tests" / "data" / "graphs").glob("*.onnx"))
REFERENCE: dict[str, list[dict[str, Any]]] = json.loads(
    (REPO / "autograder" / "profiles" / "calibration" / "kernels.json").read_text(encoding="utf-8")
)
LIGHT = sorted((Path(onnx.__file__).parent / "backend" / "test" / "data" / "light").glob("light_*.onnx"))

# GFLOPS columns (which count MACs) of https://docs.pytorch.org/vision/stable/models.html#table-of-all-available-classification-weights,
# and 569 million mult-adds from table 8 of MobileNets, https://arxiv.org/abs/1704.04861.
PUBLISHED_GMACS = {
    "densenet121": 2.83,
    "densenet201": 4.29,
    "inception_v3": 5.71,
    "mobilenet_v1_1p0_224": 0.569,
    "resnet18": 1.81,
    "resnet50": 4.09,
    "squeezenet1_0": 0.82,
    "vgg11": 7.61,
    "vgg19": 19.63,
    # The light models of onnx are of the same architectures; its SqueezeNet is version 1.1.
    "light_densenet121": 2.83,
    "light_resnet50": 4.09,
    "light_squeezenet": 0.35,
    "light_vgg19": 19.63,
}


def totals(kernels: list[dict[str, Any]]) -> Counter[str]:
    counter: Counter[str] = Counter()
    for kernel in kernels:
        counter.update({key: kernel[key] for key in ("macs", "in_elems", "out_elems", "weight_elems")})
    return counter


def as_dicts(graph: KernelGraph) -> list[dict[str, Any]]:
    return [
        {key: getattr(kernel, key) for key in ("op", "macs", "in_elems", "out_elems", "weight_elems")}
        for kernel in graph.kernels
    ]


def test_all_reference_graphs_are_there() -> None:
    assert len(GRAPHS) == 13
    assert len(LIGHT) == 9


@pytest.mark.parametrize("path", GRAPHS, ids=lambda path: path.stem)
def test_kernels_are_those_of_the_calibration_data(path: Path) -> None:
    ours, theirs = as_dicts(analyse(path)), REFERENCE[path.stem]
    assert len(ours) == len(theirs)
    mine, reference = totals(ours), totals(theirs)
    assert mine["macs"] == reference["macs"]
    for key in ("in_elems", "out_elems", "weight_elems"):
        # Only efficientvit differs: its quotient is a kernel of its own here, and has no size there.
        assert mine[key] == pytest.approx(reference[key], rel=0.03), key

    def compute(kernels: list[dict[str, Any]]) -> Counter[tuple[Any, ...]]:
        return Counter(tuple(kernel.values()) for kernel in kernels if kernel["op"] in ("conv", "dw", "mm"))

    assert compute(ours) == compute([{key: kernel[key] for key in ours[0]} for kernel in theirs])


@pytest.mark.parametrize(
    "path", [path for path in GRAPHS + LIGHT if path.stem in PUBLISHED_GMACS], ids=lambda path: path.stem
)
def test_macs_are_the_published_ones(path: Path) -> None:
    assert analyse(path).macs / 1e9 == pytest.approx(PUBLISHED_GMACS[path.stem], rel=0.01)


def macs_by_running(path: Path) -> int:
    """Count MACs from the shapes of arrays that ONNX Runtime really makes, for convolutions and Gemms."""
    model = onnx.load(path)
    counted = [node for node in model.graph.node if node.op_type in ("Conv", "Gemm")]
    wanted = list(dict.fromkeys(name for node in counted for name in (node.output[0], node.input[1])))
    del model.graph.output[:]
    model.graph.output.extend(onnx.helper.make_empty_tensor_value_info(name) for name in wanted)
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    session = onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
    feeds = {item.name: np.zeros(item.shape, np.float32) for item in session.get_inputs() if len(item.shape) == 4}
    shapes = {name: value.shape for name, value in zip(wanted, session.run(wanted, feeds), strict=True)}
    macs = 0
    for node in counted:
        out, weight = shapes[node.output[0]], shapes[node.input[1]]
        depth = math.prod(weight[1:]) if node.op_type == "Conv" else math.prod(weight) // out[-1]
        macs += math.prod(out) * depth
    return macs


@pytest.mark.parametrize("path", LIGHT, ids=lambda path: path.stem)
def test_light_models_against_shapes_from_a_run(path: Path) -> None:
    graph = analyse(path)
    assert graph.macs == macs_by_running(path)
    assert not graph.warnings


def test_parameters_are_counted_once() -> None:
    # 61,100,840 parameters of AlexNet: torchvision's table; float32.
    graph = analyse(REPO / "tests" / "data" / "graphs" / "alexnet.onnx")
    assert graph.weight_elems == 61_100_840
    assert graph.weight_bytes == 4 * graph.weight_elems


class Attention(nn.Module):
    def __init__(self, width: int = 32, heads: int = 4) -> None:
        super().__init__()
        self.heads = heads
        self.qkv, self.out = nn.Linear(width, 3 * width), nn.Linear(width, width)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        batch, tokens, width = x.shape
        packed = self.qkv(x).reshape(batch, tokens, 3, self.heads, width // self.heads)
        query, key, value = packed.permute(2, 0, 3, 1, 4).unbind(0)
        weights = ((query @ key.transpose(-2, -1)) * (width // self.heads) ** -0.5).softmax(-1)
        result: torch.Tensor = self.out((weights @ value).transpose(1, 2).reshape(batch, tokens, width))
        return result


class VisionTransformer(nn.Module):
    def __init__(self, width: int = 32) -> None:
        super().__init__()
        self.patches = nn.Conv2d(3, width, 8, 8)
        self.token = nn.Parameter(torch.zeros(1, 1, width))
        self.position = nn.Parameter(torch.zeros(1, 17, width))
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(2))
        self.attention = Attention(width)
        self.mlp = nn.Sequential(nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width))
        self.head = nn.Linear(width, 10)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = self.patches(x).flatten(2).transpose(1, 2)
        x = torch.cat([self.token.expand(x.shape[0], -1, -1), x], 1) + self.position
        x = x + self.attention(self.norms[0](x))
        x = x + self.mlp(self.norms[1](x))
        result: torch.Tensor = self.head(x[:, 0])
        return result


class MobileBlock(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.expand = nn.Sequential(nn.Conv2d(16, 64, 1, bias=False), nn.BatchNorm2d(64), nn.ReLU6())
        self.depthwise = nn.Sequential(
            nn.Conv2d(64, 64, 3, padding=1, groups=64, bias=False), nn.BatchNorm2d(64), nn.Hardswish()
        )
        self.project = nn.Sequential(nn.Conv2d(64, 16, 1, bias=False), nn.BatchNorm2d(16))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        result: torch.Tensor = x + self.project(self.depthwise(self.expand(x)))
        return result


class UNet(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.first, self.second = self.block(3, 8), self.block(8, 16)
        self.up, self.merge, self.head = nn.ConvTranspose2d(16, 8, 2, 2), self.block(16, 8), nn.Conv2d(8, 2, 1)

    @staticmethod
    def block(inputs: int, outputs: int) -> nn.Sequential:
        return nn.Sequential(nn.Conv2d(inputs, outputs, 3, padding=1), nn.BatchNorm2d(outputs), nn.SiLU())

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        first = self.first(x)
        second = self.second(functional.max_pool2d(first, 2))
        merged = self.merge(torch.cat([self.up(second), first], 1))
        return functional.interpolate(self.head(merged), scale_factor=2.0, mode="bilinear")


class Recurrent(nn.Module):
    def __init__(self, layer: type[nn.LSTM] | type[nn.GRU]) -> None:
        super().__init__()
        self.layer, self.head = layer(16, 24, batch_first=True, bidirectional=True), nn.Linear(48, 3)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        result: torch.Tensor = self.head(self.layer(x)[0])
        return result


NETS: dict[str, tuple[nn.Module, tuple[int, ...], dict[str, int]]] = {
    # One kernel list by hand for each: what TensorRT is known to fuse, from the nets above.
    "vit": (
        VisionTransformer(),
        (1, 3, 32, 32),
        {"conv": 1, "mem:transpose": 2, "pw": 1, "mem:layer_norm": 2, "mm": 7, "mem:softmax": 1},
    ),
    "mobile_block": (MobileBlock(), (1, 16, 14, 14), {"conv": 2, "dw": 1}),
    "unet": (UNet(), (1, 3, 32, 32), {"conv": 5, "mem:max_pool": 1, "mem:resize": 1}),
    "lstm": (Recurrent(nn.LSTM), (1, 7, 16), {"mm": 2 * (1 + 7) + 1}),
    "gru": (Recurrent(nn.GRU), (1, 7, 16), {"mm": 2 * (1 + 7) + 1}),
}


# torch's newer exporter wants onnxscript, which this project does not need for anything else.
EXPORTERS = [False, True] if importlib.util.find_spec("onnxscript") else [False]


def exported(net: nn.Module, shape: tuple[int, ...], dynamo: bool) -> bytes:
    buffer: Any = io.BytesIO()  # taken, though torch's annotation leaves it out
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            opset = 18 if dynamo else 14
            torch.onnx.export(net, (torch.zeros(shape),), buffer, dynamo=dynamo, opset_version=opset, verbose=False)
    finally:
        logging.disable(logging.NOTSET)
    content: bytes = buffer.getvalue()
    return content


@pytest.mark.parametrize("name", NETS)
@pytest.mark.parametrize("dynamo", EXPORTERS)
@pytest.mark.filterwarnings("ignore:TF32 acceleration")
def test_macs_of_torch_exports_are_those_that_torch_counts(name: str, dynamo: bool) -> None:
    net, shape, kernels = NETS[name]
    net = net.eval()
    # Without oneDNN an LSTM is made of products that the counter sees.
    with torch.backends.mkldnn.flags(enabled=False), torch.no_grad(), FlopCounterMode(display=False) as counter:
        net(torch.zeros(shape))
    graph = analyse(exported(net, shape, dynamo), name=name)
    assert 2 * graph.macs == counter.get_total_flops()
    assert Counter(kernel.op for kernel in graph.kernels) == kernels
    # Exporters fold batch normalisation, leave out biases that are nothing and share equal ones.
    assert graph.weight_elems == pytest.approx(sum(parameter.numel() for parameter in net.parameters()), rel=0.1)
