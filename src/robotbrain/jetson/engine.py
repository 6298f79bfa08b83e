"""Running a network: ONNX Runtime on this machine, with the latency it would have on the profile's Jetson."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robotbrain.errors import InputError
from robotbrain.jetson.profiles import PRECISION, JetsonProfile


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
    """

    def __init__(
        self,
        model: str | Path,
        profile: JetsonProfile | None = None,
        image_size: tuple[int, int] | None = None,
        charged_as: str | Path | None = None,
        precision: str = PRECISION,
    ) -> None:
        import onnxruntime

        path = Path(model)
        if not path.is_file():
            raise InputError(
                "model",
                given=str(path),
                expected="the path of an ONNX file",
                fix="Train it with `robotbrain train segmentation`, or check the path.",
            )
        options = onnxruntime.SessionOptions()
        # One thread: the nets are small, and results must not depend on the machine's core count.
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
        options.log_severity_level = 3
        try:
            # By path, not by content: the weights may lie in a file beside it, as torch exports them by default.
            self._session: Any = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # ONNX Runtime raises a family of its own, without a common public base
            raise InputError(
                "model",
                given=str(path),
                expected="a valid ONNX file",
                fix=f"ONNX Runtime says: {str(error).splitlines()[0][:200]}",
            ) from error
        self.path = path
        self.profile = profile
        self.resource = "gpu"
        self._image_size = image_size
        self._charged_as = path if charged_as is None else Path(charged_as)
        self._precision = precision
        self._latency_ns: int | None = None
        self._input = self._session.get_inputs()[0]
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

    def infer(self, batch: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the network's output for one input.

        Raises:
            InputError: for another dtype or shape than the network takes, or values that are not finite.
        """
        wanted = self.input_shape
        given = np.asarray(batch)
        fits = given.ndim == len(wanted) and all(
            not isinstance(size, int) or size == actual for size, actual in zip(wanted, given.shape, strict=False)
        )
        if given.dtype != np.float32 or not fits:
            raise InputError(
                "network input",
                given=f"{given.dtype} {given.shape}",
                expected=f"float32 {wanted}",
                fix="Scale to float32, put channels before rows and columns, and add a batch axis.",
            )
        if not np.isfinite(given).all():
            raise InputError(
                "network input",
                given="NaN or infinity",
                expected="finite values",
                fix="Check the preprocessing.",
            )
        result: NDArray[np.float32] = self._session.run([self._output], {self._input.name: given})[0]
        return result
