"""What the analyser takes and what it refuses: files, axes, control flow, functions, damage."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnx.parser
import pytest
from onnx import TensorProto, helper
from tests.jetson.graph_builders import Shape, model, node

from robotbrain.errors import InputError
from robotbrain.jetson.graph import analyse
from robotbrain.jetson.kernels import KernelGraph

REPO = Path(__file__).resolve().parents[2]
GRAPHS = REPO / "tests" / "data" / "graphs"


def conv(*shape: int | str | None) -> onnx.ModelProto:
    return model([node("Conv", "x w", "y", pads=[1, 1, 1, 1])], {"x": shape}, ["y"], {"w": (4, 3, 3, 3)})


# --- ways to give a model


def test_path_bytes_and_proto_agree(tmp_path: Path) -> None:
    proto = conv(1, 3, 8, 8)
    before = proto.SerializeToString()
    path = tmp_path / "net.onnx"
    path.write_bytes(before)
    graphs = [analyse(path), analyse(str(path)), analyse(before), analyse(proto)]
    assert [graph.kernels for graph in graphs] == [graphs[0].kernels] * 4
    assert [graph.sha256 for graph in graphs] == [hashlib.sha256(before).hexdigest()] * 3 + [""]
    assert [graph.name for graph in graphs] == ["net", "net", "test", "test"]
    assert proto.SerializeToString() == before
    assert analyse(path, name="mine").name == "mine"
    assert graphs[0].inputs == {"x": (1, 3, 8, 8)}
    assert graphs[0].outputs == {"y": (1, 4, 8, 8)}
    assert graphs[0].opset == 17


def test_weights_may_be_missing_stored_external_or_generated() -> None:
    expected = analyse(conv(1, 3, 8, 8))
    stored = model(
        [node("Conv", "x w", "y", pads=[1, 1, 1, 1])],
        {"x": (1, 3, 8, 8)},
        ["y"],
        {"w": np.ones((4, 3, 3, 3), np.float32)},
    )
    external = conv(1, 3, 8, 8)
    weight = external.graph.initializer[0]
    weight.data_location = TensorProto.EXTERNAL
    weight.external_data.add(key="location", value="there/is/no/such.file")
    generated = model(
        [node("ConstantOfShape", "s", "g"), node("Identity", "g", "w"), node("Conv", "x w", "y", pads=[1] * 4)],
        {"x": (1, 3, 8, 8)},
        ["y"],
        {"s": np.array([4, 3, 3, 3])},
    )
    listed = conv(1, 3, 8, 8)  # before IR 4, initialisers were inputs too
    listed.graph.input.append(helper.make_tensor_value_info("w", TensorProto.FLOAT, (4, 3, 3, 3)))
    for proto in (stored, external, generated, listed):
        graph = analyse(proto)
        assert [kernel.macs for kernel in graph.kernels] == [64 * 4 * 27]
        assert (graph.weight_elems, graph.weight_bytes) == (expected.weight_elems, expected.weight_bytes) == (108, 432)
        assert graph.inputs == {"x": (1, 3, 8, 8)}


def test_the_repositorys_own_network() -> None:
    graph = analyse(REPO / "src" / "robotbrain" / "pipeline" / "weights" / "segmentation.onnx")
    stored = onnx.load(REPO / "src" / "robotbrain" / "pipeline" / "weights" / "segmentation.onnx")
    assert graph.weight_elems == sum(
        int(np.prod(item.dims)) for item in stored.graph.initializer if item.data_type == 1 and len(item.dims)
    )
    assert {kernel.op for kernel in graph.kernels} == {"conv", "mem:resize"}
    assert all(kernel.dla_reason == "" for kernel in graph.kernels)


def test_importing_the_package_does_not_import_onnx() -> None:
    import subprocess
    import sys

    code = "import sys, robotbrain.jetson.graph; print('onnx' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


# --- dynamic axes


@pytest.mark.parametrize(
    ("shape", "bindings"),
    [
        (("batch", 3, "height", "width"), {"height": 8, "width": 6}),
        (("batch", 3, "height", "width"), {"batch": 1, "height": np.int64(8), "x:3": 6}),
        ((None, 3, None, None), {"x:0": 1, "x:2": 8, "x:3": 6}),
        (("N", 3, 8, 6), None),
        (("N", 3, 8, 6), {"x:2": 8}),
    ],
)
def test_axes_are_bound(shape: Shape, bindings: dict[str, int] | None) -> None:
    graph = analyse(conv(*shape), bindings=bindings)
    assert graph.inputs == {"x": (1, 3, 8, 6)}
    assert graph.outputs == {"y": (1, 4, 8, 6)}
    assert any("batch" in text for text in graph.warnings) == (
        isinstance(shape[0], str) and "batch" not in (bindings or {})
    )


def test_binding_scales_the_work() -> None:
    once, thrice = (analyse(conv("batch", 3, 8, 8), bindings={"batch": batch}) for batch in (1, 3))
    assert thrice.kernels == once.at_batch(3).kernels


@pytest.mark.parametrize(
    ("shape", "bindings", "words"),
    [
        (("batch", 3, "height", None), None, ("height", "x:3", "bindings")),
        ((1, 3, "batch", 8), None, ("batch", "x:2")),
        ((None, 3, 8, 8), None, ("nameless", "x:0")),
        ((1, 3, "h", 8), {"hight": 8, "h": 8}, ("hight", "h")),
        ((1, 3, 8, 8), {"x:2": 9}, ("x:2", "8")),
        ((1, 3, 8, 8), {"z": 9}, ("z", "x:2")),
        ((1, 3, "h", 8), {"h": 0}, ("h",)),
        ((1, 3, "h", 8), {"h": True}, ("h",)),
        ((1, 3, "h", 8), {"h": 2.5}, ("h",)),
        ((1, 3, "h", 8), {"h": 2**40}, ("h",)),
        ((1, "c", 8, 8), {"c": 5}, ("Conv", "(1, 5, 8, 8)")),
        (("h", 3, "h", "w"), {"h": 2**31 - 1, "w": 2**31 - 1}, ("shape",)),
    ],
)
def test_axes_that_cannot_be_bound(shape: Shape, bindings: Any, words: tuple[str, ...]) -> None:
    with pytest.raises(InputError) as caught:
        analyse(conv(*shape), bindings=bindings)
    assert all(word in str(caught.value) for word in words)
    assert "stumbles" not in str(caught.value)


def test_shapes_computed_from_shapes() -> None:
    # x.view(n, heads, c // heads, h * w).transpose(2, 3), resized to twice its rows: all of it spelt out.
    nodes = [
        node("Shape", "x", "s"),
        node("Gather", "s i0", "n"),
        node("Gather", "s i1", "c"),
        node("Gather", "s i2", "h"),
        node("Gather", "s i3", "w"),
        node("Div", "c two", "d"),
        node("Mul", "h w", "hw"),
        *(node("Unsqueeze", f"{name} axis", f"{name}_1") for name in ("n", "two", "d", "hw")),
        node("Concat", "n_1 two_1 d_1 hw_1", "shape", axis=0),
        node("Reshape", "x shape", "v"),
        node("Transpose", "v", "t", perm=[0, 1, 3, 2]),
        node("MatMul", "v t", "y"),
        node("Cast", "hw_1", "f", to=TensorProto.FLOAT),
        node("Div", "f f", "one"),
        node("Concat", "one one two_f one", "scales", axis=0),
        node("Resize", "x - scales", "z"),
    ]
    constants: dict[str, Any] = {f"i{axis}": np.array(axis) for axis in range(4)}
    constants |= {"two": np.array(2), "axis": np.array([0]), "two_f": np.array([2], np.float32)}
    graph = analyse(model(nodes, {"x": ("batch", 8, "h", "w")}, ["y", "z"], constants), bindings={"h": 5, "w": 7})
    assert graph.outputs == {"y": (1, 2, 4, 4), "z": (1, 8, 10, 7)}
    assert graph.macs == 2 * 4 * 4 * 35


# --- control flow, functions, custom operators


def branching(condition: bool | None) -> onnx.ModelProto:
    def branch(name: str, op: str) -> onnx.GraphProto:
        made = helper.make_node(op, ["x"], ["inner"], name=f"{name}_{op}")
        return helper.make_graph([made], name, [], [helper.make_tensor_value_info("inner", TensorProto.FLOAT, None)])

    choose = helper.make_node(
        "If", ["c"], ["y"], name="choose", then_branch=branch("then", "Exp"), else_branch=branch("else", "Softmax")
    )
    proto = model([choose], {"x": (1, 4)}, ["y"], {} if condition is None else {"c": np.array(condition)})
    if condition is None:
        proto.graph.input.append(helper.make_tensor_value_info("c", TensorProto.BOOL, []))
    return proto


@pytest.mark.parametrize(("condition", "op"), [(True, "pw"), (False, "mem:softmax")])
def test_an_if_with_a_known_condition_is_its_branch(condition: bool, op: str) -> None:
    assert [kernel.op for kernel in analyse(branching(condition)).kernels] == [op]


def test_control_flow_that_depends_on_data_is_refused() -> None:
    with pytest.raises(InputError, match="control flow"):
        analyse(branching(None))
    body = helper.make_graph([], "body", [], [])
    for op in ("Loop", "Scan"):
        loop = helper.make_node(op, ["n"], ["y"], name="again", body=body)
        with pytest.raises(InputError, match=f"(?s)again.*{op}.*control flow"):
            analyse(model([loop], {"x": (1,)}, ["y"], {"n": np.array(3)}))


def test_local_functions_are_inlined() -> None:
    text = """
    <ir_version: 8, opset_import: ["" : 17, "mine" : 1]>
    net (float[1, 8] x) => (float[1, 4] y) <float[8, 4] w> { h = mine.swish(x)
      y = MatMul(h, w) }
    <domain: "mine", opset_import: ["" : 17]>
    swish (a) => (b) { s = Sigmoid(a)
      b = Mul(a, s) }
    """
    proto = onnx.parser.parse_model(text)
    proto.graph.initializer.append(TensorProto(name="w", dims=(8, 4), data_type=1))
    graph = analyse(proto)
    assert [kernel.op for kernel in graph.kernels] == ["pw", "mm"]
    assert graph.kernels[1].weight_elems == 32


def test_custom_operators_need_a_plugin_or_are_refused() -> None:
    nodes = [node("Wobble", "x", "a", domain="acme"), node("Relu", "a", "y")]
    declared = model(nodes, {"x": (1, 4)}, ["y"], domains={"acme": 1}, value_info={"a": (1, 9)})
    graph = analyse(declared)
    assert [kernel.op for kernel in graph.kernels] == ["mem:plugin", "pw"]
    assert graph.kernels[0].out_elems == 9
    assert any("acme::Wobble" in text for text in graph.warnings)
    with pytest.raises(InputError, match=r"(?s)Wobble.*acme"):
        analyse(model(nodes, {"x": (1, 4)}, ["y"], domains={"acme": 1}))
    with pytest.raises(InputError, match="Wobble"):
        analyse(model([node("Wobble", "x", "y")], {"x": (1, 4)}, ["y"]))


def test_outputs_whose_size_depends_on_data_are_counted_at_their_largest() -> None:
    nodes = [node("NonMaxSuppression", "boxes scores most", "y")]
    proto = model(nodes, {"boxes": (1, 50, 4), "scores": (1, 3, 50)}, ["y"], {"most": np.array([20])})
    graph = analyse(proto)
    assert graph.outputs == {"y": (60, 3)}
    assert graph.kernels[0].op == "mem:nms"
    assert graph.warnings


# --- damage


def broken_graph(change: Callable[[onnx.ModelProto], object]) -> bytes:
    proto = conv(1, 3, 8, 8)
    change(proto)
    return proto.SerializeToString()


def add_cycle(proto: onnx.ModelProto) -> None:
    proto.graph.node.append(node("Relu", "b", "a"))
    proto.graph.node.append(node("Relu", "a", "b"))
    proto.graph.output[0].name = "a"


BROKEN: dict[str, tuple[Any, str]] = {
    "empty": (b"", "empty"),
    "text": (b"this is no ONNX file, only a line of text", "parse"),
    "zeros": (bytes(1000), "parse"),
    "png": (b"\x89PNG\r\n\x1a\n" + bytes(64), "parse"),
    "truncated": (conv(1, 3, 8, 8).SerializeToString()[:-30], "parse"),
    "number": (12, "int"),
    "none": (None, "NoneType"),
    "no graph": (onnx.ModelProto(ir_version=8).SerializeToString(), "without a graph"),
    "a tensor": (TensorProto(dims=(3,), data_type=1, raw_data=bytes(12)).SerializeToString(), ""),
    "no outputs": (broken_graph(lambda m: m.graph.ClearField("output")), "outputs"),
    "no opset": (broken_graph(lambda m: m.ClearField("opset_import")), "opset"),
    "old opset": (broken_graph(lambda m: setattr(m.opset_import[0], "version", 6)), "version_converter"),
    "new opset": (broken_graph(lambda m: setattr(m.opset_import[0], "version", 999)), "999"),
    "cycle": (broken_graph(add_cycle), "cycle"),
    "missing input": (broken_graph(lambda m: m.graph.node[0].input.__setitem__(0, "nobody")), "nobody"),
    "missing output": (broken_graph(lambda m: setattr(m.graph.output[0], "name", "nobody")), "nobody"),
    "written twice": (broken_graph(lambda m: m.graph.node.append(m.graph.node[0])), "twice"),
    "negative weight": (broken_graph(lambda m: m.graph.initializer[0].dims.__setitem__(0, -4)), "-4"),
    "huge weight": (broken_graph(lambda m: m.graph.initializer[0].dims.__setitem__(0, 2**62)), str(2**62)),
    "unmatched weight": (broken_graph(lambda m: m.graph.initializer[0].dims.__setitem__(1, 5)), "Conv"),
    "half a weight": (broken_graph(lambda m: setattr(m.graph.initializer[0], "raw_data", bytes(10))), "fill"),
    "stride of zero": (
        broken_graph(lambda m: m.graph.node[0].attribute.append(helper.make_attribute("strides", [0, 0]))),
        "whole numbers of 1",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_models_are_refused_in_words(name: str) -> None:
    given, words = BROKEN[name]
    with pytest.raises(InputError) as caught:
        analyse(given)
    assert words in str(caught.value)
    assert "stumbles" not in str(caught.value)


def test_files_that_are_not_there(tmp_path: Path) -> None:
    for path, word in ((tmp_path / "none.onnx", "no such file"), (tmp_path, "directory"), ("a\0b", "no such file")):
        with pytest.raises(InputError, match=f"(?s){word}"):
            analyse(path)


def test_nothing_to_compute_is_a_graph_without_kernels() -> None:
    graph = analyse(model([node("Identity", "w", "y")], {"x": (1, 4)}, ["y"], {"w": (2, 3)}))
    assert graph.kernels == ()
    assert any("nothing is computed" in text for text in graph.warnings)
    # An input that is handed through has to be copied into the caller's buffer.
    assert [kernel.op for kernel in analyse(model([node("Identity", "x", "y")], {"x": (1, 4)}, ["y"])).kernels] == [
        "mem:copy"
    ]


def flipped(data: bytes, rng: np.random.Generator) -> bytes:
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        changed[int(rng.integers(len(changed)))] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def overwritten(data: bytes, rng: np.random.Generator) -> bytes:
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        changed[int(rng.integers(len(changed)))] = int(rng.integers(256))
    return bytes(changed)


def truncated(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: int(rng.integers(len(data)))]


def cut_out(data: bytes, rng: np.random.Generator) -> bytes:
    start = int(rng.integers(len(data)))
    return data[:start] + data[start + int(rng.integers(1, 40)) :]


NUMBERS = (0, -1, 1, 3, 2**31, 2**62, -(2**63))
OPERATORS = """
Add Attention BatchNormalization Cast Concat Constant ConstantOfShape Conv ConvTranspose DeformConv Einsum Expand Gather
Gemm If LSTM Loop MatMul NonMaxSuppression Pad QuantizeLinear Range Reshape Resize Shape Slice Softmax Split Tile TopK
Transpose Unknown
"""


def rewired(data: bytes, rng: np.random.Generator) -> bytes:
    """Break rules that a parser cannot see: operators, inputs, attributes, dimensions."""
    proto = onnx.ModelProto.FromString(data)
    graph = proto.graph
    item = graph.node[int(rng.integers(len(graph.node)))]
    number = int(rng.choice(np.array(NUMBERS)))
    kind = int(rng.integers(7))
    if kind == 0:
        item.op_type = str(rng.choice(np.array(OPERATORS.split())))
    elif kind == 1 and item.input:
        item.input[int(rng.integers(len(item.input)))] = str(rng.choice(np.array(["", graph.input[0].name])))
    elif kind == 2 and item.input:
        del item.input[int(rng.integers(len(item.input)))]
    elif kind == 3 and item.attribute:
        attribute = item.attribute[int(rng.integers(len(item.attribute)))]
        if attribute.ints:
            attribute.ints[int(rng.integers(len(attribute.ints)))] = number
        else:
            attribute.i = number
    elif kind == 4:
        weight = graph.initializer[int(rng.integers(len(graph.initializer)))]
        if weight.dims:
            weight.dims[int(rng.integers(len(weight.dims)))] = number
    elif kind == 5:
        graph.input[0].type.tensor_type.shape.dim[int(rng.integers(4))].dim_value = number
    else:
        graph.ClearField(str(rng.choice(np.array(["node", "input", "output", "initializer"]))))
    return proto.SerializeToString()


@pytest.mark.parametrize("damage", [flipped, overwritten, truncated, cut_out, rewired], ids=lambda f: f.__name__)
@pytest.mark.parametrize("name", ["squeezenet1_0", "alexnet", "resnet18", "efficientvit_b1_224"])
def test_damaged_files_give_a_graph_or_an_input_error(
    name: str, damage: Callable[[bytes, np.random.Generator], bytes]
) -> None:
    data = (GRAPHS / f"{name}.onnx").read_bytes()
    rng = np.random.default_rng([len(name), len(damage.__name__)])
    refused = 0
    for _ in range(15 if name.startswith("efficient") else 50):
        damaged = damage(data, rng)
        try:
            assert isinstance(analyse(damaged), KernelGraph)
        except InputError as error:
            refused += 1
            # The catch-all is for what nobody thought of; what is thought of has a message of its own.
            assert "stumbles" not in str(error)
    assert refused


def test_weights_are_not_copied(monkeypatch: pytest.MonkeyPatch) -> None:
    """A file of 100 MB takes little more than itself: the content of large weights is never touched."""
    size = 5_000_000
    weights = {f"w{index}": np.zeros((size // 1000, 1000), np.float32) for index in range(5)}
    chain = [node("MatMul", "x w0", "a0")] + [node("MatMul", f"x w{index}", f"a{index}") for index in range(1, 5)]
    proto = model(chain, {"x": (1, size // 1000)}, [f"a{index}" for index in range(5)], weights)
    data = proto.SerializeToString()
    assert len(data) > 100_000_000

    def forbidden(tensor: TensorProto, *_: object) -> None:
        raise AssertionError(f"{tensor.name} was read")

    monkeypatch.setattr(onnx.numpy_helper, "to_array", forbidden)
    graph = analyse(data)
    assert graph.macs == graph.weight_elems == 5 * size
