"""Post-training quantisation: from a floating-point ONNX file to one with Q/DQ nodes, without training.

Ranges come from :mod:`robotbrain.optimisation.calibration`, scales and zero points from
:mod:`robotbrain.optimisation.affine`; ONNX Runtime's ``quantize_static`` puts the nodes in
(https://onnxruntime.ai/docs/performance/model-optimizations/quantization.html).

``target="tensorrt"`` writes what TensorRT takes and can fuse: opset 17, signed 8-bit integers with zero point 0 on both
sides, weights kept in floating point behind a Q/DQ pair of their own, biases in floating point. Pairs stand before
convolutions and products, on the residual branch of an addition only, and around pooling, resizing and concatenation,
which mostly share one scale (:func:`robotbrain.optimisation.ptq_prepare.harmonised`). So a convolution, an addition and
an activation can become one kernel (https://docs.nvidia.com/deeplearning/tensorrt/tensorflow-quantization-toolkit/docs/
docs/add_custom_qdq_cases.html). The file is not smaller than the floating-point one: the engine built from it is.

``target="cpu"`` writes what is fastest in ONNX Runtime on x86: unsigned activations, signed weights stored as integers,
32-bit biases. On processors without VNNI instructions set ``reduce_range``: two 8-bit products can overflow 16 bits.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robotbrain import __version__
from robotbrain.errors import InputError, RobotBrainError
from robotbrain.files import write_bytes
from robotbrain.jetson.engine.plan import onnx_digest
from robotbrain.optimisation.affine import choose_qparams
from robotbrain.optimisation.calibration import CalibrationTable, calibrate_model
from robotbrain.optimisation.onnx_files import batches, check_feed, opset_of, quiet, read_model, session
from robotbrain.optimisation.ptq_prepare import (
    KEEPS_SCALE,
    check_table,
    excluded,
    harmonised,
    matmul_overrides,
    prepare,
    refuse_quantised,
)
from robotbrain.optimisation.qdq_graph import (
    COMPUTE,
    dequantised,
    drop_pairs_before_additions,
    move_pairs_before_padding,
    producers,
    residual_additions,
    tidy,
)

OPSET = 17
"""What every JetPack from 5.0.2 parses."""

TARGETS = ("tensorrt", "cpu")
"""Who is to run the file."""

METADATA = "robotbrain.quantisation"
"""Key of the ONNX metadata entry that says how a file was made (JSON)."""

_TENSORRT_OPS = ("Add", "Concat", "Conv", "ConvTranspose", "Gemm", "MatMul", "MaxPool", "Resize")


@dataclass(frozen=True)
class QuantisedModel:
    """A quantised file and how it came about.

    Attributes:
        path: of the ONNX file.
        target: tensorrt or cpu.
        method: of the calibration.
        per_channel: whether each output channel of a weight has a scale of its own.
        nodes: names of the convolutions and products that are quantised.
        skipped: names of those that are not.
        table: the ranges that were used, before tensors were made to share one.
        size_bytes, source_bytes: of this file and of the one it was made from.
    """

    path: Path
    target: str
    method: str
    per_channel: bool
    nodes: tuple[str, ...]
    skipped: tuple[str, ...]
    table: CalibrationTable
    size_bytes: int
    source_bytes: int


@dataclass(frozen=True)
class _Options:
    """What the caller chose."""

    target: str
    per_channel: bool
    reduce_range: bool
    exclude: tuple[str, ...]

    @property
    def accelerator(self) -> bool:
        return self.target == "tensorrt"


def quantise_onnx(
    model: str | Path,
    out: str | Path,
    calibration_inputs: NDArray[np.float32] | Mapping[str, NDArray[np.float32]],
    *,
    target: str = "tensorrt",
    per_channel: bool = True,
    method: str = "minmax",
    percentile: float = 99.99,
    exclude: Sequence[str] = (),
    reduce_range: bool = False,
    batch_size: int = 16,
    table: CalibrationTable | None = None,
) -> QuantisedModel:
    """Quantise a network after training.

    The same file, inputs and options give the same bytes. The output is written whole or not at all, and only once ONNX
    Runtime has run it.

    Args:
        model: path of a floating-point ONNX file.
        out: where the quantised file goes.
        calibration_inputs: (N, C, H, W) float32, normalised as for inference, from a split of their own.
        target: ``tensorrt`` or ``cpu``.
        per_channel: one scale per output channel of a weight, instead of one per weight.
        method, percentile, batch_size: of the calibration; see :func:`robotbrain.optimisation.calibration.calibrate`.
        exclude: names of nodes that stay in floating point.
        reduce_range: weights in 7 bits; ``cpu`` only.
        table: ranges that :func:`calibrate` made earlier from the same model; the inputs are then only a trial run.

    Raises:
        InputError: for a missing, damaged, huge or already quantised model, inputs that do not fit it, NaN, unknown
            options or node names, or a model that cannot be brought to opset 17.
        RobotBrainError: the file that came out does not hold what was promised.
    """
    if target not in TARGETS or (reduce_range and target != "cpu"):
        raise InputError(
            "target",
            given=f"{target}" + (" with reduce_range" if reduce_range else ""),
            expected="tensorrt, or cpu (which alone has reduce_range)",
            fix="Tensor cores do not saturate: reduce_range is for processors without VNNI.",
        )
    source = read_model(model)
    source_bytes = Path(model).stat().st_size
    digest = onnx_digest(Path(model))
    refuse_quantised(source, Path(model).name)
    feed = check_feed(source, calibration_inputs)
    with tempfile.TemporaryDirectory(prefix="robotbrain.") as folder, quiet():
        ready = prepare(source, OPSET if target == "tensorrt" else max(13, opset_of(source)), Path(folder))
        options = _Options(target, per_channel, reduce_range, tuple(excluded(ready, exclude)))
        if table is None:
            table = calibrate_model(
                ready, feed, method, percentile=percentile, batch_size=batch_size, model_sha256=digest
            )
        else:
            check_table(table, ready, digest)
        made = _insert(ready, feed, table, options, Path(folder))
    if options.accelerator:
        drop_pairs_before_additions(made)
        move_pairs_before_padding(made)
    quantised, floating = _outcome(made)
    if not quantised:
        raise InputError(
            "model",
            given="no convolution or product that was quantised",
            expected="at least one",
            fix="Does exclude name all of them?",
        )
    tidy(made)
    _describe(made, source, table, options, digest)
    _try(made, feed, options)
    path = write_bytes(out, made.SerializeToString(deterministic=True))
    size = path.stat().st_size
    return QuantisedModel(path, target, table.method, per_channel, quantised, floating, table, size, source_bytes)


def _insert(model: Any, feed: Mapping[str, Any], table: CalibrationTable, options: _Options, folder: Path) -> Any:
    """Return the model with Q/DQ nodes, by ONNX Runtime."""
    import onnx
    from onnxruntime.quantization import CalibrationMethod, QuantFormat, QuantType, quantize_static

    accelerator, left_out = options.accelerator, set(options.exclude)
    if accelerator:
        table = harmonised(table, model)
        left_out |= {node.name for node in model.graph.node if node.op_type == "Add"} - residual_additions(model)
    tensors = {name for node in model.graph.node for name in node.output} | set(feed)
    overrides: dict[str, Any] = matmul_overrides(model) if options.per_channel else {}
    for name in sorted(tensors & set(table.ranges)):
        low, high = table.range(name)
        q = choose_qparams(low, high, signed=accelerator, symmetric=accelerator)
        overrides[name] = [{"scale": np.array(q.scale), "zero_point": np.array(q.zero_point, dtype=q.dtype)}]
    extra: dict[str, Any] = {"TensorQuantOverrides": overrides, "WeightSymmetric": True}
    if accelerator:
        extra |= {
            "ActivationSymmetric": True,
            "AddQDQPairToWeight": True,
            "QuantizeBias": False,
            "ForceQuantizeNoInputCheck": True,
            "OpTypesToExcludeOutputQuantization": [op for op in _TENSORRT_OPS if op not in KEEPS_SCALE],
        }
    ready, result = folder / "ready.onnx", folder / "result.onnx"
    onnx.save(model, str(ready))
    try:
        quantize_static(
            str(ready),
            str(result),
            _OneBatch(next(batches(model, feed, 1))),
            quant_format=QuantFormat.QDQ,
            op_types_to_quantize=list(_TENSORRT_OPS) if accelerator else None,
            per_channel=options.per_channel,
            reduce_range=options.reduce_range,
            activation_type=QuantType.QInt8 if accelerator else QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            nodes_to_exclude=sorted(left_out),
            calibrate_method=CalibrationMethod.MinMax,
            extra_options=extra,
        )
    except Exception as error:  # its errors are of many kinds
        raise InputError(
            "model",
            given=f"{type(error).__name__}: {str(error).splitlines()[0][:120] if str(error) else ''}",
            expected="a network that ONNX Runtime's quantiser can handle",
            fix="Leave the operator at fault in floating point with exclude=, or export the network again.",
        ) from error
    return onnx.load(str(result))


class _OneBatch:
    """ONNX Runtime insists on running something, though every range is given."""

    def __init__(self, batch: dict[str, Any]) -> None:
        self._rest = [batch]

    def get_next(self) -> dict[str, Any] | None:
        return self._rest.pop() if self._rest else None


def _outcome(model: Any) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of convolutions and products that read dequantised activations, and of the others."""
    made = producers(model)
    names: dict[bool, list[str]] = {True: [], False: []}
    for node in model.graph.node:
        if node.op_type in COMPUTE:
            names[all(dequantised(made, name) for name in node.input[:2])].append(node.name)
    return tuple(names[True]), tuple(names[False])


def _describe(model: Any, source: Any, table: CalibrationTable, options: _Options, digest: str) -> None:
    import onnx
    import onnxruntime

    how = {
        "target": options.target,
        "method": table.method,
        "percentile": table.percentile,
        "samples": table.samples,
        "per_channel": options.per_channel,
        "reduce_range": options.reduce_range,
        "exclude": options.exclude,
        "source_sha256": digest,
        "inputs_sha256": table.inputs_sha256,
        "onnxruntime": onnxruntime.__version__,
        "robotbrain": __version__,
    }
    kept = {entry.key: entry.value for entry in source.metadata_props}
    del model.metadata_props[:]
    onnx.helper.set_model_props(model, dict(sorted({**kept, METADATA: json.dumps(how, sort_keys=True)}.items())))
    model.producer_name, model.producer_version = "robotbrain", __version__
    model.graph.name = source.graph.name or "network"


def _try(model: Any, feed: Mapping[str, Any], options: _Options) -> None:
    """Run the file once and, for TensorRT, lint it: what leaves here is to work."""
    import onnx

    from robotbrain.optimisation.qdq_lint import lint

    try:
        onnx.checker.check_model(model)
        runner = session(model)
        outputs = runner.run(None, next(batches(model, feed, 1)))
    except Exception as error:
        raise RobotBrainError(f"the quantised model does not run: {str(error)[:200]}") from error
    if not all(np.isfinite(array).all() for array in outputs):
        raise RobotBrainError("the quantised model computes NaN or infinity")
    errors = [finding for finding in lint(model) if finding.severity == "error"] if options.accelerator else []
    if errors:
        raise InputError(
            f"model, at {errors[0].node}",
            given=errors[0].message,
            expected="operators that TensorRT runs",
            fix=errors[0].fix,
        )
