"""Running a policy from an ONNX file, which may be a stranger's.

A submitted policy is data from somebody unknown. Before ONNX Runtime sees it, the file is parsed here and refused
unless it is small, refers to no other file, holds only stateless arithmetic without loops, and costs little for one
observation. What is left cannot read files, run on for ever, or ask for much memory. A grader still runs it in a
process of its own: parsers have bugs.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robotbrain.errors import InputError
from robotbrain.rl.policy_meta import PolicyMeta

MAX_BYTES = 16 * 2**20
"""A policy of four million float32 weights; the kit's own have some fifty thousand."""
MIN_OPSET = 11
MAX_NODES = 500
ROWS = 64
"""Observations that are handed to the network at once; larger batches are cut."""
MAX_ELEMENTS = 4_000_000
"""Numbers in any tensor, for ``ROWS`` observations."""
MAX_WRITTEN = 30_000_000
"""Numbers in the outputs of all nodes together, for ``ROWS`` observations: all of them may be in memory at once."""
MAX_WORK = 500_000_000
"""Multiply-adds and numbers read or written for ``ROWS`` observations, all nodes together, slow functions counted
``SLOW`` times. A dense network of ``MAX_BYTES`` needs about half of it."""
SLOW = 10
SLOW_OPS = frozenset(("Cos", "Elu", "Erf", "Exp", "Gelu", "Log", "Mish", "Pow", "Selu", "Sin", "Softmax", "Softplus"))
EXPORT_AGAIN = "Export the policy with robotbrain.rl.export.export_policy."

# fmt: off
ALLOWED_OPS = frozenset((
    "Abs", "Add", "BatchNormalization", "Cast", "Ceil", "Clip", "Concat", "Constant", "Conv", "Cos", "Div", "Elu",
    "Erf", "Exp", "Flatten", "Floor", "Gather", "Gelu", "Gemm", "Greater", "HardSigmoid", "HardSwish", "Identity",
    "LayerNormalization", "LeakyRelu", "Less", "Log", "MatMul", "Max", "Min", "Mish", "Mul", "Neg", "Pow",
    "PRelu", "Reciprocal", "ReduceMax", "ReduceMean", "ReduceMin", "ReduceSum", "Relu", "Reshape", "Selu",
    "Shape", "Sigmoid", "Sign", "Sin", "Slice", "Softmax", "Softplus", "Softsign", "Split", "Sqrt", "Squeeze",
    "Sub", "Tanh", "Transpose", "Unsqueeze", "Where",
))
# fmt: on
"""Operators of ONNX's own domain that a feed-forward policy needs: no control flow, no state, no random numbers."""


class OnnxPolicy:
    """A policy: float32 observations (n, O) in, actions (n, A) out.

    Args:
        path: of the ONNX file.
        max_bytes: larger files are refused.
        meta: what the policy means, for a file without the kit's metadata; None: the file must say so itself.

    Attributes:
        meta: what the file says about itself.
        path: of the file.

    Raises:
        InputError: no such file, too large, no ONNX, operators or sizes outside the limits of this module, weights in
            another file, or metadata that is missing or does not fit the network.
    """

    def __init__(self, path: str | Path, *, max_bytes: int = MAX_BYTES, meta: PolicyMeta | None = None) -> None:
        self.path = Path(path)
        data = read_limited(self.path, max_bytes)
        model = checked_model(data)
        self.meta = meta or PolicyMeta.from_metadata({p.key: p.value for p in model.metadata_props})
        self._session = _session(data)
        source, target = self._session.get_inputs()[0], self._session.get_outputs()[0]
        self._input, self._output = source.name, target.name
        _check_width("obs", source.shape[1], self.meta.observation_dim)
        # Some exporters fix the batch at one row; such a policy is asked row by row.
        self._rows = 1 if isinstance(source.shape[0], int) else ROWS
        self._check_rows()

    def __call__(self, obs: ArrayLike) -> NDArray[np.float32]:
        """Return the actions (n, A), float32, for observations (n, O) as the meta describes them.

        The actions are raw: ``policy.meta.commands(actions)`` clips and scales them.

        Raises:
            InputError: another shape, or values that are not finite, in or out.
        """
        rows = np.ascontiguousarray(obs, dtype=np.float32)
        width = self.meta.observation_dim
        if rows.ndim != 2 or rows.shape[1] != width:
            terms = ", ".join(f"{name} ({size})" for name, size in self.meta.observation_names)
            raise InputError(
                "policy observation",
                given=f"shape {rows.shape}",
                expected=f"(n, {width}): {terms}",
                fix="Concatenate these terms in this order, one row per robot.",
            )
        if not np.isfinite(rows).all():
            raise InputError(
                "policy observation",
                given="NaN or infinity",
                expected="finite values",
                fix="Check the sensors' readings.",
            )
        none = np.zeros((0, self.meta.action_dim), dtype=np.float32)
        result = np.concatenate([none, *(self._run(rows[i : i + self._rows]) for i in range(0, len(rows), self._rows))])
        if not np.isfinite(result).all():
            raise InputError(
                "policy action",
                given="NaN or infinity",
                expected="finite values",
                fix="Training diverged: train again.",
            )
        return result

    def _check_rows(self) -> None:
        """Refuse a network whose answer to one robot depends on the others (batch statistics, for instance)."""
        rows = np.random.default_rng(0).standard_normal((3, self.meta.observation_dim)).astype(np.float32)
        together, alone = self(rows), np.concatenate([self(rows[i : i + 1]) for i in range(3)])
        if np.abs(together - alone).max() > 1e-4 * max(1.0, float(np.abs(alone).max())):
            raise _refuse(
                "policy", "actions that depend on the other rows", "each row on its own", "Call eval() first."
            )

    def _run(self, rows: NDArray[np.float32]) -> NDArray[np.float32]:
        try:
            actions: NDArray[np.float32] = self._session.run([self._output], {self._input: rows})[0]
        except Exception as error:  # ONNX Runtime raises a family of its own, without a common public base
            raise InputError(
                "policy", given=str(self.path), expected="a network that runs", fix=_first_line(error)
            ) from error
        expected = (len(rows), self.meta.action_dim)
        if actions.shape != expected:
            raise _refuse("actions", f"shape {actions.shape}", f"{expected}: {', '.join(self.meta.action_names)}")
        return actions


def read_limited(path: Path, max_bytes: int = MAX_BYTES) -> bytes:
    """Return the content of a regular file of 1 to ``max_bytes`` bytes; what is checked is what is read.

    Raises:
        InputError: for anything else.
    """
    if path.is_dir():
        fix = f"Of a training run: `robotbrain rl export {path}` writes it, as {path / 'policy.onnx'}."
        raise _refuse("policy", f"{path} (a folder)", "an ONNX file", fix)
    try:
        # Without O_NONBLOCK, opening a pipe would wait for its writer for ever.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
        with os.fdopen(handle, "rb") as file:
            if not stat.S_ISREG(os.fstat(handle).st_mode):
                raise _refuse("policy", f"{path} (no regular file)", "an ONNX file")
            data = file.read(max_bytes + 1)
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise _refuse("policy", str(path), "the path of an ONNX file", f"The system says: {error}") from error
    if not 0 < len(data) <= max_bytes:
        shown = "more" if data else "no"
        raise _refuse("policy", f"{path} ({shown} bytes)", f"1 to {max_bytes} bytes", "Train a smaller network.")
    return data


def checked_model(data: bytes) -> Any:
    """Parse a file's bytes and return the ``onnx.ModelProto`` if it keeps within this module's limits.

    Raises:
        InputError: otherwise.
    """
    import onnx

    model = onnx.ModelProto()
    try:
        model.ParseFromString(data)
    except Exception as error:  # protobuf's implementations raise classes of their own
        raise _refuse("policy", f"{len(data)} bytes that do not parse", "an ONNX file") from error
    graph = model.graph
    _check_opset(model)
    if not 1 <= len(graph.node) <= MAX_NODES:
        raise _refuse("policy", f"{len(graph.node)} nodes", f"1 to {MAX_NODES}", "Train a simpler network.")
    for node in graph.node:
        if node.domain not in ("", "ai.onnx") or node.op_type not in ALLOWED_OPS:
            given = f"{node.domain}::{node.op_type}" if node.domain else node.op_type
            raise _refuse("operator of the policy", given, "one of " + ", ".join(sorted(ALLOWED_OPS)))
        for attribute in node.attribute:
            if attribute.HasField("g") or attribute.graphs or attribute.ref_attr_name:
                raise _refuse("operator of the policy", f"{node.op_type} with a graph inside", "plain arithmetic")
            if attribute.HasField("sparse_tensor") or attribute.sparse_tensors:
                raise _refuse("weights of the policy", "sparse tensors", "dense ones")
    if model.functions or model.training_info or graph.sparse_initializer:
        raise _refuse("policy", "functions, training information or sparse weights", "one plain graph")
    for tensor in _tensors(graph):
        _check_tensor(tensor)
    _check_ends(graph)
    try:
        onnx.checker.check_model(model)
    except Exception as error:  # the C++ side raises several kinds
        raise _refuse("policy", _first_line(error), "a valid ONNX graph") from error
    _check_work(model)
    return model


def _check_opset(model: Any) -> None:
    import onnx

    newest = onnx.defs.onnx_opset_version()
    versions = {entry.domain: entry.version for entry in model.opset_import}
    version = versions.pop("", None) or versions.pop("ai.onnx", None)
    if version is None or not MIN_OPSET <= version <= newest:
        raise _refuse("opset of the policy", version, f"{MIN_OPSET} to {newest}")
    # Exporters also list domains that they did not use; nodes are checked one by one.


def _tensors(graph: Any) -> Iterator[Any]:
    yield from graph.initializer
    for node in graph.node:
        for attribute in node.attribute:
            if attribute.HasField("t"):
                yield attribute.t
            yield from attribute.tensors


def _check_tensor(tensor: Any) -> None:
    import onnx

    if tensor.external_data or tensor.data_location == onnx.TensorProto.EXTERNAL:
        raise _refuse(
            "weights of the policy", "weights in another file", "weights inside", "Export with external_data=False."
        )
    kinds = (onnx.TensorProto.FLOAT, onnx.TensorProto.INT64, onnx.TensorProto.INT32, onnx.TensorProto.BOOL)
    if tensor.data_type not in (*kinds, onnx.TensorProto.DOUBLE):
        raise _refuse(
            "weights of the policy", f"data type {tensor.data_type}", "float32, float64, int32, int64 or bool"
        )
    if any(d < 0 for d in tensor.dims) or prod(tensor.dims) > MAX_ELEMENTS:
        raise _refuse("weights of the policy", tuple(tensor.dims), f"at most {MAX_ELEMENTS} numbers in a tensor")


def _check_ends(graph: Any) -> None:
    import onnx

    weights = {tensor.name for tensor in graph.initializer}
    for what, ends in (("input", [i for i in graph.input if i.name not in weights]), ("output", list(graph.output))):
        if len(ends) != 1:
            raise _refuse(f"{what}s of the policy", [e.name for e in ends[:8]], f"one {what}: no state, no second head")
        kind = ends[0].type.tensor_type
        if kind.elem_type != onnx.TensorProto.FLOAT or len(kind.shape.dim) != 2:
            raise _refuse(f"{what} of the policy", ends[0].name, "a float32 matrix, one row per robot")
        batch = kind.shape.dim[0]
        if batch.HasField("dim_value") and batch.dim_value != 1:
            raise _refuse(f"{what} of the policy", f"a batch of {batch.dim_value}", "any batch, or one row")


def _check_work(model: Any) -> None:
    """Refuse what needs much time or memory: broadcasting can make a small file ask for terabytes."""
    import onnx

    one = onnx.ModelProto()
    one.CopyFrom(model)
    del one.graph.value_info[:]  # the file's own claims
    for end in (*one.graph.input, *one.graph.output):
        batch = end.type.tensor_type.shape.dim[:1]
        if batch and not batch[0].HasField("dim_value"):
            batch[0].dim_value = ROWS
    try:
        graph = onnx.shape_inference.infer_shapes(one, check_type=True, strict_mode=True, data_prop=True).graph
    except Exception as error:  # the C++ side raises several kinds
        raise _refuse("policy", _first_line(error), "shapes that fit") from error
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
            raise _refuse("operator of the policy", "Div of integers", "Div of floating-point numbers")
        for name in filter(None, node.output):
            if name not in shapes:
                raise _refuse("policy", f"{node.op_type} of unknown size", "sizes that follow from the observation's")
            size = prod(shapes[name])
            if size > MAX_ELEMENTS:
                raise _refuse("policy", f"{node.op_type} of shape {shapes[name]}", f"at most {MAX_ELEMENTS} numbers")
            written += size
            work += size * _terms(node, shapes)
        work += sum(prod(shapes.get(name, ())) for name in node.input)
    weights = {tensor.name for tensor in graph.initializer}
    obs = next(value for value in model.graph.input if value.name not in weights)
    if obs.type.tensor_type.shape.dim[0].HasField("dim_value"):
        work *= ROWS  # a batch fixed at one row is run once for each observation
    if written > MAX_WRITTEN:
        raise _refuse(
            "policy",
            f"{written} numbers in all nodes' outputs",
            f"at most {MAX_WRITTEN} for {ROWS} observations",
            "Train a smaller network.",
        )
    if work > MAX_WORK:
        raise _refuse(
            "policy", f"{work} operations for {ROWS} observations", f"at most {MAX_WORK}", "Train a smaller network."
        )


def _terms(node: Any, shapes: dict[str, tuple[int, ...]]) -> int:
    """Return the cost of one number of the node's output: how many products are summed into it, for instance."""
    first = shapes.get(node.input[0], ()) if node.input else ()
    if node.op_type == "MatMul":
        return first[-1] if first else 1
    if node.op_type == "Gemm":
        return max(first, default=1)
    if node.op_type == "Conv":
        return prod(shapes.get(node.input[1], ())[1:])
    return SLOW if node.op_type in SLOW_OPS else 1


def _session(data: bytes) -> Any:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    # One thread: the nets are small, and results must not depend on the machine's core count.
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.use_deterministic_compute = True
    options.log_severity_level = 4
    try:
        return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime raises a family of its own, without a common public base
        raise _refuse("policy", _first_line(error), "a network that ONNX Runtime takes") from error


def _check_width(what: str, given: object, expected: int) -> None:
    if isinstance(given, int) and given != expected:
        raise _refuse(
            f"width of {what}", given, f"{expected}, as the metadata says", "Export the policy with its own metadata."
        )


def _refuse(what: str, given: object, expected: str, fix: str = EXPORT_AGAIN) -> InputError:
    return InputError(what, given=given, expected=expected, fix=fix)


def _first_line(error: Exception) -> str:
    lines = str(error).splitlines()
    return lines[0][:200] if lines else type(error).__name__
