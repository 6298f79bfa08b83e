"""How good a segmentation network is while it drives: against the truth where there is one, in bounded memory.

In the simulator every image has its truth. On a physical robot there is none; what can be watched there are stand-ins
(:mod:`robotbrain.monitoring.proxies`), which may warn but measure no accuracy.
"""

from __future__ import annotations

import math
from collections import OrderedDict, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robotbrain.errors import InputError
from robotbrain.pipeline.segmentation import CLASSES

if TYPE_CHECKING:
    from robotbrain.ros import SimContext
    from robotbrain.ros.context import CallbackRecord, MessageRecord

PREDICTION_TOPIC = "/perception/segmentation"


@dataclass(frozen=True)
class Estimate:
    """A value with the interval that holds the true one with the stated confidence; NaN where nothing is known."""

    value: float
    low: float
    high: float
    level: float = 0.95

    def __str__(self) -> str:
        return f"{self.value:.3f} ({self.low:.3f} to {self.high:.3f})"


def wilson_interval(successes: int, trials: int, level: float = 0.95) -> Estimate:
    """Return a share with its Wilson score interval, which behaves also near 0 and 1 and for few trials.

    Args:
        successes: 0 to ``trials``.
        trials: independent ones, >= 0; without any, everything is possible.
        level: confidence, between 0 and 1.

    Source: Wilson, "Probable inference, the law of succession, and statistical inference", JASA 22, 1927.

    Raises:
        InputError: for numbers out of these ranges.
    """
    if not 0 <= successes <= trials:
        raise InputError("successes", given=(successes, trials), expected="0 to trials", fix="Swap the two?")
    z = _normal(level)
    if not trials:
        return Estimate(math.nan, 0.0, 1.0, level)
    share = successes / trials
    centre = (share + z * z / (2 * trials)) / (1 + z * z / trials)
    half = z / (1 + z * z / trials) * math.sqrt(share * (1 - share) / trials + z * z / (4 * trials * trials))
    # At 0 and 1 the bounds are exact; rounding would leave a trace.
    low = 0.0 if successes == 0 else max(0.0, centre - half)
    return Estimate(share, low, 1.0 if successes == trials else min(1.0, centre + half), level)


def _normal(level: float) -> float:
    if not 0 < level < 1:
        raise InputError("level", given=level, expected="between 0 and 1", fix="95 % is 0.95.")
    return NormalDist().inv_cdf(0.5 + level / 2)


def confusion(prediction: ArrayLike, truth: ArrayLike, classes: int) -> NDArray[np.int64]:
    """Return how often each true class (row) was called each class (column).

    Args:
        prediction, truth: class ids of one shape, 0 to ``classes - 1``.
        classes: how many there are.

    Raises:
        InputError: for other ids or shapes.
    """
    predicted, true = np.asarray(prediction), np.asarray(truth)
    if predicted.shape != true.shape:
        raise InputError(
            "prediction",
            given=f"shape {predicted.shape}",
            expected=f"that of the truth, {true.shape}",
            fix="Compare images of one size; class ids are resized by the nearest pixel.",
        )
    for name, ids in (("prediction", predicted), ("truth", true)):
        if ids.size and not (ids.dtype.kind in "iu" and int(ids.min()) >= 0 and int(ids.max()) < classes):
            raise InputError(name, given=ids.dtype, expected=f"whole class ids 0 to {classes - 1}", fix="Decode first.")
    flat = true.ravel().astype(np.int64) * classes + predicted.ravel()
    return np.bincount(flat, minlength=classes * classes).reshape(classes, classes)


def class_iou(matrix: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the intersection over union of each class of a confusion matrix; NaN for one that never came up."""
    both = np.diag(matrix).astype(float)
    union = matrix.sum(axis=0) + matrix.sum(axis=1) - both
    found: NDArray[np.float64] = np.divide(both, union, out=np.full(len(both), math.nan), where=union > 0)
    return found


def accuracy_of(matrix: NDArray[np.int64]) -> float:
    """Return the share of pixels that were called what they are; NaN without any."""
    total = int(matrix.sum())
    return float(np.trace(matrix)) / total if total else math.nan


class OnlineSegmentationAccuracy:
    """Compares predicted with true class images of the same stamp while both come in, in any order.

    Args:
        classes: their names, in the order of their ids.
        waiting: images that wait for their counterpart, >= 1; the oldest makes way.
        images: the newest ones whose counts are kept for intervals, >= 1; the totals are of all.

    Attributes:
        matrix: (classes, classes) int64, true class by predicted class, over all images.
        compared: images.
        unmatched: images whose counterpart never came.
    """

    def __init__(self, classes: Sequence[str] = CLASSES, waiting: int = 64, images: int = 5000) -> None:
        if not classes or waiting < 1 or images < 1:
            raise InputError(
                "accuracy",
                given=(len(classes), waiting, images),
                expected="at least one class, and 1 or more images to wait and to keep",
                fix="The defaults are those of the kit's network.",
            )
        self.classes = tuple(classes)
        self.matrix = np.zeros((len(classes), len(classes)), dtype=np.int64)
        self.compared = self.unmatched = 0
        self._waiting = waiting
        self._predictions: OrderedDict[int, NDArray[Any]] = OrderedDict()
        self._truths: OrderedDict[int, NDArray[Any]] = OrderedDict()
        self._images: deque[NDArray[np.int64]] = deque(maxlen=images)

    def add_prediction(self, stamp_ns: int, mask: ArrayLike) -> bool:
        """Take predicted class ids (H, W) of the image of this stamp; return whether they met the truth."""
        return self._add(self._predictions, self._truths, stamp_ns, mask)

    def add_truth(self, stamp_ns: int, mask: ArrayLike) -> bool:
        """Take true class ids (H, W) of the image of this stamp; return whether they met their prediction."""
        return self._add(self._truths, self._predictions, stamp_ns, mask)

    def _add(
        self,
        mine: OrderedDict[int, NDArray[Any]],
        others: OrderedDict[int, NDArray[Any]],
        stamp_ns: int,
        mask: ArrayLike,
    ) -> bool:
        other = others.pop(stamp_ns, None)
        if other is None:
            mine[stamp_ns] = np.array(mask)
            if len(mine) > self._waiting:
                mine.popitem(last=False)
                self.unmatched += 1
            return False
        prediction, truth = (mask, other) if mine is self._predictions else (other, mask)
        counts = confusion(prediction, truth, len(self.classes))
        self.matrix += counts
        self._images.append(counts)
        self.compared += 1
        return True

    @property
    def iou(self) -> dict[str, float]:
        """Intersection over union by class; NaN for a class that never came up."""
        return dict(zip(self.classes, (float(v) for v in class_iou(self.matrix)), strict=True))

    @property
    def mean_iou(self) -> float:
        """Mean over the classes that came up; NaN before the first image."""
        known = [value for value in self.iou.values() if not math.isnan(value)]
        return float(np.mean(known)) if known else math.nan

    @property
    def pixel_accuracy(self) -> float:
        """Share of pixels that were called what they are; NaN before the first image."""
        return accuracy_of(self.matrix)

    def interval(
        self,
        of: Callable[[NDArray[np.int64]], float] = accuracy_of,
        *,
        level: float = 0.95,
        block: int | None = None,
        resamples: int = 1000,
        seed: int = 0,
    ) -> Estimate:
        """Return a figure of the images that are kept, with a bootstrap interval.

        Neighbouring pixels, and images one after the other, are much alike: taking each pixel for a trial of its own
        would give an interval far too narrow. Whole runs of images are drawn instead, with replacement.

        Args:
            of: the figure of a confusion matrix.
            level: confidence, between 0 and 1.
            block: images in a run; the cube root of their number, rounded up, times two, by default.
            resamples: >= 1.
            seed: of the drawing.

        Source: Künsch, "The jackknife and the bootstrap for general stationary observations", Annals of Statistics 17,
        1989 (moving blocks).

        Raises:
            InputError: for a level, a block or a number of resamples out of range.
        """
        _normal(level)
        count = len(self._images)
        length = min(count, 2 * math.ceil(count ** (1 / 3))) if block is None else block
        if not count:
            return Estimate(math.nan, math.nan, math.nan, level)
        if not 1 <= length <= count or resamples < 1:
            raise InputError(
                "block, resamples",
                given=(length, resamples),
                expected=f"a block of 1 to {count} images, and 1 or more resamples",
                fix="Leave out block for a usual one.",
            )
        stack = np.stack(self._images)
        # Sums over all runs of this length; a resample then is a sum of a few of them.
        sums = np.concatenate([np.zeros_like(stack[:1]), np.cumsum(stack, axis=0)])
        runs = sums[length:] - sums[:-length]
        rng = np.random.default_rng(seed)
        drawn = rng.integers(0, len(runs), size=(resamples, math.ceil(count / length)))
        values = np.array([of(runs[row].sum(axis=0)) for row in drawn])
        low, high = np.nanpercentile(values, [50 * (1 - level), 50 * (1 + level)])
        return Estimate(float(of(stack.sum(axis=0))), float(low), float(high), level)

    # ------------------------------------------------------------ a simulation

    def attach(self, context: SimContext, topic: str = PREDICTION_TOPIC, truth_topic: str = "") -> Callable[[], None]:
        """Compare what a simulated brain publishes with the truth; ``drive(..., attach=[accuracy.attach])``.

        The truth is what a perfect camera sees when the robot takes an image. Nothing of it reaches the brain.

        Args:
            context: the simulation.
            topic: of mono8 images of class ids, stamped as the image that they are of.
            truth_topic: takes the truth from such images on a topic instead.

        Returns:
            A function that stops it.
        """
        from robotbrain.ros.cdr import from_cdr
        from robotbrain.ros.conversions import image_to_numpy, msg_class, time_to_ns

        def on_message(record: MessageRecord, data: bytes) -> None:
            if record.kind == "topic" and record.name in (topic, truth_topic):
                message: Any = from_cdr(data, msg_class(record.type_name))
                add = self.add_prediction if record.name == topic else self.add_truth
                add(time_to_ns(message.header.stamp), image_to_numpy(message))

        removers = [context.add_message_tap(on_message)]
        if not truth_topic:
            removers.append(context.add_callback_tap(_TruthTap(context, self)))

        def remove() -> None:
            while removers:
                removers.pop()()

        return remove

    def __str__(self) -> str:
        if not self.compared:
            return "no image was compared"
        classes = ", ".join(f"{name} {value:.3f}" for name, value in self.iou.items() if not math.isnan(value))
        return (
            f"{self.compared} images: pixel accuracy {self.interval()}, mean IoU {self.mean_iou:.3f} ({classes}); "
            f"{self.unmatched} without counterpart"
        )


class _TruthTap:
    """Renders the truth whenever the robot's node has just taken an image."""

    def __init__(self, context: SimContext, accuracy: OnlineSegmentationAccuracy) -> None:
        self._context, self._accuracy = context, accuracy

    def __call__(self, record: CallbackRecord) -> None:
        if (record.kind, record.name) != ("timer", "_camera"):
            return
        node: Any = next((n for n in self._context.nodes if n.get_fully_qualified_name() == record.node), None)
        sim = getattr(node, "sim", None) or getattr(node, "_sim", None)
        if sim is not None:
            self._accuracy.add_truth(sim.now_ns + node.epoch_ns, sim.truth.camera_image().classes)
