"""Lint of Q/DQ models: a clean file, spoilt in one way at a time, gives exactly the finding for that."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from robotbrain.errors import InputError
from robotbrain.optimisation import qdq_placement, qdq_rules
from robotbrain.optimisation.ptq import quantise_onnx
from robotbrain.optimisation.qdq_lint import Finding, check, explain, lint
from tests.optimisation.onnx_nets import Net, images, save, unet


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("lint")


@pytest.fixture(scope="module")
def clean(folder: Path) -> bytes:
    source = save(unet(), folder / "net.onnx")
    return quantise_onnx(source, folder / "clean.onnx", images()).path.read_bytes()


class Patient:
    """A model to spoil."""

    def __init__(self, data: bytes) -> None:
        self.model = onnx.ModelProto.FromString(data)
        self.graph = self.model.graph

    def made(self, name: str) -> Any:
        return next(node for node in self.graph.node if name in node.output)

    def op(self, kind: str, place: int = 0) -> Any:
        return [node for node in self.graph.node if node.op_type == kind][place]

    def pair(self, name: str) -> tuple[Any, Any]:
        quantise = next(n for n in self.graph.node if n.op_type == "QuantizeLinear" and n.input[0] == name)
        return quantise, next(n for n in self.graph.node if n.input[0] == quantise.output[0])

    def store(self, name: str, value: Any) -> str:
        old = [tensor for tensor in self.graph.initializer if tensor.name == name]
        for tensor in old:
            self.graph.initializer.remove(tensor)
        self.graph.initializer.append(numpy_helper.from_array(np.asarray(value), name))
        return name

    def value(self, name: str) -> np.ndarray:
        return numpy_helper.to_array(next(tensor for tensor in self.graph.initializer if tensor.name == name))

    def insert_pair(self, reader: Any, position: int, scale: float = 0.1) -> None:
        name = reader.input[position]
        s, z = self.store(f"{name}_s", np.float32(scale)), self.store(f"{name}_z", np.int8(0))
        place = list(self.graph.node).index(reader)
        reader.input[position] = f"{name}_dq"
        self.graph.node.insert(
            place, helper.make_node("DequantizeLinear", [f"{name}_q", s, z], [f"{name}_dq"], "new_dq")
        )
        self.graph.node.insert(place, helper.make_node("QuantizeLinear", [name, s, z], [f"{name}_q"], "new_q"))

    def bypass(self, reader: Any, position: int) -> None:
        reader.input[position] = self.made(self.made(reader.input[position]).input[0]).input[0]


def set_axis(node: Any, axis: int | None) -> None:
    for attribute in [attribute for attribute in node.attribute if attribute.name == "axis"]:
        node.attribute.remove(attribute)
    if axis is not None:
        node.attribute.append(helper.make_attribute("axis", axis))


def opset(p: Patient) -> None:
    p.model.opset_import[0].version = 18


def old_opset(p: Patient) -> None:
    p.model.opset_import[0].version = 12


def zero_point(p: Patient) -> None:
    p.store(p.pair("image")[0].input[2], np.int8(3))


def computed_zero_point(p: Patient) -> None:
    p.graph.node.insert(0, helper.make_node("Identity", [p.store("zero", np.int8(0))], ["computed"], "identity"))
    for node in p.pair("image"):
        node.input[2] = "computed"


def uint8(p: Patient) -> None:
    p.store(p.pair("image")[0].input[2], np.uint8(0))


def uint8_by_default(p: Patient) -> None:
    for node in p.pair("image"):
        del node.input[2]


def int16(p: Patient) -> None:
    p.store(p.pair("image")[0].input[2], np.int16(0))


def zero_scale(p: Patient) -> None:
    p.store(p.pair("image")[0].input[1], np.float32(0))


def nan_scale(p: Patient) -> None:
    p.store(p.pair("image")[0].input[1], np.float32(np.nan))


def computed_scale(p: Patient) -> None:
    p.graph.node.insert(0, helper.make_node("Identity", [p.pair("image")[0].input[1]], ["computed"], "identity"))
    for node in p.pair("image"):
        node.input[1] = "computed"


def wrong_axis(p: Patient) -> None:
    for node in p.pair("w0"):
        set_axis(node, 1)


def forgotten_axis(p: Patient) -> None:
    for node in p.pair("w0"):
        set_axis(node, None)


def activation_per_channel(p: Patient) -> None:
    quantise, dequantise = p.pair("image")
    s, z = p.store("s3", np.ones(3, np.float32)), p.store("z3", np.zeros(3, np.int8))
    for node in (quantise, dequantise):
        node.input[1], node.input[2] = s, z


def integers_used_elsewhere(p: Patient) -> None:
    p.graph.node.append(helper.make_node("Identity", [p.pair("image")[0].output[0]], ["copy"], "thief"))
    p.graph.output.append(helper.make_tensor_value_info("copy", TensorProto.INT8, None))


def integers_from_outside(p: Patient) -> None:
    quantise, dequantise = p.pair("image")
    p.graph.node.remove(quantise)
    dequantise.input[0] = "image"
    p.graph.input[0].type.tensor_type.elem_type = TensorProto.INT8


def different_scales(p: Patient) -> None:
    _, dequantise = p.pair("image")
    dequantise.input[1] = p.store("other", p.value(dequantise.input[1]) * np.float32(2))


def stored_weight(p: Patient) -> None:
    quantise, dequantise = p.pair("w0")
    scale = p.value(quantise.input[1]).reshape(-1, 1, 1, 1)
    p.store("w0", np.rint(p.value("w0") / scale).astype(np.int8))
    dequantise.input[0] = "w0"
    p.graph.node.remove(quantise)


def bias(p: Patient) -> None:
    conv = p.op("Conv")
    integers, scale = p.store("b", np.zeros(8, np.int32)), p.store("bs", np.ones(8, np.float32))
    zeros = p.store("bz", np.zeros(8, np.int32))
    conv.input[2] = "bias"
    p.graph.node.insert(0, helper.make_node("DequantizeLinear", [integers, scale, zeros], ["bias"], "bias_dq", axis=0))


def foreign_operator(p: Patient) -> None:
    relu = p.op("Relu")
    relu.op_type, relu.domain = "Gelu", "com.microsoft"
    p.model.opset_import.append(helper.make_opsetid("com.microsoft", 1))


def missing_operator(p: Patient) -> None:
    p.op("Relu").op_type = "Hardmax"


def integer_operator(p: Patient) -> None:
    p.op("Relu").op_type = "QLinearSigmoid"


def free_size(p: Patient) -> None:
    p.graph.input[0].type.tensor_type.shape.dim[2].dim_param = "height"


def half(p: Patient) -> None:
    p.bypass(p.op("Conv"), 1)


def before_activation(p: Patient) -> None:
    p.insert_pair(p.op("Relu"), 0)


def pair_on_both_sides(p: Patient) -> None:
    add = p.op("Add")
    position = next(k for k in (0, 1) if p.made(add.input[k]).op_type == "Conv")
    p.insert_pair(add, position)


def no_pair_on_the_residual(p: Patient) -> None:
    add = p.op("Add")
    p.bypass(add, next(k for k in (0, 1) if p.made(add.input[k]).op_type == "DequantizeLinear"))


def one_side_of_concat(p: Patient) -> None:
    p.bypass(p.op("Concat"), 1)


def scales_of_concat(p: Patient) -> None:
    concat = p.op("Concat")
    dequantise = p.made(concat.input[0])
    for node in (p.made(dequantise.input[0]), dequantise):
        node.input[1] = p.store("own", np.float32(0.5))


def quantised_output(p: Patient) -> None:
    last = p.made("logits")
    last.output[0] = "raw"
    s, z = p.store("ls", np.float32(0.1)), p.store("lz", np.int8(0))
    p.graph.node.append(helper.make_node("QuantizeLinear", ["raw", s, z], ["raw_q"], "out_q"))
    p.graph.node.append(helper.make_node("DequantizeLinear", ["raw_q", s, z], ["logits"], "out_dq"))


def before_sigmoid_of_a_sum(p: Patient) -> None:
    """Q/DQ that nobody can take in: after a softmax."""
    relu = p.op("Relu", 1)
    relu.op_type = "Softmax"


SPOILT: dict[Callable[[Patient], None], set[str]] = {
    opset: {"opset"},
    old_opset: {"opset"},
    zero_point: {"zero-point"},
    computed_zero_point: {"zero-point"},
    uint8: {"asymmetric"},
    uint8_by_default: {"asymmetric"},
    int16: {"type"},
    zero_scale: {"scale"},
    nan_scale: {"scale"},
    computed_scale: {"scale"},
    wrong_axis: {"axis"},
    forgotten_axis: {"axis"},
    activation_per_channel: {"axis"},
    integers_used_elsewhere: {"unpaired"},
    integers_from_outside: {"unpaired"},
    different_scales: {"mismatch"},
    stored_weight: {"weight-pair"},
    bias: {"bias-dq"},
    foreign_operator: {"unsupported-op"},
    missing_operator: {"unsupported-op"},
    integer_operator: {"operator-oriented"},
    free_size: {"dynamic-shape"},
    half: {"half-quantised"},
    before_activation: {"split-fusion"},
    pair_on_both_sides: {"residual-pair"},
    no_pair_on_the_residual: {"residual-missing"},
    one_side_of_concat: {"concat-missing"},
    scales_of_concat: {"concat-scale"},
    quantised_output: {"output"},
    before_sigmoid_of_a_sum: {"reformat"},
}
WARNINGS = {
    "dynamic-shape", "half-quantised", "split-fusion", "residual-pair", "residual-missing", "concat-missing",
    "concat-scale", "output", "reformat", "not-quantised", "dla-qdq",
}  # fmt: skip


@pytest.mark.parametrize("spoil", SPOILT, ids=lambda spoil: spoil.__name__)
def test_one_flaw_one_finding(clean: bytes, spoil: Callable[[Patient], None]) -> None:
    patient = Patient(clean)
    spoil(patient)
    findings = lint(patient.model)
    # What keeps a kernel from forming often leaves a Q/DQ without a neighbour as well.
    assert {finding.code for finding in findings} - SPOILT[spoil] <= {"reformat", "concat-missing", "concat-scale"}
    mine = [finding for finding in findings if finding.code in SPOILT[spoil]]
    assert mine and {finding.severity for finding in mine} == {"warning" if mine[0].code in WARNINGS else "error"}
    assert all(finding.message.endswith(".") and finding.fix.endswith(".") for finding in findings)
    if mine[0].severity == "error":
        with pytest.raises(InputError, match=mine[0].code):
            check(patient.model)
    else:
        assert check(patient.model) == findings


def test_every_code_is_tried_here() -> None:
    sources = [Path(module.__file__ or "").read_text(encoding="utf-8") for module in (qdq_rules, qdq_placement)]
    codes = {code for text in sources for code in re.findall(r'Finding\(\s*"([a-z0-9-]+)"', text)}
    assert codes == set().union(*SPOILT.values()) | {"not-quantised", "dla", "dla-qdq"}


def test_clean_file_and_plain_file(folder: Path, clean: bytes) -> None:
    assert lint(folder / "clean.onnx") == [] == check(folder / "clean.onnx", jetpack="5.1")
    assert [finding.code for finding in lint(folder / "net.onnx")] == ["not-quantised"]
    assert explain([]).startswith("No findings")


def quantised_by_default(folder: Path, **options: Any) -> Path:
    import logging

    from onnxruntime.quantization import quantize_static

    class Reader:
        def __init__(self) -> None:
            self.rest = [{"image": images()}]

        def get_next(self) -> dict | None:
            return self.rest.pop() if self.rest else None

    logging.disable()
    try:
        quantize_static(str(folder / "net.onnx"), str(folder / "default.onnx"), Reader(), **options)
    finally:
        logging.disable(logging.NOTSET)
    return folder / "default.onnx"


def test_default_options_of_onnx_runtime_are_refused_with_the_right_reasons(folder: Path, clean: bytes) -> None:
    from onnxruntime.quantization import QuantFormat, QuantType

    path = quantised_by_default(folder)
    findings = lint(path)
    errors = {finding.code for finding in findings if finding.severity == "error"}
    assert errors == {"zero-point", "weight-pair", "bias-dq"}
    with pytest.raises(InputError, match=r"zero-point: Its zero point is .*ActivationSymmetric") as caught:
        check(path)
    assert "default.onnx, at image_QuantizeLinear" in str(caught.value)
    advice = {finding.code: finding.fix for finding in findings}
    assert "AddQDQPairToWeight" in advice["weight-pair"] and "QuantizeBias" in advice["bias-dq"]
    # Each fix takes its own finding away.
    fixed = {"ActivationSymmetric": True, "WeightSymmetric": True, "AddQDQPairToWeight": True, "QuantizeBias": False}
    for option, code in zip(fixed, ("zero-point", None, "weight-pair", "bias-dq"), strict=True):
        if code:
            rest = lint(quantised_by_default(folder, extra_options={option: fixed[option]}))
            assert {finding.code for finding in rest if finding.severity == "error"} == errors - {code}
    assert check(quantised_by_default(folder, extra_options=fixed)) != []  # allowed, but the placement costs time
    unsigned = lint(quantised_by_default(folder, activation_type=QuantType.QUInt8))
    assert "asymmetric" in {finding.code for finding in unsigned}
    operators = lint(quantised_by_default(folder, quant_format=QuantFormat.QOperator))
    assert "operator-oriented" in {finding.code for finding in operators}


def test_jetpack_decides_on_opset_weights_and_operators(clean: bytes) -> None:
    new = Patient(clean)
    opset(new)
    assert lint(new.model, jetpack="6.2") == []
    assert "JetPack 6.0 parses up to 17" in lint(new.model, jetpack="6.0")[0].message
    assert "parses up to 13" in lint(Patient(clean).model, jetpack="4.6.1")[0].message
    stored = Patient(clean)
    stored_weight(stored)
    assert lint(stored.model, jetpack="6.2") == []
    assert [finding.code for finding in lint(stored.model, jetpack="6.0")] == ["weight-pair"]
    missing = Patient(clean)
    missing_operator(missing)
    found = next(finding for finding in lint(missing.model, jetpack="6.2") if finding.code == "unsupported-op")
    assert found.severity == "warning"
    with pytest.raises(InputError, match=r"^jetpack"):
        lint(Patient(clean).model, jetpack="6.3.7")


def test_dla(clean: bytes, folder: Path) -> None:
    assert [finding.code for finding in lint(folder / "clean.onnx", jetpack="6.2", dla=True)] == ["dla-qdq"]
    assert [finding.code for finding in lint(folder / "net.onnx", dla=True)] == ["not-quantised"]
    errors = [f for f in lint(folder / "net.onnx", jetpack="7.2", dla=True) if f.severity == "error"]
    assert [finding.code for finding in errors] == ["dla"] and "6.2" in errors[0].fix
    net = Net()
    a = net.node("Softmax", [net.conv("image", 3, 4)], axis=1)
    refused = lint(net.model(net.conv(net.node("Erf", [a]), 4, 4, kernel=1)), dla=True)
    reasons = [finding for finding in refused if finding.code == "dla"]
    assert reasons and all(finding.severity == "warning" for finding in reasons)
    free = Patient(clean)
    free_size(free)
    assert ("dla", "error") in {(finding.code, finding.severity) for finding in lint(free.model, dla=True)}


def test_explanation_is_one_paragraph_per_code(folder: Path, clean: bytes) -> None:
    text = explain(lint(quantised_by_default(folder)))
    assert text.count("zero-point") == 1 and "places, first: image_QuantizeLinear" in text
    assert max(len(line) for line in text.splitlines()) <= 108
    assert re.search(r"\d+ errors, \d+ warnings?$", text)
    assert explain([Finding("opset", "error", "", "A.", "B.")]).splitlines() == [
        "error   opset             the whole file",
        "        A.",
        "        Fix: B.",
        "1 error, 0 warnings",
    ]


@pytest.mark.parametrize("content", [b"", b"not ONNX at all", None])
def test_files_that_are_none(tmp_path: Path, content: bytes | None) -> None:
    if content is not None:
        (tmp_path / "x.onnx").write_bytes(content)
    with pytest.raises(InputError, match=r"^model"):
        lint(tmp_path / "x.onnx")


Q = ("QuantizeLinear", ["image", "s", "z"], ["q"])
HOSTILE: dict[str, list[tuple[str, list[str], list[str]]]] = {
    "no scale": [("QuantizeLinear", ["image"], ["q"]), ("DequantizeLinear", ["q", "s", "z"], ["logits"])],
    "nothing": [("DequantizeLinear", [], ["logits"])],
    "no output": [Q, ("Relu", ["image"], [])],
    "circle": [Q, ("Identity", ["b"], ["a"]), ("Identity", ["a"], ["b"]), ("MatMul", ["q", "a"], ["logits"])],
    "own input": [("DequantizeLinear", ["logits", "s", "z"], ["logits"])],
    "twice": [("Relu", ["image"], ["logits"]), ("Relu", ["logits"], ["logits"])],
}


@pytest.mark.parametrize("case", HOSTILE)
def test_graphs_that_are_none_are_refused(case: str) -> None:
    """Not even ONNX's checker may have seen them: no crash, and no search without an end."""
    info = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 3, 8, 8]) for name in ("image", "logits")]
    constants = [numpy_helper.from_array(np.float32(0.1), "s"), numpy_helper.from_array(np.int8(0), "z")]
    nodes = [helper.make_node(op, inputs, outputs) for op, inputs, outputs in HOSTILE[case]]
    with pytest.raises(InputError, match="node"):
        lint(helper.make_model(helper.make_graph(nodes, "g", info[:1], info[1:], constants)))


@pytest.mark.parametrize(("axis", "found"), [(0, set()), (1, {"axis"})])
def test_scales_of_a_left_factor_run_along_its_rows(axis: int, found: set[str]) -> None:
    net = Net()
    scale, zero = net.constant(np.full(16, 0.1, np.float32)), net.constant(np.zeros(16, np.int8))
    weight = net.constant(net.rng.normal(size=(16, 16)).astype(np.float32))
    low = net.node("QuantizeLinear", [weight, scale, zero], axis=axis)
    left = net.node("DequantizeLinear", [low, scale, zero], axis=axis)
    step, none = net.constant(np.float32(0.1)), net.constant(np.int8(0))
    image = net.node("DequantizeLinear", [net.node("QuantizeLinear", ["image", step, none]), step, none])
    assert {finding.code for finding in lint(net.model(net.node("MatMul", [left, image])))} == found
