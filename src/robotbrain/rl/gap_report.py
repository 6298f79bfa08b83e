"""The report of a gap study: what was measured, intervals over seeds, the paired test, a table, a figure, JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robotbrain import files
from robotbrain.errors import InputError
from robotbrain.monitoring.accuracy import Estimate

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from robotbrain.rl.evaluate import Comparison
    from robotbrain.rl.surrogate.reach import ReachEpisodes

Array = NDArray[np.float64]
PLACES = ("simulation", "surrogate")
FORMAT = "robotbrain-gap/1"


@dataclass(frozen=True)
class Measurement:
    """How one policy did in one place.

    Args:
        success: share of targets reached.
        error_m: mean distance over the last steps of the episodes (m).
        by_robot: share of targets reached by each robot.
        error_by_robot_m: mean final distance of each robot (m).
    """

    success: float
    error_m: float
    by_robot: tuple[float, ...]
    error_by_robot_m: tuple[float, ...]

    @classmethod
    def from_episodes(cls, episodes: ReachEpisodes) -> Measurement:
        """Summarise episodes; robots in the order of the fleet, also where two have the same serial."""
        robots = len(episodes.serial) // _repeats(episodes.serial)
        by_robot = episodes.success.reshape(-1, robots).mean(axis=0)
        error = episodes.final_error.reshape(-1, robots).mean(axis=0)
        return cls(
            round(float(by_robot.mean()), 6),
            round(float(error.mean()), 6),
            tuple(round(float(v), 6) for v in by_robot),
            tuple(round(float(v), 6) for v in error),
        )


def _repeats(serial: NDArray[np.int64]) -> int:
    """How often the row of robots repeats: episodes of all robots follow one another."""
    n = len(serial)
    for robots in range(1, n + 1):
        if n % robots == 0 and (serial.reshape(-1, robots) == serial[:robots]).all():
            return n // robots
    return 1


def mean_interval(values: ArrayLike, level: float = 0.95) -> Estimate:
    """Return the mean of independent values with Student's interval; NaN bounds for fewer than two.

    Shares are bounded by 0 and 1 and Student's interval is not; it is an interval over trainings, of which there are
    few.
    """
    from scipy.stats import t

    found = np.asarray(values, float)
    mean = float(found.mean())
    if len(found) < 2:
        return Estimate(mean, math.nan, math.nan, level)
    half = float(t.ppf(0.5 + level / 2, len(found) - 1) * found.std(ddof=1) / math.sqrt(len(found)))
    return Estimate(mean, mean - half, mean + half, level)


@dataclass(frozen=True)
class GapReport:
    """Measurements by variant, training seed and place, and the recipe that made them.

    Args:
        rows: variant -> seed -> place -> measurement.
        recipe: what was done (JSON types).
        dissection: variant -> seed -> kind of difference -> share of targets reached on robots that differ from the
            nominal one in this way only.
    """

    rows: Mapping[str, Mapping[int, Mapping[str, Measurement]]]
    recipe: Mapping[str, Any]
    dissection: Mapping[str, Mapping[int, Mapping[str, float]]] = field(default_factory=dict)

    def values(self, variant: str, place: str, what: str = "success") -> Array:
        """Return one number per seed: ``success`` (share) or ``error_m`` (m).

        Raises:
            InputError: a variant that was not measured.
        """
        if variant not in self.rows:
            raise InputError("variant", given=variant, expected=", ".join(self.rows), fix="Measure it first.")
        return np.array([getattr(found[place], what) for found in self.rows[variant].values()])

    def gap(self, variant: str) -> Array:
        """Return, per seed, what share of targets is lost from simulation to surrogates."""
        return self.values(variant, "simulation") - self.values(variant, "surrogate")

    def by_robot(self, variant: str, place: str = "surrogate") -> Array:
        """Return the share of targets that each robot reached, mean over seeds, (robots,)."""
        return np.asarray(np.mean([found[place].by_robot for found in self.rows[variant].values()], axis=0))

    def over_trainings(self, better: str = "randomised", worse: str = "plain") -> Comparison:
        """Compare two variants on surrogates, one value per training: would other trainings agree?

        The exact permutation test: 5 trainings of each can show p = 0.004.
        """
        from robotbrain.rl.evaluate import compare

        return compare(self.values(better, "surrogate"), self.values(worse, "surrogate"))

    def over_robots(self, better: str = "randomised", worse: str = "plain") -> Comparison:
        """Compare two variants surrogate by surrogate, means over trainings, paired: would other robots agree?"""
        from robotbrain.rl.evaluate import compare

        return compare(self.by_robot(better), self.by_robot(worse), paired=True, resamples=19_999)

    def error_by_robot(self, variant: str) -> Array:
        """Return the final error of each surrogate (m), mean over seeds, (robots,)."""
        return np.asarray(
            np.mean([found["surrogate"].error_by_robot_m for found in self.rows[variant].values()], axis=0)
        )

    def surrogate_parameters(self) -> dict[str, Array]:
        """Return one number per parameter and surrogate, see ``SurrogateParams.summary``; name -> (robots,)."""
        from robotbrain.rl.surrogate.parameters import draw

        table = [draw(int(s)).summary() for s in self.recipe["serials"]]
        return {name: np.array([row[name] for row in table]) for name in table[0]}

    def sensitivity(self, variant: str) -> dict[str, float]:
        """Return Spearman's rank correlation of each surrogate parameter with the final error, strongest first."""
        from scipy.stats import spearmanr

        error = self.error_by_robot(variant)
        found = {n: float(spearmanr(values, error).statistic) for n, values in self.surrogate_parameters().items()}
        return dict(sorted(found.items(), key=lambda item: -abs(item[1])))

    def dissected(self, variant: str) -> dict[str, float]:
        """Return the share reached by kind of difference, mean over seeds; see :func:`robotbrain.rl.gap.dissect`."""
        seeds = list(self.dissection[variant].values())
        return {kind: float(np.mean([found[kind] for found in seeds])) for kind in seeds[0]}

    def table(self) -> str:
        """Return the report as text."""
        lines = [
            f"{'trained with':20} {'reached in simulation':26} {'on surrogates':26} {'final error, mm':>16} {'gap':>6}"
        ]
        for variant in self.rows:
            sim, real = (_percent(mean_interval(self.values(variant, place))) for place in PLACES)
            errors = " / ".join(f"{1e3 * self.values(variant, place, 'error_m').mean():.1f}" for place in PLACES)
            lines.append(f"{variant:20} {sim:26} {real:26} {errors:>16} {self.gap(variant).mean():>6.0%}")
        count = len(next(iter(self.rows.values())))
        robots = len(self.recipe.get("serials", ()))
        lines.append(
            f"Means over {count} trainings with 95 % intervals; {robots} surrogates; 2 cm over the last 5 steps."
        )
        if {"plain", "randomised"} <= set(self.rows):
            lines.append("Randomised against plain, on surrogates:")
            if min(len(self.rows[name]) for name in ("plain", "randomised")) > 1:
                lines.append(f"  over trainings: {self.over_trainings()}")
            lines.append(f"  over surrogates: {self.over_robots()}")
        if self.dissection:
            lines.append("Reached on robots that differ from the nominal one in one way only:")
            kinds = list(next(iter(next(iter(self.dissection.values())).values())))
            lines.append(f"{'':20} " + " ".join(f"{kind:>13}" for kind in kinds))
            for variant in self.dissection:
                shares = self.dissected(variant)
                lines.append(f"{variant:20} " + " ".join(f"{shares[kind]:>13.0%}" for kind in kinds))
        return "\n".join(lines)

    def plot(self) -> Figure:
        """Return a figure: success in both places per training, and the final error per surrogate."""
        from robotbrain.rl.gap_plots import plot_gap

        return plot_gap(self)

    def plot_dissection(self) -> Figure:
        """Return a figure: success on robots that differ in one way only."""
        from robotbrain.rl.gap_plots import plot_dissection

        return plot_dissection(self)

    def plot_sensitivity(self, columns: int = 5) -> Figure:
        """Return a figure: the final error against each of the surrogates' parameters."""
        from robotbrain.rl.gap_plots import plot_sensitivity

        return plot_sensitivity(self, columns)

    def to_json(self) -> str:
        """Return the report as JSON, the same bytes for the same report."""
        rows = {
            variant: {str(seed): {place: asdict(m) for place, m in found.items()} for seed, found in seeds.items()}
            for variant, seeds in self.rows.items()
        }
        kinds = {
            variant: {str(seed): dict(found) for seed, found in seeds.items()}
            for variant, seeds in self.dissection.items()
        }
        content = {"format": FORMAT, "recipe": dict(self.recipe), "rows": rows, "dissection": kinds}
        return json.dumps(content, indent=1, sort_keys=True, allow_nan=False) + "\n"

    def save(self, path: str | Path) -> Path:
        """Write the report as JSON and return the path."""
        return files.write_text(path, self.to_json())

    @classmethod
    def load(cls, path: str | Path) -> GapReport:
        """Read a report.

        Raises:
            InputError: no such file, or no report.
        """
        try:
            content = json.loads(Path(path).read_text(encoding="utf-8"))
            if content["format"] != FORMAT:
                raise ValueError(f"format {content['format']}")
            names = [f.name for f in fields(Measurement)]
            rows = {
                variant: {
                    int(seed): {p: Measurement(**{n: _tuple(m[n]) for n in names}) for p, m in found.items()}
                    for seed, found in seeds.items()
                }
                for variant, seeds in content["rows"].items()
            }
            kinds = {
                variant: {int(seed): {k: float(v) for k, v in found.items()} for seed, found in seeds.items()}
                for variant, seeds in content["dissection"].items()
            }
            return cls(rows, content["recipe"], kinds)
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise InputError(
                "gap report", given=str(path), expected="a file that GapReport.save wrote", fix=f"It says: {error}."
            ) from error


def _tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _percent(found: Estimate) -> str:
    if math.isnan(found.low):
        return f"{found.value:.0%}"
    return f"{found.value:.0%} ({max(found.low, 0.0):.0%} to {min(found.high, 1.0):.0%})"
