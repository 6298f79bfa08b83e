"""Under which conditions a network runs: the module, its clocks, the precision and the way of timing."""

from __future__ import annotations

import difflib
from dataclasses import dataclass

from robotbrain.errors import InputError
from robotbrain.jetson.catalogue import Module
from robotbrain.jetson.modes import PowerMode

HARNESSES = ("trtexec", "torch2trt", "tf_to_trt", "efficientvit", "ultralytics", "mlperf")
"""Ways in which published latencies were timed.

``trtexec``: TensorRT's own tool, GPU compute time; no published row is of it, so it is predicted by transfer.
``torch2trt``, ``tf_to_trt``, ``efficientvit``, ``ultralytics``: the benchmark scripts of these projects, timed by the
host. ``mlperf``: MLPerf SingleStream, with CUDA graphs and hand-fused plugins.
"""

PRECISIONS = ("fp32", "fp16", "int8")
"""Precisions that an engine can be built for."""

BYTES = {"fp32": 4.0, "fp16": 2.0, "int8": 1.0}
"""Bytes of an element by precision."""


RELATIVES = {"blackwell": "ampere"}
"""Families without a published measurement, and the measured one whose behaviour stands in for theirs: the newest."""


def check_choice(what: str, given: object, choices: tuple[str, ...]) -> str:
    """Return ``given`` in lower case if it is one of the choices.

    Raises:
        InputError: otherwise, with the nearest choice.
    """
    word = str(given).strip().lower()
    if word in choices:
        return word
    near = difflib.get_close_matches(word, choices, n=1)
    raise InputError(
        what,
        given=given,
        expected="one of " + ", ".join(choices),
        fix=f"Did you mean {near[0]!r}?" if near else "Choose one of these.",
    )


@dataclass(frozen=True, slots=True)
class Conditions:
    """What the latency model needs to know besides the kernels.

    Attributes:
        module: slug.
        family: of the GPU.
        precision: that layers run in; the kernels' own Q/DQ precision goes first. Where the GPU does not speed INT8 up
            this is FP16 when INT8 was asked for.
        harness: one of HARNESSES.
        peak: dense FLOP/s by precision, of tensor cores where there are any.
        cuda_peak: FLOP/s of the CUDA cores by precision (twice the FP32 rate for FP16 and INT8).
        bandwidth: bytes/s of the memory bus.
        gpu_ghz: GPU clock.
        fast_int8: whether the GPU speeds INT8 up; if not, such layers run in FP16.
    """

    module: str
    family: str
    precision: str
    harness: str
    peak: tuple[float, float, float]
    cuda_peak: tuple[float, float, float]
    bandwidth: float
    gpu_ghz: float
    fast_int8: bool = True

    def levels(self) -> dict[str, str]:
        """Return the values of the attributes that effects of the model depend on."""
        return {
            "family": RELATIVES.get(self.family, self.family),
            "precision": self.precision,
            # MLPerf's engines are fused by hand and run as CUDA graphs: no model of what anybody else's do.
            "engine": "tuned" if self.harness == "mlperf" else "plain",
            "harness": self.harness,
            "module": self.module,
        }


def conditions(module: Module, mode: PowerMode, precision: str, harness: str) -> Conditions:
    """Return the conditions of an engine on a module in a power mode, or with the clocks of a mode made for it.

    Raises:
        InputError: for an unknown precision or harness.
    """
    precision = module.runs_as(check_choice("precision", precision, PRECISIONS))
    harness = check_choice("harness", harness, HARNESSES)
    share = mode.gpu_mhz / module.gpu_max_mhz * mode.sms_on / module.sm_count
    # TensorRT uses TF32 for FP32 layers wherever the tensor cores have it.
    peak = tuple(module.highest_flops("tf32" if p == "fp32" else p) * share for p in PRECISIONS)
    cuda = module.fp32_tflops * 1e12 * share
    return Conditions(
        module=module.slug,
        family=module.family,
        precision=precision,
        harness=harness,
        peak=(peak[0], peak[1], peak[2]),
        cuda_peak=(cuda, 2 * cuda, 2 * cuda),
        bandwidth=module.bandwidth_gbs * 1e9 * mode.emc_mhz / module.emc_max_mhz,
        gpu_ghz=mode.gpu_mhz / 1000,
        fast_int8=module.int8_tops is not None,
    )
