"""What this machine's processor does with 8-bit integers: what it says, and what ONNX Runtime does on it."""

from __future__ import annotations

import platform
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

_VNNI_FLAGS = frozenset({"avx512_vnni", "avx_vnni", "avx512vnni", "avxvnni"})

_PF_AVX2 = 40
"""PF_AVX2_INSTRUCTIONS_AVAILABLE of the Windows API."""


@dataclass(frozen=True)
class CpuFeatures:
    """What the operating system says about the processor; None where it does not say.

    Attributes:
        architecture: ``x86-64``, ``arm64`` or what Python calls another.
        avx2: whether there are 256-bit integer instructions; None if unknown.
        vnni: whether there are 8-bit dot products with 32-bit sums (AVX-512 VNNI or AVX-VNNI); None if unknown.
        source: where this was read.
    """

    architecture: str
    avx2: bool | None
    vnni: bool | None
    source: str

    @property
    def saturates(self) -> bool | None:
        """Whether INT8 layers can saturate here (see :mod:`robotbrain.optimisation.saturation`); None if unknown."""
        if self.architecture != "x86-64":
            return False if self.architecture == "arm64" else None
        return None if self.vnni is None else not self.vnni

    def sentence(self) -> str:
        """Return one sentence for a report."""
        say = {True: "yes", False: "no", None: "unknown"}
        verdict = {
            True: "INT8 layers can saturate in ONNX Runtime; use reduce_range or VNNI hardware",
            False: "INT8 layers do not saturate",
            None: "whether INT8 layers saturate is unknown; onnxruntime_saturates() finds out",
        }[self.saturates]
        return f"{self.architecture}, AVX2 {say[self.avx2]}, VNNI {say[self.vnni]} ({self.source}): {verdict}."


def cpu_features() -> CpuFeatures:
    """Ask the operating system; takes no privileges, and never fails.

    Linux: /proc/cpuinfo. macOS: sysctl. Windows says whether there is AVX2, but nothing about VNNI.
    """
    machine = platform.machine().lower()
    architecture = {"amd64": "x86-64", "x86_64": "x86-64", "aarch64": "arm64", "arm64": "arm64"}.get(machine, machine)
    if architecture != "x86-64":
        return CpuFeatures(architecture, False if architecture == "arm64" else None, None, "platform.machine")
    flags, source = _flags()
    if flags:
        return CpuFeatures(architecture, "avx2" in flags, bool(flags & _VNNI_FLAGS), source)
    return CpuFeatures(architecture, _windows_avx2(), None, source)


def onnxruntime_saturates() -> bool:
    """Find out by experiment: run one layer that would saturate in ONNX Runtime, with its integer kernel and without.

    This is what counts, on any operating system, under emulation too. Takes a few milliseconds.
    """
    import onnxruntime

    levels = onnxruntime.GraphOptimizationLevel
    content = _one_layer()
    outputs = []
    for level in (levels.ORT_ENABLE_ALL, levels.ORT_DISABLE_ALL):
        options = onnxruntime.SessionOptions()
        options.graph_optimization_level = level
        options.intra_op_num_threads = 1
        options.log_severity_level = 3
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        outputs.append(session.run(None, {"x": np.ones((2, 32), np.float32)})[0])
    return bool(np.abs(outputs[0] - outputs[1]).max() > 2 * _STEP)


_STEP = 0.25


def _one_layer() -> bytes:
    """Return a QDQ model: y = x W, (n, 32) to (n, 16), every weight and every input at its largest."""
    from onnx import TensorProto, helper, numpy_helper

    constants = {
        "sx": np.float32(1 / 255),
        "zx": np.uint8(0),
        "w": np.full((32, 16), 127, np.int8),
        "sw": np.float32(1 / 127),
        "zw": np.int8(0),
        "sy": np.float32(_STEP),
    }
    nodes = [
        helper.make_node("QuantizeLinear", ["x", "sx", "zx"], ["xq"]),
        helper.make_node("DequantizeLinear", ["xq", "sx", "zx"], ["xd"]),
        helper.make_node("DequantizeLinear", ["w", "sw", "zw"], ["wd"]),
        helper.make_node("MatMul", ["xd", "wd"], ["product"]),
        helper.make_node("QuantizeLinear", ["product", "sy", "zx"], ["yq"]),
        helper.make_node("DequantizeLinear", ["yq", "sy", "zx"], ["y"]),
    ]
    graph = helper.make_graph(
        nodes,
        "one_layer",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, ["n", 32])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, ["n", 16])],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    content: bytes = model.SerializeToString()
    return content


def _flags() -> tuple[frozenset[str], str]:
    """Return the lower-case names of instruction sets, and where they come from; none on Windows."""
    if sys.platform == "darwin":
        names = ("machdep.cpu.features", "machdep.cpu.leaf7_features")
        try:
            done = subprocess.run(["sysctl", "-n", *names], capture_output=True, text=True, timeout=10, check=False)
        except (OSError, subprocess.SubprocessError):
            return frozenset(), "sysctl does not answer"
        return frozenset(done.stdout.lower().split()), "sysctl"
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return frozenset(), "the system does not say"
    found = next((line.partition(":")[2] for line in lines if line.startswith("flags")), "")
    return frozenset(found.lower().split()), "/proc/cpuinfo"


def _windows_avx2() -> bool | None:
    import ctypes

    windows = getattr(ctypes, "windll", None)
    return None if windows is None else bool(windows.kernel32.IsProcessorFeaturePresent(_PF_AVX2))
