"""The brain as a process of its own: the path to a physical robot, or to ``robotbrain robot`` in its place.

The nodes are those of :func:`~robotbrain.pipeline.brain.drive`. Nobody judges here: the brain says when it is there.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotbrain.errors import InputError, RobotBrainError
from robotbrain.link.description import RobotDescription
from robotbrain.link.driver import Driver, clock_node
from robotbrain.link.handshake import DEFAULT_PORT, LinkError, RefusedError
from robotbrain.link.recording import record
from robotbrain.link.runtime import KitRuntime, RclpyRuntime, Runtime, use_kit
from robotbrain.pipeline.brain import ROLES, TIME_LIMIT, Parts, default_model

if TYPE_CHECKING:
    from robotbrain.link.local import LinkClient
    from robotbrain.link.robot import Transport

MEASURE_S = 2.0
"""How long the pre-flight check measures rates, s."""

PATIENCE_S = 30.0
"""How long the brain waits for the robot's topics, s."""


class PreflightError(RobotBrainError):
    """The robot is not as the brain needs it; the message says what is missing or wrong."""


@dataclass(frozen=True)
class RemoteOptions:
    """How the brain reaches the robot.

    Args:
        transport: ``local`` (TCP), ``rclpy`` (genuine ROS 2) or ``dds``.
        host, port, token: of the local transport.
        domain: of DDS.
        follow_clock: take the time from ``/clock`` instead of this computer's.
        patience_s: wait for the robot's topics so long.
        time_limit: end the drive after this long, s.
        preflight: check topics, frames, rates and clocks before driving.
        bag: folder to record to.
        decisions: file for what the brain decided, a JSON object per line: commands, plans, goals.
    """

    transport: Transport = "local"
    host: str = "127.0.0.1"
    port: int = DEFAULT_PORT
    token: str | None = None
    domain: int = 0
    follow_clock: bool = False
    patience_s: float = PATIENCE_S
    time_limit: float = TIME_LIMIT
    preflight: bool = True
    bag: Path | None = None
    decisions: Path | None = None


@dataclass
class RemoteResult:
    """How a drive went, as the brain saw it.

    Attributes:
        reached: the brain said that it had arrived.
        reason: why the drive ended.
        seconds: that it took.
        commands: sent to the motors.
        decisions: published by topic.
        pace: how late the brain's events were, in words.
        links: per topic that came from the robot: messages, mean and worst age on arrival (ms), and messages dropped.
        log_sha256: of all that the brain's nodes published, in order: time, topic, type, node, CDR. Lockstep only.
    """

    reached: bool = False
    reason: str = ""
    seconds: float = 0.0
    commands: int = 0
    decisions: dict[str, int] = field(default_factory=dict)
    pace: str = ""
    links: dict[str, tuple[int, float, float, int]] = field(default_factory=dict)
    log_sha256: str = ""


def make_nodes(
    robot: RobotDescription, model: str | Path | None = None, parts: Parts | None = None
) -> dict[str, Callable[[], Any]]:
    """Return a factory for each role of a brain on this robot, the kit's own unless replaced.

    Raises:
        InputError: a role that does not exist.
    """
    from robotbrain.jetson.engine import OnnxEngine
    from robotbrain.pipeline.nodes.controller import ControllerNode
    from robotbrain.pipeline.nodes.estimator import EstimatorNode
    from robotbrain.pipeline.nodes.mapper import MapperNode
    from robotbrain.pipeline.nodes.mission import MissionNode
    from robotbrain.pipeline.nodes.perception import PerceptionNode
    from robotbrain.pipeline.nodes.planner import PlannerNode

    nodes: dict[str, Callable[[], Any]] = {
        "perception": lambda: PerceptionNode(OnnxEngine(model or default_model()), robot.camera),
        "estimator": lambda: EstimatorNode(robot.wheel_radius, robot.track),
        "mapper": MapperNode,
        "planner": PlannerNode,
        "mission": MissionNode,
        "controller": ControllerNode,
    }
    for role, factory in (parts or {}).items():
        if role not in nodes:
            raise InputError("part", given=role, expected="one of " + ", ".join(ROLES), fix="Replace one of these.")
        nodes[role] = factory
    return nodes


def drive_remote(
    options: RemoteOptions,
    robot: RobotDescription | None = None,
    *,
    model: str | Path | None = None,
    parts: Parts | None = None,
    say: Callable[[str], None] = print,
) -> RemoteResult:
    """Connect to a robot, check it, and drive until the brain has arrived, its time is over or it is interrupted.

    However it ends, the robot is told to stop. Should this process be killed, the robot's watchdog does that.

    Args:
        options: how to reach it.
        robot: what it is like; the kit's robot by default.
        model: ONNX file of the segmentation network; the shipped one by default.
        parts: nodes of your own by role.
        say: prints a line.

    Raises:
        PreflightError: topics are missing, or something else speaks against driving.
        LinkError: the robot does not let this brain in.
        InputError: impossible options.
        Exception: what a node's callback raised.
    """
    robot = robot or RobotDescription()
    if options.transport != "rclpy":
        use_kit()
    nodes = make_nodes(robot, model, parts)
    if options.transport == "local" and (lockstep := _lockstep_offer(options)) is not None:
        return _drive_lockstep(*lockstep, options, nodes, say, robot.ros_arguments())
    session = _Session(options, robot, say)
    try:
        return session.drive(nodes)
    finally:
        session.close()


class _Session:
    """One drive in wall-clock time."""

    def __init__(self, options: RemoteOptions, robot: RobotDescription, say: Callable[[str], None]) -> None:
        self.options, self.robot, self.say = options, robot, say
        self.client: LinkClient | None = None
        self._closing: list[Callable[[], None]] = []
        self.runtime: Runtime = self._make_runtime()
        if options.bag is not None:
            try:
                self._closing.append(record(self.runtime, options.bag))
            except BaseException:
                self.close()
                raise

    def _make_runtime(self) -> Runtime:
        options, arguments = self.options, self.robot.ros_arguments()
        if options.transport == "rclpy":
            if options.follow_clock:
                arguments = [*(arguments or ["--ros-args"]), "-p", "use_sim_time:=true"]
            return RclpyRuntime(arguments)
        from robotbrain.link.realtime import FollowedClock

        clock = FollowedClock() if options.follow_clock else None
        runtime = KitRuntime(arguments, clock)
        context = runtime.context
        if clock is not None:
            runtime.make(lambda: clock_node(clock))
        if options.transport == "dds":
            from robotbrain.link.dds import DdsBridge

            bridge = DdsBridge(context, options.domain)
            self._closing.append(bridge.close)
            runtime.remote = bridge.offered
        else:
            from robotbrain.link.local import LinkClient

            client = self.client = LinkClient(context, options.host, options.port, options.token)
            self._closing.append(client.close)
            runtime.remote = lambda: _offered(client)
        return runtime

    def drive(self, nodes: dict[str, Callable[[], Any]]) -> RemoteResult:
        driver = Driver(self.runtime, self.options.decisions)
        self._preflight()
        result, running = RemoteResult(), []
        began = time.monotonic()
        try:
            for factory in nodes.values():
                running.append(self.runtime.make(factory))
            self.say("driving; Ctrl-C stops the robot")
            result.reached = self.runtime.run(lambda: driver.reached, self.options.time_limit)
            late = f"did not arrive within {self.options.time_limit:g} s"
            result.reason = "arrived, says the brain" if result.reached else late
        except KeyboardInterrupt:
            result.reason = "interrupted"
        finally:
            result.seconds = time.monotonic() - began
            self._report(result)
            for node in running:
                self.runtime.destroy(node)
            result.decisions, result.commands = dict(driver.decisions), driver.decisions["cmd_vel"]
            driver.halt()
            driver.close()
        return result

    def _report(self, result: RemoteResult) -> None:
        if not isinstance(self.runtime, KitRuntime):
            return
        context = self.runtime.context
        result.pace = str(context.lag)
        peer = self.client.peer if self.client is not None else None
        if peer is not None:
            dropped = peer.dropped
            for topic, stats in sorted(peer.bridge.received.items()):
                mean = stats.total_ns / stats.messages * 1e-6
                result.links[topic] = (stats.messages, mean, stats.worst_ns * 1e-6, dropped[topic])

    def _preflight(self) -> None:
        from robotbrain.link.preflight import Preflight

        check: Any = None

        def make() -> Any:
            nonlocal check
            check = Preflight(self.robot.sensors)
            return check.node

        node = self.runtime.make(make)
        told = ""
        deadline = time.monotonic() + self.options.patience_s
        while check.missing():
            if self.client is not None and self.client.refusal is not None:
                raise self.client.refusal
            if time.monotonic() > deadline:
                raise PreflightError(f"the robot is not there: {told}")
            self.runtime.run(lambda: not check.missing(), 1.0)
            waiting = check.waiting_for(self.runtime.offered())
            state = f" ({self.client.state})" if self.client is not None and self.client.peer is None else ""
            if waiting and waiting + state != told:
                told = waiting + state
                self.say(f"waiting for {told}")
        if self.options.preflight:
            check.restart()
            self.runtime.run(lambda: False, MEASURE_S)
            found = check.problems()
            if found:
                raise PreflightError("the pre-flight check found:\n- " + "\n- ".join(found))
            rates = ", ".join(f"{topic} {sight.hz:.0f} Hz" for topic, sight in check.sights.items())
            self.say(f"pre-flight check passed: {rates}")
        self.runtime.destroy(node)

    def close(self) -> None:
        for close in reversed(self._closing):
            close()
        self.runtime.close()


def _offered(client: LinkClient) -> dict[str, list[str]]:
    if client.peer is None:
        return {}
    return {name: [end.type_name] for name, end in client.peer.bridge.remote.publishers.items()}


def _lockstep_offer(options: RemoteOptions) -> tuple[socket.socket, int] | None:
    """Return a connection if the robot runs in lockstep, None if it runs in wall-clock time or is not there yet."""
    from robotbrain.link.local import connect

    try:
        sock, offer = connect(options.host, options.port, options.token)
    except (RefusedError, InputError):
        raise
    except LinkError:
        return None
    if offer.get("clock") == "lockstep":
        return sock, int(offer["latency_ns"])
    sock.close()
    return None


def _drive_lockstep(
    sock: socket.socket,
    latency_ns: int,
    options: RemoteOptions,
    nodes: dict[str, Callable[[], Any]],
    say: Callable[[str], None],
    arguments: list[str],
) -> RemoteResult:
    from robotbrain.link.brainlog import BrainLog
    from robotbrain.link.lockstep import drive_lockstep
    from robotbrain.ros import SimContext

    context = SimContext(latency_ns=latency_ns)
    context.init(arguments)
    log = BrainLog(context)
    say("driving in lockstep")
    limit_ns = round(options.time_limit * 1e9)
    reason = drive_lockstep(context, sock, latency_ns, nodes, lambda: log.reached or context.now_ns >= limit_ns)
    late = f"did not arrive within {options.time_limit:g} s" if context.now_ns >= limit_ns else reason
    return RemoteResult(
        reached=log.reached,
        reason="arrived, says the brain" if log.reached else late,
        seconds=context.now_ns * 1e-9,
        commands=log.counts["/cmd_vel"],
        decisions=dict(log.counts),
        log_sha256=log.sha256(),
    )
