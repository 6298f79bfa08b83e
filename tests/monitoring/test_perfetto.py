"""The file is what the Trace Event format asks for, and says what the trace says."""

from __future__ import annotations

import gzip
import json
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any, Literal

import pytest

from robotbrain.errors import InputError
from robotbrain.monitoring.metrics import measure
from robotbrain.monitoring.perfetto import perfetto_events, write_perfetto
from robotbrain.monitoring.queues import queue_timelines
from robotbrain.monitoring.resources import Reading
from tests.monitoring.sample_runs import trace_of

REQUIRED = {"name", "ph", "ts", "pid", "tid"}


@pytest.fixture(params=[(False, "node"), (True, "node"), (True, "executor")], ids=str)
def events(request: pytest.FixtureRequest) -> list[dict[str, Any]]:
    overloaded, by = request.param
    return perfetto_events(trace_of(overloaded), by=by)


def test_every_event_has_what_the_format_requires(events: list[dict[str, Any]]) -> None:
    json.dumps(events, allow_nan=False)
    for event in events:
        assert set(event) >= REQUIRED, event
        assert event["ts"] >= 0 and isinstance(event["ts"], float)
        assert round(event["ts"], 3) == event["ts"]
        match event["ph"]:
            case "X":
                assert event["dur"] >= 0 and "cat" in event
            case "i":
                assert event["s"] == "t"
            case "C":
                assert isinstance(event["args"]["value"], int | float)
            case "s" | "f":
                assert "id" in event and event["cat"] == "message"
            case "M":
                assert event["args"]
            case other:
                pytest.fail(f"unknown phase {other}")


def test_times_do_not_fall(events: list[dict[str, Any]]) -> None:
    times = [event["ts"] for event in events if event["ph"] != "M"]
    assert times == sorted(times)
    first = next(i for i, event in enumerate(events) if event["ph"] != "M")
    assert all(event["ph"] != "M" for event in events[first:])


def test_every_thread_and_process_has_a_name(events: list[dict[str, Any]]) -> None:
    processes = {e["pid"] for e in events if e["name"] == "process_name"}
    threads = {(e["pid"], e["tid"]) for e in events if e["name"] == "thread_name"}
    assert {e["pid"] for e in events} <= processes
    assert {(e["pid"], e["tid"]) for e in events if e["ph"] in "Xi"} <= threads


def test_slices_of_a_thread_do_not_cross(events: list[dict[str, Any]]) -> None:
    lanes: dict[tuple[int, int], list[tuple[float, float]]] = defaultdict(list)
    for event in events:
        if event["ph"] == "X":
            lanes[event["pid"], event["tid"]].append((event["ts"], round(event["ts"] + event["dur"], 3)))
    for spans in lanes.values():
        for (_, end), (begin, _) in zip(sorted(spans), sorted(spans)[1:], strict=False):
            assert begin >= end - 1e-6


def test_arrows_go_from_the_sender_to_each_taker(events: list[dict[str, Any]]) -> None:
    starts = {e["id"]: e for e in events if e["ph"] == "s"}
    ends = {e["id"]: e for e in events if e["ph"] == "f"}
    assert starts.keys() == ends.keys() and len(starts) > 500
    assert Counter(e["ph"] for e in events)["s"] == len(starts)
    slices: dict[tuple[int, int], list[tuple[float, float]]] = defaultdict(list)
    for event in events:
        if event["ph"] == "X":
            slices[event["pid"], event["tid"]].append((event["ts"], event["ts"] + event["dur"]))
    for number, begin in list(starts.items())[:200]:
        end = ends[number]
        assert begin["ts"] <= end["ts"] and end["bp"] == "e" and begin["name"] == end["name"]
        for mark in (begin, end):
            assert any(low - 1e-9 <= mark["ts"] <= high for low, high in slices[mark["pid"], mark["tid"]])


def test_it_says_what_the_trace_says() -> None:
    trace = trace_of(True)
    events = perfetto_events(trace)
    slices = [e for e in events if e["ph"] == "X" and e["cat"] in ("timer", "subscription", "service", "client")]
    assert len(slices) == len(trace.callbacks)
    by_id = {event["args"]["id"]: event for event in slices}
    for callback in trace.callbacks[:500]:
        event = by_id[callback.id]
        assert event["ts"] == pytest.approx(callback.start_ns / 1000, abs=1e-3)
        assert event["dur"] == pytest.approx((callback.end_ns - callback.start_ns) / 1000, abs=2e-3)
    marks = Counter(e["name"] for e in events if e["ph"] == "i")
    summary = measure(trace)
    late = sum(c.misses - _lost(summary, c) for c in summary.callbacks if c.deadline_ms is not None)
    assert marks["deadline missed"] == late > 50
    assert marks["message dropped"] == sum(len(q.drop_ns) for q in queue_timelines(trace)) > 100
    gpu = sum(e["dur"] for e in events if e["ph"] == "X" and e["cat"] == "gpu")
    assert gpu * 1e-6 / trace.seconds == pytest.approx(summary.utilisation["gpu"], abs=1e-6)


def _lost(summary: Any, callback: Any) -> int:
    found = [q for q in summary.queues if (q.node, q.topic) == (callback.node, callback.name)]
    return found[0].dropped if found and callback.kind == "subscription" else 0


def test_readings_become_counters() -> None:
    readings = [Reading(t, "twin", power_w=5.0 + t) for t in (0.5, 1.5)]
    events = perfetto_events(trace_of(False), readings=readings)
    assert [(e["ts"], e["args"]["value"]) for e in events if e["name"] == "power_w"] == [(5e5, 5.5), (1.5e6, 6.5)]


@pytest.mark.parametrize("name", ["run.json", "run.json.gz"])
def test_files_are_whole_and_the_same_each_time(tmp_path: Path, name: str) -> None:
    first, second = (write_perfetto(trace_of(False), tmp_path / folder / name) for folder in ("a", "b"))
    data = first.read_bytes()
    assert data == second.read_bytes() and len(list(tmp_path.glob("a/*"))) == 1
    document = json.loads(gzip.decompress(data) if name.endswith(".gz") else data)
    assert document["traceEvents"] == perfetto_events(trace_of(False))
    assert document["otherData"]["title"].startswith("world 0")


def test_misuse_is_explained(tmp_path: Path) -> None:
    wrong: Literal["node"] = "thread"  # type: ignore[assignment]
    with pytest.raises(InputError, match="'node' or 'executor'"):
        perfetto_events(trace_of(False), by=wrong)
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="written to"):
        write_perfetto(trace_of(False), tmp_path / "file" / "run.json")
