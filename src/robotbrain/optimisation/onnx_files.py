"""Reading ONNX files for quantisation: what is refused, and the few questions one has about a graph."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robotbrain.errors import InputError

MAX_BYTES = 2**31 - 1
"""Protocol buffers end at 2 GiB."""

QUANTISERS = frozenset({"QuantizeLinear", "DequantizeLinear"})


def read_model(path: str | Path, *, check_weights: bool = True) -> Any:
    """Return the ``onnx.ModelProto`` of a file, weights included.

    Raises:
        InputError: for a missing or damaged file, one of more than 2 GB, or (with ``check_weights``) weights that are
            NaN or infinite.
    """
    import onnx

    file = Path(path)
    if not file.is_file():
        raise InputError(
            "model",
            given=str(path),
            expected="the path of an ONNX file",
            fix="Export the network first, e.g. with robotbrain.optimisation.export_onnx.",
        )
    try:
        _check_size(file, file.stat().st_size)
        model = onnx.load(str(file), load_external_data=False)
        entries = [entry for tensor in contents(model)[1] for entry in tensor.external_data]
        outside = {entry.value for entry in entries if entry.key == "location"}
        if outside:
            _check_size(file, sum((file.parent / name).stat().st_size for name in outside))
            onnx.load_external_data_for_model(model, str(file.parent))
        if not model.graph.node:
            raise ValueError("no nodes")
        if any(tensor.data_location == onnx.TensorProto.EXTERNAL for tensor in contents(model)[1]):
            raise ValueError("weights of a function in another file")
    except InputError:
        raise
    except Exception as error:  # protobuf, onnx and the file system raise classes of their own
        raise InputError(
            "model",
            given=file.name,
            expected="an ONNX model with nodes",
            fix=f"It cannot be read ({type(error).__name__}): export or download it again.",
        ) from error
    for tensor in model.graph.initializer if check_weights else ():
        if tensor.data_type == onnx.TensorProto.FLOAT and not np.isfinite(onnx.numpy_helper.to_array(tensor)).all():
            raise InputError(
                f"weight {tensor.name!r}",
                given="NaN or infinity",
                expected="finite numbers",
                fix="Training diverged, or the file is damaged; take an earlier checkpoint.",
            )
    return model


def _check_size(file: Path, size: int) -> None:
    if size > MAX_BYTES:
        raise InputError(
            "model",
            given=f"{file.name}, {size / 1e9:.1f} GB with its weights",
            expected="at most 2 GB",
            fix="Quantise a network of this size with its maker's own tools.",
        )


def contents(model: Any) -> tuple[list[Any], list[Any]]:
    """Return all nodes and all constant tensors, those of inner graphs and of the model's own functions too."""
    nodes: list[Any] = []
    tensors: list[Any] = []

    def sparse(found: Any) -> None:
        for item in found:
            tensors.extend((item.values, item.indices))

    def attributes(found: Any) -> None:
        for item in found:
            tensors.extend([*item.tensors, *([item.t] if item.HasField("t") else [])])
            sparse([*item.sparse_tensors, *([item.sparse_tensor] if item.HasField("sparse_tensor") else [])])
            for inner in (*item.graphs, *([item.g] if item.HasField("g") else [])):
                graph(inner)

    def body(found: Any) -> None:
        nodes.extend(found)
        for node in found:
            attributes(node.attribute)

    def graph(found: Any) -> None:
        tensors.extend(found.initializer)
        sparse(found.sparse_initializer)
        body(found.node)

    graph(model.graph)
    for function in model.functions:
        attributes(function.attribute_proto)
        body(function.node)
    return nodes, tensors


def check_graph(model: Any) -> None:
    """Check that every node has an output and runs after what it reads, as ONNX asks.

    Raises:
        InputError: for anything else; a graph that goes in circles among it.
    """
    known = {tensor.name for tensor in model.graph.initializer} | {info.name for info in model.graph.input} | {""}
    known |= {tensor.values.name for tensor in model.graph.sparse_initializer}
    for node in model.graph.node:
        unknown = [name for name in node.input if name not in known]
        missing = node.op_type in QUANTISERS and len(node.input) < 2
        if unknown or missing or not any(node.output) or known & ({*node.output} - {""}):
            raise InputError(
                f"node {node.name or node.op_type!r}",
                given=f"inputs {list(node.input)}, outputs {list(node.output)}",
                expected="inputs that are there before it, outputs of its own",
                fix="The file is damaged, or its nodes are out of order: export it again.",
            )
        known.update(node.output)


def opset_of(model: Any) -> int:
    """Return the version of ONNX's own operator set that a model imports, 0 if none."""
    return next((int(entry.version) for entry in model.opset_import if entry.domain in ("", "ai.onnx")), 0)


def open_inputs(model: Any) -> list[Any]:
    """Return the ValueInfoProtos of the inputs that have to be fed."""
    stored = {tensor.name for tensor in model.graph.initializer}
    return [info for info in model.graph.input if info.name not in stored]


def dims(info: Any) -> list[int | str]:
    """Return the axes of a value: lengths, or names (possibly empty) of those that may have any length."""
    return [int(axis.dim_value) if axis.HasField("dim_value") else axis.dim_param for axis in shape_of(info)]


def shape_of(info: Any) -> Any:
    """Return the protobuf axes of a value."""
    return info.type.tensor_type.shape.dim


def check_feed(model: Any, inputs: NDArray[np.float32] | Mapping[str, NDArray[np.float32]]) -> dict[str, Any]:
    """Return calibration inputs by name, (N, ...) float32 each.

    Raises:
        InputError: for no samples, names, shapes or types that do not fit the model, NaN or infinity.
    """
    infos = open_inputs(model)
    feed = dict(inputs) if isinstance(inputs, Mapping) else {infos[0].name: inputs} if infos else {}
    if set(feed) != {info.name for info in infos}:
        raise InputError(
            "calibration inputs",
            given=sorted(feed),
            expected=f"arrays for {', '.join(info.name for info in infos)}",
            fix="Pass a dictionary from input name to array.",
        )
    feed = {name: np.asarray(array) for name, array in feed.items()}
    for info in infos:
        array, wanted = feed[info.name], dims(info)
        if array.ndim == 0 or len(array) == 0:
            raise InputError(
                f"calibration input {info.name!r}",
                given=f"shape {array.shape}",
                expected="some tens to hundreds of samples like those at work",
                fix="Take them from a split of their own: never from the test set.",
            )
        tail = list(zip(wanted[1:], array.shape[1:], strict=False))
        fits = array.ndim == len(wanted) and all(not isinstance(a, int) or a == b for a, b in tail)
        if array.dtype != np.float32 or not fits:
            raise InputError(
                f"calibration input {info.name!r}",
                given=f"{array.dtype} {array.shape}",
                expected=f"float32 (N, {', '.join(str(axis or '?') for axis in wanted[1:])})",
                fix="Normalise the images as for inference: robotbrain.pipeline.segmentation.normalise.",
            )
        if not np.isfinite(array).all():
            raise InputError(
                f"calibration input {info.name!r}",
                given="NaN or infinity",
                expected="finite values",
                fix="Check the preprocessing.",
            )
    if len({len(array) for array in feed.values()}) != 1:
        raise InputError(
            "calibration inputs",
            given={name: len(array) for name, array in feed.items()},
            expected="as many samples for every input",
            fix="Row n of every array belongs to sample n.",
        )
    return feed


def batches(model: Any, feed: Mapping[str, Any], batch_size: int) -> Iterator[dict[str, Any]]:
    """Yield the samples in order, in batches of the model's own size, or of ``batch_size`` where it is free.

    Samples that do not fill a batch of fixed size are left out.

    Raises:
        InputError: for fewer samples than the model's fixed batch.
    """
    count = len(next(iter(feed.values())))
    fixed = {axes[0] for axes in map(dims, open_inputs(model)) if axes and isinstance(axes[0], int)}
    size = max(fixed, default=batch_size)
    if size < 1 or (fixed and count < size):
        raise InputError(
            "calibration inputs",
            given=f"{count} samples in batches of {size}",
            expected="at least one batch",
            fix="Export the network with a dynamic batch, or pass more samples.",
        )
    for start in range(0, count - count % size if fixed else count, size):
        yield {name: array[start : start + size] for name, array in feed.items()}


def session(model: Any) -> Any:
    """Return an ONNX Runtime session that runs a model as it is written, on one thread.

    Graph optimisations are off, so that every tensor is there and INT8 is computed exactly (in floating point).

    Raises:
        InputError: for a model that ONNX Runtime refuses.
    """
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime raises a family of its own
        raise InputError(
            "model",
            given=model.graph.name or "an ONNX model",
            expected="a model that ONNX Runtime can run",
            fix=f"It says: {str(error).splitlines()[0][:200]}",
        ) from error


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keep the advice that ONNX Runtime's quantiser writes to the root logger away from the reader."""
    import onnxruntime

    root, drop, handler = logging.getLogger(), _Drop(), logging.NullHandler()
    root.addHandler(handler)  # without any handler, logging.warning() would install one that prints
    root.addFilter(drop)
    onnxruntime.set_default_logger_severity(3)
    try:
        yield
    finally:
        onnxruntime.set_default_logger_severity(2)
        root.removeFilter(drop)
        root.removeHandler(handler)


class _Drop(logging.Filter):
    def filter(self, record: logging.LogRecord) -> bool:
        return record.levelno >= logging.ERROR
