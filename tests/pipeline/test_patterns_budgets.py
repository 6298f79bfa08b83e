"""Schedulability against simulation, chains against their bound, budgets against runs."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robotbrain.errors import InputError
from robotbrain.pipeline.patterns.brains import run_brain
from robotbrain.pipeline.patterns.budgets import (
    Budget,
    Task,
    executor_response_ns,
    liu_layland_bound,
    make_budget,
    passes_hyperbolic_bound,
    rate_monotonic,
    response_times,
    simulate_fixed_priority,
    stage_response_ms,
    utilisation,
)
from robotbrain.pipeline.patterns.chains import reaction_bound_ns, run_chain
from robotbrain.pipeline.patterns.stages import Device, Stage
from robotbrain.ros import SimContext, charge
from robotbrain.ros.node import Node

MS = 1_000_000


@st.composite
def task_sets(draw, most=4, load=1.0):
    count = draw(st.integers(1, most))
    tasks = []
    for k in range(count):
        period = draw(st.integers(4, 60))
        tasks.append(Task(f"t{k}", period, draw(st.integers(1, min(period, max(1, int(load * period / count)))))))
    return rate_monotonic(tasks)


@given(task_sets())
@settings(max_examples=150, deadline=None)
def test_response_times_are_those_of_the_critical_instant(tasks):
    """Released all at once, every task has its worst response, and it is the fixed point to the ns."""
    found = response_times(tasks)
    simulated = simulate_fixed_priority(tasks, max(task.period_ns for task in tasks))
    for task in tasks:
        # A task that may miss its deadline does so on its first release.
        if math.isinf(found[task.name]):
            assert simulated[task.name] > task.due_ns
        else:
            first = simulate_fixed_priority(tasks[: tasks.index(task) + 1], task.period_ns)[task.name]
            assert first == found[task.name] <= task.due_ns


@given(task_sets(), st.lists(st.integers(0, 60), min_size=4, max_size=4), st.booleans())
@settings(max_examples=150, deadline=None)
def test_no_offsets_make_it_worse(tasks, offsets, preemptive):
    found = response_times(tasks, preemptive=preemptive)
    if not all(math.isfinite(response) for response in found.values()):
        return
    simulated = simulate_fixed_priority(tasks, 600, offsets[: len(tasks)], preemptive=preemptive)
    for task in tasks:
        assert task.wcet_ns <= simulated[task.name] <= found[task.name]


@given(task_sets())
@settings(max_examples=200)
def test_utilisation_bounds_are_sufficient_and_in_order(tasks):
    if utilisation(tasks) <= liu_layland_bound(len(tasks)):
        assert passes_hyperbolic_bound(tasks)
    if passes_hyperbolic_bound(tasks):
        assert all(math.isfinite(response) for response in response_times(tasks).values())


def test_textbook_values():
    assert liu_layland_bound(1) == 1
    assert liu_layland_bound(3) == pytest.approx(0.7798, abs=1e-4)
    assert liu_layland_bound(10**6) == pytest.approx(math.log(2), abs=1e-6)
    # By hand: t3 = 5 + 2 x 3 + 1 x 3 = 14 -> 5 + 2 x 3 + 2 x 3 = 17 -> 5 + 3 x 3 + 2 x 3 = 20.
    tasks = [Task("t1", 7, 3), Task("t2", 12, 3), Task("t3", 20, 5)]
    assert response_times(tasks) == {"t1": 3, "t2": 6, "t3": 20}
    assert response_times([*tasks[:2], Task("t3", 20, 6)])["t3"] == math.inf


def test_without_preemption_the_second_release_may_be_worse():
    """The example of Davis et al. (2007) that refuted the older analysis: it gives 30 for C, where 35 happens."""
    tasks = [Task("A", 25, 10), Task("B", 35, 10), Task("C", 35, 10)]
    assert simulate_fixed_priority(tasks, 51, preemptive=False)["C"] == 35
    assert response_times(tasks, preemptive=False)["C"] >= 35


@given(task_sets(load=2.0))
@settings(max_examples=30, deadline=None)
def test_timers_that_share_an_executor_keep_its_bound(tasks):
    context, responses = SimContext(), []
    node = Node("busy", context=context)
    for task in tasks:
        node.create_timer(task.period_ns * MS / 1e9, lambda task=task: charge(task.wcet_ns * MS))
    context.add_callback_tap(lambda record: responses.append(record.end_ns - record.ready_ns))
    context.run_for(0.5)
    assert max(responses) <= executor_response_ns(tasks) * MS


# ------------------------------------------------------------ chains

links = st.lists(st.tuples(st.integers(5, 60), st.floats(0.05, 0.9)), min_size=1, max_size=3).map(
    lambda pairs: [Task(f"link_{k}", p * MS + 13 * k, max(1, int(p * MS * u))) for k, (p, u) in enumerate(pairs)]
)


@given(links, st.lists(st.integers(0, 60 * MS), min_size=3, max_size=3), st.sampled_from([None, 1, 2]))
@settings(max_examples=30, deadline=None)
def test_chains_never_exceed_their_bound(chain, offsets, cores):
    shared = max(1.0, len(chain) / (cores or len(chain)))
    if any(link.wcet_ns * shared + 10 > link.period_ns for link in chain):
        return
    found = run_chain(chain, seconds=1.5, cores=cores, offsets_ns=offsets[: len(chain)])
    assert found.reaction_ms * MS <= reaction_bound_ns(chain, cores=cores) + 1


def test_the_bound_is_nearly_reached_and_events_save_all_but_one_period():
    chain = [Task.of("camera", 100, 10), Task.of("planner", 97.3, 40), Task.of("control", 51.7, 5)]
    periodic = run_chain(chain, seconds=60)
    assert 0.95 <= periodic.reaction_ms * MS / reaction_bound_ns(chain) <= 1
    events = run_chain(chain, "events", seconds=5)
    assert events.reaction_ms * MS == reaction_bound_ns(chain, "events") == 155 * MS
    assert events.mean_age_ms == pytest.approx(55 + 50)
    assert periodic.mean_age_ms == pytest.approx(55 + (100 + 97.3 + 51.7) / 2, rel=0.02)


@pytest.mark.parametrize("call", [([], "timers", None), (["x"], "ask", None), (["x"], "timers", [1, 2])])
def test_bad_chains_are_explained(call):
    tasks = [Task(name, 10, 1) for name in call[0]]
    with pytest.raises(InputError, match="chain"):
        run_chain(tasks, call[1], offsets_ns=call[2])


# ------------------------------------------------------------ budgets

STAGES = [Stage.of("perception", 10, 20, 10), Stage.of("estimation", 5), Stage.of("planning", 20), Stage.of("act", 1)]


@pytest.mark.parametrize("how", ["proportional", "equal"])
def test_a_budget_adds_up(how):
    budget = make_budget(200, STAGES, 20, reserve=0.25, how=how)
    assert budget.sampling_ms + sum(budget.stages_ms.values()) + budget.reserve_ms == pytest.approx(200)
    assert budget.reserve_ms == pytest.approx(50)
    shares = list(budget.stages_ms.values())
    assert shares[0] / shares[1] == pytest.approx(8 if how == "proportional" else 1)


def test_a_pipeline_within_its_budget_meets_the_deadline():
    result = run_brain("pipelined", STAGES, Device(8), camera_hz=20, seconds=3)
    assert stage_response_ms(result) == {"perception": 40, "estimation": 5, "planning": 20, "act": 1}
    budget = make_budget(150, STAGES, 20)
    assert budget.kept_by(result)
    assert all(line.slack_ms >= 0 for line in budget.check(result))
    assert result.peak_age_ms == pytest.approx(50 + 66)
    assert "deadline kept" in budget.table(result)


def test_who_is_over_budget_is_named():
    result = run_brain("pipelined", STAGES, Device(8), camera_hz=20, seconds=3)
    budget = Budget(110, 50, {"perception": 30, "estimation": 5, "planning": 20, "act": 1})
    late = [line.name for line in budget.check(result) if line.slack_ms < 0]
    assert late == ["perception", "reserve"]
    text = budget.table(result)
    assert "deadline missed" in text
    assert text.splitlines()[2].endswith("over budget")


@pytest.mark.parametrize("kind", ["sequential", "pipelined", "parallel"])
def test_stages_of_a_run_cover_its_latency(kind):
    result = run_brain(kind, STAGES, Device(8), camera_hz=30, seconds=3)
    spent = stage_response_ms(result)
    state = ("perception", "estimation") if kind == "parallel" else tuple(spent)
    wait = 20 if kind == "parallel" else 0  # for the tick of control
    assert result.latency_ms.max() <= sum(spent[name] for name in state) + wait + spent["act"] + 1e-6


@pytest.mark.parametrize(
    "arguments", [{"deadline_ms": 40, "camera_hz": 20}, {"how": "fair"}, {"reserve": 1.0}, {"reserve": -0.1}]
)
def test_bad_budgets_are_explained(arguments):
    with pytest.raises(InputError):
        make_budget(**({"deadline_ms": 200, "stages": STAGES, "camera_hz": 20} | arguments))


@pytest.mark.parametrize("numbers", [(10, 0), (10, 11), (10, 5, 4), (10, 5, 11)])
def test_bad_tasks_are_explained(numbers):
    with pytest.raises(InputError, match="task 'x'"):
        Task("x", *numbers)
