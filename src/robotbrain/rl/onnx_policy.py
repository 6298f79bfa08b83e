"""Running a policy from an ONNX file, which may be a stranger's.

Before ONNX Runtime sees it, :mod:`robotbrain.untrusted_onnx` refuses what is too large, too dear or no plain
feed-forward arithmetic; the limits are here.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robotbrain.errors import InputError
from robotbrain.rl.policy_meta import PolicyMeta
from robotbrain.untrusted_onnx import (
    Limits,
    check_graph,
    check_work,
    first_line,
    open_session,
    parse_limited,
    read_limited,
    tensors_of,
)

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

LIMITS = Limits(
    what="policy",
    fix=EXPORT_AGAIN,
    ops=ALLOWED_OPS,
    opsets=range(MIN_OPSET, MIN_OPSET + 1),  # to the newest that the installed onnx knows: see checked_model
    rows=ROWS,
    max_nodes=MAX_NODES,
    max_elements=MAX_ELEMENTS,
    max_written=MAX_WRITTEN,
    max_work=MAX_WORK,
    slow=SLOW,
    slow_ops=SLOW_OPS,
)


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
        folder = f"Of a training run: `robotbrain rl export {path}` writes it, as {self.path / 'policy.onnx'}."
        data = read_limited(self.path, max_bytes, what="policy", folder_fix=folder, fix=EXPORT_AGAIN)
        model = checked_model(data)
        self.meta = meta or PolicyMeta.from_metadata({p.key: p.value for p in model.metadata_props})
        self._session = open_session(data, LIMITS)
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
                "policy", given=str(self.path), expected="a network that runs", fix=first_line(error)
            ) from error
        expected = (len(rows), self.meta.action_dim)
        if actions.shape != expected:
            raise _refuse("actions", f"shape {actions.shape}", f"{expected}: {', '.join(self.meta.action_names)}")
        return actions


def checked_model(data: bytes) -> Any:
    """Parse a file's bytes and return the ``onnx.ModelProto`` if it keeps within this module's limits.

    Raises:
        InputError: otherwise.
    """
    import onnx

    newest = onnx.defs.onnx_opset_version()
    limits = replace(LIMITS, opsets=range(MIN_OPSET, newest + 1))
    model = parse_limited(data, limits)
    kinds = (onnx.TensorProto.FLOAT, onnx.TensorProto.INT64, onnx.TensorProto.INT32, onnx.TensorProto.BOOL)
    for tensor in tensors_of(model.graph):
        if tensor.data_type not in (*kinds, onnx.TensorProto.DOUBLE):
            given = f"data type {tensor.data_type}"
            raise limits.refuse("weights", given, "float32, float64, int32, int64 or bool")
    _check_ends(model.graph)
    check_graph(model, limits)
    weights = {tensor.name for tensor in model.graph.initializer}
    obs = next(value for value in model.graph.input if value.name not in weights)
    check_work(model, limits, once_per_row=obs.type.tensor_type.shape.dim[0].HasField("dim_value"))
    return model


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


def _check_width(what: str, given: object, expected: int) -> None:
    if isinstance(given, int) and given != expected:
        raise _refuse(
            f"width of {what}", given, f"{expected}, as the metadata says", "Export the policy with its own metadata."
        )


def _refuse(what: str, given: object, expected: str, fix: str = EXPORT_AGAIN) -> InputError:
    return InputError(what, given=given, expected=expected, fix=fix)
