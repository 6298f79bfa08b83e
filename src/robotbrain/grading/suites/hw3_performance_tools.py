"""What the visible and hidden tests of `hw3_performance` share: oracles, and how typical mistakes look.

Each ``compare_...`` function puts a question to the student's function, compares with an oracle, and, where the answer
is wrong, looks whether a typical mistake would have given just that answer; then the hint names the mistake.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robotbrain.grading import expect, fail
from robotbrain.grading.suites import judging
from robotbrain.grading.suites.hw3_performance_traces import MS, hand_over

if TYPE_CHECKING:
    from robotbrain.grading import Student
    from robotbrain.monitoring.trace import Trace
    from robotbrain.ros.context import CallbackRecord

Array = NDArray[np.float64]

POINTS, IMAGE, COMMAND = "/perception/points", "/camera/image", "/cmd_vel"
CONTROLLER, PERCEPTION = "/controller", "/perception"
FOLLOW = {CONTROLLER: POINTS}
"""Which input to follow back from a timer of a node."""


def numbers(answer: Any, what: str, count: int) -> list[float]:
    """Return an answer as so many floats, or fail with what it should have been."""
    try:
        values = [float(value) for value in answer]
    except (TypeError, ValueError):
        fail(f"the answer should be {what}", got=answer, expected=f"{count} numbers")
    expect(len(values) == count, f"the answer should be {what}", got=answer, expected=f"{count} numbers")
    return values


# ---------------------------------------------------------------- Part 1: monitor


def ages(
    trace: Trace,
    pick: Callable[[list[tuple[int, int]]], int] = lambda known: known[-1][1],
    until: Callable[[CallbackRecord], int] = lambda control: control.start_ns,
    at: Callable[[CallbackRecord], int] = lambda control: control.end_ns,
) -> Array:
    """Return the ages of the commands, ms; the arguments make the mistakes.

    Args:
        pick: chooses a stamp from the (end, stamp) of every take so far.
        until: up to when a take counts.
        at: when the command is dated.
    """
    takes = sorted((c.end_ns, trace.stamps[c.message]) for c in _takes(trace))
    found = []
    for control in trace.callbacks:
        if control.node == CONTROLLER and control.published and control.kind == "timer":
            known = [take for take in takes if take[0] <= until(control)]
            if known:
                found.append((at(control) - pick(known)) / MS)
    return np.array(found)


def _takes(trace: Trace) -> list[CallbackRecord]:
    return [c for c in trace.callbacks if c.node == CONTROLLER and c.kind == "subscription" and c.name == POINTS]


def compare_ages(student: Student, trace: Trace, given: str) -> None:
    """Compare with the oracle."""
    expected = ages(trace)
    answer = student.command_ages_ms(hand_over(student, trace))
    numbers = judging.as_numbers(answer)
    longer = numbers is not None and numbers.size > len(expected)

    def mistakes() -> list[tuple[str, Any]]:
        released = {c.end_ns: trace.message_by_id[c.message].released_ns for c in _takes(trace)}
        first = min((trace.stamps[c.message] for c in _takes(trace)), default=0)
        controls = [c for c in trace.callbacks if c.node == CONTROLLER and c.kind == "timer"]
        return [
            ("ns-to-ms", expected * MS),
            ("ns-to-ms", expected * 1e3),
            ("ns-to-ms", expected * 1e-3),
            ("stamp-is-the-truth", ages(trace, lambda known: released[known[-1][0]])),
            ("stamp-is-the-truth", ages(trace, lambda known: known[-1][0])),
            ("newest-input", ages(trace, lambda known: known[0][1])),
            ("newest-input", ages(trace, lambda known: first)),
            ("leaves-at-the-end", ages(trace, at=lambda control: control.start_ns)),
            ("leaves-at-the-end", ages(trace, at=lambda control: control.ready_ns)),
            ("taken-before-start", ages(trace, until=lambda control: control.end_ns)),
            ("callback-is-not-latency", [(c.end_ns - c.start_ns) / MS for c in controls]),
            ("callback-is-not-latency", [(c.end_ns - c.start_ns) / MS for c in controls][-len(expected) :]),
            ("callback-is-not-latency", [(c.end_ns - c.ready_ns) / MS for c in controls]),
        ]

    hint = "no-input-no-age" if longer else ""
    judging.compare(answer, expected, mistakes, given=given, hint=hint, what="the list of ages")


def compare_summary(student: Student, values: Sequence[float]) -> None:
    """Compare with NumPy's percentiles."""
    answer = student.summarise(np.array(values, dtype=float))
    keys = ("n", "p50", "p95", "p99")
    if not isinstance(answer, Mapping) or not set(keys) <= set(answer):
        fail("the answer is not the dict asked for", got=answer, expected=f"a dict with the keys {', '.join(keys)}")
    given = f"{len(values)} latencies" + (f" from {min(values):g} to {max(values):g} ms" if len(values) else "")
    expect(answer["n"] == len(values), "n is the number of values", got=answer["n"], expected=len(values), given=given)
    if not len(values):
        numb = all(isinstance(answer[k], float) and math.isnan(answer[k]) for k in keys[1:])
        expect(numb, "percentiles of nothing", got=answer, expected="NaN, not a number", hint="nothing-is-nan")
        return
    for key, quantile in zip(keys[1:], np.percentile(values, [50, 95, 99]), strict=True):
        percent = float(key[1:])

        def mistakes(percent: float = percent) -> list[tuple[str, float]]:
            mean, spread = float(np.mean(values)), float(np.std(values))
            wrong = [("percentile-not-mean", mean + z * spread) for z in (0.0, 1.0, 1.645, 2.0, 2.326)]
            return [*wrong, ("quantile-or-percent", float(np.percentile(values, percent / 100)))]

        judging.compare(answer[key], float(quantile), mistakes, given=given, what=key)


def misses(trace: Trace, deadline_ms: float, topic: str = IMAGE, node: str = PERCEPTION) -> tuple[int, int]:
    """Return how many messages missed their deadline, and how many were due."""
    ends = {c.message: c.end_ns for c in trace.callbacks if c.node == node and c.message}
    due = [m for m in trace.messages if m.name == topic and m.released_ns + deadline_ms * MS <= trace.end_ns]
    late = [m for m in due if ends.get(m.id, math.inf) > m.released_ns + deadline_ms * MS]
    return len(late), len(due)


def compare_misses(student: Student, trace: Trace, deadline_ms: float, given: str) -> None:
    """Compare with the oracle."""
    expected = misses(trace, deadline_ms)
    answer = student.deadline_misses(hand_over(student, trace), IMAGE, PERCEPTION, deadline_ms)
    late, due = numbers(answer, "(missed, due)", 2)
    if [late, due] == list(expected):
        return
    done = [c for c in trace.callbacks if c.node == PERCEPTION and c.name == IMAGE]
    limit = deadline_ms * MS
    sent = [m for m in trace.messages if m.name == IMAGE]
    gone = sum(count for place, count in trace.dropped.items() if place == (PERCEPTION, IMAGE))
    from_start = sum(c.end_ns - c.start_ns > limit for c in done)
    from_ready = sum(c.end_ns - c.ready_ns > limit for c in done)
    strict = sum(c.end_ns - c.ready_ns >= limit for c in done)
    never = len(sent) - len(done)
    mistakes = [
        ("lost-is-late", (from_ready, len(done))),
        ("lost-is-late", (from_ready, expected[1])),
        ("from-ready-on", (from_start, len(done))),
        ("from-ready-on", (from_start + never, len(sent))),
        ("from-ready-on", (from_start + never, expected[1])),
        ("from-ready-on", (from_start + expected[1] - len(done), expected[1])),
        ("waiting-is-late", (from_ready + gone, len(done) + gone)),
        ("waiting-is-late", (from_ready + gone, expected[1])),
        ("not-due-yet", (from_ready + never, len(sent))),
        ("just-in-time", (strict + expected[0] - from_ready, expected[1])),
        ("ns-to-ms", (len(done), expected[1])),
        ("ns-to-ms", (expected[1], expected[1])),
    ]
    hint = judging.first_match((late, due), mistakes, expected)
    fail("these are not the missed and the due", got=(late, due), expected=expected, given=given, hint=hint)


def compare_rhythm(student: Student, trace: Trace, period_ms: float, given: str) -> None:
    """Compare with the closed form."""
    calls = [c for c in trace.callbacks if c.node == CONTROLLER and c.kind == "timer"]
    starts = np.array([c.start_ns for c in calls]) / MS
    gaps = np.diff(starts)
    spread, drift = float(gaps.std()), float((gaps.mean() / period_ms - 1) * 1e3)
    answer = student.timer_rhythm(hand_over(student, trace), CONTROLLER, "_control", period_ms)
    jitter, lost = numbers(answer, "(jitter_ms, drift_ms_per_s)", 2)

    def jitters() -> list[tuple[str, Any]]:
        ends, queued = (np.array([getattr(c, name) for c in calls]) / MS for name in ("end_ns", "queued_ns"))
        own = (starts.std(), gaps.mean(), gaps.var(), (ends - starts).std(), np.diff(ends).std(), queued.std())
        return [("spread-of-intervals", v) for v in own] + [("ns-to-ms", spread * MS), ("ns-to-ms", spread * 1e-3)]

    def drifts() -> list[tuple[str, Any]]:
        return [
            ("drift-per-second", gaps.mean() - period_ms),
            ("drift-per-second", gaps.mean() / period_ms - 1),
            ("drift-per-second", starts[-1] - starts[0] - (len(starts) - 1) * period_ms),
            ("late-is-positive", -drift),
        ]

    judging.compare(jitter, spread, jitters, match_atol=1e-9, given=given, what="the jitter")
    judging.compare(lost, drift, drifts, match_atol=1e-9, given=given, what="the drift")


# ---------------------------------------------------------------- Part 2: identify


def resource_use(trace: Trace) -> dict[str, float]:
    """Return the share of its capacity that each resource was busy."""
    spent = dict.fromkeys(trace.capacity, 0)
    for callback in trace.callbacks:
        for resource, length in callback.segments:
            spent[resource] += length
    whole = trace.end_ns - trace.start_ns
    return {resource: spent[resource] / (count * whole) for resource, count in trace.capacity.items()}


def thread_use(trace: Trace) -> dict[tuple[int, int], float]:
    """Return the share of time that each thread was occupied."""
    spent: dict[tuple[int, int], int] = {}
    for callback in trace.callbacks:
        place = callback.executor, callback.worker
        spent[place] = spent.get(place, 0) + callback.end_ns - callback.start_ns
    return {place: length / (trace.end_ns - trace.start_ns) for place, length in spent.items()}


def compare_utilisation(student: Student, trace: Trace, given: str) -> None:
    """Compare both dicts with the oracles."""
    resources, threads = resource_use(trace), thread_use(trace)
    answer = student.utilisation(hand_over(student, trace))
    if not (isinstance(answer, tuple) and len(answer) == 2 and all(isinstance(part, Mapping) for part in answer)):
        fail("the answer should be two dicts", got=answer, expected="(resources, threads)")
    got_resources, got_threads = dict(answer[0]), dict(answer[1])
    missing = set(resources) - set(got_resources)
    idle = any(resources[name] == 0 for name in missing)
    expect(
        got_resources.keys() == resources.keys(),
        "the first dict should have each resource that the device has",
        got=sorted(map(str, got_resources)),
        expected=sorted(resources),
        hint="idle-is-zero" if idle else "",
    )
    whole = trace.end_ns - trace.start_ns

    def stretched(share: float) -> tuple[str, float]:
        length = max(c.end_ns for c in trace.callbacks) - min(c.start_ns for c in trace.callbacks)
        return "whole-recording", share * whole / length

    for name, share in resources.items():

        def wrong_resource(name: str = name, share: float = share) -> list[tuple[str, float]]:
            held = sum(c.end_ns - c.start_ns for c in trace.callbacks) / whole
            return [
                ("all-the-cores", share * trace.capacity[name]),
                ("percent-or-share", 100 * share),
                ("waiting-is-not-busy", held),
                ("waiting-is-not-busy", held / trace.capacity[name]),
                stretched(share),
                ("ns-to-ms", share * 1e6),
            ]

        judging.compare(
            got_resources[name], share, wrong_resource, match_atol=1e-9, given=given, what=f"the share of {name}"
        )
    expect(
        got_threads.keys() == threads.keys(),
        "the second dict should have each thread (executor, worker) that ran something",
        got=sorted(got_threads, key=str),
        expected=sorted(threads),
        hint="thread-is-a-pair",
    )
    for place, share in threads.items():

        def wrong_thread(place: tuple[int, int] = place, share: float = share) -> list[tuple[str, float]]:
            calls = [c for c in trace.callbacks if (c.executor, c.worker) == place]
            on_cpu = sum(length for c in calls for resource, length in c.segments if resource == "cpu")
            return [
                ("thread-is-held", on_cpu / whole),
                ("thread-is-held", sum(c.demand_ns for c in calls) / whole),
                ("all-the-cores", share / trace.capacity["cpu"]),
                ("percent-or-share", 100 * share),
                stretched(share),
            ]

        what = f"the share of thread {place}"
        judging.compare(got_threads[place], share, wrong_thread, match_atol=1e-9, given=given, what=what)


def chain(trace: Trace, message: int, newest: bool = True, through_timers: bool = True) -> list[int]:
    """Return the ids of the callbacks behind a message, from the sensor on; the options make the mistakes."""
    found: list[int] = []
    while message in trace.sender:
        callback = trace.sender[message]
        found.append(callback.id)
        if not callback.message:
            topic = FOLLOW.get(callback.node)
            before = [
                c
                for c in trace.callbacks
                if (c.node, c.kind, c.name) == (callback.node, "subscription", topic) and c.end_ns <= callback.start_ns
            ]
            if not before or not through_timers:
                break
            callback = before[-1 if newest else 0]
            found.append(callback.id)
        message = callback.message
    return found[::-1]


def compare_chains(student: Student, trace: Trace, commands: Sequence[int], given: str) -> None:
    """Compare the chains behind some commands with the oracle's."""
    theirs = hand_over(student, trace)
    for message in commands:
        expected = chain(trace, message)
        answer = student.causal_chain(theirs, message, dict(FOLLOW))
        try:
            got = [callback.id for callback in answer]
        except (TypeError, AttributeError):
            fail("the answer should be a list of callback records", got=answer, expected="[CallbackRecord, ...]")
        if got == expected:
            continue
        mistakes = {
            "timers-have-inputs": [chain(trace, message, through_timers=False)],
            "newest-input": [chain(trace, message, newest=False)],
            "sensor-first": [expected[::-1]],
            "both-callbacks": [expected[:-2] + expected[-1:]],
        }
        fail(
            f"this is not the chain behind command {message}",
            got=[_show(trace, number) for number in got],
            expected=[_show(trace, number) for number in expected],
            given=given,
            hint=next((key for key, wrong in mistakes.items() if got in wrong), ""),
        )


def _show(trace: Trace, number: int) -> str:
    callback = next((c for c in trace.callbacks if c.id == number), None)
    return "?" if callback is None else f"{number} {callback.node} {callback.name}"


def compare_budget(student: Student, links: list[CallbackRecord], given: str) -> None:
    """Compare with the closed form: waiting and working of each link after the first."""
    expected = [
        (b.node, (b.start_ns - a.end_ns) / MS, (b.end_ns - b.start_ns) / MS) for a, b in itertools.pairwise(links)
    ]
    answer = student.latency_budget(list(links))
    try:
        rows = [(str(node), float(waiting), float(working)) for node, waiting, working in answer]
    except (TypeError, ValueError):
        fail("the answer should be rows (node, waiting_ms, working_ms)", got=answer, expected=expected, given=given)
    total = sum(waiting + working for _, waiting, working in rows)
    whole = (links[-1].end_ns - links[0].end_ns) / MS
    own = [(c.node, c.queued_ns / MS, (c.end_ns - c.start_ns) / MS) for c in links[1:]]
    demand = [(b.node, (b.start_ns - a.end_ns) / MS, b.demand_ns / MS) for a, b in itertools.pairwise(links)]
    scaled = [(node, waiting * 1e6, working * 1e6) for node, waiting, working in expected]
    mistakes = {"holding-is-waiting": own, "work-as-it-was": demand, "ns-to-ms": scaled}
    hint = next((key for key, wrong in mistakes.items() if _same_rows(rows, wrong)), "")
    expect([r[0] for r in rows] == [r[0] for r in expected], "one row for each link after the first",
           got=rows, expected=expected, given=given)  # fmt: skip
    expect(abs(total - whole) < 1e-6, "the parts do not add up to the latency", got=f"{total:.3f} ms",
           expected=f"{whole:.3f} ms", given=given, hint=hint)  # fmt: skip
    expect(_same_rows(rows, expected), got=rows, expected=expected, given=given, hint=hint)


def _same_rows(a: Sequence[tuple[str, float, float]], b: Sequence[tuple[str, float, float]]) -> bool:
    return len(a) == len(b) and all(
        x[0] == y[0] and abs(x[1] - y[1]) < 1e-6 and abs(x[2] - y[2]) < 1e-6 for x, y in zip(a, b, strict=True)
    )


def bottleneck(trace: Trace, full: float = 0.9, main: float = 2 / 3) -> tuple[str, str]:
    """Return role and cause as the exercise defines them."""
    use = thread_use(trace)
    place = max(use, key=lambda p: use[p])
    if use[place] < full:
        return "", "none"
    spent: dict[str, dict[str, int]] = {}
    for callback in trace.callbacks:
        if (callback.executor, callback.worker) == place:
            row = spent.setdefault(trace.roles.get(callback.node, callback.node), {"": 0, "cpu": 0, "gpu": 0})
            row[""] += callback.end_ns - callback.start_ns
            for resource, length in callback.segments:
                row[resource] = row.get(resource, 0) + length
    role = max(spent, key=lambda r: spent[r][""])
    if spent[role][""] < main * sum(row[""] for row in spent.values()):
        return role, "sharing"
    return role, "gpu" if spent[role]["gpu"] > spent[role]["cpu"] else "cpu"


def compare_bottleneck(student: Student, trace: Trace, expected: tuple[str, str], given: str) -> None:
    """Compare with what was planted."""
    answer = student.find_bottleneck(hand_over(student, trace))
    if not (isinstance(answer, (tuple, list)) and len(answer) == 2):
        fail("the answer should be (role, cause)", got=answer, expected=expected)
    got = tuple("" if part is None else part for part in answer)
    if got == expected:
        return
    lengths: dict[str, list[int]] = {}
    for callback in trace.callbacks:
        name = trace.roles.get(callback.node, callback.node)
        lengths.setdefault(name, []).append(callback.end_ns - callback.start_ns)
    longest = max(lengths, key=lambda r: float(np.mean(lengths[r])))
    frequent = max(lengths, key=lambda r: len(lengths[r]))
    hint = ""
    if got[0] == longest != expected[0]:
        hint = "long-is-not-full"
    elif got[0] == frequent != expected[0]:
        hint = "often-is-not-full"
    elif got[1] == "none":
        hint = "thread-is-held"
    elif expected[1] == "none":
        hint = "nothing-is-full"
    elif "sharing" in (got[1], expected[1]):
        hint = "sharing-or-not"
    elif got[0] == expected[0]:
        hint = "where-the-time-goes"
    fail("this is not the bottleneck", got=got, expected=expected, given=given, hint=hint)


# ---------------------------------------------------------------- Part 3: propose


def compare_gain(student: Student, stages: Mapping[str, float], change: Mapping[str, float]) -> None:
    """Compare both gains, serial and pipelined, with the closed form."""
    after = {name: ms / change.get(name, 1.0) for name, ms in stages.items()}
    latency = sum(stages.values()) / sum(after.values())
    rate = max(stages.values()) / max(after.values())
    given = f"stages {dict(stages)} ms, speed-ups {dict(change)}"
    for pipelined in (False, True):
        answer = student.predict_gain(dict(stages), dict(change), pipelined)
        if not isinstance(answer, Mapping) or not {"latency", "throughput"} <= set(answer):
            fail("the answer is not the dict asked for", got=answer, expected="keys latency and throughput")
        for key, expected in (("latency", latency), ("throughput", rate if pipelined else latency)):
            wrong = [
                ("before-over-after", 1 / expected),
                ("slowest-stage", latency if pipelined and key == "throughput" else rate),
                ("gains-do-not-add", sum(change.values())),
                ("gains-do-not-add", sum(change.values()) - len(change) + 1),
                ("gains-do-not-add", math.prod(change.values())),
                ("gains-do-not-add", sum(change.get(name, 1.0) for name in stages) / len(stages)),
            ]
            where = f"{given}, {'pipelined' if pipelined else 'one after the other'}"
            judging.compare(answer[key], expected, wrong, atol=1e-9, given=where, what=f"the gain in {key}")


def service_ms(trace: Trace, node: str, name: str, resource: str, factor: float) -> float:
    """Return the closed form of the predicted mean time of a callback."""
    calls = [c for c in trace.callbacks if (c.node, c.name) == (node, name)]
    spent = [sum(length for r, length in c.segments if r == resource) for c in calls]
    return float(np.mean([c.end_ns - c.start_ns - s + s / factor for c, s in zip(calls, spent, strict=True)])) / MS


def compare_prediction(
    student: Student,
    trace: Trace,
    place: tuple[str, str],
    resource: str,
    factor: float,
    measured_ms: float | None = None,
) -> None:
    """Compare with the closed form, or with what was measured after the repair (to 10 %)."""
    expected = service_ms(trace, *place, resource, factor)
    before = service_ms(trace, *place, resource, 1.0)
    calls = [c for c in trace.callbacks if (c.node, c.name) == place]
    bare = float(np.mean([sum(t for r, t in c.segments if r == resource) for c in calls])) / MS
    mistakes = [
        ("amdahl", before / factor),
        ("amdahl", bare / factor),
        ("before-over-after", before - bare + bare * factor),
        ("ns-to-ms", expected * MS),
        ("before-over-after", before / expected),
    ]
    answer = student.predict_service_ms(hand_over(student, trace), *place, resource, factor)
    given = (
        f"{place[0]} {place[1]}: {before:.1f} ms, of which {bare:.1f} ms on the {resource}, made {factor:g} x faster"
    )
    judging.compare(answer, expected, mistakes, rtol=1e-3, given=given, what="the predicted time")
    if measured_ms is not None:
        what = "against the measured time, the predicted one"
        judging.compare(answer, measured_ms, rtol=0.1, given=given, what=what)
