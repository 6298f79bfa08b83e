"""What a network asks of a GPU: the kernels it runs, what each computes and what each moves."""

from __future__ import annotations

import operator
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from robotbrain.errors import InputError

COMPUTE_OPS = ("conv", "dw", "mm")
"""Kernels that multiply and accumulate: dense or grouped convolution, depthwise convolution, matrix product."""

MEMORY_OPS = ("pw", "mem")
"""Kernels that only move data: pointwise arithmetic (``pw``) and everything else (``mem:pool``, ...)."""

MAX_BATCH = 65536
"""Largest batch; beyond it a number is a slip of the pen."""

PRECISIONS = ("fp32", "fp16", "int8")
"""Precisions a kernel can run in."""


def _plain(number: Any) -> Any:
    """Return a whole number of any kind (NumPy's, 5e6) as an int; leave anything else for the check to name."""
    if isinstance(number, bool):
        return number
    if isinstance(number, float) and number.is_integer():
        return int(number)
    try:
        return operator.index(number)
    except TypeError:
        return number


@dataclass(frozen=True, slots=True)
class Kernel:
    """One launch on the device: a layer with everything that is fused into it.

    Attributes:
        op: class of work: one of COMPUTE_OPS, ``"pw"``, or ``"mem:<what>"``.
        macs: multiply-accumulates, 0 for memory-bound kernels.
        in_elems: activation elements read.
        out_elems: activation elements written.
        weight_elems: weight elements read, or elements of the second operand of a product of two activations.
        name: of its first layer; empty if unknown.
        layers: names of all layers fused into it.
        precision: what the model's Q/DQ nodes ask for, or None where the builder chooses.
        dla_reason: why a DLA cannot run it; empty if it can.
    """

    op: str
    macs: int
    in_elems: int
    out_elems: int
    weight_elems: int
    name: str = ""
    layers: tuple[str, ...] = ()
    precision: str | None = None
    dla_reason: str = "unknown"

    def __post_init__(self) -> None:
        kind = self.op.partition(":")[0] if isinstance(self.op, str) else ""
        if kind not in COMPUTE_OPS + MEMORY_OPS:
            raise InputError(
                f"kernel {self.name or self.op!r}: op",
                given=self.op,
                expected="conv, dw, mm, pw or mem:<what>",
                fix="Name the class of work, not the framework's operator.",
            )
        for label in ("macs", "in_elems", "out_elems", "weight_elems"):
            value = getattr(self, label)
            if isinstance(value, bool) or not isinstance(value, int) or value < 0:
                raise InputError(
                    f"kernel {self.name or self.op!r}: {label}",
                    given=value,
                    expected="a whole number, 0 or more",
                    fix="Count elements, not bytes.",
                )
        if self.precision is not None and self.precision not in PRECISIONS:
            raise InputError(
                f"kernel {self.name or self.op!r}: precision",
                given=self.precision,
                expected="None, " + ", ".join(PRECISIONS),
                fix="Leave it None to let the builder choose.",
            )

    @property
    def computes(self) -> bool:
        """Whether it multiplies and accumulates."""
        return self.op in COMPUTE_OPS

    @property
    def elems(self) -> int:
        """Elements moved to or from memory."""
        return self.in_elems + self.out_elems + self.weight_elems

    def intensity(self, bytes_per_elem: float) -> float:
        """Return FLOPs (two for each MAC) per byte moved."""
        return 2 * self.macs / max(1.0, self.elems * bytes_per_elem)

    def at_batch(self, batch: int) -> Kernel:
        """Return the kernel for ``batch`` times as many inputs (weights are read once)."""
        return replace(self, macs=self.macs * batch, in_elems=self.in_elems * batch, out_elems=self.out_elems * batch)


@dataclass(frozen=True)
class KernelGraph:
    """The kernels of one inference, in the order in which they run.

    Attributes:
        name: of the model.
        kernels: in order.
        weight_elems: parameters, each counted once.
        weight_bytes: as stored in the model file's types.
        peak_activation_elems: most activation elements alive at once (input and output included).
        inputs, outputs: shapes by name.
        opset: ONNX opset, 0 if unknown.
        sha256: of the model file, empty if the graph did not come from a file.
        warnings: what the analyser had to assume, in words.
    """

    name: str
    kernels: tuple[Kernel, ...]
    weight_elems: int = 0
    weight_bytes: int = 0
    peak_activation_elems: int = 0
    inputs: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    outputs: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    opset: int = 0
    sha256: str = ""
    warnings: tuple[str, ...] = ()

    @property
    def macs(self) -> int:
        """Multiply-accumulates of one inference."""
        return sum(kernel.macs for kernel in self.kernels)

    def at_batch(self, batch: int) -> KernelGraph:
        """Return the graph for ``batch`` times as many inputs.

        Raises:
            InputError: unless ``batch`` is a whole number from 1 to MAX_BATCH.
        """
        if isinstance(batch, bool) or not isinstance(batch, int) or not 1 <= batch <= MAX_BATCH:
            raise InputError(
                "batch",
                given=batch,
                expected=f"a whole number, 1 or more (at most {MAX_BATCH})",
                fix="1 is one image at a time.",
            )
        if batch == 1:
            return self
        return replace(
            self,
            kernels=tuple(kernel.at_batch(batch) for kernel in self.kernels),
            peak_activation_elems=self.peak_activation_elems * batch,
        )

    @staticmethod
    def from_list(kernels: Iterable[Mapping[str, Any]], name: str = "kernels") -> KernelGraph:
        """Make a graph from plain mappings with ``op, macs, in_elems, out_elems, weight_elems``.

        Raises:
            InputError: for a missing field, or a value out of range.
        """
        made: list[Kernel] = []
        for index, item in enumerate(kernels):
            try:
                fields: dict[str, Any] = {"op": item["op"]}
                for key in ("macs", "in_elems", "out_elems", "weight_elems"):
                    fields[key] = _plain(item[key])
            except (KeyError, TypeError) as error:
                raise InputError(
                    f"kernel {index} of {name}",
                    given=item,
                    expected="a mapping with op, macs, in_elems, out_elems and weight_elems",
                    fix="Compare with autograder/profiles/calibration/kernels.json.",
                ) from error
            made.append(Kernel(**fields, name=str(item.get("name", ""))))
        if not made:
            raise InputError(name, given="no kernels", expected="at least one", fix="Is the list empty?")
        # A product of two activations fills weight_elems too; without the model there is no telling them apart.
        weights = sum(k.weight_elems for k in made)
        peak = max(k.in_elems + k.out_elems for k in made)
        return KernelGraph(
            name, tuple(made), weight_elems=weights, weight_bytes=4 * weights, peak_activation_elems=peak
        )
