"""Faults that change what is measured: noise, bias, outliers."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from robotbrain.errors import InputError
from robotbrain.monitoring.faults_base import Copies, MessageFault, check_number, edited
from robotbrain.monitoring.faults_fields import find_field

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from robotbrain.ros.context import MessageRecord


@dataclass(frozen=True)
class _NumberFault(MessageFault):
    """Base of the faults that change numbers.

    Attributes:
        field: which of the message; None: the usual one of its type, e.g. ``ranges`` of a scan.
    """

    _: dataclasses.KW_ONLY
    field: str | None = None

    def change(self, values: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        """Return the changed numbers."""
        raise NotImplementedError

    def start(self, rng: np.random.Generator) -> Callable[[MessageRecord, bytes], Copies]:
        """Return what befalls the messages of one run."""

        def act(record: MessageRecord, data: bytes) -> Copies:
            field = find_field(record.type_name, self.field, record.name)

            def edit(message: Any) -> None:
                field.write(message, self.change(field.read(message), rng))

            return [(edited(record, data, edit), 0)]

        return act


@dataclass(frozen=True)
class Noise(_NumberFault):
    """Gaussian noise on a measurement.

    Attributes:
        sigma: standard deviation, in the field's unit (m, rad/s, grey levels …).
    """

    sigma: float = 0.0

    def check(self) -> None:
        """Raise InputError for parameters out of range."""
        check_number("sigma", self.sigma, 0, 1e9, "In the unit of the measurement.")

    def change(self, values: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        """Return the changed numbers."""
        # Infinity and NaN say something (REP 117) and stay what they are; the draws do not depend on them.
        return values + self.sigma * rng.standard_normal(values.shape)


@dataclass(frozen=True)
class SensorBias(_NumberFault):
    """A sensor that reads too much: ``value * scale + bias``, for instance a gyro's offset or a worn wheel.

    Attributes:
        bias: added; a number, or one for each number of the field, e.g. (0, 0, 0.05) rad/s for a gyro.
        scale: factor.
    """

    bias: float | tuple[float, ...] = 0.0
    scale: float = 1.0

    def check(self) -> None:
        """Raise InputError for parameters out of range."""
        for value in self.bias if isinstance(self.bias, tuple) else (self.bias,):
            check_number("bias", value, -1e9, 1e9, "In the unit of the measurement.")
        check_number("scale", self.scale, -1e3, 1e3, "1.02 reads 2 % too much.")

    def change(self, values: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        """Return the changed numbers."""
        if isinstance(self.bias, tuple) and len(self.bias) != values.shape[-1]:
            raise InputError(
                f"bias on {self.topic}",
                given=self.bias,
                expected=f"one number, or {values.shape[-1]}",
                fix="Give as many as the field has.",
            )
        return np.asarray(values * self.scale + np.asarray(self.bias), dtype=np.float64)


@dataclass(frozen=True)
class Outliers(_NumberFault):
    """Readings that have nothing to do with what is there.

    Attributes:
        rate: share of the numbers replaced, 0 to 1.
        low, high: they are drawn evenly from here.
    """

    rate: float = 0.01
    low: float = 0.1
    high: float = 8.0

    def check(self) -> None:
        """Raise InputError for parameters out of range."""
        check_number("rate", self.rate, 0, 1, "0.01 is one in a hundred.")
        check_number("low", self.low, -1e9, 1e9, "In the unit of the measurement.")
        check_number("high", self.high, self.low, 1e9, "Not below low.")

    def change(self, values: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        """Return the changed numbers."""
        hit = rng.random(values.shape) < self.rate
        return np.where(hit, rng.uniform(self.low, self.high, values.shape), values)
