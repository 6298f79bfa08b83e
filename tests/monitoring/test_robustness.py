"""The robustness test: intervals and p-values against scipy, pairing, resuming, and nodes that do not survive."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest

from robotbrain.errors import InputError
from robotbrain.monitoring.faults import Blackout, Fault, LateFrames, Noise
from robotbrain.monitoring.robustness import robustness, standard_faults
from robotbrain.monitoring.robustness_results import NOTHING, mcnemar, wilson
from robotbrain.ros import SimContext

FAULTS: dict[str, dict[str, list[Fault]]] = {
    "noise": {"little": [Noise("/scan", 0.1)], "much": [Noise("/scan", 1.0)]},
    "dark": {"": [Blackout("/camera/image")]},
}


class Runner:
    """Stands in for ``drive``: odd worlds fail with much noise, all fail in the dark."""

    def __init__(self) -> None:
        self.calls: list[tuple[int, int]] = []

    def __call__(self, seed: int, attach: Sequence[Any]) -> Any:
        self.calls.append((seed, len(attach)))
        context = SimContext()
        for install in attach:
            install(context)
        dark = any(topic == "/camera/image" for topic, _ in context.filters)
        faults = [install.__self__ for install in attach]
        loud = any(isinstance(fault, Noise) and fault.sigma > 0.5 for fault in faults)
        failed = dark or (loud and seed % 2 == 1)
        return SimpleNamespace(
            success=not failed,
            reason="did not arrive" if failed else "reached the goal",
            seconds=20.0 + seed,
            trace=None,
            e2e_ms=np.full(10, 50.0 + 10 * loud) if not dark else np.zeros(0),
        )


@given(st.integers(1, 400).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_intervals_are_wilson_s(pair: tuple[int, int]) -> None:
    k, n = pair
    wanted = binomtest(k, n).proportion_ci(method="wilson")
    assert wilson(k, n) == pytest.approx((wanted.low, wanted.high), abs=1e-12)


@given(st.integers(0, 60), st.integers(0, 60))
def test_the_paired_test_is_the_exact_one(lost: int, won: int) -> None:
    wanted = binomtest(lost, lost + won).pvalue if lost + won else 1.0
    assert mcnemar(lost, won) == pytest.approx(wanted)


def test_worlds_are_paired_and_summed_up() -> None:
    result = robustness(range(4), FAULTS, runner=Runner(), progress=False)
    found = {(s.fault, s.severity): s for s in result.summaries}
    assert list(found) == [(NOTHING, ""), ("noise", "little"), ("noise", "much"), ("dark", "")]
    assert [s.successes for s in result.summaries] == [4, 4, 2, 0]
    much, dark = found["noise", "much"], found["dark", ""]
    assert (much.lost, much.won, much.e2e_p50_ms) == (2, 0, 60.0)
    assert dark.p_value == pytest.approx(0.125) and dark.reasons == (("did not arrive", 4),)
    assert np.isnan(dark.e2e_p99_ms) and np.isnan(dark.seconds)
    assert found[NOTHING, ""].seconds == 21.5
    text = str(result)
    assert "noise  much" in text and "2/4" in text and "4 x did not arrive" in text
    figure, alt = result.plot()
    assert "noise, much: 2 of 4 solved" in alt and len(figure.axes) == 2
    assert json.loads(json.dumps(result.to_dict()))["summaries"][3]["e2e_p99_ms"] is None


def test_a_test_that_was_stopped_goes_on_where_it_was(tmp_path: Path) -> None:
    store = tmp_path / "results.json"

    class Stopped(Runner):
        def __call__(self, seed: int, attach: Sequence[Any]) -> Any:
            if len(self.calls) == 6:
                raise KeyboardInterrupt
            return super().__call__(seed, attach)

    with pytest.raises(KeyboardInterrupt):
        robustness(range(4), FAULTS, runner=Stopped(), results=store, progress=False)
    second = Runner()
    resumed = robustness(range(4), FAULTS, runner=second, results=store, progress=False)
    assert len(second.calls) == 16 - 6
    third = Runner()
    again = robustness(range(4), FAULTS, runner=third, results=store, progress=False)
    assert not third.calls and str(again) == str(resumed)
    assert str(resumed) == str(robustness(range(4), FAULTS, runner=Runner(), progress=False))
    # Other parameters of a fault, or other settings, are other runs.
    changed: dict[str, dict[str, list[Fault]]] = {**FAULTS, "noise": {"little": [Noise("/scan", 0.2)]}}
    fourth = Runner()
    robustness(range(4), changed, runner=fourth, results=store, progress=False)
    assert len(fourth.calls) == 4


def test_a_node_that_does_not_survive_is_a_result() -> None:
    from rclpy.node import Node

    def runner(seed: int, attach: Sequence[Any]) -> Any:
        context = SimContext()
        context.log_sink = lambda _: None

        def choke() -> None:
            raise ZeroDivisionError("no points left")

        Node("brain", context=context).create_timer(0.1, choke)
        context.run_for(1.0)

    result = robustness([1], {}, runner=runner, progress=False)
    assert result.summaries[0].reasons == (("ZeroDivisionError: no points left", 1),)


def test_late_frames_show_in_the_latency() -> None:
    # Watch pairs messages by the time at which they were published, so late ones would be missing from a run's report.
    late = {"late": {"100 ms": [LateFrames("/scan", 100.0)]}}
    plain, delayed = robustness([6000], late, progress=False, time_limit=2).summaries
    # The controller looks every 50 ms, so 100 ms of delay cost 50 to 100.
    assert 45 <= delayed.e2e_p50_ms - plain.e2e_p50_ms <= 105
    assert 45 <= delayed.e2e_p99_ms - plain.e2e_p99_ms <= 105


def test_the_standard_faults_are_many_and_distinct() -> None:
    faults = standard_faults()
    cases = [repr(found) for levels in faults.values() for found in levels.values()]
    assert len(cases) == len(set(cases)) > 20
    context = SimContext()
    context.log_sink = lambda _: None
    for levels in faults.values():
        for found in levels.values():
            for fault in found:
                fault.install(context)()


def test_what_cannot_be_tested_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="seeds"):
        robustness([], FAULTS, runner=Runner())
    with pytest.raises(InputError, match="successes"):
        wilson(3, 2)
    broken = tmp_path / "broken.json"
    broken.write_text("[1, 2]", encoding="utf-8")
    with pytest.raises(InputError, match=r"broken\.json"):
        robustness([1], FAULTS, runner=Runner(), results=broken, progress=False)
