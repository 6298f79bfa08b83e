"""The dashboard shows a running monitor and replays a trace, in a notebook and without one."""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest

from robotbrain.errors import InputError
from robotbrain.figures import alt_text
from robotbrain.monitoring import dashboard as module
from robotbrain.monitoring.commands import monitor_arguments, monitor_main
from robotbrain.monitoring.dashboard import Dashboard, plot_dashboard, snapshot_text, snapshots_of
from robotbrain.monitoring.metrics import measure
from robotbrain.monitoring.monitor import Monitor
from robotbrain.monitoring.snapshots import Snapshot
from tests.monitoring.sample_runs import trace_of, watched_run


def test_a_replay_shows_what_the_monitor_saw() -> None:
    _, monitor = watched_run(True)
    live = list(monitor.snapshots)
    replayed = snapshots_of(trace_of(True), every_s=1.0, window_s=2.0)
    assert [s.time_s for s in replayed] == [s.time_s for s in live]
    for found, true in zip(replayed, live, strict=True):
        assert found.topics == pytest.approx(true.topics)
        assert found.callbacks.keys() == true.callbacks.keys()
        for label, glance in true.callbacks.items():
            assert found.callbacks[label].p99_ms == pytest.approx(glance.p99_ms, rel=0.05, nan_ok=True), label
        assert found.alarms == true.alarms
        assert found.chains.keys() == true.chains.keys() and len(found.chains) == 2
        for chain, age in true.chains.items():
            assert found.chains[chain].p50_ms == pytest.approx(age.p50_ms, rel=0.05), chain
        assert found.utilisation == pytest.approx(true.utilisation, abs=0.05)
    assert replayed[-1].queues["/estimator /imu"] >= 3


def test_the_picture_says_what_it_shows() -> None:
    found = list(watched_run(True)[1].snapshots)
    figure = plot_dashboard(found)
    words = alt_text(figure)
    assert "/camera/image > /perception/points > /cmd_vel" in words and "Alarms: " in words
    assert len(figure.axes) == 4
    empty = plot_dashboard([])
    assert "Nothing to show yet" in alt_text(empty)
    resources = Snapshot(3.0, resources={"cpu_percent": 40.0, "temperature_c": 51.0, "power_w": 7.0})
    drawn = plot_dashboard([resources])
    assert "processors 40 %" in alt_text(drawn) and "51 °C, 7 W" in drawn.axes[3].get_title(loc="left")


def test_text_for_a_terminal() -> None:
    found = snapshot_text(watched_run(True)[1].snapshots[-1])
    assert "ALARM" in found and "busy: cpu" in found and "nan" not in found
    assert len(found.splitlines()) < 15


class FakeWidget:
    made: ClassVar[list[FakeWidget]] = []

    def __init__(self, value: str) -> None:
        self.values = [value]
        FakeWidget.made.append(self)

    @property
    def value(self) -> str:
        return self.values[-1]

    @value.setter
    def value(self, text: str) -> None:
        self.values.append(text)


@pytest.fixture
def notebook(monkeypatch: pytest.MonkeyPatch) -> None:
    FakeWidget.made = []
    monkeypatch.setattr(module, "in_notebook", lambda: True)
    monkeypatch.setitem(sys.modules, "ipywidgets", SimpleNamespace(HTML=FakeWidget))
    monkeypatch.setattr("IPython.display.display", lambda widget: None)


@pytest.mark.usefixtures("notebook")
def test_in_a_notebook_the_picture_changes_in_place() -> None:
    monitor = Monitor()
    with Dashboard(monitor, period_s=0.05) as dashboard:
        monitor.start()
        with monitor.span("inference"):
            pass
        widget = dashboard.show()
        ends = time.monotonic() + 20
        while len(widget.values) < 4 and time.monotonic() < ends:
            time.sleep(0.02)
    monitor.close()
    assert len(FakeWidget.made) == 1 and len(widget.values) >= 4
    assert 'alt="Dashboard' in widget.value and "data:image/png" in widget.value
    count = len(widget.values)
    time.sleep(0.15)
    assert len(widget.values) == count and dashboard.problem == ""


@pytest.mark.usefixtures("notebook")
def test_a_picture_that_fails_ends_neither_the_dashboard_nor_the_brain(monkeypatch: pytest.MonkeyPatch) -> None:
    dashboard = Dashboard(watched_run(False)[1], period_s=0.02)
    markup = dashboard.markup

    def broken(snapshots: Any) -> str:
        if snapshots and not dashboard.problem:
            raise ZeroDivisionError("planted")
        return markup(snapshots)

    monkeypatch.setattr(dashboard, "markup", broken)
    widget = dashboard.show()
    ends = time.monotonic() + 20
    while len(widget.values) < 2 and time.monotonic() < ends:
        time.sleep(0.02)
    dashboard.stop()
    assert "planted" in dashboard.problem and "planted" in widget.value


def test_scripts_get_text_and_a_replay_keeps_its_pace() -> None:
    lines: list[str] = []
    began = time.monotonic()
    assert Dashboard().replay(trace_of(False), speed=12.0, write=lines.append) is None
    assert time.monotonic() - began >= 5.3 / 12.0
    assert 1 <= len(lines) <= 11 and lines[-1].startswith("t = ")
    Dashboard(watched_run(False)[1], period_s=0.01).run(0.05, write=lines.append)
    assert "/camera/image > /perception/points" in lines[-1]
    assert "nothing is watched" in Dashboard().text()


@pytest.mark.parametrize("arguments", [{"period_s": 0}, {"span_s": -1}])
def test_misuse_is_explained(arguments: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        Dashboard(**arguments)
    with pytest.raises(InputError, match="speed"):
        Dashboard().replay(trace_of(False), speed=0)


# ---- the command ----


def command(*words: str) -> int:
    parser = argparse.ArgumentParser()
    monitor_arguments(parser)
    return monitor_main(parser.parse_args(words))


def test_the_command_drives_and_writes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = {name: tmp_path / f"run.{name}" for name in ("html", "json", "trace.json.gz")}
    words = ["--report", str(files["html"]), "--json", str(files["json"]), "--perfetto", str(files["trace.json.gz"])]
    assert command("drive", "--world", "2", "--seconds", "1.5", "--profile", "xavier-nx", *words) == 0
    said = capsys.readouterr().out
    assert "end to end, sensor to command" in said and "ui.perfetto.dev" in said
    assert all(file.stat().st_size > 1000 for file in files.values())
    assert json.loads(files["json"].read_text())["title"].startswith("world 2 on xavier-nx")


def test_the_command_says_what_the_machine_does_not_tell(capsys: pytest.CaptureFixture[str]) -> None:
    assert command("resources", "--period", "0.15") == 0
    said = capsys.readouterr().out
    assert "cpu_percent" in said and "power_w" in said and "%  (psutil)" in said


def test_the_package_gives_its_names_lazily() -> None:
    import robotbrain.monitoring as package

    for name in package.__all__:
        assert getattr(package, name) is not None
    assert set(dir(package)) == set(package.__all__)
    assert package.measure is measure
    with pytest.raises(AttributeError):
        package.nothing  # noqa: B018
