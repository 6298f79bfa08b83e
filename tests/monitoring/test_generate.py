"""Generated pipelines: the same every time, of the promised shape, and really cured by their cure."""

from __future__ import annotations

import numpy as np
import pytest

from robotbrain.errors import InputError
from robotbrain.monitoring.generate import FAULTS, generate_pipeline
from robotbrain.monitoring.generate_program import draw_factor
from robotbrain.monitoring.whatif import Change, outcome


def test_a_seed_says_everything() -> None:
    first, second = (generate_pipeline(17).run(1.5) for _ in range(2))
    assert first.callbacks == second.callbacks and first.messages == second.messages
    assert generate_pipeline(17) == generate_pipeline(17) != generate_pipeline(25)
    other_day = generate_pipeline(17).run(1.5, day=1)
    assert other_day.callbacks != first.callbacks


def test_shapes_are_as_promised() -> None:
    sizes, gpus, timers, shared = set(), 0, 0, 0
    for seed in range(120):
        pipeline = generate_pipeline(seed)
        assert pipeline.fault == FAULTS[seed % 8]
        nodes = [node for node in pipeline.nodes if node.name != "/indexer"]
        assert 3 <= len(nodes) <= 9
        assert len({node.name for node in nodes}) == len(nodes)
        sizes.add(len(nodes))
        tasks = [task for node in nodes for task in node.tasks]
        gpus += any(work.resource == "gpu" for task in tasks for work in task.work)
        timers += any(task.kind == "timer" for task in tasks)
        shared += len({node.executor for node in nodes}) < len(nodes)
        assert sum(topic == "/cmd_vel" for task in tasks for topic, _ in task.publishes) == 1
    assert {3, 4, 5, 6, 7, 8} <= sizes
    assert min(gpus, timers, shared) > 20


@pytest.mark.parametrize("fault", FAULTS)
def test_the_cure_is_a_cure(fault: str) -> None:
    pipeline = generate_pipeline(77, fault)  # type: ignore[arg-type]
    sick, cured = pipeline.run(6.0), pipeline.changed(pipeline.cure).run(6.0)
    before = outcome(sick)
    assert outcome(cured, source=before.source).mean_ms < 0.8 * before.mean_ms


def test_work_is_log_normal_with_mean_one() -> None:
    draws = np.array([draw_factor((3, k), 0.5) for k in range(4000)])
    assert draws.mean() == pytest.approx(1, abs=0.03)
    assert np.log(draws).std() == pytest.approx(0.5, abs=0.02)


def test_what_cannot_be_generated_is_refused() -> None:
    with pytest.raises(InputError, match="seed"):
        generate_pipeline(-1)
    with pytest.raises(InputError, match="slow node"):
        generate_pipeline(1, "gremlins")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="change"):

        class Odd(Change):
            node = "/controller"

        generate_pipeline(1).changed(Odd())
