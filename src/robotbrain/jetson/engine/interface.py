"""What every inference engine offers, whatever computes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np

from robotbrain.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path
    from types import TracebackType

    from numpy.typing import NDArray

    from robotbrain.jetson.engine.timing import Latency


class InferenceEngine(Protocol):
    """One network with one float32 input, ready to run."""

    @property
    def path(self) -> Path:
        """Path of the ONNX file or plan."""
        ...

    @property
    def backend(self) -> str:
        """``onnxruntime``, ``twin``, ``tensorrt``, or ``simulated tensorrt``."""
        ...

    @property
    def timing(self) -> str:
        """Source of ``latency_ns``, one of ``timing.SOURCES``; empty where nothing is charged."""
        ...

    @property
    def resource(self) -> str:
        """Resource of the device that an inference occupies: ``charge(engine.latency_ns, engine.resource)``."""
        ...

    @property
    def input_shape(self) -> tuple[int | str | None, ...]:
        """Shape of the input; names (or -1) stand for axes of more than one length."""
        ...

    @property
    def latency_ns(self) -> int:
        """Simulated time to charge for one inference, ns; 0 where real time passes by itself."""
        ...

    def infer(self, batch: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the first output for one input; InputError for another dtype or shape, or values not finite."""
        ...

    def measure(self, batch: NDArray[np.float32] | None = None, *, runs: int = 50, warmup: int = 10) -> Latency:
        """Time ``infer`` on this machine. A simulated runtime raises InputError: it has no latency."""
        ...

    def close(self) -> None:
        """Give memory back. Closing twice is fine; an inference afterwards is an InputError."""
        ...

    def __enter__(self) -> InferenceEngine: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


def check_input(batch: object, wanted: Sequence[int | str | None]) -> NDArray[np.float32]:
    """Return a batch as an array if the network can take it.

    Args:
        batch: what was given.
        wanted: shape of the input; anything but a whole number of at least 0 fits every length.

    Raises:
        InputError: for another dtype or shape, an empty batch, or values that are not finite.
    """
    given = np.asarray(batch)
    fits = given.ndim == len(wanted) and all(
        not isinstance(size, int) or size < 0 or size == actual
        for size, actual in zip(wanted, given.shape)  # noqa: B905
    )
    if given.dtype != np.float32 or not fits or given.size == 0:
        raise InputError(
            "network input",
            given=f"{given.dtype} {given.shape}",
            expected=f"float32 {tuple(wanted)}",
            fix="Scale to float32, put channels before rows and columns, and add a batch axis.",
        )
    if not np.isfinite(given).all():
        raise InputError(
            "network input", given="NaN or infinity", expected="finite values", fix="Check the preprocessing."
        )
    return given


def example(wanted: Sequence[int | str | None]) -> NDArray[np.float32]:
    """Return a batch of zeros of the smallest shape that fits ``wanted``: open axes have length 1."""
    return np.zeros([size if isinstance(size, int) and size >= 0 else 1 for size in wanted], dtype=np.float32)


def check_open(closed: bool, path: Path) -> None:
    """Raise InputError if an engine was closed."""
    if closed:
        raise InputError("engine", given=f"{path} after close()", expected="an open engine", fix="Open it again.")
