"""The TensorRT that an engine runs on: the module, CUDA, and one log, for the genuine one and for its stand-in."""

from __future__ import annotations

import functools
import re
from typing import TYPE_CHECKING, Any, Protocol

from robotbrain.errors import InputError, MissingDependencyError, RobotBrainError

if TYPE_CHECKING:
    import tensorrt

    from robotbrain.jetson.engine.cuda import CudaRuntime

OLDEST, NEWEST = (8, 5), (11, 99)
"""Versions of TensorRT that the engine is written for: named tensors begin with 8.5."""


class TensorRTError(RobotBrainError, RuntimeError):
    """TensorRT refused a call that should have worked; the message ends with what it said."""


class TensorRTModule(Protocol):
    """What is used of ``import tensorrt``."""

    __version__: str
    Builder: type[tensorrt.Builder]
    BuilderFlag: type[tensorrt.BuilderFlag]
    DataType: type[tensorrt.DataType]
    ILogger: type[tensorrt.ILogger]
    LayerType: type[tensorrt.LayerType]
    MemoryPoolType: type[tensorrt.MemoryPoolType]
    NetworkDefinitionCreationFlag: type[tensorrt.NetworkDefinitionCreationFlag]
    OnnxParser: type[tensorrt.OnnxParser]
    Runtime: type[tensorrt.Runtime]
    TensorIOMode: type[tensorrt.TensorIOMode]
    TensorLocation: type[tensorrt.TensorLocation]


if TYPE_CHECKING:
    _checked: TensorRTModule = tensorrt


class TensorRTRuntime:
    """One TensorRT and the GPU under it.

    There is one log for everything made from it, because TensorRT keeps the first logger of a process and ignores
    later ones.

    Args:
        trt: the module.
        cuda: the CUDA runtime.

    Attributes:
        log: messages of TensorRT.
        logger: what TensorRT's constructors take.

    Raises:
        InputError: for a version that the engine is not written for.
    """

    def __init__(self, trt: TensorRTModule, cuda: CudaRuntime) -> None:
        self.trt, self.cuda = trt, cuda
        if not OLDEST <= self.version <= NEWEST:
            raise InputError(
                "TensorRT",
                given=trt.__version__,
                expected="8.5 to 11",
                fix="On a Jetson, flash JetPack 5.1 or later (its modules: `robotbrain jetson list`).",
            )
        self.log = MessageLog()
        self.logger = _make_logger(trt, self.log)

    @property
    def version(self) -> tuple[int, int]:
        """Major and minor version of TensorRT."""
        found = re.match(r"(\d+)\.(\d+)", self.trt.__version__)
        return (int(found.group(1)), int(found.group(2))) if found else (0, 0)

    @property
    def simulated(self) -> bool:
        """Whether this is the stand-in."""
        return self.cuda.simulated

    def __repr__(self) -> str:
        name = "simulated TensorRT" if self.simulated else "TensorRT"
        return f"{name} {self.trt.__version__} on {self.cuda.device}"


class MessageLog:
    """What TensorRT said, the last thousand messages of it."""

    def __init__(self) -> None:
        self._messages: list[tuple[int, str]] = []
        self._dropped = 0

    def add(self, severity: int, message: str) -> None:
        """Add a message; severity 0 internal error, 1 error, 2 warning, 3 information, 4 verbose."""
        self._messages.append((severity, message))
        if len(self._messages) > 1000:
            del self._messages[0]
            self._dropped += 1

    def mark(self) -> int:
        """Return a mark for :meth:`errors`."""
        return self._dropped + len(self._messages)

    def errors(self, since: int) -> list[str]:
        """Return the errors since a mark."""
        recent = self._messages[max(0, since - self._dropped) :]
        return [message for severity, message in recent if severity <= 1]


def _make_logger(trt: TensorRTModule, log: MessageLog) -> tensorrt.ILogger:
    base: Any = trt.ILogger

    class Logger(base):  # type: ignore[misc]
        def __init__(self) -> None:
            base.__init__(self)  # pybind11 asks for the base's own, called by name

        def log(self, severity: Any, msg: str) -> None:
            if int(severity) <= 2:  # information and verbose messages come by the thousand
                log.add(int(severity), msg)

    made: tensorrt.ILogger = Logger()
    return made


@functools.lru_cache(maxsize=1)
def genuine_runtime() -> TensorRTRuntime:
    """Return the TensorRT of this machine.

    Raises:
        MissingDependencyError: if TensorRT or CUDA is not installed.
        InputError: without a GPU, or for a TensorRT older than 8.5 or newer than 11.
    """
    try:
        import tensorrt
    except ImportError as error:
        raise MissingDependencyError(
            "TensorRT",
            needed_for="the backend tensorrt",
            install="on a Jetson `sudo apt install nvidia-jetpack` (or only tensorrt and python3-libnvinfer), then use "
            "the system's Python or a virtual environment made with --system-site-packages; elsewhere, with an NVIDIA "
            f"GPU, `pip install tensorrt`. Python said: {error}",
        ) from error
    from robotbrain.jetson.engine.cuda import LibCudart

    return TensorRTRuntime(tensorrt, LibCudart())
