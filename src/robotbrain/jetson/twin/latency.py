"""The latency model: a roofline for each kernel, launch overhead for each, and one fixed cost for each inference.

For kernel k with F FLOPs and B bytes on a GPU of peak P and bandwidth W::

    compute_k = F / (P x efficiency)        memory_k = B / (W x memory efficiency)
    t = sum_k [ sqrt(compute_k^2 + memory_k^2) + launch / gpu_ghz^clock ] + fixed

The root of squares is a roofline with a round corner: a kernel that is bound equally by both takes 1.4 times either.
The efficiencies, the launch overhead and the fixed cost are exponentials of sums of effects (of the GPU's family, the
precision, the harness, the module), each with a normal prior around 0, so that conditions without measurements borrow
from those that have them (partial pooling; see Gelman and Hill, Data Analysis Using Regression and Multilevel/
Hierarchical Models, 2007). The roofline is that of Williams, Waterman and Patterson, CACM 52(4), 2009.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robotbrain.jetson.kernels import KernelGraph
from robotbrain.jetson.twin.conditions import BYTES, PRECISIONS, Conditions

Array = NDArray[np.float64]

CONV, WINDOW_CONV, DEPTHWISE, MATMUL, DATA = range(5)
"""Kinds of kernels that the model tells apart: 1x1 (or strided) convolution, convolution with a window that is used
again and again (3x3 ...), depthwise convolution, matrix product, and kernels that only move data."""


@dataclass(frozen=True)
class Component:
    """One parameter of the model, on a logarithmic scale, and the effects it is made of.

    Attributes:
        name: of the parameter.
        mean, sd: prior of its general level.
        effects: attributes (joined by ``+``) whose values have an effect of their own, with the prior's sd.
        about: what it is, in words.
    """

    name: str
    mean: float
    sd: float
    effects: tuple[tuple[str, float], ...]
    about: str


COMPONENTS = (
    Component(
        "compute",
        math.log(0.5),
        1.0,
        (
            ("family", 0.3),
            ("family+precision", 0.2),
            ("engine", 0.4),
            ("harness", 0.2),
            ("family+harness", 0.2),
            ("harness+module+precision", 0.1),
        ),
        "share of the dense peak that convolutions and matrix products reach",
    ),
    Component("window", 0.0, 0.2, (("family+precision", 0.2),), "gain of convolutions with a window over 1x1"),
    Component(
        "depthwise",
        math.log(0.3),
        0.6,
        (("family", 0.7), ("engine", 0.7), ("harness", 0.7), ("family+harness", 1.5), ("family+precision", 0.3)),
        "share of the CUDA cores' peak that depthwise convolutions reach (they do not use tensor cores)",
    ),
    Component(
        "memory",
        math.log(0.6),
        0.3,
        (("family", 0.2), ("engine", 0.3), ("family+harness", 0.2), ("family+precision", 0.15)),
        "share of the bandwidth that is reached",
    ),
    Component("matmul", 0.0, 0.3, (("family", 0.3),), "gain in bandwidth of matrix products, which stream weights"),
    Component(
        "launch",
        math.log(0.02),
        1.5,
        (
            ("family", 0.5),
            ("engine", 0.7),
            ("harness", 0.7),
            ("family+harness", 0.5),
            ("harness+module", 0.15),
            ("family+harness+precision", 0.15),
        ),
        "launch overhead of a kernel at a GPU clock of 1 GHz, ms",
    ),
    Component("clock", 1.0, 0.3, (), "power of the GPU clock by which launch overhead falls (not a logarithm)"),
    Component(
        "fixed",
        math.log(0.1),
        1.2,
        (("family", 0.5), ("engine", 0.7), ("harness", 0.7), ("family+harness", 0.5), ("harness+module", 0.3)),
        "fixed cost of an inference, ms",
    ),
)
"""The parameters of the model and their priors."""

NAMES = tuple(component.name for component in COMPONENTS)


@dataclass(frozen=True)
class Work:
    """Kernels under given conditions: what the roofline needs of them.

    Attributes:
        kind: (K,) CONV ... DATA.
        compute_ms: (K,) time at the peak.
        memory_ms: (K,) time at the full bandwidth.
        bytes_moved: (K,)
        flops: (K,)
    """

    kind: NDArray[np.int64]
    compute_ms: Array
    memory_ms: Array
    bytes_moved: Array
    flops: Array


def explicit_precision(graph: KernelGraph) -> bool:
    """Whether the model states precisions itself by Q/DQ nodes."""
    return any(kernel.precision is not None for kernel in graph.kernels)


def kernel_precisions(graph: KernelGraph, where: Conditions) -> NDArray[np.int64]:
    """Return (K,) the precision in which each kernel runs, as an index into PRECISIONS."""
    asked = PRECISIONS.index(where.precision)
    if explicit_precision(graph) and where.precision == "int8":
        # With Q/DQ nodes, INT8 is only what lies between them; the rest runs in half precision.
        asked = PRECISIONS.index("fp16")
    index = np.array(
        [asked if k.precision is None else max(PRECISIONS.index(k.precision), asked) for k in graph.kernels],
        dtype=np.int64,
    )
    # Where nothing speeds INT8 up, what lies between Q/DQ nodes runs in half precision too.
    return index if where.fast_int8 else np.minimum(index, PRECISIONS.index("fp16"))


def make_work(graph: KernelGraph, where: Conditions) -> Work:
    """Return what the roofline needs of a graph's kernels."""
    count = len(graph.kernels)
    kind = np.empty(count, dtype=np.int64)
    flops, moved = np.empty(count), np.empty(count)
    precision = kernel_precisions(graph, where)
    for index, kernel in enumerate(graph.kernels):
        kind[index] = _kind(kernel.op, kernel.macs, kernel.in_elems, kernel.out_elems, kernel.weight_elems)
        flops[index] = 2.0 * kernel.macs
        moved[index] = float(kernel.elems) * BYTES[PRECISIONS[precision[index]]]
    peak = np.where(kind == DEPTHWISE, np.array(where.cuda_peak)[precision], np.array(where.peak)[precision])
    return Work(kind, 1e3 * flops / peak, 1e3 * moved / where.bandwidth, moved, flops)


def _kind(op: str, macs: int, in_elems: int, out_elems: int, weight_elems: int) -> int:
    if op == "dw":
        return DEPTHWISE
    if op == "mm":
        return MATMUL
    if op != "conv" or not (macs and out_elems and in_elems and weight_elems):
        return DATA
    # An output element sums macs / out terms; a pixel has weights / terms channels; so the window (over the square of
    # the stride, and times the groups' share) is how often each input element is used for one output channel.
    terms = macs / out_elems
    channels = max(1.0, weight_elems / terms)
    return WINDOW_CONV if terms * (out_elems / channels) / in_elems > 2 else CONV


class Batch:
    """Several (graph, conditions) pairs, evaluated at once."""

    def __init__(self, works: Sequence[Work], where: Sequence[Conditions]) -> None:
        self._count = len(works)
        self._row = np.repeat(np.arange(len(works)), [len(work.kind) for work in works])
        self._kind = np.concatenate([work.kind for work in works])
        self._compute = np.concatenate([work.compute_ms for work in works])
        self._memory = np.concatenate([work.memory_ms for work in works])
        self._log_ghz = np.log([c.gpu_ghz for c in where])

    def kernel_ms(self, theta: Mapping[str, Array]) -> tuple[Array, Array, Array]:
        """Return compute, memory and launch time of every kernel, ms.

        Args:
            theta: (N,) parameters by name, one value for each pair.
        """
        row, kind = self._row, self._kind
        compute = theta["compute"][row] + np.where(kind == WINDOW_CONV, theta["window"][row], 0.0)
        compute = np.where(kind == DEPTHWISE, theta["depthwise"][row], compute)
        memory = theta["memory"][row] + np.where(kind == MATMUL, theta["matmul"][row], 0.0)
        launch = np.exp(theta["launch"] - theta["clock"] * self._log_ghz)
        return self._compute * np.exp(-compute), self._memory * np.exp(-memory), launch[row]

    def latency_ms(self, theta: Mapping[str, Array]) -> Array:
        """Return (N,) latencies, ms."""
        compute, memory, launch = self.kernel_ms(theta)
        return self._sum(np.hypot(compute, memory) + launch) + np.exp(theta["fixed"])

    def log_slopes(self, theta: Mapping[str, Array]) -> dict[str, Array]:
        """Return the derivatives of the logarithms of the latencies with respect to each parameter, (N,) each."""
        compute, memory, launch = self.kernel_ms(theta)
        both = np.hypot(compute, memory)
        total = self._sum(both + launch) + np.exp(theta["fixed"])
        safe = np.where(both > 0, both, 1.0)
        by_compute, by_memory = -(compute**2) / safe, -(memory**2) / safe
        kind = self._kind
        launches = self._sum(launch)
        slopes = {
            "compute": self._sum(np.where(kind == DEPTHWISE, 0.0, by_compute)),
            "window": self._sum(np.where(kind == WINDOW_CONV, by_compute, 0.0)),
            "depthwise": self._sum(np.where(kind == DEPTHWISE, by_compute, 0.0)),
            "memory": self._sum(by_memory),
            "matmul": self._sum(np.where(kind == MATMUL, by_memory, 0.0)),
            "launch": launches,
            "clock": -self._log_ghz * launches,
            "fixed": np.exp(theta["fixed"]),
        }
        return {name: slope / total for name, slope in slopes.items()}

    def _sum(self, by_kernel: Array) -> Array:
        return np.asarray(np.bincount(self._row, by_kernel, minlength=self._count), dtype=np.float64)


@dataclass(frozen=True)
class Effect:
    """One coefficient of the model: a component's general level, or the effect of some levels on it.

    Attributes:
        component: which it belongs to.
        key: e.g. ``"family=ampere+harness=mlperf"``, empty for the general level.
        mean, sd: of the prior.
    """

    component: str
    key: str
    mean: float
    sd: float

    @property
    def name(self) -> str:
        """Component and key in one word."""
        return f"{self.component}[{self.key}]" if self.key else self.component


def effect_keys(component: Component, levels: Mapping[str, str]) -> list[tuple[str, float]]:
    """Return the effects (key, prior sd) that apply to a component under given levels."""
    keys = []
    for attributes, sd in component.effects:
        keys.append(("+".join(f"{name}={levels[name]}" for name in attributes.split("+")), sd))
    return keys


def list_effects(where: Iterable[Conditions]) -> list[Effect]:
    """Return the coefficients that the given conditions need, in a stable order."""
    levels = [c.levels() for c in where]
    effects: list[Effect] = []
    for component in COMPONENTS:
        effects.append(Effect(component.name, "", component.mean, component.sd))
        seen: dict[str, float] = {}
        for level in levels:
            seen.update(effect_keys(component, level))
        effects += [Effect(component.name, key, 0.0, seen[key]) for key in sorted(seen)]
    return effects


def design(effects: Sequence[Effect], where: Sequence[Conditions]) -> dict[str, Array]:
    """Return, by component, the (N, P) matrix that sums coefficients into parameters."""
    column = {(effect.component, effect.key): index for index, effect in enumerate(effects)}
    matrices: dict[str, Array] = {}
    for component in COMPONENTS:
        matrix = np.zeros((len(where), len(effects)))
        for row, condition in enumerate(where):
            for key, _ in [("", 0.0), *effect_keys(component, condition.levels())]:
                index = column.get((component.name, key))
                if index is not None:
                    matrix[row, index] = 1.0
        matrices[component.name] = matrix
    return matrices


def unseen_variance(effects: Sequence[Effect], where: Conditions) -> dict[str, float]:
    """Return, by component, the prior variance of the effects that no measurement informs."""
    known = {(effect.component, effect.key) for effect in effects}
    return {
        component.name: sum(
            sd**2 for key, sd in effect_keys(component, where.levels()) if (component.name, key) not in known
        )
        for component in COMPONENTS
    }
