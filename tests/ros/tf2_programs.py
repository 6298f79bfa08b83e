"""Random programs for a tf2 buffer core, run on the kit's core and (to make the fixture) on the genuine one.

A program is a list of operations, each a list that JSON can hold; a run gives one plain answer per operation.
"""

from __future__ import annotations

import math
import random

from geometry_msgs.msg import TransformStamped
from rclpy.time import Time

STEP_NS = 100_000_000


def corner_cases() -> list[list]:
    """A program of what random ones hit too rarely: equal stamps at both ends, and the very edge of the history."""
    still = [0.0, 0.0, 0.0, 1.0]
    second = 10**9
    program = [
        ["set", "map", "base", stamp * second, [x, 0.0, 0.0], still, False]
        for stamp, x in ((5, 1.0), (5, 2.0), (7, 3.0), (7, 4.0), (7, 5.0), (6, 6.0), (6, 7.0))
    ]
    program += [["lookup", "map", "base", int(stamp * second)] for stamp in (5, 5.5, 6, 6.5, 7, 0)]
    program += [["set", "map", "edge", stamp * second, [float(stamp), 0.0, 0.0], still, False] for stamp in (20, 10, 9)]
    program += [["lookup", "map", "edge", stamp * second] for stamp in (10, 15, 9)]
    program += [
        ["set", "sea", "edge", 25 * second, [0.0, 1.0, 0.0], still, False],
        ["lookup", "sea", "edge", 10 * second],
    ]
    return [*program, ["set", "sea", "edge", 26 * second, [0.0, 1.0, 0.0], still, False], ["yaml"], ["string"]]


def random_program(seed: int, length: int = 90) -> list[list]:
    """Transforms and lookups over a few frames that form trees, change parents, fall silent and form loops."""
    rng = random.Random(seed)
    frames = [f"f{index}" for index in range(rng.randint(3, 7))]
    parents = {child: rng.choice(frames[:index]) for index, child in enumerate(frames) if index and rng.random() < 0.9}
    static = {child for child in parents if rng.random() < 0.3}
    clock, program = rng.choice([0, 3, 1_700_000_000]) * 10**9, []

    since = clock

    def quaternion() -> list[float]:
        if rng.random() < 0.2:  # half turns and identities: where signs are decided
            return [float(value) for value in rng.choice([(0, 0, 0, 1), (0, 0, 1, 0), (1, 0, 0, 0), (0, -1, 0, 0)])]
        values = [rng.gauss(0, 1) for _ in range(4)]
        norm = math.sqrt(sum(value * value for value in values)) * rng.choice([1, 1, 1, 1, 0.999, 2])
        return [round(value / norm, 7) for value in values]

    def moment() -> int:
        ago = rng.choice([rng.randrange(12 * STEP_NS), STEP_NS * rng.randrange(12), clock - since])
        return rng.choice([0, 0, clock, max(0, clock - ago), clock + STEP_NS // 3])

    def late() -> int:
        return rng.choice([rng.randrange(30 * STEP_NS), 10 * 10**9, 10 * 10**9 + 1])

    def name() -> str:
        return rng.choice(frames) if rng.random() < 0.94 else rng.choice(["", "/f0", "nowhere"])

    for _ in range(length):
        kind = rng.random()
        if kind < 0.5:
            clock += rng.choice([0, STEP_NS, STEP_NS, 7 * STEP_NS])
            for child, parent in parents.items():
                if rng.random() < 0.25:
                    continue
                stamp = clock if rng.random() < 0.85 else max(0, clock - late())
                up = parent if rng.random() < 0.97 else rng.choice(frames)
                place = [round(rng.uniform(-3, 3), 3) for _ in range(3)]
                is_static = child in static if rng.random() < 0.97 else child not in static
                program.append(["set", up, child, stamp, place, quaternion(), is_static])
        elif kind < 0.52:
            place = [rng.choice([math.nan, 1.0]), 0.0, 0.0]
            turn = rng.choice([[0.0] * 4, [0.0, 0.0, 0.0, 1.0], [math.nan, 0.0, 0.0, 1.0]])
            program.append(["set", name(), name(), clock, place, turn, False])
        elif kind < 0.53:
            program.append(["clear"])
            since = clock
        elif kind < 0.58:
            program.append([rng.choice(["string", "yaml"])])
        elif kind < 0.63:
            program.append(["common", name(), name()])
        elif kind < 0.73:
            program.append(["can", name(), name(), moment()])
        elif kind < 0.78:
            program.append(["can_full", name(), moment(), name(), moment(), name()])
        elif kind < 0.85:
            program.append(["full", name(), moment(), name(), moment(), name()])
        else:
            program.append(["lookup", name(), name(), moment()])
    return program


def run(core, program: list[list]) -> list:
    """Run a program on a ``BufferCore``; an exception is answered by its class and text."""
    answers = []
    for operation in program:
        try:
            answers.append(_answer(core, *operation))
        except Exception as error:
            answers.append({"error": type(error).__name__, "text": str(error)})
    return answers


def _answer(core, kind, *args):
    if kind == "set":
        parent, child, stamp, place, turn, is_static = args
        message = TransformStamped()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
        message.header.frame_id, message.child_frame_id = parent, child
        v, q = message.transform.translation, message.transform.rotation
        v.x, v.y, v.z = place
        q.x, q.y, q.z, q.w = turn
        (core.set_transform_static if is_static else core.set_transform)(message, "program")
        return None
    if kind == "clear":
        return core.clear()
    if kind == "string":
        return core.all_frames_as_string()
    if kind == "yaml":
        return core.all_frames_as_yaml()
    if kind == "common":
        return core.get_latest_common_time(*args).nanoseconds
    if kind == "can":
        target, source, time = args
        return plain_bool(core.can_transform_core(target, source, Time(nanoseconds=time)))
    if kind == "lookup":
        target, source, time = args
        return plain(core.lookup_transform_core(target, source, Time(nanoseconds=time)))
    target, target_time, source, source_time, fixed = args
    query = (target, Time(nanoseconds=target_time), source, Time(nanoseconds=source_time), fixed)
    if kind == "can_full":
        return plain_bool(core.can_transform_full_core(*query))
    return plain(core.lookup_transform_full_core(*query))


def plain_bool(found) -> list:
    return [bool(found[0]), found[1]]


def plain(message) -> dict:
    v, q, stamp = message.transform.translation, message.transform.rotation, message.header.stamp
    return {
        "stamp": stamp.sec * 10**9 + stamp.nanosec,
        "frames": [message.header.frame_id, message.child_frame_id],
        "translation": [round(value, 10) for value in (v.x, v.y, v.z)],
        "rotation": [round(value, 10) for value in (q.x, q.y, q.z, q.w)],
    }
