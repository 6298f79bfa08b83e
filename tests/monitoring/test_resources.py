"""Readings: what is there is right, what is not says why, and a source may do what it likes."""

from __future__ import annotations

import json
import math
import os
import threading
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import psutil
import pytest

from robotbrain.errors import InputError, MissingDependencyError, RobotBrainError
from robotbrain.monitoring.resources import UNITS, Combined, Missing, Reading, Sampler, local_source, merge
from robotbrain.monitoring.resources.host import PsutilSource
from robotbrain.monitoring.resources.jetson import JtopSource, TegrastatsSource
from robotbrain.monitoring.resources.nvml import NvmlError, NvmlSource
from robotbrain.monitoring.resources.reading import NOT_READ, number_or_missing
from robotbrain.monitoring.resources.twin import TwinSource
from robotbrain.ros import DeviceResources, SimContext, charge

LINE = (
    "05-17-2026 10:00:32 RAM 3011/7620MB (lfb 4x4MB) SWAP 0/3810MB (cached 0MB) CPU [12%@1510,8%@1510,off,off] "
    "EMC_FREQ 1%@2133 GR3D_FREQ 37%@[624] cpu@47.5C gpu@48.25C tj@48.5C VDD_IN 5299mW/5299mW VDD_SOC 1500mW/1500mW"
)


def wait_until(condition: Any, seconds: float = 5.0) -> None:
    ends = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < ends, "waited in vain"
        time.sleep(0.01)


# ---- readings ----


def test_what_is_missing_is_never_nought() -> None:
    reading = Reading(1.0, "test", cpu_percent=0.0)
    assert reading.known() == {"cpu_percent": 0.0}
    assert set(reading.missing()) == set(UNITS) - {"cpu_percent"}
    assert not reading.power_w and str(reading.power_w).startswith("missing")
    plain = json.loads(json.dumps(reading.to_dict(), allow_nan=False))
    assert plain["power_w"] == {"missing": NOT_READ.reason} and plain["cpu_percent"] == 0.0
    assert "power_w" in str(reading) and "\npower_w                0" not in str(reading)


def test_merging_takes_the_first_that_knows_and_says_who() -> None:
    first = Reading(1.0, "a", gpu_percent=Missing("no driver"), power_w=5.0, temperatures_c={"x": 40.0, "y": 50.0})
    second = Reading(2.0, "b", gpu_percent=Missing("no fan"), power_w=7.0, cpu_percent=30.0)
    both = merge([first, second])
    assert (both.power_w, both.cpu_percent, both.time_s, both.source) == (5.0, 30.0, 2.0, "a + b")
    assert (both.source_of("power_w"), both.source_of("cpu_percent")) == ("a", "b")
    assert both.gpu_percent == Missing("a: no driver; b: no fan")
    assert both.known()["temperature_c"] == 50.0
    assert isinstance(merge([]).cpu_percent, Missing)
    assert merge([both, first]).source_of("cpu_percent") == "b"


@pytest.mark.parametrize("value", [math.nan, math.inf, "3", None, True])
def test_only_finite_numbers_count(value: object) -> None:
    assert isinstance(number_or_missing(lambda: value, "it"), Missing)


# ---- this machine ----


def test_psutil_agrees_with_the_counters() -> None:
    source = PsutilSource()
    before = psutil.cpu_times()
    ends = time.monotonic() + 0.15
    while time.monotonic() < ends:
        sum(range(1000))
    reading = source.read()
    after = psutil.cpu_times()
    idle = after.idle - before.idle + getattr(after, "iowait", 0) - getattr(before, "iowait", 0)
    total = sum(after) - sum(before)
    assert isinstance(reading.cpu_percent, float) and isinstance(reading.cpu_per_core_percent, tuple)
    assert reading.cpu_percent == pytest.approx(100 * (1 - idle / total), abs=15)
    assert len(reading.cpu_per_core_percent) == psutil.cpu_count()
    assert reading.cpu_percent >= 100 / len(reading.cpu_per_core_percent) * 0.5  # this very loop
    assert reading.process_rss_mb == pytest.approx(psutil.Process(os.getpid()).memory_info().rss / 1e6, rel=0.2)
    assert reading.memory_total_mb == pytest.approx(psutil.virtual_memory().total / 1e6)


def test_a_first_look_is_not_an_idle_processor() -> None:
    reading = PsutilSource().read()
    assert isinstance(reading.cpu_percent, Missing) and "two looks" in reading.cpu_percent.reason
    assert "cpu_percent" not in reading.known()


def test_sensors_that_are_not_there_say_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(psutil, "sensors_temperatures", dict, raising=False)
    monkeypatch.setattr(psutil, "cpu_freq", lambda: None)
    reading = PsutilSource().read()
    assert isinstance(reading.temperatures_c, Missing) and isinstance(reading.cpu_mhz, Missing)
    monkeypatch.delattr(psutil, "sensors_temperatures")
    missing = PsutilSource().read().temperatures_c
    assert isinstance(missing, Missing) and "reads no temperatures" in missing.reason
    hot = {"chip": [SimpleNamespace(label="die", current=61.5), SimpleNamespace(label="", current=None)]}
    monkeypatch.setattr(psutil, "sensors_temperatures", lambda: hot, raising=False)
    assert PsutilSource().read().temperatures_c == {"chip die": 61.5}


def test_local_source_reads_what_there_is() -> None:
    with_all = local_source()
    reading = with_all.read()
    assert isinstance(reading.memory_total_mb, float) and with_all.sources[-1].name == "psutil"
    if isinstance(reading.gpu_percent, Missing):
        assert "nvml" in reading.gpu_percent.reason
    with_all.close()


def test_one_source_that_fails_does_not_take_the_others_along() -> None:
    broken = SimpleNamespace(name="broken", read=lambda: 1 / 0, close=lambda: None)
    reading = Combined([broken, PsutilSource()], {"other": "not here"}).read()
    assert isinstance(reading.memory_total_mb, float)
    assert isinstance(reading.gpu_percent, Missing)
    assert "broken: failed: ZeroDivisionError" in reading.gpu_percent.reason
    assert "other: not here" in reading.gpu_percent.reason


# ---- NVML and Jetsons ----


class FakeNvml:
    """NVML of a GPU that knows most things."""

    NVML_TEMPERATURE_GPU, NVML_CLOCK_SM = 0, 1

    def __init__(self, reasons: int = 0) -> None:
        self.reasons, self.open = reasons, False

    def nvmlInit(self) -> None:  # noqa: N802
        self.open = True

    def nvmlShutdown(self) -> None:  # noqa: N802
        self.open = False

    def nvmlDeviceGetHandleByIndex(self, index: int) -> int:  # noqa: N802
        if index:
            raise RuntimeError("Invalid Argument")
        return 7

    def nvmlDeviceGetUtilizationRates(self, handle: int) -> Any:  # noqa: N802
        return SimpleNamespace(gpu=42)

    def nvmlDeviceGetMemoryInfo(self, handle: int) -> Any:  # noqa: N802
        return SimpleNamespace(used=2_000_000_000, total=8_000_000_000)

    def nvmlDeviceGetTemperature(self, handle: int, kind: int) -> int:  # noqa: N802
        return 55

    def nvmlDeviceGetPowerUsage(self, handle: int) -> int:  # noqa: N802
        raise RuntimeError("Not Supported")

    def nvmlDeviceGetClockInfo(self, handle: int, kind: int) -> int:  # noqa: N802
        return 1410

    def nvmlDeviceGetCurrentClocksThrottleReasons(self, handle: int) -> int:  # noqa: N802
        return self.reasons


@pytest.mark.parametrize(("reasons", "throttled"), [(0, False), (0x1, False), (0x40, True), (0x4, True)])
def test_nvml_is_read_and_what_it_refuses_is_missing(reasons: int, throttled: bool) -> None:
    library = FakeNvml(reasons)
    source = NvmlSource(library=library)
    reading = source.read()
    assert (reading.gpu_percent, reading.gpu_memory_used_mb, reading.gpu_mhz) == (42, 2000, 1410)
    assert reading.temperatures_c == {"GPU": 55} and reading.throttled is throttled
    assert reading.power_w == Missing("GPU power: RuntimeError: Not Supported")
    source.close()
    assert not library.open
    with pytest.raises(NvmlError, match="GPU 1"):
        NvmlSource(1, library)


def test_without_its_package_nvml_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pynvml", None)
    with pytest.raises(MissingDependencyError, match="pip install nvidia-ml-py"):
        NvmlSource()


def test_tegrastats_lines_become_readings() -> None:
    source = TegrastatsSource(lines=iter(["garbage", LINE]))
    reading = source.read()
    assert reading.gpu_percent == pytest.approx(37) and reading.gpu_mhz == 624 and reading.cpu_mhz == 1510
    assert reading.memory_used_mb == pytest.approx(3011 * 2**20 / 1e6)
    assert reading.power_w == pytest.approx(5.299)
    assert reading.temperatures_c == {"cpu": 47.5, "gpu": 48.25, "tj": 48.5}
    assert isinstance(reading.gpu_memory_used_mb, Missing) and isinstance(reading.cpu_percent, Missing)


def test_tegrastats_that_says_nothing_or_is_not_there() -> None:
    with pytest.raises(RobotBrainError, match="ended"):
        TegrastatsSource(lines=iter(["nothing of use"])).read()
    with pytest.raises(MissingDependencyError, match="JetPack"):
        TegrastatsSource(command=["no-such-program-anywhere"])


def test_jtop_is_read_through_its_client() -> None:
    client = SimpleNamespace(
        power={"rail": {"VDD_IN": {"power": 5200}}, "tot": {}},
        temperature={"gpu": {"temp": 44.0, "online": True}},
        gpu={"ga10b": {"status": {"load": 20}, "freq": {"cur": 624000}}},
        memory={"RAM": {"used": 1024 * 1000, "tot": 1024 * 8000}, "EMC": {"cur": 2133000}},
        cpu={"cpu": []},
        close=lambda: None,
    )
    reading = JtopSource(client).read()
    assert (reading.gpu_percent, reading.power_w) == (20, 5.2) and reading.gpu_mhz == pytest.approx(624)
    assert isinstance(reading.cpu_mhz, Missing)


def busy_twin(gpu_share: float, seconds: float, **place: Any) -> tuple[TwinSource, list[Reading]]:
    from rclpy.node import Node

    context = SimContext(resources=DeviceResources(cpu_cores=6, gpu=1))
    twin = TwinSource(context, "orin-nano-8gb:15W", **place)
    readings = []
    with context.as_default():
        node = Node("load")
        if gpu_share:
            node.create_timer(0.1, lambda: charge(round(gpu_share * 1e8), "gpu"))
        for _ in range(round(seconds / 5)):
            context.run_for(5.0)
            readings.append(twin.read())
    return twin, readings


def test_the_twin_heats_up_to_its_steady_temperature() -> None:
    _, idle = busy_twin(0.0, 50)
    _, busy = busy_twin(0.8, 4000)
    assert all(reading.source == "twin" for reading in busy)
    assert busy[-1].gpu_percent == pytest.approx(80, abs=1) and idle[-1].gpu_percent == 0
    assert isinstance(idle[-1].temperatures_c, dict) and isinstance(idle[0].temperatures_c, dict)
    assert idle[-1].temperatures_c["predicted"] == pytest.approx(idle[0].temperatures_c["predicted"])
    heat = [reading.temperatures_c["predicted"] for reading in busy if isinstance(reading.temperatures_c, dict)]
    assert np.all(np.diff(heat[:50]) > 0)
    from robotbrain.jetson.catalogue import load_module
    from robotbrain.jetson.twin.runtime import thermal_model

    power = busy[-1].power_w
    assert isinstance(power, float) and isinstance(idle[-1].power_w, float) and power > idle[-1].power_w
    assert heat[-1] == pytest.approx(thermal_model(load_module("orin-nano-8gb")).steady_c(power), abs=0.1)
    assert busy[-1].throttled is False and isinstance(busy[-1].memory_used_mb, Missing)


def test_the_twin_throttles_in_a_hot_place() -> None:
    _, readings = busy_twin(1.0, 3000, ambient_c=75, cooling="passive")
    assert readings[0].throttled is False and readings[-1].throttled is True


def test_the_twin_needs_a_device() -> None:
    with pytest.raises(InputError, match="without a device"):
        TwinSource(SimContext(), "orin-nano-8gb")


# ---- the sampler ----


class Scripted:
    """A source that does what it is told."""

    name = "scripted"

    def __init__(self, *script: Any) -> None:
        self.script, self.reads, self.closed = list(script), 0, False

    def read(self) -> Reading:
        self.reads += 1
        step = self.script.pop(0) if self.script else None
        if isinstance(step, BaseException):
            raise step
        if isinstance(step, threading.Event):
            step.wait()
        return Reading(time.monotonic(), self.name, cpu_percent=float(self.reads))

    def close(self) -> None:
        self.closed = True


def test_a_sampler_keeps_the_last_readings_and_stops() -> None:
    source = Scripted()
    with Sampler(source, period_s=0.01, keep=5) as sampler:
        wait_until(lambda: source.reads >= 8)
        assert len(sampler.history) == 5
        assert (sampler.alive, sampler.stale) == (True, "")
        latest = sampler.latest
        assert latest is not None and isinstance(latest.cpu_percent, float)
    assert source.closed and not sampler.alive
    reads = source.reads
    time.sleep(0.05)
    assert source.reads == reads


def test_a_source_that_raises_is_asked_again() -> None:
    source = Scripted(OSError("no sensor"), ValueError("odd"))
    with Sampler(source, period_s=0.01) as sampler:
        wait_until(lambda: sampler.history)
        assert sampler.errors == 2 and sampler.last_error == "ValueError: odd"


@pytest.mark.parametrize("how", ["hangs", "dies"])
def test_a_source_that_hangs_or_dies_is_stale(how: str) -> None:
    release = threading.Event()
    source = Scripted(None, release if how == "hangs" else SystemExit("gone"))
    sampler = Sampler(source, period_s=0.02).start()
    wait_until(lambda: sampler.stale)
    latest = sampler.latest
    assert latest is not None and set(latest.missing()) == set(UNITS)
    assert isinstance(latest.cpu_percent, Missing) and "scripted" in latest.cpu_percent.reason
    assert latest.known() == {}
    if how == "hangs":
        assert "has not answered" in sampler.stale
        assert sampler.stop(timeout_s=0.05) is False
        release.set()
    else:
        assert "SystemExit: gone" in sampler.stale and not sampler.alive
        assert sampler.stop() is True
    assert len(sampler.history) >= 1


def test_a_slow_source_does_not_make_the_sampler_drift(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a clock of the test's own: readings of 7 ms on a grid of 10 ms, and one of 25 ms, stay on the grid."""
    from robotbrain.monitoring.resources import sampler as module

    now = [100.0]
    starts: list[float] = []

    class Slow(Scripted):
        def read(self) -> Reading:
            starts.append(round(now[0] - 100.0, 6))
            now[0] += 0.025 if len(starts) == 3 else 0.007
            return super().read()

    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: now[0]))
    sampler = Sampler(Slow(), period_s=0.01)

    class Stop(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            now[0] += timeout or 0.0
            return len(starts) >= 6

    sampler._stop = Stop()
    sampler._run()
    assert starts == [0.0, 0.01, 0.02, 0.05, 0.06, 0.07] and sampler.skipped == 2


@pytest.mark.parametrize("arguments", [{"period_s": 0}, {"period_s": math.inf}, {"keep": 0}])
def test_samplers_are_checked(arguments: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        Sampler(Scripted(), **arguments)
