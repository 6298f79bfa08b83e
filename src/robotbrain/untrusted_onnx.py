"""ONNX files from strangers: parsed and judged before a runtime sees them.

A submitted policy or network is data from somebody unknown. It is refused unless it is small, refers to no other file,
holds only stateless arithmetic without loops, and costs little. What is left cannot read files, run on for ever, or
ask for much memory. A grader still runs it in a process of its own: parsers have bugs.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

from robotbrain.errors import InputError


@dataclass(frozen=True)
class Limits:
    """What a file may ask for.

    Attributes:
        what: it is, for messages: ``"policy"``.
        fix: what its author can do.
        ops: operators of ONNX's own domain that it may use.
        opsets: it may be written in.
        rows: examples that are handed to it at once; the limits below are for so many.
        max_nodes: of the graph.
        max_elements: numbers in any tensor.
        max_written: numbers in the outputs of all nodes together: all of them may be in memory at once.
        max_work: multiply-adds and numbers read or written, all nodes together.
        slow: how often a result of a slow function counts.
        slow_ops: these functions.
    """

    what: str
    fix: str
    ops: frozenset[str]
    opsets: range
    rows: int
    max_nodes: int
    max_elements: int
    max_written: int
    max_work: int
    slow: int = 1
    slow_ops: frozenset[str] = frozenset()

    def refuse(self, of: str, given: object, expected: str, fix: str = "") -> InputError:
        """Return the error to raise; ``of`` is the part at fault, empty for the whole."""
        what = f"{of} of the {self.what}" if of else self.what
        return InputError(what, given=given, expected=expected, fix=fix or self.fix)


def read_limited(path: Path, max_bytes: int, *, what: str = "network", folder_fix: str = "", fix: str = "") -> bytes:
    """Return the content of a regular file of 1 to ``max_bytes`` bytes; what is checked is what is read.

    Args:
        path: of the file.
        max_bytes: it may have.
        what: it is, for messages.
        folder_fix: what to do if it is a folder; as for any other file if empty.
        fix: what to do otherwise.

    Raises:
        InputError: for anything else.
    """
    fix = fix or "Check the path."
    if path.is_dir():
        raise InputError(what, given=f"{path} (a folder)", expected="an ONNX file", fix=folder_fix or fix)
    try:
        # Without O_NONBLOCK, opening a pipe would wait for its writer for ever.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
        with os.fdopen(handle, "rb") as file:
            regular = stat.S_ISREG(os.fstat(handle).st_mode)
            data = file.read(max_bytes + 1) if regular else b""
    except (OSError, ValueError) as error:
        said = f"The system says: {error}"
        raise InputError(what, given=str(path), expected="the path of an ONNX file", fix=said) from error
    if not regular:
        raise InputError(what, given=f"{path} (no regular file)", expected="an ONNX file", fix=fix)
    if not 0 < len(data) <= max_bytes:
        given = f"{path} ({'more' if data else 'no'} bytes)"
        raise InputError(what, given=given, expected=f"1 to {max_bytes} bytes", fix="Train a smaller network.")
    return data


def parse_limited(data: bytes, limits: Limits) -> Any:
    """Parse a file's bytes and return the ``onnx.ModelProto`` if it keeps within the limits.

    The shapes of its inputs and outputs are the caller's to judge, and its cost is :func:`check_work`'s.

    Raises:
        InputError: otherwise.
    """
    import onnx

    model = onnx.ModelProto()
    try:
        model.ParseFromString(data)
    except Exception as error:  # protobuf's implementations raise classes of their own
        raise limits.refuse("", f"{len(data)} bytes that do not parse", "an ONNX file") from error
    graph = model.graph
    # Exporters also list domains that they did not use; nodes are checked one by one.
    versions = {entry.domain: entry.version for entry in model.opset_import}
    version = versions.get("", versions.get("ai.onnx"))
    if version not in limits.opsets:
        raise limits.refuse("opset", version, f"{limits.opsets[0]} to {limits.opsets[-1]}")
    if not 1 <= len(graph.node) <= limits.max_nodes:
        given = f"{len(graph.node)} nodes"
        raise limits.refuse("", given, f"1 to {limits.max_nodes}", "Train a simpler network.")
    for node in graph.node:
        if node.domain not in ("", "ai.onnx") or node.op_type not in limits.ops:
            given = f"{node.domain}::{node.op_type}" if node.domain else node.op_type
            raise limits.refuse("operator", given, "one of " + ", ".join(sorted(limits.ops)))
        for attribute in node.attribute:
            if attribute.HasField("g") or attribute.graphs or attribute.ref_attr_name:
                raise limits.refuse("operator", f"{node.op_type} with a graph inside", "plain arithmetic")
            if attribute.HasField("sparse_tensor") or attribute.sparse_tensors:
                raise limits.refuse("weights", "sparse tensors", "dense ones")
    if model.functions or model.training_info or graph.sparse_initializer:
        raise limits.refuse("", "functions, training information or sparse weights", "one plain graph")
    for tensor in tensors_of(graph):
        if tensor.external_data or tensor.data_location == onnx.TensorProto.EXTERNAL:
            fix = "Export with external_data=False."
            raise limits.refuse("weights", "weights in another file", "weights inside", fix)
        if any(d < 0 for d in tensor.dims) or prod(tensor.dims) > limits.max_elements:
            raise limits.refuse("weights", tuple(tensor.dims), f"at most {limits.max_elements} numbers in a tensor")
    return model


def check_graph(model: Any, limits: Limits) -> None:
    """Let ONNX's own checker judge the graph.

    Raises:
        InputError: it refuses.
    """
    import onnx

    try:
        onnx.checker.check_model(model)
    except Exception as error:  # the C++ side raises several kinds
        raise limits.refuse("", first_line(error), "a valid ONNX graph") from error


def tensors_of(graph: Any) -> Iterator[Any]:
    """All constant tensors of a graph: its initializers and those in attributes."""
    yield from graph.initializer
    for node in graph.node:
        for attribute in node.attribute:
            if attribute.HasField("t"):
                yield attribute.t
            yield from attribute.tensors


def check_work(model: Any, limits: Limits, *, once_per_row: bool = False) -> None:
    """Refuse what needs much time or memory: broadcasting or a resize can make a small file ask for terabytes.

    Args:
        model: that :func:`parse_limited` and :func:`check_graph` have passed.
        limits: of its cost.
        once_per_row: the batch is fixed at one row, so that it is run for each row anew.

    Raises:
        InputError: it costs too much, or nobody can say how much.
    """
    import onnx

    one = onnx.ModelProto()
    one.CopyFrom(model)
    del one.graph.value_info[:]  # the file's own claims
    for end in (*one.graph.input, *one.graph.output):
        batch = end.type.tensor_type.shape.dim[:1]
        if batch and not batch[0].HasField("dim_value"):
            batch[0].dim_value = limits.rows
    try:
        graph = onnx.shape_inference.infer_shapes(one, check_type=True, strict_mode=True, data_prop=True).graph
    except Exception as error:  # the C++ side raises several kinds
        raise limits.refuse("", first_line(error), "shapes that fit") from error
    shapes: dict[str, tuple[int, ...]] = {t.name: tuple(t.dims) for t in graph.initializer}
    floats = (onnx.TensorProto.FLOAT, onnx.TensorProto.DOUBLE)
    whole = set()
    for value in (*graph.input, *graph.value_info, *graph.output):
        if value.type.tensor_type.elem_type not in floats:
            whole.add(value.name)
        dims = value.type.tensor_type.shape.dim
        if all(d.HasField("dim_value") for d in dims):
            shapes[value.name] = tuple(d.dim_value for d in dims)
    work = written = 0
    for node in graph.node:
        if node.op_type == "Div" and whole.intersection(node.output):
            # A division of integers by zero ends the process.
            raise limits.refuse("operator", "Div of integers", "Div of floating-point numbers")
        for name in filter(None, node.output):
            if name not in shapes:
                raise limits.refuse("", f"{node.op_type} of unknown size", "sizes that follow from the input's")
            size = prod(shapes[name])
            if size > limits.max_elements:
                given = f"{node.op_type} of shape {shapes[name]}"
                raise limits.refuse("", given, f"at most {limits.max_elements} numbers")
            written += size
            work += size * _terms(node, shapes, limits)
        work += sum(prod(shapes.get(name, ())) for name in node.input)
    work *= limits.rows if once_per_row else 1
    fix = "Train a smaller network."
    for cost, limit, unit in (
        (written, limits.max_written, "numbers in all nodes' outputs"),
        (work, limits.max_work, "operations"),
    ):
        if cost > limit:
            raise limits.refuse("cost", f"{cost} {unit}", f"at most {limit} for {limits.rows} inputs at once", fix)


def _terms(node: Any, shapes: dict[str, tuple[int, ...]], limits: Limits) -> int:
    """Return the cost of one number of the node's output: how many products are summed into it, for instance."""
    first = shapes.get(node.input[0], ()) if node.input else ()
    if node.op_type == "MatMul":
        return first[-1] if first else 1
    if node.op_type == "Gemm":
        return max(first, default=1)
    if node.op_type == "Conv":
        return max(1, prod(shapes.get(node.input[1], ())[1:]))
    if node.op_type == "ConvTranspose":  # what its pads cut off is computed, too
        steps = prod(first) * prod(shapes.get(node.input[1], ())[1:])
        return max(1, steps // max(1, prod(shapes[node.output[0]])))
    if node.op_type in ("MaxPool", "AveragePool"):
        return prod(next((tuple(a.ints) for a in node.attribute if a.name == "kernel_shape"), (1,)))
    return limits.slow if node.op_type in limits.slow_ops else 1


def open_session(data: bytes, limits: Limits, *, as_written: bool = False) -> Any:
    """Return an ONNX Runtime session on one thread: results must not depend on the machine's core count.

    Args:
        data: of a model that was checked.
        limits: for messages.
        as_written: switch ONNX Runtime's optimisations off.

    Raises:
        InputError: ONNX Runtime does not take it.
    """
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.use_deterministic_compute = True
    options.log_severity_level = 4
    if as_written:
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    try:
        return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime raises a family of its own, without a common public base
        raise limits.refuse("", first_line(error), "a network that ONNX Runtime takes") from error


def first_line(error: Exception) -> str:
    """Return what an error says first, at most 200 characters."""
    lines = str(error).splitlines()
    return lines[0][:200] if lines else type(error).__name__
