"""Two processes in lockstep do what one process with the same transport latency does, to the byte."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from robotbrain.link.brainlog import BrainLog
from robotbrain.link.description import RobotDescription
from robotbrain.link.robot import RobotOptions, SimulatedRobot, make_sim
from robotbrain.pipeline.remote import make_nodes
from robotbrain.ros import SimContext

from .processes import Robot, brain


def in_one_process(latency_ns: int, limit_s: float) -> BrainLog:
    context = SimContext(latency_ns=latency_ns)

    def make(factory: Any) -> Any:
        with context.as_default():
            return factory()

    options = RobotOptions(world=1, difficulty=0.2)
    SimulatedRobot(make_sim(options), make, options)
    for factory in make_nodes(RobotDescription()).values():
        make(factory)
    log = BrainLog(context, others=frozenset({"/robot", "/safety"}))
    context.log_sink = lambda record: None
    with context.as_default():
        while not log.reached and context.now_ns < limit_s * 1e9:
            context.step()
    return log


def test_lockstep_is_one_process_in_two(tmp_path: Path) -> None:
    robot = Robot(tmp_path, "--lockstep", 1)
    try:
        driver = brain(tmp_path, robot.port())
        assert driver.finish() == 0, driver.output
        assert robot.finish() == 0, robot.output
    finally:
        robot.kill()
    alone = in_one_process(1_000_000, 60.0)
    assert alone.reached
    digest = driver.wait_for("decision log of the brain").split()[-1]
    assert "touched nothing" in robot.output
    assert digest == alone.sha256()
    assert alone.counts["/cmd_vel"] > 200, "the log is of something"
