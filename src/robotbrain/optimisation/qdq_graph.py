"""Small operations on ONNX graphs with Q/DQ nodes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

from robotbrain.errors import InputError
from robotbrain.optimisation.onnx_files import opset_of

COMPUTE = frozenset({"Conv", "ConvTranspose", "Gemm", "MatMul"})
"""Operators that TensorRT runs on 8-bit integers when both operands are dequantised."""


def conform(model: Any, opset: int) -> Any:
    """Return a copy of a model at an opset.

    Raises:
        InputError: if the model cannot be converted.
    """
    import onnx

    copy = onnx.ModelProto()
    copy.CopyFrom(model)
    have = opset_of(model)
    if have == opset:
        return copy
    try:
        copy = onnx.version_converter.convert_version(copy, opset)
        onnx.checker.check_model(copy)
        if opset_of(copy) != opset:
            raise ValueError(f"still opset {opset_of(copy)}")
    except Exception as error:  # the converter's C++ side raises several kinds
        raise InputError(
            "opset of the model",
            given=have,
            expected=f"{opset}, or one that can be converted to it",
            fix=f"Export it again with torch.onnx.export(..., opset_version={opset}, dynamo=False): the exporter that "
            "torch uses by default writes 18 and later only.",
        ) from error
    return copy


_LOOKED_THROUGH = frozenset({"Flatten", "Identity", "Pad", "Reshape", "Squeeze", "Transpose", "Unsqueeze"})


def producers(model: Any) -> dict[str, Any]:
    """Return tensor name -> the node that computes it."""
    return {name: node for node in model.graph.node for name in node.output if name}


def readers(model: Any) -> dict[str, list[Any]]:
    """Return tensor name -> the nodes that read it."""
    found: dict[str, list[Any]] = defaultdict(list)
    for node in model.graph.node:
        for name in dict.fromkeys(node.input):
            if name:
                found[name].append(node)
    return found


def constants(model: Any) -> set[str]:
    """Return the names of tensors that never change."""
    fixed = {tensor.name for tensor in model.graph.initializer}
    return fixed | {name for node in model.graph.node if node.op_type == "Constant" for name in node.output}


def residual_additions(model: Any) -> set[str]:
    """Return the names of Add nodes whose operands both change from one inference to the next."""
    fixed = constants(model)
    return {
        node.name
        for node in model.graph.node
        if node.op_type == "Add" and not any(name in fixed for name in node.input)
    }


def pass_through_groups(model: Any, ops: Sequence[str]) -> list[list[str]]:
    """Return groups of tensors that operators only move: each should have one scale.

    Args:
        model: an ``onnx.ModelProto`` in floating point.
        ops: operators whose output holds values of its inputs; all inputs of a Concat, the first of others.
    """
    parent: dict[str, str] = {}

    def root(name: str) -> str:
        while parent.setdefault(name, name) != name:
            name = parent[name]
        return name

    for node in model.graph.node:
        if node.op_type in ops:
            moved = list(node.input) if node.op_type == "Concat" else [node.input[0]]
            for name in moved:
                parent[root(name)] = root(node.output[0])
    fixed = constants(model)
    groups: dict[str, list[str]] = defaultdict(list)
    for name in parent:
        if name not in fixed:
            groups[root(name)].append(name)
    return [sorted(group) for group in groups.values()]


def convolved(made: dict[str, Any], read: dict[str, list[Any]], name: str) -> bool:
    """Whether a convolution or product computes a tensor that a single node reads."""
    node = made.get(name)
    return node is not None and node.op_type in COMPUTE and len(read.get(name, ())) == 1


def dequantised(made: dict[str, Any], name: str) -> bool:
    """Whether a tensor comes from a DequantizeLinear, at once or by way of padding and changes of shape."""
    node = made.get(name)
    while node is not None and node.op_type in _LOOKED_THROUGH:
        node = made.get(node.input[0])
    return node is not None and node.op_type == "DequantizeLinear"


def move_pairs_before_padding(model: Any) -> None:
    """Put Q/DQ before a padding with zeros instead of behind it: the convolution that follows then pads for itself.

    Zero being exact, nothing changes in what is computed.
    """
    made, read = producers(model), readers(model)
    values = {tensor.name: tensor for tensor in model.graph.initializer}
    for quantise in [node for node in model.graph.node if node.op_type == "QuantizeLinear"]:
        pad = made.get(quantise.input[0])
        dequantises = read[quantise.output[0]]
        if pad is None or len(dequantises) != 1 or not _zero_padding(pad, values):
            continue
        source, padded, last = pad.input[0], pad.output[0], dequantises[0]
        if len(read[padded]) != 1 or len(read[source]) != 1 or last.op_type != "DequantizeLinear":
            continue
        quantise.input[0] = source
        for reader in read[last.output[0]]:
            reader.input[list(reader.input).index(last.output[0])] = padded
        pad.input[0] = last.output[0]
        moved = type(pad)()
        moved.CopyFrom(pad)
        model.graph.node.remove(pad)
        model.graph.node.insert(list(model.graph.node).index(last) + 1, moved)
        made, read = producers(model), readers(model)


def _zero_padding(node: Any, values: dict[str, Any]) -> bool:
    import onnx

    if node.op_type != "Pad" or any(a.name == "mode" and a.s != b"constant" for a in node.attribute):
        return False
    filler = node.input[2] if len(node.input) > 2 else ""
    return not filler or (filler in values and not onnx.numpy_helper.to_array(values[filler]).any())


def drop_pairs_before_additions(model: Any) -> None:
    """Take the Q/DQ pair off one operand of every residual addition, where a convolution computes that operand.

    The convolution, the addition and what follows are then one kernel; the other operand keeps its pair.
    """
    made, read = producers(model), readers(model)
    for add in [node for node in model.graph.node if node.op_type == "Add"]:
        for position, name in enumerate(add.input):
            dequantise = made.get(name)
            if dequantise is None or dequantise.op_type != "DequantizeLinear":
                continue
            quantise = made.get(dequantise.input[0])
            if quantise is None or not convolved(made, read, quantise.input[0]):
                continue
            add.input[position] = quantise.input[0]
            if len(read[name]) == 1:
                model.graph.node.remove(dequantise)
                if len(read[quantise.output[0]]) == 1:
                    model.graph.node.remove(quantise)
            break


def tidy(model: Any) -> None:
    """Drop what is not used, and put what has no order in alphabetical order: same network, same bytes."""
    used = {name for node in model.graph.node for name in node.input} | {info.name for info in model.graph.output}
    stored = sorted((t for t in model.graph.initializer if t.name in used), key=lambda tensor: str(tensor.name))
    del model.graph.initializer[:]
    model.graph.initializer.extend(stored)
    del model.graph.value_info[:]
    domains = {node.domain for node in model.graph.node if node.domain not in ("", "ai.onnx")}
    versions = {entry.domain: entry.version for entry in model.opset_import if entry.domain in domains}
    opset = opset_of(model)
    del model.opset_import[:]
    for domain, version in [("", opset), *sorted(versions.items())]:
        entry = model.opset_import.add()
        entry.domain, entry.version = domain, version
    for node in model.graph.node:
        node.doc_string = ""
    model.doc_string = model.graph.doc_string = ""
