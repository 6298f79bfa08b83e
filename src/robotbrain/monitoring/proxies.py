"""Stand-ins for a model's accuracy where there is no truth. Each is a proxy: it may warn, it measures no accuracy.

- The classes that a network sees change (:class:`ClassDrift`): another place, another light, or a broken camera.
- It gets less sure of itself (:class:`ConfidenceDrift`); networks can be sure and wrong.
- It contradicts another sensor (:func:`lidar_disagreement`); either may be wrong.

Drift is told by the population stability index between shares p now and q in the reference, sum of (p - q) ln(p / q),
the symmetric form of the Kullback-Leibler divergence. Rule of thumb: below 0.1 nothing happened, above 0.25 something
did (Siddiqi, "Credit Risk Scorecards", Wiley 2006).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robotbrain.errors import InputError
from robotbrain.pipeline.segmentation import CLASSES

Array = NDArray[np.float64]

WARN_PSI, ALARM_PSI = 0.1, 0.25
"""Population stability index from which something may have changed, and has."""


def stability_index(reference: ArrayLike, now: ArrayLike) -> float:
    """Return the population stability index between two histograms; 0 when they are alike.

    Args:
        reference, now: (B,) counts or shares, not negative. Half a count is added to each bin, so that one that is
            empty does not make it infinite.

    Raises:
        InputError: for histograms of different length, negative numbers, or nothing counted.
    """
    before, after = np.asarray(reference, dtype=float), np.asarray(now, dtype=float)
    well_formed = before.shape == after.shape and before.ndim == 1 and min(before.sum(), after.sum()) > 0
    if not well_formed or before.min() < 0 or after.min() < 0:
        raise InputError(
            "histograms",
            given=(before.tolist(), after.tolist()),
            expected="two of one length, counts 0 or more, not all 0",
            fix="Count both with the same bins.",
        )
    p = (after + 0.5) / (after + 0.5).sum()
    q = (before + 0.5) / (before + 0.5).sum()
    return float(np.sum((p - q) * np.log(p / q)))


class _Drift:
    """Histograms of single images, summed over a window and compared with a reference."""

    def __init__(self, bins: int, reference: ArrayLike | None, window: int, learn: int) -> None:
        if window < 1 or learn < 1:
            raise InputError("window, learn", given=(window, learn), expected="1 or more images", fix="Try 50.")
        self._recent: deque[Array] = deque(maxlen=window)
        self._learn = learn
        self._learnt = np.zeros(bins)
        self._seen = 0
        self.reference = None if reference is None else np.asarray(reference, dtype=float)
        if self.reference is not None and self.reference.shape != (bins,):
            raise InputError(
                "reference", given=self.reference.shape, expected=f"({bins},) counts", fix="One for each bin."
            )

    def _note(self, histogram: Array) -> None:
        if self.reference is None:
            self._learnt += histogram
            self._seen += 1
            if self._seen >= self._learn:
                self.reference = self._learnt
            return
        self._recent.append(histogram)

    @property
    def psi(self) -> float:
        """Population stability index of the last images against the reference; NaN before there are both."""
        if self.reference is None or not self._recent:
            return math.nan
        # Shares of a fixed number of pixels: half a count means the same for one image as for many.
        now = np.sum(self._recent, axis=0)
        scale = 1000.0
        return stability_index(scale * self.reference / self.reference.sum(), scale * now / now.sum())

    @property
    def verdict(self) -> str:
        """What the index means by the rule of thumb: ``unknown``, ``stable``, ``watch`` or ``drift``."""
        if math.isnan(self.psi):
            return "unknown"
        return "stable" if self.psi < WARN_PSI else "watch" if self.psi < ALARM_PSI else "drift"


class ClassDrift(_Drift):
    """Proxy: how the shares of the predicted classes change against a reference.

    Args:
        classes: their names.
        reference: (classes,) counts, e.g. of the training set; None: learnt from the first images.
        window: images that count as now.
        learn: images that a reference is learnt from.
    """

    def __init__(
        self, classes: Sequence[str] = CLASSES, reference: ArrayLike | None = None, window: int = 50, learn: int = 50
    ) -> None:
        super().__init__(len(classes), reference, window, learn)
        self.classes = tuple(classes)

    def add(self, mask: ArrayLike) -> None:
        """Note the predicted class ids of an image (H, W).

        Raises:
            InputError: for ids beyond the classes.
        """
        ids = np.asarray(mask).ravel()
        if ids.size == 0 or ids.min() < 0 or ids.max() >= len(self.classes):
            raise InputError(
                "mask",
                given=ids[:8],
                expected=f"class ids 0 to {len(self.classes) - 1}",
                fix="Decode the scores first.",
            )
        self._note(np.bincount(ids, minlength=len(self.classes)).astype(float))


def entropy(probabilities: ArrayLike, axis: int = 0) -> Array:
    """Return the entropy over the classes as a share of the largest possible: 0 (sure) to 1 (no idea).

    Args:
        probabilities: not negative, summing to 1 along ``axis``, e.g. (classes, H, W).
        axis: of the classes, at least two.
    """
    p = np.asarray(probabilities, dtype=float)
    terms = np.where(p > 0, -p * np.log(np.maximum(p, 1e-300)), 0.0)
    found: Array = terms.sum(axis=axis) / math.log(p.shape[axis])
    return found


class ConfidenceDrift(_Drift):
    """Proxy: how the entropy of the predictions changes against a reference. Sure is not the same as right.

    Args:
        window: images that count as now.
        learn: images that the reference is learnt from.
        bins: of the histogram of entropies.
    """

    def __init__(self, window: int = 50, learn: int = 50, bins: int = 10) -> None:
        super().__init__(bins, None, window, learn)
        self._edges = np.linspace(0, 1, bins + 1)
        self.last_entropy = math.nan

    def add(self, probabilities: ArrayLike) -> float:
        """Note the class probabilities of an image (classes, H, W); return their mean entropy, 0 to 1."""
        values = entropy(probabilities)
        self.last_entropy = float(values.mean())
        self._note(np.histogram(np.clip(values, 0, 1), self._edges)[0].astype(float))
        return self.last_entropy


def lidar_disagreement(
    floor: ArrayLike,
    ranges: ArrayLike,
    angle_min: float,
    angle_increment: float,
    *,
    lidar: tuple[float, float] = (0.0, 0.0),
    margin: float = 0.15,
) -> float:
    """Proxy: return the share of points called floor that lie behind something that the lidar hit.

    Either sensor may be wrong, and both may be right: a camera can look over what is low, and glass lets a lidar
    through.

    Args:
        floor: (N, 2) points in the base frame that the network calls floor, m.
        ranges: (R,) of a scan, m; not finite where nothing was hit.
        angle_min, angle_increment: of the scan, rad.
        lidar: its position in the base frame, m.
        margin: how far behind the hit counts, m.

    Returns:
        0 to 1; NaN when no point lies in the scan's field of view.
    """
    points = np.asarray(floor, dtype=float).reshape(-1, 2) - np.asarray(lidar)
    beams = np.asarray(ranges, dtype=float)
    turn = np.mod(np.arctan2(points[:, 1], points[:, 0]) - angle_min, 2 * math.pi)
    index = np.rint(turn / angle_increment).astype(int)
    full = abs(len(beams) * angle_increment - 2 * math.pi) < 1.5 * angle_increment
    seen = np.ones(len(index), dtype=bool) if full else index < len(beams)
    if not seen.any():
        return math.nan
    hit = beams[index[seen] % len(beams)]
    behind = np.isfinite(hit) & (np.hypot(*points[seen].T) > np.where(np.isfinite(hit), hit, np.inf) + margin)
    return float(behind.mean())
