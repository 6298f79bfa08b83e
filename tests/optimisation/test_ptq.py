"""Post-training quantisation: what is in the file, agreement with torch's fake quantisation, refusals."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import numpy_helper

from robotbrain.errors import InputError
from robotbrain.optimisation import onnx_files
from robotbrain.optimisation.affine import choose_qparams, per_channel_range, per_tensor_range
from robotbrain.optimisation.calibration import calibrate
from robotbrain.optimisation.onnx_files import session
from robotbrain.optimisation.ptq import METADATA, quantise_onnx
from robotbrain.optimisation.ptq_prepare import harmonised
from robotbrain.optimisation.qdq_graph import dequantised, move_pairs_before_padding, producers, readers
from robotbrain.optimisation.qdq_lint import lint
from tests.optimisation.onnx_nets import Net, images, save, unet


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save(unet(), tmp_path_factory.mktemp("nets") / "net.onnx")


@pytest.fixture(scope="module")
def accelerated(source: Path) -> Any:
    return quantise_onnx(source, source.parent / "tensorrt.onnx", images())


def run(model: Any, x: np.ndarray, names: list[str] | None = None) -> dict[str, np.ndarray]:
    """Return tensors of a model, all of them by default, computed as written."""
    opened = onnx.ModelProto()
    opened.CopyFrom(model)
    names = names or [name for node in model.graph.node for name in node.output]
    known = {info.name for info in opened.graph.output}
    opened.graph.output.extend(onnx.ValueInfoProto(name=name) for name in names if name not in known)
    return dict(zip(names, session(opened).run(names, {"image": x}), strict=True))


def constants(model: Any) -> dict[str, np.ndarray]:
    return {tensor.name: numpy_helper.to_array(tensor) for tensor in model.graph.initializer}


def in_torch(node: Any, values: list[Any]) -> Any:
    """Compute one node with torch; Q and DQ keep integers as floats times scale."""
    import torch
    from torch.nn import functional

    attributes = {item.name: onnx.helper.get_attribute_value(item) for item in node.attribute}
    match node.op_type:
        case "Conv":
            bias = values[2] if len(values) > 2 else None
            return functional.conv2d(
                values[0], values[1], bias, padding=attributes["pads"][0], groups=attributes.get("group", 1)
            )
        case "Relu":
            return torch.relu(values[0])
        case "Add":
            return values[0] + values[1]
        case "Concat":
            return torch.cat(values, dim=1)
        case "MaxPool":
            return functional.max_pool2d(values[0], 2)
        case "Resize":
            return functional.interpolate(values[0], scale_factor=2, mode="nearest")
        case "QuantizeLinear":
            scale, axis = values[1], attributes.get("axis", 1)
            if scale.ndim:
                zero = torch.zeros(len(scale), dtype=torch.int32)
                return torch.fake_quantize_per_channel_affine(values[0], scale, zero, axis, -128, 127)
            return torch.fake_quantize_per_tensor_affine(values[0], float(scale), 0, -128, 127)
        case "DequantizeLinear":
            return values[0]
    raise AssertionError(node.op_type)


def test_every_node_agrees_with_torch_within_one_step(accelerated: Any) -> None:
    import torch

    model, x = onnx.load(accelerated.path), images(4, seed=7)
    fixed = constants(model)
    computed = run(model, x)
    known = {"image": x, **fixed, **computed}
    for node in model.graph.node:
        if node.op_type == "QuantizeLinear":
            continue  # compared below, together with its DQ
        if node.op_type == "DequantizeLinear":
            quantise = producers(model)[node.input[0]]
            scale = fixed[quantise.input[1]]
            ours = in_torch(quantise, [torch.from_numpy(np.array(known[name])) for name in quantise.input[:2]]).numpy()
            axis = next((a.i for a in quantise.attribute if a.name == "axis"), 1)
            wide = scale.reshape([-1 if k == axis else 1 for k in range(ours.ndim)]) if scale.ndim else scale
            steps = np.abs(ours - computed[node.output[0]]) / wide
            assert steps.max() <= 1.0 + 1e-4  # one step, and that only where a value lies between two integers
            assert np.mean(steps > 1e-4) < 1e-3
        else:
            inputs = [torch.from_numpy(np.array(known[name])) for name in node.input if name]
            ours = in_torch(node, inputs[:1] if node.op_type == "Resize" else inputs).numpy()
            np.testing.assert_allclose(ours, computed[node.output[0]], rtol=1e-4, atol=1e-4)


def test_whole_network_agrees_with_torch_fake_quantisation(accelerated: Any) -> None:
    """A value between two integers may round either way and move everything behind it: 99 % within 1 % of the peak."""
    import torch

    model, x = onnx.load(accelerated.path), images(8, seed=8)
    known = {name: torch.from_numpy(np.array(value)) for name, value in constants(model).items()}
    known["image"] = torch.from_numpy(x)
    for node in model.graph.node:
        inputs = [known[name] for name in node.input if name]
        known[node.output[0]] = in_torch(node, inputs[:1] if node.op_type == "Resize" else inputs)
    theirs = run(model, x, ["logits"])["logits"]
    gap = np.abs(known["logits"].numpy() - theirs) / np.abs(theirs).max()
    assert np.quantile(gap, 0.99) < 0.01 and gap.max() < 0.05
    assert np.mean(known["logits"].numpy().argmax(1) == theirs.argmax(1)) > 0.995


def test_scales_are_those_of_the_calibration_table(accelerated: Any) -> None:
    model = onnx.load(accelerated.path)
    fixed, shared = constants(model), set()
    for node in model.graph.node:
        if node.op_type != "QuantizeLinear":
            continue
        scale, zero = fixed[node.input[1]], fixed[node.input[2]]
        assert zero.dtype == np.int8 and not zero.any()
        name = node.input[0]
        if name in fixed:
            q = choose_qparams(*per_channel_range(fixed[name], 0), symmetric=True, narrow=True, axis=0)
            np.testing.assert_allclose(scale, q.scale, rtol=1e-6)
        else:
            own = accelerated.table.scale(name)
            assert scale >= np.float32(own)
            shared |= {name} if scale > np.float32(own) else set()
    # Only tensors around pooling, resizing and concatenation take the range of a neighbour.
    around = {n for node in model.graph.node if node.op_type in ("Concat", "Resize", "MaxPool") for n in node.output}
    made = producers(model)
    for node in model.graph.node:
        if node.op_type in ("Concat", "Resize", "MaxPool"):
            around |= {made[made[n].input[0]].input[0] for n in node.input if n in made}
    assert shared and shared <= around


def test_pairs_stand_where_tensorrt_fuses(accelerated: Any) -> None:
    model = onnx.load(accelerated.path)
    made, read = producers(model), readers(model)
    add = next(node for node in model.graph.node if node.op_type == "Add")
    assert sorted(made[name].op_type for name in add.input) == ["Conv", "DequantizeLinear"]
    for node in model.graph.node:
        if node.op_type in ("Conv", "Concat", "MaxPool", "Resize"):
            changing = [name for name in node.input if name in made]
            assert all(made[name].op_type == "DequantizeLinear" for name in changing)
        if node.op_type in ("Concat", "MaxPool", "Resize"):
            scales = {made[made[name].input[0]].input[1] for name in node.input if name in made}
            scales |= {reader.input[1] for reader in read[node.output[0]]}
            assert len({float(constants(model)[name]) for name in scales}) == 1
        if node.op_type == "Conv" and node.output[0] != "logits":
            assert {reader.op_type for reader in read[node.output[0]]} <= {"Relu", "Add"}
    assert accelerated.skipped == () and len(accelerated.nodes) == 6
    assert {entry.domain: entry.version for entry in model.opset_import} == {"": 17}


def test_tensorrt_file_is_clean_and_the_twin_sees_int8(accelerated: Any) -> None:
    from robotbrain.jetson.graph import analyse

    assert lint(accelerated.path) == []
    kernels = analyse(accelerated.path).kernels
    assert {kernel.precision for kernel in kernels if kernel.computes} == {"int8"}
    assert [kernel.name for kernel in kernels if kernel.op == "mem:reformat"] == ["image_QuantizeLinear"]


def snr_db(reference: np.ndarray, other: np.ndarray) -> float:
    return float(10 * np.log10((reference**2).sum() / ((reference - other) ** 2).sum()))


@pytest.mark.parametrize("target", ["tensorrt", "cpu"])
def test_accuracy_and_what_per_channel_is_worth(source: Path, tmp_path: Path, target: str) -> None:
    x = images(8, seed=9)
    expected = run(onnx.load(source), x, ["logits"])["logits"]
    found = {}
    for per_channel in (True, False):
        made = quantise_onnx(source, tmp_path / f"{per_channel}.onnx", images(), target=target, per_channel=per_channel)
        values = run(onnx.load(made.path), x, ["logits", "w2_DequantizeLinear_Output"])
        assert snr_db(expected, values["logits"]) > 20
        # One scale for all channels is paid for by the smallest of them.
        channels = zip(constants(onnx.load(source))["w2"], values["w2_DequantizeLinear_Output"], strict=True)
        found[per_channel] = min(snr_db(before, after) for before, after in channels)
    assert found[True] > 35 and found[True] > found[False] + 10


def test_cpu_file_is_small_unsigned_and_may_use_seven_bits(source: Path, tmp_path: Path) -> None:
    made = quantise_onnx(source, tmp_path / "cpu.onnx", images(), target="cpu", method="percentile", percentile=99.9)
    model = onnx.load(made.path)
    types = {tensor.name: tensor.data_type for tensor in model.graph.initializer}
    activations = [node for node in model.graph.node if node.op_type == "QuantizeLinear"]
    assert activations and {types[node.input[2]] for node in activations} == {onnx.TensorProto.UINT8}
    q = choose_qparams(*made.table.ranges["image"], signed=False)
    assert constants(model)["image_scale"] == q.scale and constants(model)["image_zero_point"] == q.zero_point
    weights = [
        tensor for tensor in model.graph.initializer if tensor.data_type == onnx.TensorProto.INT8 and tensor.dims
    ]
    wide = [numpy_helper.to_array(tensor) for tensor in weights if len(tensor.dims) == 4]
    assert len(wide) == 6 and max(int(np.abs(w.astype(int)).max()) for w in wide) == 127
    reduced = onnx.load(quantise_onnx(source, tmp_path / "r.onnx", images(), target="cpu", reduce_range=True).path)
    wide = [numpy_helper.to_array(t) for t in reduced.graph.initializer if t.data_type == 3 and len(t.dims) == 4]
    assert max(int(np.abs(w.astype(int)).max()) for w in wide) == 64
    assert made.method == made.table.method == "percentile" and made.table.percentile == 99.9


def test_a_concatenation_shares_a_scale_unless_that_is_too_coarse(source: Path) -> None:
    model = onnx.load(source)
    table = calibrate(source, images())
    together = harmonised(table, model)
    moved = ["relu1", "maxpool2", "relu9", "resize10", "concat11"]
    assert len({together.ranges[name] for name in moved}) == 1
    wide = replace(table, ranges={**table.ranges, **dict.fromkeys(["relu9", "resize10", "concat11"], (0.0, 1e3))})
    wide = replace(wide, ranges={**wide.ranges, "maxpool2": (0.0, 1.0)})  # as a percentile may have it
    apart = harmonised(wide, model)
    assert apart.ranges["relu1"] == table.ranges["relu1"] == apart.ranges["maxpool2"]
    assert apart.ranges["concat11"] == (0.0, 1e3)


def test_same_input_same_bytes_in_another_process(source: Path, accelerated: Any, tmp_path: Path) -> None:
    program = (
        "import sys; from tests.optimisation.onnx_nets import images\n"
        "from robotbrain.optimisation.ptq import quantise_onnx\n"
        "quantise_onnx(sys.argv[1], sys.argv[2], images())"
    )
    out = tmp_path / "again.onnx"
    environment = {**os.environ, "PYTHONHASHSEED": "77"}
    root = Path(__file__).parents[2]
    result = subprocess.run(
        [sys.executable, "-c", program, str(source), str(out)],
        cwd=root,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout == result.stderr == ""
    assert out.read_bytes() == accelerated.path.read_bytes()


def test_file_says_how_it_was_made(source: Path, accelerated: Any) -> None:
    model = onnx.load(accelerated.path)
    how = json.loads({entry.key: entry.value for entry in model.metadata_props}[METADATA])
    assert (how["target"], how["method"], how["samples"], how["per_channel"]) == ("tensorrt", "minmax", 8, True)
    assert how["source_sha256"] == hashlib.sha256(source.read_bytes()).hexdigest()
    assert how["inputs_sha256"] == accelerated.table.inputs_sha256
    assert accelerated.size_bytes == accelerated.path.stat().st_size
    assert accelerated.source_bytes == source.stat().st_size
    assert not any(str(source.parent) in node.name for node in model.graph.node)


def test_a_table_made_before_gives_the_same_scales(source: Path, accelerated: Any, tmp_path: Path) -> None:
    x = images()
    again = quantise_onnx(source, tmp_path / "a.onnx", x, table=calibrate(source, x))
    ours, theirs = constants(onnx.load(again.path)), constants(onnx.load(accelerated.path))
    assert ours.keys() == theirs.keys()
    assert all(np.allclose(ours[name], theirs[name], rtol=1e-5) for name in ours)
    table = calibrate(source, x)
    less = replace(table, ranges={name: ends for name, ends in table.ranges.items() if name != "concat11"})
    with pytest.raises(InputError, match="no tensor 'concat11'"):
        quantise_onnx(source, tmp_path / "b.onnx", x, table=less)
    other = save(unet(size="wide"), tmp_path / "other.onnx")
    with pytest.raises(InputError, match="Calibrate this model"):
        quantise_onnx(other, tmp_path / "b.onnx", x, table=calibrate(source, x))


def test_normalisation_is_folded_and_opset_raised(tmp_path: Path) -> None:
    net = Net()
    a = net.conv("image", 3, 4, bias=False)
    ones = np.ones(4, np.float32)
    a = net.node("BatchNormalization", [a, *(net.constant(v * ones) for v in (2.0, 0.5, 0.1, 1.5))])
    path = save(net.model(net.conv(net.relu(a), 4, 4), opset=13), tmp_path / "net.onnx")
    made = quantise_onnx(path, tmp_path / "q.onnx", images())
    model = onnx.load(made.path)
    assert {node.op_type for node in model.graph.node} == {"Conv", "Relu", "QuantizeLinear", "DequantizeLinear"}
    assert model.opset_import[0].version == 17 and lint(made.path) == []
    x = images(4, seed=5)
    before, after = (run(onnx.load(file), x, ["logits"])["logits"] for file in (path, made.path))
    assert snr_db(before, after) > 25


def test_products_and_deconvolutions_have_their_scales_along_the_right_axis(tmp_path: Path) -> None:
    net = Net()
    a = net.node("Add", [net.relu(net.conv("image", 3, 4)), net.constant(np.ones((1, 4, 1, 1), np.float32))])
    w = net.constant(net.rng.normal(size=(4, 6, 2, 2)).astype(np.float32))
    a = net.relu(net.node("ConvTranspose", [a, w], strides=[2, 2]))
    a = net.node("Flatten", [net.node("GlobalAveragePool", [a])])
    w, b = net.constant(net.rng.normal(size=(5, 6)).astype(np.float32)), net.constant(np.zeros(5, np.float32))
    a = net.node("Gemm", [a, w, b], transB=1)
    a = net.node("MatMul", [net.relu(a), net.constant(net.rng.normal(size=(5, 7)).astype(np.float32))])
    path = save(net.model(net.node("Add", [a, net.constant(np.ones(7, np.float32))]), rank=2), tmp_path / "net.onnx")
    made = quantise_onnx(path, tmp_path / "q.onnx", images())
    assert [finding for finding in lint(made.path) if finding.severity == "error"] == []
    assert len(made.nodes) == 4
    model = onnx.load(made.path)
    fixed, made_by = constants(model), producers(model)
    computing = [node for node in model.graph.node if node.op_type in ("Conv", "ConvTranspose", "Gemm", "MatMul")]
    assert [fixed[made_by[node.input[1]].input[1]].size for node in computing] == [4, 6, 5, 7]
    biases = [node for node in model.graph.node if node.op_type == "Add"]  # no residual branches
    assert biases and not any(dequantised(made_by, name) for node in biases for name in node.input)


def test_excluded_nodes_stay_in_floating_point(source: Path, tmp_path: Path) -> None:
    last = next(node.name for node in onnx.load(source).graph.node if node.output[0] == "logits")
    made = quantise_onnx(source, tmp_path / "q.onnx", images(), exclude=[last])
    assert made.skipped == (last,) and lint(made.path) == []
    with pytest.raises(InputError, match="names of nodes, such as /conv0"):
        quantise_onnx(source, tmp_path / "q2.onnx", images(), exclude=["nobody"])
    everything = [node.name for node in onnx.load(source).graph.node if node.op_type == "Conv"]
    with pytest.raises(InputError, match="no convolution"):
        quantise_onnx(source, tmp_path / "q2.onnx", images(), exclude=everything)
    assert not (tmp_path / "q2.onnx").exists()


def test_refusals_leave_nothing_behind(
    source: Path, accelerated: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Any, caplog: Any
) -> None:
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    out, x = tmp_path / "out" / "q.onnx", images(4)
    broken = unet()
    broken.graph.initializer[0].CopyFrom(
        numpy_helper.from_array(np.full((8, 3, 3, 3), np.nan, np.float32), broken.graph.initializer[0].name)
    )
    spoilt = x.copy()
    spoilt[0] = np.inf
    new = unet()
    new.opset_import[0].version = 30
    cases: dict[str, tuple[Any, Any, dict[str, Any]]] = {
        "quantised already": (accelerated.path, x, {}),
        "tens to hundreds": (source, x[:0], {}),
        r"float32 \(N, 3": (source, x[:, :2], {}),
        "finite values": (source, spoilt, {}),
        "path of an ONNX file": (tmp_path / "none.onnx", x, {}),
        "weight 'w0'": (save(broken, tmp_path / "nan.onnx"), x, {}),
        "^target": (source, x, {"target": "tpu"}),
        "VNNI": (source, x, {"reduce_range": True}),
        "^method": (source, x, {"method": "guess"}),
        "^percentile": (source, x, {"method": "percentile", "percentile": 101}),
        "opset of the model": (save(new, tmp_path / "new.onnx"), x, {}),
    }
    for message, (model, inputs, options) in cases.items():
        with pytest.raises(InputError, match=message):
            quantise_onnx(model, out, inputs, **options)
    monkeypatch.setattr(onnx_files, "MAX_BYTES", 100)
    with pytest.raises(InputError, match="at most 2 GB"):
        quantise_onnx(source, out, x)
    monkeypatch.undo()
    assert not out.parent.exists() and list((tmp_path / "temporary").iterdir()) == []
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    handlers = list(logging.getLogger().handlers)
    quantise_onnx(source, out, x)
    assert [file.name for file in out.parent.iterdir()] == ["q.onnx"]
    assert list((tmp_path / "temporary").iterdir()) == []
    assert logging.getLogger().handlers == handlers and not logging.getLogger().filters
    assert "".join(capfd.readouterr()) == "" and caplog.records == []


@pytest.mark.parametrize("filler", [0.0, 0.5])
def test_a_pair_moves_before_padding_with_zeros_only(filler: float) -> None:
    net = Net()
    pads, value = net.constant(np.int64([0, 0, 1, 1, 0, 0, 1, 1])), net.constant(np.float32(filler))
    scale, zero = net.constant(np.float32(0.05)), net.constant(np.int8(0))
    a = net.node("Pad", [net.relu(net.conv("image", 3, 4)), pads, value])
    a = net.node("DequantizeLinear", [net.node("QuantizeLinear", [a, scale, zero]), scale, zero])
    model, x = net.model(net.conv(a, 4, 4, kernel=1)), images(2)
    expected = run(model, x, ["logits"])["logits"]
    move_pairs_before_padding(model)
    onnx.checker.check_model(model)
    np.testing.assert_array_equal(run(model, x, ["logits"])["logits"], expected)
    pad = next(node for node in model.graph.node if node.op_type == "Pad")
    before, (after,) = producers(model)[pad.input[0]].op_type, readers(model)[pad.output[0]]
    assert (before, after.op_type) == (("DequantizeLinear", "Conv") if filler == 0 else ("Relu", "QuantizeLinear"))
    assert dequantised(producers(model), model.graph.node[-1].input[0])
    assert not dequantised(producers(model), "logits")


def test_concatenated_lengths_are_not_taken_for_activations(tmp_path: Path) -> None:
    net = Net()
    a = net.node("MaxPool", [net.relu(net.conv("image", 3, 4))], kernel_shape=[4, 4], strides=[4, 4])
    batch = net.node("Slice", [net.node("Shape", [a]), net.constant(np.int64([0])), net.constant(np.int64([1]))])
    a = net.node("Reshape", [a, net.node("Concat", [batch, net.constant(np.int64([64]))], axis=0)])
    w = net.constant(net.rng.normal(size=(64, 5)).astype(np.float32))
    path = save(net.model(net.node("MatMul", [a, w]), rank=2), tmp_path / "net.onnx")
    made = quantise_onnx(path, tmp_path / "q.onnx", images())
    assert len(made.nodes) == 2 and not [finding for finding in lint(made.path) if finding.severity == "error"]


@pytest.mark.parametrize("target", ["tensorrt", "cpu"])
def test_a_fixed_batch_is_kept(tmp_path: Path, target: str) -> None:
    path = save(unet(batch=3), tmp_path / "net.onnx")
    made = quantise_onnx(path, tmp_path / "q.onnx", images(7), target=target)
    assert made.table.samples == 6
    assert run(onnx.load(made.path), images(3), ["logits"])["logits"].shape == (3, 4, 16, 16)


def test_dead_channels_and_constant_inputs_still_make_a_file(tmp_path: Path) -> None:
    net = Net()
    w = net.rng.normal(size=(4, 3, 3, 3)).astype(np.float32)
    w[1] = 0
    a = net.relu(net.node("Conv", ["image", net.constant(w)], pads=[1] * 4))
    path = save(net.model(net.conv(a, 4, 4)), tmp_path / "net.onnx")
    made = quantise_onnx(path, tmp_path / "q.onnx", np.zeros((2, 3, 16, 16), np.float32))
    assert lint(made.path) == []
    assert per_tensor_range(run(onnx.load(made.path), images(1), ["logits"])["logits"])


@pytest.mark.parametrize("stacked", [False, True])
def test_constant_factors_have_scales_that_leave_the_sum(tmp_path: Path, stacked: bool) -> None:
    """Columns of a right factor, whatever its rank; a left one per tensor: along its axis 1 it is summed over."""
    net = Net()
    left = net.node("MatMul", [net.constant(net.rng.normal(size=(7, 16)).astype(np.float32), "left"), "image"])
    shape = (1, 3, 16, 5) if stacked else (16, 5)
    right = net.node("MatMul", [left, net.constant(net.rng.normal(size=shape).astype(np.float32), "right")])
    made = quantise_onnx(save(net.model(right), tmp_path / "net.onnx"), tmp_path / "q.onnx", images(4))
    model = onnx.load(made.path)
    values = {tensor.name: numpy_helper.to_array(tensor) for tensor in model.graph.initializer}
    scales = {node.input[0]: values[node.input[1]] for node in model.graph.node if node.op_type == "QuantizeLinear"}
    assert scales["left"].shape == () and len(made.nodes) == 2
    columns = np.abs(values["right"]).max(axis=tuple(range(len(shape) - 1)))
    np.testing.assert_allclose(scales["right"], columns / 127, rtol=1e-6)
