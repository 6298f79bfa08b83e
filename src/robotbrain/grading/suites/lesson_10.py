"""Checks of the lesson `10_troubleshooting`. Nothing here is graded: an answer that is still open is no mistake."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from robotbrain.grading import Suite, expect, fail
from robotbrain.grading.suites.lesson_tools import answered, equals

suite = Suite("lesson_10")

suite.exercise("yaw", title="1 How far has it turned away?", points=3, provides=("yaw_error",))
suite.exercise("full", title="2 How long have we got?", points=2, provides=("seconds_until_full",))
suite.exercise("energy", title="3 The whole period", points=2, provides=("period_mj",))
suite.exercise("frames", title="4 From the sensor to the robot", points=2, provides=("to_base",))
suite.exercise("verdicts", title="5 What is wrong?", points=1, provides=("verdicts",))
suite.exercise("repairs", title="6 Repair them", points=3, provides=("brighter", "keep", "to_network"))

_HINTS = {
    "wrap-the-difference": "Angles are the same after a full turn: bring the difference back to -pi..pi, for instance "
    "with np.arctan2(np.sin(d), np.cos(d)).",
    "estimate-minus-truth": "Estimated minus true, with its sign: positive if turned too far to the left.",
    "radians": "Angles are in radians: half a turn is np.pi, not 180.",
    "works-for-arrays": "It should work for arrays too: use np.arctan2 or %, no `if` and no math.* function.",
    "the-difference-grows": "The queue grows by what comes minus what is worked off.",
    "never-is-infinite": "A consumer that keeps up leaves no growing queue: float('inf'), no negative time, no error.",
    "frames-have-size": "Frames per second times MB per frame gives MB per second.",
    "rest-is-idle": "After the work the module draws idle_w for period_ms - busy_ms.",
    "watt-milliseconds": "Watt times millisecond is millijoule: there is nothing to convert.",
    "idle-only-rests": "Idle power counts for the rest of the period only; busy_w holds it already.",
    "does-not-fit": "Work that takes longer than the period does not fit: float('nan').",
    "just-fits": "Work that takes the whole period fits: there is just no rest.",
    "rotate-then-shift": "First turn the point by the mounting's yaw, then add the mounting's x and y.",
    "turn-with-the-mount": "Turning by yaw is x cos - y sin and x sin + y cos; with the signs exchanged it turns back.",
    "stamp-is-when-measured": "The stamp should say when the image was taken. now() is 150 ms later, and whoever "
    "transforms the boxes to the map uses the pose of that later time.",
    "empty-means-unknown": "With no reading left the mean is NaN, and min(1.0, nan) is 1.0 in Python: full speed, "
    "because nothing is known.",
    "nobody-else-runs": "While it waits in the loop, the node's only thread runs nothing else: no timer, and not the "
    "answer that it waits for either. It waits for ever.",
    "clip-before-uint8": "Compute in a wider type, clip to 0..255, and only then go back to uint8.",
    "stays-uint8": "An image stays uint8: convert back with .astype(np.uint8).",
    "keep-a-copy": "history.append(scan) keeps a reference to an array that changes; append scan.copy().",
    "all-that-came": "Append: what was in the history before stays in it.",
    "move-the-axis": "reshape does not move axes: use image.transpose(2, 0, 1).",
    "height-then-width": "Channels first, then height, then width: transpose(2, 0, 1).",
}
for _key, _text in _HINTS.items():
    suite.hint(_key, _text)


# ---------------------------------------------------------------- 1


def _same_angle(got: Any, right: float) -> bool:
    """Tell whether an answer is right; half a turn may have either sign."""
    try:
        value = float(got)
    except (TypeError, ValueError):
        return False
    either = math.isclose(abs(right), math.pi, abs_tol=1e-9)
    return math.isclose(abs(value) if either else value, abs(right) if either else right, abs_tol=1e-6)


def _yaw_hint(got: Any, right: float, plain: float) -> str:
    if _same_angle(got, plain):
        return "wrap-the-difference"
    if _same_angle(got, math.degrees(right)) or _same_angle(got, math.degrees(plain)):
        return "radians"
    if _same_angle(got, -right) or _same_angle(got, abs(right)) or _same_angle(got, -plain):
        return "estimate-minus-truth"
    return "wrap-the-difference"


@suite.test("yaw", points=2, name="pairs of headings", reread="Exercise 1")
def _yaw_pairs(student: Any) -> None:
    cases = [(10, 4), (-20, 5), (-179, 179), (179, -179), (90, -170), (0, 180), (720, 3)]
    for estimated, true in cases:
        got = answered(student.yaw_error(math.radians(estimated), math.radians(true)), "yaw_error")
        plain = math.radians(estimated) - math.radians(true)
        right = math.atan2(math.sin(plain), math.cos(plain))
        if not _same_angle(got, right):
            fail(
                f"a heading of {estimated}° held for {true}° is turned by {math.degrees(right):g}° ({right:.4f} rad)",
                got=got,
                hint=_yaw_hint(got, right, plain),
            )


@suite.test("yaw", points=1, name="arrays", reread="Exercise 1")
def _yaw_arrays(student: Any) -> None:
    estimated, true = np.radians([179.0, 10.0, -170.0]), np.radians([-179.0, 5.0, 175.0])
    try:
        got = answered(student.yaw_error(estimated, true), "yaw_error")
    except (TypeError, ValueError) as error:
        fail(f"for arrays it says: {error}", hint="works-for-arrays")
    right = np.radians([-2.0, 5.0, 15.0])
    expect(np.shape(got) == (3,), "for arrays it should return an array", got=got, hint="works-for-arrays")
    good = np.allclose(got, right, atol=1e-6)
    expect(good, "for arrays the numbers are wrong", expected=right, got=got, hint="wrap-the-difference")


# ---------------------------------------------------------------- 2


@suite.test("full", points=1, name="queues worked out by hand", reread="Trouble 4")
def _full_grows(student: Any) -> None:
    for free, frame, arrival, service in ((100.0, 1.0, 10.0, 5.0), (4000.0, 0.5, 30.0, 22.0), (60.0, 2.0, 3.0, 0.0)):
        got = answered(student.seconds_until_full(free, frame, arrival, service), "seconds_until_full")
        right = free / (frame * (arrival - service))
        if equals(got, right):
            continue
        hint = "frames-have-size" if equals(got, right * frame) else "the-difference-grows"
        fail(
            f"{free:g} MB fill in {right:g} s, if frames of {frame:g} MB come {arrival:g} times a second and "
            f"{service:g} are worked off",
            got=got,
            hint=hint,
        )


@suite.test("full", points=1, name="a consumer that keeps up", reread="Exercise 2, last sentence")
def _full_never(student: Any) -> None:
    for arrival, service in ((10.0, 20.0), (10.0, 10.0)):
        try:
            got = answered(student.seconds_until_full(100.0, 1.0, arrival, service), "seconds_until_full")
        except ZeroDivisionError:
            got = "a division by zero"
        expect(
            equals(got, math.inf),
            f"{arrival:g} frames come and {service:g} could be worked off a second: it never fills up",
            got=got,
            hint="never-is-infinite",
        )


# ---------------------------------------------------------------- 3


@suite.test("energy", points=1, name="periods worked out by hand", reread="Exercise 3")
def _energy(student: Any) -> None:
    for busy, idle, work, period in ((10.0, 3.0, 20.0, 100.0), (6.5, 1.5, 3.0, 50.0), (15.0, 5.0, 40.0, 40.0)):
        got = answered(student.period_mj(busy, idle, work, period), "period_mj")
        right = busy * work + idle * (period - work)
        if equals(got, right):
            continue
        hint = "rest-is-idle"
        if equals(got, right / 1000) or equals(got, right * 1000):
            hint = "watt-milliseconds"
        elif equals(got, busy * work + idle * period):
            hint = "idle-only-rests"
        elif isinstance(got, float) and math.isnan(got):
            hint = "just-fits"
        fail(
            f"{work:g} ms at {busy:g} W and the rest of {period:g} ms at {idle:g} W are {right:g} mJ",
            got=got,
            hint=hint,
        )


@suite.test("energy", points=1, name="work that does not fit", reread="Exercise 3, last sentence")
def _energy_too_long(student: Any) -> None:
    got = answered(student.period_mj(10.0, 3.0, 120.0, 100.0), "period_mj")
    expect(equals(got, math.nan), "120 ms of work do not fit into 100 ms", got=got, hint="does-not-fit")


# ---------------------------------------------------------------- 4


def _point(student: Any, point: tuple[float, float], mount: tuple[float, float, float]) -> np.ndarray[Any, Any]:
    got = answered(student.to_base(point, mount), "to_base")
    try:
        values = np.asarray(got, dtype=float)
    except (TypeError, ValueError):
        fail("`to_base` should return two numbers (x, y)", got=got)
    if values.shape != (2,):
        fail("`to_base` should return two numbers (x, y)", got=got)
    return values


@suite.test("frames", points=2, name="mountings worked out by hand", reread="Exercise 4")
def _frames(student: Any) -> None:
    rng = student.rng("frames")
    cases = [((1.0, 0.0), (0.2, 0.0, 0.0)), ((1.0, 0.0), (0.0, 0.0, 90.0)), ((1.0, 2.0), (-0.1, 0.05, 180.0))]
    cases += [(tuple(rng.uniform(-2, 2, 2)), (*rng.uniform(-1, 1, 2), rng.uniform(-170, 170))) for _ in range(4)]
    for (px, py), (mx, my, degrees) in cases:
        yaw = math.radians(degrees)
        got = _point(student, (px, py), (mx, my, yaw))
        cos, sin = math.cos(yaw), math.sin(yaw)
        right = np.array([mx + cos * px - sin * py, my + sin * px + cos * py])
        if np.allclose(got, right, atol=1e-6):
            continue
        back = np.array([mx + cos * px + sin * py, my - sin * px + cos * py])
        hint = "turn-with-the-mount" if np.allclose(got, back, atol=1e-6) else "rotate-then-shift"
        again = (math.cos(math.radians(yaw)), math.sin(math.radians(yaw)))
        if np.allclose(got, [mx + again[0] * px - again[1] * py, my + again[1] * px + again[0] * py], atol=1e-6):
            hint = "radians"
        fail(
            f"a sensor at ({mx:.2f}, {my:.2f}) m, turned by {degrees:.0f}°, sees ({px:.2f}, {py:.2f}): from the robot "
            f"that is ({right[0]:.3f}, {right[1]:.3f})",
            got=got,
            hint=hint,
        )


# ---------------------------------------------------------------- 5

_CHOICES = (
    "wrong unit",
    "integer overflow",
    "wrong frame",
    "fresh stamp on old data",
    "unknown taken for free",
    "blocking callback",
    "aliasing",
)
_RIGHT = {
    "A": ("fresh stamp on old data", "stamp-is-when-measured"),
    "B": ("unknown taken for free", "empty-means-unknown"),
    "C": ("blocking callback", "nobody-else-runs"),
}


@suite.test("verdicts", points=1, name="the three pieces", reread="The silent-bug clinic")
def _verdicts(student: Any) -> None:
    answers = student["verdicts"]
    expect(isinstance(answers, dict), "`verdicts` should still be the dictionary of the cell", got=answers)
    if all(answers.get(piece) is ... for piece in _RIGHT):
        raise NotImplementedError("verdicts")
    for piece, (right, hint) in _RIGHT.items():
        got = answers.get(piece)
        got = got.strip().lower() if isinstance(got, str) else got
        expect(got in _CHOICES, f"for {piece} choose one of: " + ", ".join(_CHOICES), got=got)
        expect(got == right, f"{piece}: {got} is not what makes it dangerous", hint=hint)


# ---------------------------------------------------------------- 6


@suite.test("repairs", points=1, name="brighter", reread="The silent-bug clinic")
def _brighter(student: Any) -> None:
    image = np.array([[0, 10, 200], [250, 255, 128]], np.uint8)
    for amount in (20, -20, 0, 300, -300):
        got = answered(student.brighter(image.copy(), amount), "brighter")
        right = np.clip(image.astype(int) + amount, 0, 255)
        same = np.shape(got) == right.shape and np.allclose(got, right)
        expect(
            same,
            f"by {amount} grey levels",
            given=image,
            expected=right.astype(np.uint8),
            got=got,
            hint="clip-before-uint8",
        )
        expect(
            isinstance(got, np.ndarray) and got.dtype == np.uint8,
            "the result is no longer a uint8 image",
            got=getattr(got, "dtype", type(got).__name__),
            hint="stays-uint8",
        )


@suite.test("repairs", points=1, name="keep", reread="The silent-bug clinic")
def _keep(student: Any) -> None:
    history: list[Any] = []
    scan = np.zeros(3)
    for reading in (1.0, 2.0, 3.0):
        scan[:] = reading
        student.keep(history, scan)
        if not history:
            raise NotImplementedError("keep")
    scan[:] = 9.0
    expect(len(history) == 3, f"after three scans the history holds {len(history)}", hint="all-that-came")
    got = [float(np.asarray(kept).ravel()[0]) for kept in history]
    expect(got == [1.0, 2.0, 3.0], "the history changes when the driver reads on", got=got, hint="keep-a-copy")


@suite.test("repairs", points=1, name="to_network", reread="The silent-bug clinic")
def _to_network(student: Any) -> None:
    image = np.arange(2 * 4 * 3, dtype=np.uint8).reshape(2, 4, 3)
    got = answered(student.to_network(image.copy()), "to_network")
    right = np.stack([image[..., channel] for channel in range(3)])
    hint = "height-then-width" if np.shape(got) == (3, 4, 2) else "move-the-axis"
    same = np.shape(got) == right.shape and np.array_equal(got, right)
    expect(same, "result[0] should be the red channel, image[..., 0]", expected=right[0], got=got, hint=hint)
