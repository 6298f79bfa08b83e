"""Before quantisation: is the model fit for it, and in what shape must it and its calibration table be?"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from robotbrain.errors import InputError
from robotbrain.optimisation.calibration import CalibrationTable
from robotbrain.optimisation.onnx_files import QUANTISERS
from robotbrain.optimisation.qdq_graph import COMPUTE, conform, pass_through_groups

KEEPS_SCALE = ("Concat", "MaxPool", "Resize")
"""Operators whose output holds the values of their inputs (or mixtures of them), and nothing else."""

_COARSER = 4.0


def harmonised(table: CalibrationTable, model: Any) -> CalibrationTable:
    """Return the table with one range for tensors that pooling, resizing and concatenation only move.

    Then 8-bit values are copied as they are. Around a concatenation this stops where it would make a tensor more than
    four times coarser, which costs more accuracy than the rescaling costs time.

    Args:
        table: ranges of the model's tensors.
        model: an ``onnx.ModelProto`` in floating point.
    """

    def groups(ops: Sequence[str]) -> list[list[str]]:
        # Lengths of axes are concatenated, too: integers, which have no range.
        kept = ([name for name in group if name in table.ranges] for group in pass_through_groups(model, ops))
        return [group for group in kept if group]

    table = table.merged(groups(("MaxPool", "Resize")))
    joined = []
    for group in groups(KEEPS_SCALE):
        bounds = [bound for name in group if (bound := max(map(abs, table.range(name)))) > 0]
        if max(bounds, default=0.0) <= _COARSER * min(bounds, default=0.0):
            joined.append(group)
    return table.merged(joined)


def matmul_overrides(model: Any) -> dict[str, list[dict[str, Any]]]:
    """Return what ONNX Runtime's quantiser must be told about constant factors of MatMul when it works per channel.

    It takes axis 1, which is the columns of a matrix only. Of a stack of matrices the columns are the last axis, and
    along axis 1 of a left factor is what is summed over, where a scale cannot be taken out of the sum.
    """
    ranks = {tensor.name: len(tensor.dims) for tensor in model.graph.initializer}
    products = [node.input for node in model.graph.node if node.op_type == "MatMul"]
    stacks = {right: [{"axis": ranks[right] - 1}] for _, right in products if ranks.get(right, 0) > 2}
    return stacks | {left: [{"symmetric": True}] for left, _ in products if left in ranks}


def refuse_quantised(model: Any, name: str) -> None:
    """Raise InputError for a model that has been quantised before."""
    low = [node.op_type for node in model.graph.node if _is_quantised(node.op_type)]
    if low:
        raise InputError(
            "model",
            given=f"{name}, with {len(low)} nodes such as {low[0]}",
            expected="a network in floating point",
            fix="It is quantised already: start from the file it was made from.",
        )


def _is_quantised(op: str) -> bool:
    return op in QUANTISERS or op.startswith("QLinear") or op.endswith("Integer") or op == "DynamicQuantizeLinear"


def prepare(model: Any, opset: int, folder: Path) -> Any:
    """Return the model at its opset, normalisations folded, shapes inferred and every node named."""
    import onnx
    from onnxruntime.quantization.shape_inference import quant_pre_process

    ready = conform(model, opset)
    source, target_file = folder / "source.onnx", folder / "ready.onnx"
    onnx.save(ready, str(source))
    try:
        quant_pre_process(str(source), str(target_file), skip_symbolic_shape=True)
        ready = onnx.load(str(target_file))
    except Exception as error:  # ONNX Runtime raises a family of its own
        raise InputError(
            "model",
            given=f"{type(error).__name__}: {str(error).splitlines()[0][:120] if str(error) else ''}",
            expected="a model that ONNX Runtime can load and whose shapes can be inferred",
            fix="Check it with onnx.checker.check_model(path, full_check=True).",
        ) from error
    taken = {node.name for node in ready.graph.node}
    for index, node in enumerate(ready.graph.node):
        if not node.name:
            name = f"{node.op_type}_{index}"
            while name in taken:
                name += "_"
            node.name = name
            taken.add(name)
    del ready.metadata_props[:]
    return ready


def excluded(model: Any, exclude: Sequence[str]) -> list[str]:
    """Return the names of nodes to leave out, sorted; raise InputError for one that is not there."""
    names = [exclude] if isinstance(exclude, str) else sorted(set(exclude))
    known = {node.name for node in model.graph.node}
    missing = [name for name in names if name not in known]
    if missing:
        computing = [node.name for node in model.graph.node if node.op_type in COMPUTE]
        raise InputError(
            "exclude",
            given=missing,
            expected="names of nodes, such as " + ", ".join(computing[:6]),
            fix="Look the names up in the ONNX file, e.g. with Netron.",
        )
    return names


def check_table(table: CalibrationTable, model: Any, digest: str) -> None:
    """Raise InputError unless a table has a range for every floating-point tensor of a prepared model.

    Args:
        table: made from the same file.
        model: from :func:`prepare`, its shapes inferred.
        digest: SHA-256 of the file.
    """
    import onnx

    if table.model_sha256 not in ("", digest):
        raise InputError(
            "calibration table",
            given=f"of a model with sha256 {table.model_sha256[:12]}...",
            expected=f"of this one, {digest[:12]}...",
            fix="Calibrate this model.",
        )
    computed = {name for node in model.graph.node if node.op_type != "Constant" for name in node.output}
    for info in (*model.graph.value_info, *model.graph.output):
        if info.name in computed and info.type.tensor_type.elem_type == onnx.TensorProto.FLOAT:
            table.range(info.name)
