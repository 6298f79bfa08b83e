"""The same brain on several Jetsons: hardware must matter, in the right order, and the same on every run."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from robotbrain.errors import InputError
from robotbrain.jetson.catalogue import load_module
from robotbrain.pipeline import devices
from robotbrain.pipeline.brain import drive
from robotbrain.pipeline.devices import DeviceSummary, compare_devices, detector_deployment, summarise

SMALL, MIDDLE, LARGE = "nano-4gb:5W", "xavier-nx:15W", "agx-orin-64gb:MAXN"
SEEDS = (8000, 8001)


@pytest.fixture(scope="module")
def summaries() -> dict[str, DeviceSummary]:
    # A quick brain arrives in these worlds in under 30 s: half a minute more shows which ones do not.
    found = compare_devices(SEEDS, (SMALL, MIDDLE, LARGE), time_limit=60.0)
    return {f"{s.profile}:{s.power_mode.removeprefix('MODE_').removesuffix('_6CORE')}": s for s in found}


def test_success_latency_and_rate_are_ordered_as_the_devices_are(summaries: dict[str, DeviceSummary]) -> None:
    small, middle, large = (summaries[name] for name in (SMALL, MIDDLE, LARGE))
    assert small.successes <= middle.successes <= large.successes
    assert small.e2e_p99_ms > 1.5 * middle.e2e_p99_ms > 1.5 * large.e2e_p99_ms
    assert small.control_hz < middle.control_hz < large.control_hz


def test_the_smallest_fails_visibly_and_the_largest_does_not(summaries: dict[str, DeviceSummary]) -> None:
    assert summaries[SMALL].successes < len(SEEDS) == summaries[LARGE].successes
    assert summaries[SMALL].control_hz < 5 and summaries[LARGE].control_hz > 19
    assert len(summaries[SMALL].reasons) == len(SEEDS) - summaries[SMALL].successes


def test_the_failure_comes_from_one_thread_for_everything() -> None:
    apart = drive(SEEDS[0], profile=SMALL, deployment=detector_deployment(one_thread=False), time_limit=60.0)
    assert apart.success and apart.control_hz > 19


def test_power_is_that_of_a_module_at_work(summaries: dict[str, DeviceSummary]) -> None:
    for summary in summaries.values():
        module = load_module(summary.profile)
        assert 0.3 * module.idle_power_w < summary.power_w < module.max_power_w
        driven = sum(run.path_length for run in summary.results)
        lasted = sum(run.seconds for run in summary.results)
        # Energy is power times time, run by run; so its mean lies between the extremes of the runs.
        assert summary.energy_j_per_m == pytest.approx(summary.power_w * lasted / driven, rel=0.2)


def test_a_run_is_the_same_every_time(summaries: dict[str, DeviceSummary]) -> None:
    again = drive(SEEDS[0], profile=MIDDLE, deployment=detector_deployment(), time_limit=60.0)
    first = summaries[MIDDLE].results[0]
    assert again.log_sha256 == first.log_sha256
    assert np.array_equal(again.e2e_ms, first.e2e_ms)


def test_a_busier_module_draws_more(summaries: dict[str, DeviceSummary]) -> None:
    run = summaries[MIDDLE].results[0]
    network = detector_deployment().network
    assert network is not None
    watts = [
        devices.run_power_w(dataclasses.replace(run, busy={"cpu": cpu, "gpu": gpu}), Path(network), (640, 480))
        for cpu, gpu in ((0.0, 0.0), (0.0, 0.5), (0.0, 1.0), (1.0, 1.0))
    ]
    assert watts == sorted(watts) and len(set(watts)) == 4


def test_the_summary_is_of_the_precision_that_was_driven_in(summaries: dict[str, DeviceSummary]) -> None:
    results = summaries[LARGE].results
    full, half = (
        summarise(results, dataclasses.replace(detector_deployment(), precision=precision))
        for precision in ("fp32", "fp16")
    )
    assert full.network_ms > 1.2 * half.network_ms == pytest.approx(1.2 * summaries[LARGE].network_ms)


def test_runs_of_different_devices_are_not_averaged(summaries: dict[str, DeviceSummary]) -> None:
    mixed = [summaries[SMALL].results[0], summaries[LARGE].results[0]]
    with pytest.raises(InputError, match="one Jetson"):
        summarise(mixed)
    with pytest.raises(InputError, match="one Jetson"):
        summarise([])


def test_the_figure_shows_every_device_and_says_so_in_words(summaries: dict[str, DeviceSummary]) -> None:
    figure, alt = devices.plot_devices(list(summaries.values()))
    labels = [text.get_text() for text in figure.axes[0].get_yticklabels()]
    assert len(labels) == len(summaries)
    for summary in summaries.values():
        assert f"{summary.name} in {summary.power_mode}" in alt
    lines = devices.table(list(summaries.values())).splitlines()
    assert len(lines) == 1 + len(summaries) and len({line.count("/") for line in lines[1:]}) == 1
    assert all(math.isfinite(s.e2e_p50_ms) for s in summaries.values())
