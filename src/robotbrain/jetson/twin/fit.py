"""Fitting the latency model: maximum a posteriori by Gauss-Newton steps on robust log errors, and its uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robotbrain.jetson.twin.conditions import RELATIVES, Conditions
from robotbrain.jetson.twin.latency import NAMES, Batch, Effect, Work, design, list_effects, unseen_variance

Array = NDArray[np.float64]

NOISE = 0.06
"""Spread of published latencies around any model, as a log error: between harness runs of one network, about 5 %."""

KINSHIP = 0.4
"""Spread of the log error where another GPU family stands in (assumed: as between measured families left out)."""

_ROBUST = 1.5
"""Beyond this many NOISE, a residual counts linearly (pseudo-Huber)."""


@dataclass(frozen=True)
class Sample:
    """One measured latency.

    Attributes:
        work: of the network's kernels under ``where``.
        where: conditions.
        latency_ms: measured.
        weight: 1, or less for rows that repeat each other.
    """

    work: Work
    where: Conditions
    latency_ms: float
    weight: float = 1.0


@dataclass(frozen=True)
class Fitted:
    """Coefficients of the model and their covariance.

    Attributes:
        effects: (P) what the coefficients are.
        values: (P,)
        covariance: (P, P) of the Laplace approximation.
    """

    effects: tuple[Effect, ...]
    values: Array
    covariance: Array

    def parameters(self, where: Sequence[Conditions]) -> dict[str, Array]:
        """Return the parameters by name, one value for each of the conditions; effects never seen are 0."""
        return {name: matrix @ self.values for name, matrix in design(self.effects, where).items()}

    def predict_ms(self, works: Sequence[Work], where: Sequence[Conditions]) -> Array:
        """Return (N,) latencies, ms."""
        return Batch(works, where).latency_ms(self.parameters(where))

    def log_sd(self, work: Work, where: Conditions) -> float:
        """Return the standard deviation of the log latency: coefficients, unseen effects and noise together."""
        batch, matrices = Batch([work], [where]), design(self.effects, [where])
        theta = {name: matrix @ self.values for name, matrix in matrices.items()}
        slopes = batch.log_slopes(theta)
        gradient = sum(slopes[name][0] * matrices[name][0] for name in NAMES)
        variance = float(gradient @ self.covariance @ gradient) + NOISE**2
        if where.family in RELATIVES:
            variance += KINSHIP**2
        for name, unseen in unseen_variance(self.effects, where).items():
            variance += float(slopes[name][0]) ** 2 * unseen
        return float(np.sqrt(variance))


def fit(samples: Sequence[Sample], start: Fitted | None = None, iterations: int = 60) -> Fitted:
    """Fit the model.

    Args:
        samples: at least one.
        start: an earlier fit to begin from (coefficients are matched by name).
        iterations: at most.
    """
    where = [sample.where for sample in samples]
    effects = list_effects(where)
    matrices = design(effects, where)
    batch = Batch([sample.work for sample in samples], where)
    target = np.log([sample.latency_ms for sample in samples])
    weight = np.array([sample.weight for sample in samples])
    mean, sd = np.array([e.mean for e in effects]), np.array([e.sd for e in effects])
    values = mean.copy()
    if start is not None:
        known = {(e.component, e.key): v for e, v in zip(start.effects, start.values, strict=True)}
        values = np.array([known.get((e.component, e.key), v) for e, v in zip(effects, values, strict=True)])

    def evaluate(q: Array) -> tuple[float, Array, dict[str, Array]]:
        theta = {name: matrix @ q for name, matrix in matrices.items()}
        error = np.log(batch.latency_ms(theta)) - target
        z = error / NOISE
        loss = 2 * _ROBUST**2 * (np.sqrt(1 + (z / _ROBUST) ** 2) - 1)
        return float(weight @ loss + np.sum(((q - mean) / sd) ** 2)), error, theta

    cost, error, theta = evaluate(values)
    damping = 1e-2
    hessian = np.diag(1 / sd**2)
    for _ in range(iterations):
        slopes = batch.log_slopes(theta)
        jacobian = np.zeros((len(samples), len(values)))
        for name in NAMES:
            jacobian += slopes[name][:, None] * matrices[name]
        robust = weight / NOISE**2 / np.sqrt(1 + (error / NOISE / _ROBUST) ** 2)
        hessian = jacobian.T @ (robust[:, None] * jacobian) + np.diag(1 / sd**2)
        gradient = jacobian.T @ (robust * error) + (values - mean) / sd**2
        improved = False
        while damping < 1e8:
            step = np.linalg.solve(hessian + damping * np.diag(np.diag(hessian)), gradient)
            new_cost, new_error, new_theta = evaluate(values - step)
            if new_cost <= cost:
                improved = True
                break
            damping *= 5
        if not improved:
            break
        converged = cost - new_cost < 1e-10 * cost
        values, cost, error, theta = values - step, new_cost, new_error, new_theta
        damping = max(damping / 5, 1e-9)
        if converged:
            break
    covariance: Array = np.asarray(np.linalg.inv(hessian), dtype=np.float64)
    return Fitted(tuple(effects), values, covariance)
