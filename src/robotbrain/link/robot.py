"""The simulated robot as a process of its own, behind the topics that a physical one has.

Nominal or surrogate (a stand-in for a physical robot: the same robot with other friction, mass, motor lag, backlash,
sensor errors and delays). A safety node stands in front of its motors.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from robotbrain.errors import InputError
from robotbrain.link import handshake
from robotbrain.link.runtime import KitRuntime, RclpyRuntime, Runtime, use_kit

if TYPE_CHECKING:
    from robotbrain.sim import RobotSim
    from robotbrain.sim.view import Replay

Transport = Literal["local", "rclpy", "dds"]
TRANSPORTS: tuple[Transport, ...] = ("local", "rclpy", "dds")
CLOCK_HZ, TRUTH_HZ = 100.0, 10.0


@dataclass(frozen=True)
class RobotOptions:
    """What ``robotbrain robot`` is asked for.

    Args:
        world, difficulty: of the world.
        surrogate: its seed; None for the nominal robot.
        transport: how brains reach it.
        host, port, token: of the local transport.
        domain: of DDS (0 to 101), for the transport ``dds``.
        clock_topic: publish ``/clock``.
        lockstep_ms: simulated time in lockstep with this transport latency, ms; None for wall-clock time.
        seconds: end after this long.
        log: file for commands and true states, a JSON object per line.
        safety: fields of SafetyLimits.
    """

    world: int = 0
    difficulty: float = 0.5
    surrogate: int | None = None
    transport: Transport = "local"
    host: str = "127.0.0.1"
    port: int = handshake.DEFAULT_PORT
    token: str | None = None
    domain: int = 0
    clock_topic: bool = False
    lockstep_ms: float | None = None
    seconds: float = float("inf")
    log: Path | None = None
    safety: Mapping[str, float] = field(default_factory=dict)

    def check(self) -> None:
        """Raise InputError where the options contradict each other."""
        if self.lockstep_ms is not None and self.transport != "local":
            raise InputError(
                "transport",
                given=f"{self.transport} with lockstep",
                expected="the local transport with lockstep",
                fix="Genuine ROS 2 has no lockstep; leave one of the two out.",
            )


def make_sim(options: RobotOptions) -> RobotSim:
    """Return the robot in its world, at time zero."""
    from robotbrain.sim import RobotSim, generate_world
    from robotbrain.sim.surrogate import surrogate_robot

    world = generate_world(options.world, options.difficulty)
    if options.surrogate is None:
        return RobotSim(world, seed=options.world)
    body, sensors = surrogate_robot(options.surrogate)
    return RobotSim(world, body, sensors, seed=options.world)


class SimulatedRobot:
    """Robot and safety node on a runtime, with a judge who watches.

    Args:
        sim: at time zero.
        make: makes and runs a node.
        options: see there.

    Attributes:
        replay: where robot and boxes were, to watch in 3D.
    """

    def __init__(self, sim: RobotSim, make: Callable[[Callable[[], Any]], Any], options: RobotOptions) -> None:
        from robotbrain.pipeline.nodes.safety import SafetyNode, limits_from
        from robotbrain.sim.view import Replay

        self.sim = sim
        self.replay: Replay = Replay(sim.world)
        self._log = options.log.open("w", encoding="utf-8", buffering=1) if options.log else None
        limits = limits_from(options.safety)
        self.safety = make(lambda: SafetyNode(limits))
        self.node = make(lambda: self._make_robot(options))

    def _make_robot(self, options: RobotOptions) -> Any:
        """Return the robot's driver node. The judge looks on from its executor: the simulator is not thread-safe."""
        from geometry_msgs.msg import Twist

        from robotbrain.pipeline.nodes.robot import RobotNode

        node = RobotNode(self.sim, command_topic="cmd_vel_safe")
        node.create_timer(1.0 / TRUTH_HZ, lambda: self._judge(node))
        if self._log is not None:
            for topic in ("cmd_vel", "cmd_vel_safe"):
                node.create_subscription(Twist, topic, self._logger(node, topic), 10)
        if options.clock_topic:
            from rosgraph_msgs.msg import Clock

            publisher = node.create_publisher(Clock, "clock", 1)
            node.create_timer(1.0 / CLOCK_HZ, lambda: publisher.publish(Clock(clock=node.get_clock().now().to_msg())))
        return node

    def _judge(self, node: Any) -> None:
        self.sim.advance_to(max(self.sim.now_ns, int(node.get_clock().now().nanoseconds) - node.epoch_ns))
        self.replay.record(self.sim)
        pose, twist = self.sim.truth.pose, self.sim.truth.twist
        self._write(node, "truth", x=pose.x, y=pose.y, yaw=pose.yaw, v=twist.v, w=twist.w)

    def _logger(self, node: Any, topic: str) -> Callable[[Any], None]:
        return lambda msg: self._write(node, topic, v=float(msg.linear.x), w=float(msg.angular.z))

    def _write(self, node: Any, event: str, **values: float) -> None:
        if self._log is not None:
            seconds = (int(node.get_clock().now().nanoseconds) - node.epoch_ns) * 1e-9
            self._log.write(json.dumps({"t": seconds, "event": event, **values}) + "\n")

    def summary(self) -> str:
        """Return how things stand, as the judge sees it."""
        truth = self.sim.truth
        touched = ", ".join(sorted(truth.collided)) or "nothing"
        return (
            f"after {self.sim.now_ns * 1e-9:.1f} s: drove {truth.path_length:.2f} m, {truth.distance_to_goal:.2f} m "
            f"from the goal, touched {touched}; {self.safety.refused} commands refused"
        )

    def close(self) -> None:
        """Close the log."""
        if self._log is not None:
            self._log.close()


def run_robot(
    options: RobotOptions, say: Callable[[str], None] = print, finish: Callable[[SimulatedRobot], None] | None = None
) -> SimulatedRobot:
    """Run the robot until it is interrupted, its time is over or, in lockstep, the brain has left.

    Args:
        options: see there.
        say: prints a line.
        finish: called at the end, however it came.

    Returns:
        The robot at its end.

    Raises:
        InputError: impossible options; port in use.
        robotbrain.errors.MissingDependencyError: the transport needs something that is not installed.
    """
    options.check()
    if options.transport != "rclpy":
        use_kit()
    if options.lockstep_ms is not None:
        return _run_lockstep(options, say, finish)
    runtime: Runtime
    closing: list[Callable[[], None]] = []
    if options.transport == "rclpy":
        runtime = RclpyRuntime()
    else:
        runtime = KitRuntime()
        # A fault of one callback, such as a message that cannot be decoded, must not end the safety node.
        runtime.context.on_callback_error = lambda error: _go_on(say, error)
    try:
        robot = SimulatedRobot(make_sim(options), runtime.make, options)
        closing.append(robot.close)
        if isinstance(runtime, KitRuntime):
            closing.append(_serve(runtime, options, say))
        else:
            say("the robot's topics are on the ROS 2 graph")
        try:
            runtime.run(lambda: False, options.seconds)
        except KeyboardInterrupt:
            say("interrupted")
        say(robot.summary())
        if isinstance(runtime, KitRuntime):
            say(f"pace: {runtime.context.lag}")
        if finish is not None:
            finish(robot)
    finally:
        for close in reversed(closing):
            close()
        runtime.close()
    return robot


def _go_on(say: Callable[[str], None], error: Exception) -> bool:
    say(f"error: {error}")
    return True


def _serve(runtime: KitRuntime, options: RobotOptions, say: Callable[[str], None]) -> Callable[[], None]:
    """Open the transport; return what closes it."""
    if options.transport == "dds":
        from robotbrain.link.dds import DdsBridge

        bridge = DdsBridge(runtime.context, options.domain)
        say(f"the robot's topics are on DDS domain {options.domain}")
        return bridge.close
    from robotbrain.link.local import LinkServer

    server = LinkServer(runtime.context, options.host, options.port, options.token)
    host, port = server.address
    say(f"listening on {host}:{port}; token in {handshake.token_path(port)}")
    return server.close


def _run_lockstep(
    options: RobotOptions, say: Callable[[str], None], finish: Callable[[SimulatedRobot], None] | None
) -> SimulatedRobot:
    from robotbrain.link.lockstep import LockstepRobot, accept_one
    from robotbrain.ros import SimContext

    latency_ns = round((options.lockstep_ms or 0.0) * 1e6)
    context = SimContext(latency_ns=latency_ns)

    def make(factory: Callable[[], Any]) -> Any:
        with context.as_default():
            return factory()

    robot = SimulatedRobot(make_sim(options), make, options)
    try:
        end_ns = round(min(options.seconds, 3600.0) * 1e9)
        offer = {"clock": "lockstep", "latency_ns": latency_ns}
        sock = accept_one(
            options.host,
            options.port,
            options.token,
            offer,
            lambda port: say(f"listening on {options.host}:{port}; token in {handshake.token_path(port)}"),
        )
        link = LockstepRobot(context, sock, latency_ns)
        reason = "interrupted"
        try:
            with context.as_default():
                reason = link.run(lambda: False, end_ns)
        except KeyboardInterrupt:
            pass
        finally:
            link.close(reason)
        say(f"{reason}; {link.windows} windows")
        say(robot.summary())
        if finish is not None:
            finish(robot)
    finally:
        robot.close()
        context.try_shutdown()
    return robot
