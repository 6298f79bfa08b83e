"""What lies between a commanded joint angle and the joint: interpolation, transport delay, motor lag and gear play.

All of it is feed-forward from the command, so that it is computed here, for every physics step of a control period at
once, and MuJoCo gets a row of set points. Arrays are (n, ...) for n robots. The lag is the exact discretisation that
MuJoCo's ``filterexact`` actuators use; a test compares the two.

Play is the rate-independent play operator (Krasnosel'skii and Pokrovskii, *Systems with Hysteresis*, 1989), not a
MuJoCo joint with a small range: friction holds the link while the motor crosses the gap, which is what the operator
says, and its hysteresis loop has a closed form. A joint in the gap would double the degrees of freedom and bring
stops too stiff for 5 ms steps; what it would add is the link rattling inside the gap, which friction mostly prevents.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def play(output: Array, motor: Array, half_gap: Array) -> Array:
    """Return where a link is after its motor moved: the play operator.

    Args:
        output: where the link was (rad).
        motor: where the motor is now (rad).
        half_gap: half of the play (rad), >= 0.
    """
    return np.minimum(np.maximum(output, motor - half_gap), motor + half_gap)  # a fraction of what np.clip costs


def lag_factor(step_s: float, time_constant_s: ArrayLike) -> Array:
    """Return what share of the way to a constant input a first-order lag covers in ``step_s``: ``1 - exp(-h / T)``.

    A time constant of 0 s is no lag: 1.
    """
    constant = np.asarray(time_constant_s, float)
    with np.errstate(divide="ignore"):
        return np.asarray(-np.expm1(-step_s / constant), float)


class DelayLine:
    """The last samples of n signals, each read a fixed number of samples ago.

    Args:
        delays: of each signal, samples (n,), >= 0.
        size: of a sample.
    """

    def __init__(self, delays: NDArray[np.int64], size: int) -> None:
        self._delays = delays
        self._longest = int(delays.max(initial=0))
        self._past = np.zeros((len(delays), self._longest, size))

    def fill(self, ids: NDArray[np.int64], value: Array) -> None:
        """Let the signals ``ids`` have had ``value`` (k, size) for ever."""
        self._past[ids] = value[:, None]

    def push(self, samples: Array) -> Array:
        """Append ``samples`` (n, k, size); return the k delayed ones, of the same shape."""
        if not self._longest:
            return samples
        line = np.concatenate([self._past, samples], axis=1)
        k = samples.shape[1]
        rows = self._longest - self._delays[:, None] + np.arange(k)
        self._past = line[:, line.shape[1] - self._longest :]
        return np.take_along_axis(line, rows[:, :, None], axis=1)


class Drive:
    """The joints' drives of n robots with J joints each.

    Args:
        step_s: physics step (s).
        delay_steps: transport delay, physics steps (n,).
        lag_s: time constant of each robot's motors (s), (n,).
        half_gap: half of each joint's play (rad), (n, J).

    Attributes:
        motor: angle of each motor, referred to the link (rad), (n, J).
        link: what each link is driven to (rad), (n, J); within ``half_gap`` of the motor.
    """

    def __init__(self, step_s: float, delay_steps: NDArray[np.int64], lag_s: Array, half_gap: Array) -> None:
        self._factor = lag_factor(step_s, lag_s)[:, None]
        self._half_gap = half_gap
        self._delay = DelayLine(delay_steps, half_gap.shape[1])
        self._wanted = np.zeros_like(half_gap)
        self.motor = np.zeros_like(half_gap)
        self.link = np.zeros_like(half_gap)

    def settle(self, ids: NDArray[np.int64], position: Array) -> None:
        """Put the robots ``ids`` at rest at ``position`` (k, J), in the middle of their play."""
        self._wanted[ids] = self.motor[ids] = self.link[ids] = position
        self._delay.fill(ids, position)

    def run(self, target: Array, steps: int, ramp_steps: int = 0) -> Array:
        """Return the set points of the next ``steps`` physics steps, (n, steps, J).

        Args:
            target: commanded angles (rad), (n, J).
            steps: how many.
            ramp_steps: reach the target on a straight line in so many steps, as a trajectory controller does; 0: at
                once.
        """
        share = np.minimum(np.arange(1, steps + 1) / max(ramp_steps, 1), 1.0)[None, :, None]
        wanted = self._wanted[:, None] + share * (target - self._wanted)[:, None]
        self._wanted = wanted[:, -1].copy()  # the points below may lie in the same memory
        points = self._delay.push(wanted)
        for k in range(steps):
            self.motor = self.motor + self._factor * (points[:, k] - self.motor)
            self.link = play(self.link, self.motor, self._half_gap)
            points[:, k] = self.link
        return points
