"""Memory and heat: verdicts, closed forms, and what a governor does."""

from __future__ import annotations

import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robotbrain.errors import InputError
from robotbrain.jetson.catalogue import list_modules, load_module
from robotbrain.jetson.kernels import Kernel, KernelGraph
from robotbrain.jetson.paths import find_part
from robotbrain.jetson.twin.data import load_kernel_lists
from robotbrain.jetson.twin.runtime import (
    ThermalModel,
    memory_use,
    runtime_figures,
    simulate_heat,
    thermal_model,
)

MODEL = ThermalModel(25.0, 4.0, 120.0, 97.5, 102.5, 3.0)


def network(weights: int, activations: int = 10**6) -> KernelGraph:
    kernel = Kernel("conv", weights, activations // 2, activations // 2, weights)
    return KernelGraph("n", (kernel,), weights, 4 * weights, activations)


# -- figures


def test_every_figure_is_labelled_and_says_why() -> None:
    for name, figure in runtime_figures().items():
        assert figure.provenance == "assumed" and figure.note, name


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("value = 1100", "value = -1"),
        ("context_mb = {", "contxt_mb = {"),
        ('unit = "ratio"', 'unit = "percent"'),
        ("[thermal]", "[heat]"),
        ('source = "rule", note = "a room"', 'note = "a room"'),
        ("value = 25,", 'value = "warm",'),
        ("[memory]", "[memory"),
    ],
)
def test_a_damaged_table_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, old: str, new: str) -> None:
    text = find_part("runtime.toml").read_text(encoding="utf-8")
    assert old in text
    (tmp_path / "runtime.toml").write_text(text.replace(old, new), encoding="utf-8")
    monkeypatch.setenv("ROBOTBRAIN_PROFILES", str(tmp_path))
    with pytest.raises(InputError, match=r"runtime\.toml"):
        runtime_figures()


def test_a_figure_of_ones_own_is_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copy(find_part("runtime.toml"), tmp_path)
    path = tmp_path / "runtime.toml"
    path.write_text(path.read_text(encoding="utf-8").replace("value = 25,", "value = 40,"), encoding="utf-8")
    before = thermal_model(load_module("nano-4gb")).ambient_c
    monkeypatch.setenv("ROBOTBRAIN_PROFILES", str(tmp_path))
    assert (before, thermal_model(load_module("nano-4gb")).ambient_c) == (25, 40)


# -- memory


@pytest.mark.parametrize("slug", list_modules())
def test_memory_grows_with_weights_activations_and_bits(slug: str) -> None:
    module = load_module(slug)
    for precision in ("fp32", "fp16", "int8"):
        small = memory_use(network(10**7), module, precision)
        assert small.total_mb < memory_use(network(2 * 10**7), module, precision).total_mb
        assert small.total_mb < memory_use(network(10**7, 10**7), module, precision).total_mb
        assert small.total_mb < small.building_mb
        assert small.total_mb == pytest.approx(small.weights_mb + small.activations_mb + small.context_mb)
    totals = [memory_use(network(10**8), module, p).total_mb for p in ("int8", "fp16", "fp32")]
    assert totals == sorted(totals) and len(set(totals)) == 3


def test_weights_take_their_bytes() -> None:
    module = load_module("agx-orin-64gb")
    for precision, size in (("fp32", 4), ("fp16", 2), ("int8", 1)):
        assert memory_use(network(25_000_000), module, precision).weights_mb == pytest.approx(25 * size)


def test_the_verdict_turns_where_memory_ends() -> None:
    module = load_module("nano-4gb")
    empty = memory_use(network(0, 0), module, "fp16")
    assert 0 < empty.available_mb < module.memory_gb * 2**30 / 1e6
    room = int((empty.available_mb - empty.total_mb) * 1e6 / 2)
    assert memory_use(network(room - 10, 0), module, "fp16").fits
    assert not memory_use(network(room + 10, 0), module, "fp16").fits
    # What runs need not be buildable on the module itself.
    assert not memory_use(network(room - 10, 0), module, "fp16").builds


def test_ordinary_networks_fit_and_a_language_model_does_not() -> None:
    nano = load_module("nano-4gb")
    for graph in load_kernel_lists().values():
        for precision in ("fp32", "fp16"):
            assert memory_use(graph, nano, precision).fits, graph.name
    llama = network(7 * 10**9, 10**7)
    verdicts = {slug: memory_use(llama, load_module(slug), "fp16").fits for slug in list_modules()}
    assert not verdicts["nano-4gb"] and not verdicts["orin-nano-8gb"]
    assert verdicts["agx-orin-64gb"] and verdicts["t5000"]
    sizes = [(load_module(slug).memory_gb, fits) for slug, fits in verdicts.items()]
    assert max(gb for gb, fits in sizes if not fits) < min(gb for gb, fits in sizes if fits)


# -- heat


@given(st.floats(-40, 120), st.floats(0, 60), st.floats(0, 2000), st.floats(0, 2000))
def test_constant_power_follows_the_exponential(start: float, power: float, first: float, second: float) -> None:
    goal = 25 + 4 * power
    assert MODEL.steady_c(power) == pytest.approx(goal)
    after = MODEL.after(start, power, first)
    assert after == pytest.approx(goal + (start - goal) * math.exp(-first / 120))
    # Two steps are one: the step's length does not matter.
    assert MODEL.after(after, power, second) == pytest.approx(MODEL.after(start, power, first + second), abs=1e-9)


def test_changing_power_follows_a_fine_integration() -> None:
    def power(now: float, clock: float = 1.0) -> float:
        return 6 + 4 * math.sin(2 * math.pi * now / 300)

    trace = simulate_heat(MODEL, power, 900, step_s=0.5)
    temperature, dt, reference = 25.0, 0.002, []
    for step in range(round(900 / dt)):
        if step % round(100 / dt) == 0:
            reference.append(temperature)
        temperature += dt * (25 + 4 * power(step * dt) - temperature) / 120
    sampled = trace.temperature_c[:: round(100 / 0.5)][: len(reference)]
    np.testing.assert_allclose(sampled, reference, atol=0.1)
    assert trace.throttled_s == 0 and not trace.shut_down
    assert (trace.clock == 1.0).all()


def test_throttling_holds_the_temperature_at_the_trip_point() -> None:
    trace = simulate_heat(MODEL, lambda now, clock: 25 * clock, 3600)
    late = trace.temperature_c[len(trace.temperature_c) // 2 :]
    assert not trace.shut_down
    assert MODEL.throttle_c - MODEL.hysteresis_c - 1 < late.min() and late.max() < MODEL.throttle_c + 1
    # In the mean the clock is what the trip point allows: (97.5 - 25) / 4 = 18 W of 25 W.
    mean = trace.clock[len(trace.clock) // 2 :].mean()
    assert mean == pytest.approx(72.5 / 4 / 25, abs=0.05)
    assert trace.throttled_s == np.count_nonzero(trace.clock[:-1] < 1)
    assert 0.7 * 3600 < trace.throttled_s < 3600


def test_clocks_stay_up_below_the_trip_point() -> None:
    trace = simulate_heat(MODEL, lambda now, clock: 18 * clock, 7200)
    assert MODEL.steady_c(18) < MODEL.throttle_c
    assert (trace.clock == 1).all() and trace.throttled_s == 0
    assert trace.temperature_c[-1] == pytest.approx(MODEL.steady_c(18), abs=0.01)
    assert (np.diff(trace.temperature_c) >= 0).all()


def test_power_that_ignores_the_clock_shuts_the_module_down() -> None:
    trace = simulate_heat(MODEL, lambda now, clock: 40.0, 3600)
    assert trace.shut_down
    assert trace.temperature_c[-1] >= MODEL.shutdown_c > trace.temperature_c[-2]
    assert trace.time_s[-1] == pytest.approx(-120 * math.log((185 - 102.5) / 160), abs=1)
    assert trace.clock.min() >= 0.2


def test_the_clock_recovers_once_it_is_cool() -> None:
    trace = simulate_heat(MODEL, lambda now, clock: 30 * clock if now < 600 else 1.0, 2400)
    assert trace.throttled_s > 0
    assert trace.clock[-1] == 1.0 and trace.temperature_c[-1] < 50
    steps = np.diff(trace.clock)
    assert set(np.round(steps, 6)) <= {-0.1, 0.0, 0.1}


def test_a_hot_start_throttles_at_once() -> None:
    trace = simulate_heat(MODEL, lambda now, clock: 10 * clock, 60, start_c=98.0)
    assert trace.clock[0] == 0.9
    assert trace.power_w[0] == pytest.approx(9.0)


@pytest.mark.parametrize("slug", list_modules())
def test_a_fan_cools_better_and_warm_air_worse(slug: str) -> None:
    module = load_module(slug)
    fan, passive, desert = thermal_model(module), thermal_model(module, "passive"), thermal_model(module, "fan", 45)
    watts = module.max_power_w
    assert fan.steady_c(watts) < passive.steady_c(watts)
    assert desert.steady_c(watts) == pytest.approx(fan.steady_c(watts) + 20)
    # The maker's heat sink keeps the module out of throttling at its highest power; without the fan it does not, if
    # that is the highest power of this hardware (a Super variant is the same hardware in faster modes).
    assert fan.steady_c(watts) < fan.throttle_c
    if f"{slug}-super" not in list_modules():
        assert fan.throttle_c < passive.steady_c(watts)
    assert fan.throttle_c < fan.shutdown_c


@pytest.mark.parametrize(
    ("cooling", "ambient"), [("water", None), (None, None), ("fan", 81), ("fan", -41), ("fan", math.nan)]
)
def test_unknown_cooling_and_air_are_refused(cooling: Any, ambient: Any) -> None:
    with pytest.raises(InputError, match=r"cooling|ambient"):
        thermal_model(load_module("nano-4gb"), cooling, ambient)


@pytest.mark.parametrize(
    ("seconds", "step"), [(0, 1), (-1, 1), (10, 0), (10, -1), (10, 11), (math.inf, 1), (math.nan, 1), (10, math.nan)]
)
def test_times_that_are_none_are_refused(seconds: float, step: float) -> None:
    with pytest.raises(InputError, match="seconds"):
        simulate_heat(MODEL, lambda now, clock: 1.0, seconds, step_s=step)


@pytest.mark.parametrize("watts", [math.nan, math.inf, -1.0])
def test_a_power_that_is_none_is_refused(watts: float) -> None:
    with pytest.raises(InputError, match="power_w"):
        simulate_heat(MODEL, lambda now, clock: watts, 10)


def test_a_start_that_is_no_temperature_is_refused() -> None:
    with pytest.raises(InputError, match="start_c"):
        simulate_heat(MODEL, lambda now, clock: 1.0, 10, start_c=math.nan)
