"""Running a network: ONNX Runtime on this machine, with the latency it would have on the profile's Jetson."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robotbrain.errors import InputError
from robotbrain.jetson.engine.interface import check_input, check_open, example
from robotbrain.jetson.engine.timing import MEASURED_HERE, TWIN, Latency, check_counts, summarise
from robotbrain.jetson.profiles import PRECISION, JetsonProfile

if TYPE_CHECKING:
    from types import TracebackType


def load_session(path: Path, *, threads: int = 1, optimise: bool = True) -> Any:
    """Return an ONNX Runtime session for a file.

    Args:
        path: of the file, which exists.
        threads: that one inference may use. With one, results do not depend on the machine's core count.
        optimise: False computes the graph as it is written (``ORT_DISABLE_ALL``).

    Raises:
        InputError: ONNX Runtime cannot load it.
    """
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    if not optimise:
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    try:
        # By path, not by content: the weights may lie in a file beside it, as torch exports them by default.
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime raises a family of its own, without a common public base
        raise InputError(
            "model",
            given=str(path),
            expected="a valid ONNX file",
            fix=f"ONNX Runtime says: {str(error).splitlines()[0][:200]}",
        ) from error


class OnnxEngine:
    """An inference engine over an ONNX file with one float32 image input and one output.

    The numbers come from ONNX Runtime here; ``latency_ns`` is what the profile says one inference takes there.

    Args:
        model: path of the ONNX file.
        profile: the Jetson it is deployed to; None means an inference takes no simulated time.
        image_size: (width, height) of the images whose latency is charged; None: those that it infers.
        charged_as: ONNX file whose latency is charged; None: that of ``model``.
        precision: ``fp32``, ``fp16`` or ``int8``, whose latency is charged; here it is computed in float32.

    Attributes:
        path: of the ONNX file.
        profile: as given.
        resource: of the device that an inference occupies: ``charge(engine.latency_ns, engine.resource)``.
        backend: ``twin`` with a profile (twin-timed), ``onnxruntime`` without.
        timing: source of ``latency_ns``: ``twin`` with a profile, empty without.
    """

    def __init__(
        self,
        model: str | Path,
        profile: JetsonProfile | None = None,
        image_size: tuple[int, int] | None = None,
        charged_as: str | Path | None = None,
        precision: str = PRECISION,
    ) -> None:
        path = Path(model)
        if not path.is_file():
            raise InputError(
                "model",
                given=str(path),
                expected="the path of an ONNX file",
                fix="Train it with `robotbrain train segmentation`, or check the path.",
            )
        self._session: Any = load_session(path)
        inputs = self._session.get_inputs()
        if [value.type for value in inputs] != ["tensor(float)"]:
            raise InputError(
                "model",
                given=f"{path.name} with inputs {[f'{value.name}: {value.type}' for value in inputs]}",
                expected="a network with one float32 input",
                fix="Export a network with one float32 image input.",
            )
        self.path = path
        self.profile = profile
        self.resource = "gpu"
        self.backend = "onnxruntime" if profile is None else "twin"
        self.timing = "" if profile is None else TWIN
        self._image_size = image_size
        self._charged_as = path if charged_as is None else Path(charged_as)
        self._precision = precision
        self._latency_ns: int | None = None
        self._input = inputs[0]
        self._output: str = self._session.get_outputs()[0].name

    @property
    def input_shape(self) -> tuple[int | str | None, ...]:
        """Shape of the input; names stand for axes of any length."""
        return tuple(self._input.shape)

    @property
    def latency_ns(self) -> int:
        """Time that is charged for one inference on the profile's module, ns; 0 without a profile."""
        if self.profile is None:
            return 0
        if self._latency_ns is None:
            latency_ms = self.profile.network_ms(self._charged_as, self._precision, self._image_size)
            self._latency_ns = round(latency_ms * 1e6)
        return self._latency_ns

    def predicted(self) -> Latency:
        """Return the profile's latency of one inference, with its source.

        Raises:
            InputError: without a profile.
        """
        if self.profile is None:
            raise InputError(
                "profile",
                given=None,
                expected="a Jetson profile",
                fix="Open the engine with profile=load_profile(...).",
            )
        milliseconds = self.latency_ns * 1e-6
        where = f"{self.profile.name} in {self.profile.power_mode}, {self._precision}"
        return Latency(milliseconds, milliseconds, 0, 1, TWIN, where)

    def infer(self, batch: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the network's output for one input.

        Raises:
            InputError: for another dtype or shape than the network takes, or values that are not finite.
        """
        check_open(self._session is None, self.path)
        given = check_input(batch, self.input_shape)
        result: NDArray[np.float32] = self._session.run([self._output], {self._input.name: given})[0]
        return result

    def measure(self, batch: NDArray[np.float32] | None = None, *, runs: int = 50, warmup: int = 10) -> Latency:
        """Time ``infer`` on this host; with a profile too, for the profile's own latency is :meth:`predicted`.

        Args:
            batch: what is inferred; None: zeros, open axes of length 1.
            runs, warmup: timed inferences, and untimed ones before.

        Raises:
            InputError: for a batch that does not fit, or counts that are too small.
        """
        check_counts(runs, warmup)
        given = example(self.input_shape) if batch is None else batch
        for _ in range(warmup):
            self.infer(given)
        times = []
        for _ in range(runs):
            start = time.perf_counter()
            self.infer(given)
            times.append((time.perf_counter() - start) * 1e3)
        harness = "ONNX Runtime on the CPU, one thread, input check included"
        return summarise(times, batch=len(given), source=MEASURED_HERE, harness=harness)

    def close(self) -> None:
        """Give the session's memory back."""
        self._session = None

    def __enter__(self) -> OnnxEngine:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
