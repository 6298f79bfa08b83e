"""The AVX2 trap: why an INT8 network can be wrong on one PC and right on the next.

x86 processors before VNNI multiply 8-bit numbers with the instruction ``vpmaddubsw``: 32 unsigned bytes times 32
signed ones, neighbouring products added in pairs, each sum *saturated to 16 bits*. One product is at most
255 x 127 = 32385 and fits; two do not (16 bits end at 32767). Whatever lies above is lost without a word, and the layer
returns too small a number. With VNNI (``vpdpbusd``) sums are kept in 32 bits. Sources: Intel 64 and IA-32 manual, vol.
2, PMADDUBSW; https://onnxruntime.ai/docs/performance/model-optimizations/quantization.html, "When and why do I need to
try U8U8?".

This module computes both sums exactly, so that the damage to a given network can be seen on any machine. ONNX Runtime
1.31 under an emulated Haswell returns, number for number, what is computed here (``benchmarks/opt_saturation.py``).
Signed activations are no way out: on x86 it shifts them by 128 and runs the same kernel. Depthwise convolutions have a
kernel of their own, which does not saturate.

Cures: a processor with VNNI; weights of 7 bits (``reduce_range``), for 255 x (64 + 64) = 32640 fits; the session option
``session.x64quantprecision`` = "1", slower. To judge a network's accuracy, switch graph optimisations off
(``evaluate.onnx_session(path, optimise=False)``): integers are then emulated in float32.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robotbrain.errors import InputError
from robotbrain.optimisation.onnx_files import check_feed, read_model, session
from robotbrain.optimisation.saturation_layers import IntegerLayer, integer_layers

LOW, HIGH = -32768, 32767
"""What 16 bits hold."""


def maddubs(a: NDArray[np.uint8], b: NDArray[np.int8]) -> NDArray[np.int16]:
    """Return what ``vpmaddubsw`` does: neighbours along the last axis multiplied, added in pairs, saturated to 16 bits.

    Args:
        a: unsigned bytes, (..., 2 n).
        b: signed bytes of the same shape.

    Returns:
        (..., n) int16.
    """
    a, b = np.asarray(a), np.asarray(b)
    if a.dtype != np.uint8 or b.dtype != np.int8 or a.shape != b.shape or a.ndim == 0 or a.shape[-1] % 2:
        given = f"{a.dtype} {a.shape}, {b.dtype} {b.shape}"
        raise InputError("bytes", given=given, expected="uint8 and int8, of one even length", fix="Pad with zeros.")
    products = a.astype(np.int32) * b.astype(np.int32)
    return (products[..., 0::2] + products[..., 1::2]).clip(LOW, HIGH).astype(np.int16)


def exact_product(a: NDArray[np.uint8], w: NDArray[np.int8]) -> NDArray[np.int32]:
    """Return (M, K) uint8 times (K, N) int8 with 32-bit sums, as VNNI does it."""
    _check(a, w)
    # float64 holds every sum of fewer than 2^38 such products exactly, and has a fast matrix product.
    return np.rint(a.astype(np.float64) @ w.astype(np.float64)).astype(np.int32)


def saturating_product(a: NDArray[np.uint8], w: NDArray[np.int8]) -> NDArray[np.int32]:
    """Return (M, K) uint8 times (K, N) int8 with pairs k = (0, 1), (2, 3) ... saturated to 16 bits, as AVX2 does it."""
    result = exact_product(a, w)
    if a.shape[1] % 2:
        a, w = np.pad(a, ((0, 0), (0, 1))), np.pad(w, ((0, 1), (0, 0)))
    risky = can_saturate(w)
    # Only what exceeds 16 bits differs from the exact sum, and only few pairs of weights can make it.
    for pair in np.flatnonzero(risky.any(axis=1)):
        columns = np.flatnonzero(risky[pair])
        left, right = a[:, 2 * pair, None].astype(np.int32), a[:, 2 * pair + 1, None].astype(np.int32)
        sums = left * w[2 * pair, columns].astype(np.int32) + right * w[2 * pair + 1, columns].astype(np.int32)
        result[:, columns] -= sums - sums.clip(LOW, HIGH)
    return result


def can_saturate(w: NDArray[np.int8]) -> NDArray[np.bool_]:
    """Return for each pair of weights along axis 0 of (K, N), K even, whether some pair of unsigned bytes overflows."""
    pairs = w.astype(np.int32).reshape(-1, 2, w.shape[1])
    highest = 255 * np.maximum(pairs, 0).sum(axis=1)
    lowest = 255 * np.minimum(pairs, 0).sum(axis=1)
    return np.asarray((highest > HIGH) | (lowest < LOW))


@dataclass(frozen=True)
class LayerSaturation:
    """What saturation does to one layer.

    Attributes:
        name: of the ONNX node.
        op: its operator.
        risky_pairs: share of the pairs of weights that can overflow, 0 to 1; 0 means the layer is safe for any input.
        changed_outputs: share of the outputs that change on the given inputs.
        worst: largest change, relative to the layer's largest output.
        sqnr_db: outputs to change, dB; infinite if nothing changes. 40 is about 8-bit rounding, 20 hurts.
    """

    name: str
    op: str
    risky_pairs: float
    changed_outputs: float
    worst: float
    sqnr_db: float


def layer_saturation(model: str | Path, inputs: NDArray[np.float32]) -> list[LayerSaturation]:
    """Say for each integer layer of a QDQ file whether it can saturate, and what that does to its real inputs.

    Every layer gets the exact values of the layers before it, so that its own error is seen. Depthwise convolutions
    and weights in uint8 are left out: their kernels do not saturate.

    Args:
        model: a quantised ONNX file, weights in int8.
        inputs: (N, C, H, W) float32; a few images do.

    Raises:
        InputError: for a file without such a layer, or inputs that do not fit.
    """
    loaded = read_model(model)
    layers = _layers(loaded)
    values = _run(loaded, check_feed(loaded, inputs), [layer.activation for layer in layers])
    report = []
    for layer in layers:
        pairs = np.concatenate([can_saturate(_even(w)) for w in layer.matrices], axis=1)
        exact = layer.apply(values[layer.activation], exact_product)
        change = layer.apply(values[layer.activation], saturating_product) - exact
        power, noise = float((exact**2).sum()), float((change**2).sum())
        report.append(
            LayerSaturation(
                name=layer.name,
                op=layer.op,
                risky_pairs=float(pairs.mean()),
                changed_outputs=float((change != 0).mean()),
                worst=float(np.abs(change).max() / max(float(np.abs(exact).max()), 1e-30)),
                sqnr_db=float("inf") if noise == 0 else float(10 * np.log10(max(power, 1e-300) / noise)),
            )
        )
    return report


def run_saturating(model: str | Path, inputs: NDArray[np.float32], *, batch: int = 4) -> NDArray[np.float32]:
    """Return the first output of a QDQ file as a processor with AVX2 and without VNNI computes it.

    Exact sums in each integer layer are replaced by saturating ones, from the first layer to the last; everything else
    is ONNX Runtime. Slow (one run of the network per layer), and independent of this machine's processor.

    Args:
        model: a quantised ONNX file.
        inputs: (N, C, H, W) float32.
        batch: inputs at a time.
    """
    loaded = read_model(model)
    feed = check_feed(loaded, inputs)
    ((name, array),) = feed.items()
    layers = [layer for layer in _layers(loaded) if any(can_saturate(_even(w)).any() for w in layer.matrices)]
    cut = _cut(loaded, layers)
    runner = session(cut)
    outputs = []
    for first in range(0, len(array), batch):
        part = {name: array[first : first + batch]}
        part.update(_run(loaded, part, [layer.output for layer in layers]))
        for layer in layers:
            (quantised,) = runner.run([layer.activation], part)
            part[layer.output] = layer.apply(quantised, saturating_product).astype(np.float32)
        outputs.append(runner.run([loaded.graph.output[0].name], part)[0])
    return np.concatenate(outputs)


def _layers(model: Any) -> list[IntegerLayer]:
    layers = integer_layers(model)
    if not layers:
        raise InputError(
            "model",
            given="no Conv, MatMul or Gemm with 8-bit activations and int8 weights",
            expected="a QDQ file",
            fix="Quantise it with robotbrain.optimisation.quantise_onnx.",
        )
    return layers


def _even(w: NDArray[np.int8]) -> NDArray[np.int8]:
    return np.pad(w, ((0, w.shape[0] % 2), (0, 0)))


def _run(model: Any, feed: dict[str, Any], names: list[str]) -> dict[str, Any]:
    """Return tensors inside a model by name."""
    import onnx

    exposed = onnx.ModelProto()
    exposed.CopyFrom(model)
    present = {value.name for value in exposed.graph.output}
    exposed.graph.output.extend(onnx.ValueInfoProto(name=n) for n in dict.fromkeys(names) if n not in present)
    wanted = list(dict.fromkeys(names))
    return dict(zip(wanted, session(exposed).run(wanted, feed), strict=True)) if wanted else {}


def _cut(model: Any, layers: list[IntegerLayer]) -> Any:
    """Return a copy in which the layers' outputs are inputs, and their activations outputs."""
    import onnx

    cut = onnx.ModelProto()
    cut.CopyFrom(model)
    outputs = {layer.output for layer in layers}
    kept = [node for node in cut.graph.node if node.output[0] not in outputs]
    del cut.graph.node[:]
    cut.graph.node.extend(kept)
    for layer in layers:
        cut.graph.input.append(onnx.helper.make_tensor_value_info(layer.output, onnx.TensorProto.FLOAT, None))
    present = {value.name for value in cut.graph.output}
    names = dict.fromkeys(layer.activation for layer in layers)
    cut.graph.output.extend(onnx.ValueInfoProto(name=n) for n in names if n not in present)
    return cut


def _check(a: NDArray[np.uint8], w: NDArray[np.int8]) -> None:
    if a.dtype != np.uint8 or w.dtype != np.int8 or a.ndim != 2 or w.ndim != 2 or a.shape[1] != w.shape[0]:
        given = f"{a.dtype} {a.shape}, {w.dtype} {w.shape}"
        raise InputError("matrices", given=given, expected="uint8 (M, K), int8 (K, N)", fix="Quantise them first.")
