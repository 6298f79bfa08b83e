"""The monitor says what the trace says, notices what it should, and never gets in the brain's way."""

from __future__ import annotations

import errno
import json
import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, cast

import pytest
from rclpy.node import Node
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String
from std_srvs.srv import Trigger

from robotbrain.errors import InputError
from robotbrain.monitoring import snapshots as snapshots_module
from robotbrain.monitoring.alarms import Alarm, AlarmBoard, AlarmRules
from robotbrain.monitoring.clockwatch import ClockWatch
from robotbrain.monitoring.deadlines import Deadlines
from robotbrain.monitoring.metrics import measure
from robotbrain.monitoring.monitor import Monitor
from robotbrain.monitoring.snapshots import Snapshot, SnapshotLog
from robotbrain.monitoring.streams import RhythmStream
from robotbrain.ros import SimContext, charge
from tests.monitoring.sample_runs import trace_of, watched_run

MS = 1_000_000
S = 1_000_000_000


# ---- the same figures as from a trace ----


@pytest.mark.parametrize("overloaded", [False, True])
def test_a_monitor_says_what_the_trace_says(overloaded: bool) -> None:
    streamed, exact = watched_run(overloaded)[1].summary(), measure(trace_of(overloaded))
    assert streamed.notes == ()
    assert {c.label for c in streamed.callbacks} == {c.label for c in exact.callbacks}
    for found, true in zip(streamed.callbacks, exact.callbacks, strict=True):
        assert (found.role, found.calls, found.misses) == (true.role, true.calls, true.misses), found.label
        assert found.rate_hz == pytest.approx(true.rate_hz, nan_ok=True)
        for part in ("latency", "response", "queueing", "contention", "age"):
            ours, theirs = getattr(found, part), getattr(true, part)
            assert ours.count == theirs.count, (found.label, part)
            if ours.count:
                assert ours.mean == pytest.approx(theirs.mean, abs=1e-9)
                assert ours.max == pytest.approx(theirs.max)
            if ours.count > 100:  # numpy interpolates between the two nearest values, a sketch takes one
                assert ours.p50 == pytest.approx(theirs.p50, rel=0.03, abs=1e-3), (found.label, part)
        assert {n: d.count for n, d in found.demand.items()} == {n: d.count for n, d in true.demand.items()}
    assert [(t.topic, t.messages) for t in streamed.topics] == [(t.topic, t.messages) for t in exact.topics]
    assert streamed.end_to_end.count == exact.end_to_end.count
    assert streamed.end_to_end.mean == pytest.approx(exact.end_to_end.mean)
    assert streamed.end_to_end.max == pytest.approx(exact.end_to_end.max)
    assert streamed.utilisation["cpu"] == pytest.approx(watched_run(overloaded)[0].busy["cpu"])


@pytest.mark.parametrize("overloaded", [False, True])
def test_queues_are_those_of_the_trace(overloaded: bool) -> None:
    streamed = {(q.node, q.topic): q for q in watched_run(overloaded)[1].summary().queues}
    for true in measure(trace_of(overloaded)).queues:
        found = streamed[true.node, true.topic]
        assert (found.limit, found.dropped) == (true.limit, true.dropped)
        # The trace knows what waits at the end; the stream learns of it when it is taken.
        assert found.max_depth == pytest.approx(true.max_depth, abs=2 if overloaded else 0)
        assert found.mean_depth == pytest.approx(true.mean_depth, rel=0.12, abs=0.1)


def test_watching_does_not_change_a_run() -> None:
    from robotbrain.pipeline.brain import drive

    watched = drive(3, time_limit=1.5, attach=[Monitor(snapshot_s=0.2, window_s=0.5).attach])
    assert watched.log_sha256 == drive(3, time_limit=1.5).log_sha256


def test_snapshots_are_taken_in_time() -> None:
    _, monitor = watched_run(False)
    times = [snapshot.time_s for snapshot in monitor.snapshots]
    assert len(times) == 5  # the sixth second ends with the run
    assert all(abs(t - round(t)) < 0.05 for t in times)
    last = monitor.snapshots[-1]
    assert last.topics["/scan"] == pytest.approx(10, rel=0.01)
    assert last.callbacks["/controller timer _control"].rate_hz == pytest.approx(20, rel=0.1)
    assert 0 < last.utilisation["cpu"] < 0.1
    json.dumps(last.to_dict(), allow_nan=False)


def chatter(context: SimContext, monitor: Monitor, seconds: float, period: float = 0.01, work_ms: float = 0) -> Node:
    monitor.attach(context)
    with context.as_default():
        node = Node("talker")
        publisher = node.create_publisher(String, "out", 10)

        def tick() -> None:
            charge(round(work_ms * MS))
            publisher.publish(String(data="x"))

        node.create_timer(period, tick)
        context.run_for(seconds)
    return node


def test_two_simulations_are_one_watch() -> None:
    monitor = Monitor(chains=[("/out", "/nothing")])
    for _ in range(2):
        chatter(SimContext(), monitor, 1.0)
    summary = monitor.summary()
    assert summary.seconds == pytest.approx(2.0, abs=0.02)
    assert summary.callback("/talker", "timer", "tick").calls == 200
    assert summary.topics[0].messages == 200 and summary.notes == ()


def test_nothing_of_one_simulation_reaches_into_the_next() -> None:
    monitor = Monitor(chains=[("/scan", "/cmd_vel")])
    for scans in (True, False):
        context = SimContext()
        monitor.attach(context)
        with context.as_default():
            node, sensor = Node("controller"), Node("sensor")
            publisher = node.create_publisher(String, "cmd_vel", 10)
            node.create_subscription(LaserScan, "scan", lambda _: None, 10)
            node.create_timer(0.1, lambda publisher=publisher: publisher.publish(String(data="x")))
            if scans:
                out = sensor.create_publisher(LaserScan, "scan", 10)
                sensor.create_timer(0.1, lambda out=out, context=context: out.publish(scan(context.now_ns)))
            context.run_for(1.0)
        # In the first run all commands but the one before the first scan; in the second none.
        assert monitor.summary().end_to_end.count == 9


def test_a_monitor_can_be_taken_off() -> None:
    context, monitor = SimContext(), Monitor()
    remove = monitor.attach(context)
    assert (len(context.callback_taps), len(context.message_taps)) == (1, 1)
    remove()
    remove()
    assert not context.callback_taps and not context.message_taps
    monitor.attach(context)
    monitor.close()
    assert context.callback_taps == []


def test_memory_does_not_grow_with_time() -> None:
    def size(monitor: Monitor) -> int:
        tables: list[Any] = [
            monitor.stamps,
            monitor.callbacks,
            monitor.topics,
            monitor.queues,
            monitor.snapshots,
            monitor.alarms,
        ]
        stream = monitor.callbacks["/talker", "timer", "tick"]
        return sum(len(table) for table in tables) + len(stream.latency.total()._sketch._store.bins)

    monitor = Monitor(window_s=0.5, keep=5)
    chatter(SimContext(), monitor, 10.0)
    before = size(monitor)
    chatter(SimContext(), monitor, 30.0)
    assert size(monitor) <= before


# ---- alarms ----


def test_deadline_alarms_have_hysteresis() -> None:
    board = AlarmBoard(AlarmRules(deadline_raise=3, deadline_clear=2))

    def calls(*missed: bool) -> list[bool]:
        return [alarm.active for bad in missed for alarm in board.call("x", bad, 60.0 if bad else 10.0, 50.0, 0)]

    assert calls(True, True, False, True, True) == []
    assert calls(True) == [True]
    assert calls(True, True, False, True, False) == []
    assert calls(False, False, False) == [False]
    assert board.active == {}


def test_silence_is_noticed_once_and_ends_with_the_second_message() -> None:
    board = AlarmBoard(AlarmRules(stale_s={"/scan": 0.5}), 0)  # type: ignore[arg-type]
    assert board.tick(S // 2) == []
    (raised,) = board.tick(7 * S // 10)
    assert raised.active and raised.kind == "stale" and "0.70 s" in raised.text
    assert board.tick(S) == []
    assert board.message("/scan", 2 * S) == []
    (cleared,) = board.message("/scan", 2 * S + 1)
    assert not cleared.active and board.message("/other", 3 * S) == []


def test_a_rate_alarm_needs_a_margin_to_clear() -> None:
    board = AlarmBoard(AlarmRules(min_hz={"/scan": 10.0}), 0)  # type: ignore[arg-type]
    now = 0

    def second_at(hz: int) -> list[bool]:
        nonlocal now
        for _ in range(hz):
            board.message("/scan", now)
        now += S
        return [alarm.active for alarm in board.tick(now)]

    assert second_at(10) == [] and second_at(9) == [True] and second_at(9) == []
    assert second_at(10) == [] and second_at(11) == [False]


def test_alarms_of_a_run_reach_whoever_asked() -> None:
    heard: list[Alarm] = []
    monitor = Monitor(
        Deadlines({("/talker", "timer", "*"): 5.0}),
        rules=AlarmRules(deadline_raise=2, stale_s={"/gone": 0.3}),  # type: ignore[arg-type]
        on_alarm=heard.append,
    )
    chatter(SimContext(), monitor, 1.0, work_ms=6)
    assert {(alarm.kind, alarm.subject) for alarm in heard} == {("deadline", "/talker timer tick"), ("stale", "/gone")}
    assert all(alarm.active for alarm in heard) and len(heard) == 2
    assert len(monitor.summary().alarms) == 2
    assert monitor.summary().callback("/talker", "timer", "tick").misses > 90


@pytest.mark.parametrize(
    "rules", [{"deadline_raise": 0}, {"stale_s": {"/x": 0}}, {"min_hz": [("/x", -1)]}, {"rate_margin": -1}]
)
def test_rules_are_checked(rules: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        AlarmRules(**rules)
    with pytest.raises(InputError, match="window_s"):
        Monitor(window_s=0)


# ---- what goes wrong in the monitor stays there ----


def test_an_error_of_the_monitor_does_not_hurt_the_brain(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monitor = Monitor()

    def broken(*_: object) -> None:
        raise ZeroDivisionError("planted")

    monkeypatch.setattr(monitor, "message", broken)
    with caplog.at_level(logging.WARNING):
        node = chatter(SimContext(), monitor, 1.0)
    assert node.context.now_ns == S
    notes = " ".join(monitor.summary().notes)
    assert monitor.failures == 100
    assert len([r for r in caplog.records if "the brain goes on" in r.message]) == 1
    assert "ZeroDivisionError: planted" in notes and "failed 100 times" in notes


def test_whoever_listens_to_alarms_may_fail() -> None:
    def broken(_: Alarm) -> None:
        raise RuntimeError("planted")

    monitor = Monitor(Deadlines({("/talker", "timer", "*"): 5.0}), on_alarm=broken)
    chatter(SimContext(), monitor, 1.0, work_ms=6)
    assert monitor.failures == 1 and len(monitor.alarms) == 1


def test_threads_do_not_lose_counts() -> None:
    monitor = Monitor()
    threads = [threading.Thread(target=lambda: [monitor.record("span", 1.0) for _ in range(2000)]) for _ in range(4)]
    for thread in threads:
        thread.start()
    for _ in range(20):
        monitor.summary()
    for thread in threads:
        thread.join()
    assert monitor.summary().spans["span"].count == 8000 and monitor.failures == 0


def test_a_value_that_is_no_time_is_left_out() -> None:
    monitor = Monitor()
    monitor.record("span", float("nan"))
    monitor.record("span", -1.0)
    monitor.record("span", 2.0)
    summary = monitor.summary()
    assert summary.spans["span"].count == 1 and len(summary.notes) == 2


# ---- a full disk ----


class FullDisk:
    """A file on a disk with so many bytes left."""

    def __init__(self, path: Path, room: list[int]) -> None:
        self._file, self._room = path.open("ab", buffering=0), room

    def write(self, data: bytes) -> int:
        if self._room[0] <= 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        part = data[: self._room[0]]
        self._room[0] -= len(part)
        return int(self._file.write(part) or 0)

    def close(self) -> None:
        self._file.close()


def full_disk(room: list[int]) -> Callable[[Path], BinaryIO]:
    return lambda path: cast(BinaryIO, FullDisk(path, room))


def test_a_full_disk_is_survived_and_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    room = [3000]
    monkeypatch.setattr(snapshots_module, "open_unbuffered", full_disk(room))
    monitor = Monitor(log=tmp_path / "log.jsonl", snapshot_s=0.1)
    chatter(SimContext(), monitor, 5.0)
    assert monitor.failures == 0 and len(monitor.snapshots) >= 48
    notes = " ".join(monitor.summary().notes)
    assert "No space left on device" in notes and "make room" in notes and "snapshots are missing" in notes


def test_after_a_full_disk_the_log_goes_on_and_can_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    room = [400]
    monkeypatch.setattr(snapshots_module, "open_unbuffered", full_disk(room))
    log = SnapshotLog(tmp_path / "log.jsonl", retry=2)
    wrote = [log.write(Snapshot(float(i))) for i in range(6)]
    room[0] = 100_000
    wrote += [log.write(Snapshot(float(i))) for i in range(6, 20)]
    log.close()
    assert wrote[0] and not all(wrote) and all(wrote[-10:])
    assert log.written + log.lost == 20 == len(wrote) and log.written == sum(wrote)
    times = []
    for line in (tmp_path / "log.jsonl").read_text().splitlines():
        try:
            times.append(json.loads(line)["time_s"])
        except json.JSONDecodeError:
            times.append(None)
    assert len(times) - times.count(None) == log.written
    assert times.count(None) >= 1 and times[-10:] == [float(i) for i in range(10, 20)]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_a_device_that_is_always_full(caplog: pytest.LogCaptureFixture) -> None:
    monitor = Monitor(log="/dev/full", snapshot_s=0.1)
    chatter(SimContext(), monitor, 1.0)
    assert any("cannot be logged" in note for note in monitor.summary().notes)
    assert len([r for r in caplog.records if "cannot be logged" in r.message]) == 1


def test_a_log_holds_the_snapshots(tmp_path: Path) -> None:
    monitor = Monitor(log=tmp_path / "deep" / "log.jsonl", snapshot_s=0.25)
    chatter(SimContext(), monitor, 2.1)
    monitor.close()
    lines = [json.loads(line) for line in (tmp_path / "deep" / "log.jsonl").read_text().splitlines()]
    assert lines == [snapshot.to_dict() for snapshot in monitor.snapshots] and len(lines) == 8


# ---- clocks ----


def test_a_clock_that_is_set_is_noticed() -> None:
    watch = ClockWatch("the clock", 0.05)
    assert [watch.look(1000 * S + t, t) for t in (0, S, 2 * S)] == [None] * 3
    said = watch.look(1000 * S + 2 * S + S // 2, 2 * S + 100 * MS)
    assert said is not None and "forward by 0.400 s" in said
    said = watch.look(999 * S, 3 * S)
    assert said is not None and "back by" in said and watch.jumps == 2


def test_simulated_time_may_run_at_any_rate_but_not_back() -> None:
    watch = ClockWatch("the clock", steady=False)
    assert [watch.look(t, t // 7) for t in (0, 5 * S, 6 * S)] == [None] * 3
    said = watch.look(2 * S, S)
    assert said is not None and "back by 4.000 s" in said


def test_a_clock_that_jumps_gives_no_strange_ages(monkeypatch: pytest.MonkeyPatch) -> None:
    """The system clock is set back by an hour, and later forward by two, while a node listens."""
    shift = [0]
    real = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: real() + shift[0])
    context = SimContext(start_ns=real())
    with context.as_default():
        node = Node("listener")
    monkeypatch.setattr(node.get_clock(), "now", lambda: _Now(real() + shift[0]))
    monitor = Monitor(chains=[("/scan", "/out")])
    monitor.attach_node(node)
    with context.as_default():
        out = node.create_publisher(LaserScan, "out", 10)
        subscription = node.create_subscription(LaserScan, "scan", lambda _: out.publish(LaserScan()), 10)
    for step in range(30):
        before = scan(real() + shift[0] - 5 * MS)  # taken 5 ms ago, before the clock is set
        if step in (10, 20):
            shift[0] += -3600 * S if step == 10 else 7200 * S
        subscription.callback(before)
        time.sleep(0.006)
    monitor.close()
    summary = monitor.summary()
    age = summary.callback("/listener", "subscription", "/scan").age
    assert 27 <= age.count <= 29 and age.min >= 5 and age.max < 1000
    (chain,) = summary.chains
    assert chain.age.min >= 5 and chain.age.max < 1000
    assert any("jumped back by 3600" in note for note in summary.notes)
    assert any("jumped forward by 7200" in note for note in summary.notes)


class _Now:
    def __init__(self, nanoseconds: int) -> None:
        self.nanoseconds = nanoseconds


def scan(stamp_ns: int) -> LaserScan:
    message = LaserScan()
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, S)
    return message


# ---- wall-clock time ----


def test_a_node_is_timed_and_otherwise_left_alone() -> None:
    context = SimContext()
    with context.as_default():
        node, other = Node("brain"), Node("other")
        publisher = node.create_publisher(LaserScan, "points", 10)
        taken: list[Any] = []

        def take(message: Any) -> None:
            taken.append(message)
            time.sleep(0.003)
            publisher.publish(message)

        early = node.create_subscription(LaserScan, "scan", take, 10)
        with Monitor(chains=[("/scan", "/points")]) as monitor:
            undo = monitor.attach_node(node)
            ticks: list[int] = []
            node.create_timer(0.05, lambda: ticks.append(context.now_ns))
            node.create_service(Trigger, "ask", lambda _, response: answer(response))
            sender = other.create_publisher(LaserScan, "scan", 10)
            other.create_timer(0.1, lambda: sender.publish(scan(context.now_ns)))
            client = other.create_client(Trigger, "ask")
            context.run_for(1.0)
            assert client.call(Trigger.Request()).message == "yes"
            summary = monitor.summary()
            undo()
            assert early.callback is take and "publish" not in vars(publisher)
            context.run_for(0.5)
            assert monitor.summary().topics == summary.topics
    assert summary.clock == "wall" and summary.notes == ()
    found = summary.callback("/brain", "subscription", "/scan")
    assert found.calls == 10 and found.latency.min >= 3.0 and found.response.count == 0
    assert summary.callback("/brain", "timer", "<lambda>").jitter.declared
    assert summary.callback("/brain", "service", "/ask").calls == 1
    assert summary.chains[0].age.count == 10
    assert {t.topic: t.messages for t in summary.topics} == {"/scan": 10, "/points": 10}
    assert len(taken) == 15 and len(ticks) == 30


def answer(response: Any) -> Any:
    response.message = "yes"
    return response


def test_errors_of_a_callback_pass_through_and_are_counted() -> None:
    context = SimContext()
    errors: list[Any] = []
    context.on_callback_error = lambda error: errors.append(error) or True  # type: ignore[func-returns-value]
    with context.as_default(), Monitor() as monitor:
        node = Node("brain")
        monitor.attach_node(node)

        def fail() -> None:
            raise ValueError("planted")

        node.create_timer(0.1, fail)
        context.run_for(0.55)
    assert [str(error.__cause__) for error in errors] == ["planted"] * 5
    found = monitor.summary().callback("/brain", "timer", "fail")
    assert found.failures == found.calls == 5 and monitor.failures == 0


def test_coroutines_are_timed_to_their_end() -> None:
    context = SimContext()
    with context.as_default(), Monitor() as monitor:
        node, server = Node("brain"), Node("server")
        server.create_service(Trigger, "ask", lambda _, response: answer(response))
        client = node.create_client(Trigger, "ask")
        monitor.attach_node(node)
        answers: list[str] = []

        async def ask() -> None:
            answers.append((await client.call_async(Trigger.Request())).message)

        from robotbrain.ros.callback_groups import ReentrantCallbackGroup

        client.callback_group = ReentrantCallbackGroup()
        node.create_timer(0.1, ask)
        context.run_for(0.35)
    assert answers == ["yes"] * 3
    found = monitor.summary().callback("/brain", "timer", "ask")
    assert (found.calls, found.failures) == (3, 0)


def test_spans_are_timed_also_when_they_fail() -> None:
    monitor = Monitor()
    with monitor.span("inference"):
        time.sleep(0.01)
    with pytest.raises(KeyError), monitor.span("inference"):
        raise KeyError
    found = monitor.summary().spans["inference"]
    assert found.count == 2 and found.max >= 10


def test_silence_is_noticed_while_nothing_happens() -> None:
    heard = threading.Event()
    rules = AlarmRules(stale_s={"/scan": 0.05})  # type: ignore[arg-type]
    with Monitor(rules=rules, on_alarm=lambda _: heard.set()) as monitor:
        monitor.start()
        monitor.start()
        assert heard.wait(5.0)
    assert not [t for t in threading.enumerate() if t.name == "robotbrain-monitor"]


# ---- streams ----


def test_the_streaming_rhythm_agrees_with_the_whole() -> None:
    import numpy as np

    from robotbrain.monitoring.deadlines import jitter_of

    rng = np.random.default_rng(5)
    times = np.sort(np.round(np.arange(600) * 20.002 * MS + rng.uniform(0, 3 * MS, 600)).astype(np.int64))
    times = np.delete(times, [50, 51, 300])
    for period in (20 * MS, None):
        stream = RhythmStream(period)
        for part in np.array_split(times, [1, 3, 100, 101]):
            stream.extend(part.tolist())
        found, whole = stream.jitter(), jitter_of(times, period)
        assert found.missed == whole.missed == 3
        assert found.period_ms == pytest.approx(whole.period_ms, rel=0.05)
        if period:
            assert found.drift_ppm == pytest.approx(whole.drift_ppm, abs=1e-3)
            assert found.deviation.p95 == pytest.approx(whole.deviation.p95, rel=0.03)
