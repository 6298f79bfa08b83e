"""A surrogate arm, and a policy, as processes of their own: what stands between them is a network, as in reality.

    robotbrain rl surrogate --serial 7          # in one terminal
    robotbrain rl policy reach.onnx --goal 0.5 0.2 0.4   # in another

With ``--transport rclpy`` both speak genuine ROS 2; the policy then runs a physical arm in the same way.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from robotbrain.errors import InputError, RobotBrainError
from robotbrain.link.handshake import DEFAULT_PORT, token_path
from robotbrain.link.robot import Transport
from robotbrain.link.runtime import KitRuntime, RclpyRuntime, Runtime, use_kit

if TYPE_CHECKING:
    from robotbrain.rl.deployment import NodeOptions
    from robotbrain.rl.view import Motion

Say = Callable[[str], None]


@dataclass(frozen=True)
class LinkOptions:
    """How the two processes find each other.

    Args:
        transport: ``local`` (TCP), ``rclpy`` (genuine ROS 2) or ``dds``.
        host, port, token: of the local transport.
        domain: of DDS.
    """

    transport: Transport = "local"
    host: str = "127.0.0.1"
    port: int = DEFAULT_PORT
    token: str | None = None
    domain: int = 0


def run_surrogate(
    serial: int,
    link: LinkOptions | None = None,
    *,
    seed: int = 0,
    seconds: float = float("inf"),
    say: Say = print,
) -> Motion:
    """Run a surrogate arm in wall-clock time until it is interrupted or its time is over; return what it did.

    Raises:
        InputError: a serial that is no integer >= 0; port in use.
        robotbrain.errors.MissingDependencyError: the transport needs something that is not installed.
    """
    link = link or LinkOptions()
    runtime, connect = _runtime(link)
    closing: list[Callable[[], None]] = []
    states: list[Any] = []
    try:
        from robotbrain.rl.surrogate.fleet import Surrogate
        from robotbrain.rl.surrogate.node import SurrogateArmNode

        fleet = Surrogate(serial, seed=seed)
        runtime.make(lambda: SurrogateArmNode(fleet, lambda f: states.append((f.elapsed_steps, f.qpos[0]))))
        closing.append(connect(True, say))
        try:
            runtime.run(lambda: False, seconds)
        except KeyboardInterrupt:
            say("interrupted")
    finally:
        for close in reversed(closing):
            close()
        runtime.close()
    say(f"after {fleet.elapsed_steps * fleet.step_s:.1f} s the surrogate ends")
    return _motion(f"surrogate {serial}", fleet, states)


def _motion(label: str, fleet: Any, states: Sequence[tuple[int, Any]]) -> Motion:
    """Resample (physics step, qpos) to 25 Hz."""
    from robotbrain.rl.view import Motion

    states = states or [(0, fleet.qpos[0])]
    steps = np.array([s for s, _ in states])
    grid = np.arange(0, steps[-1] + 1, max(1, round(0.04 / fleet.step_s)))
    rows = np.searchsorted(steps, grid).clip(max=len(states) - 1)
    return Motion(label, fleet.body.model, np.stack([states[i][1] for i in rows]), 0.04, trace="ee")


def run_policy(
    policy: str | Path | None,
    goals: Sequence[Sequence[float]],
    link: LinkOptions | None = None,
    *,
    options: NodeOptions | None = None,
    mjcf: str | Path | None = None,
    site: str = "ee",
    seconds_per_goal: float = 3.0,
    patience_s: float = 30.0,
    say: Say = print,
) -> int:
    """Run a policy against the arm on the other end, one goal after the other; return the number of commands sent.

    Args:
        policy: ONNX file; None for the shipped reaching policy.
        goals: places in the base frame (m), each (x, y, z).
        link: how to reach the arm.
        options: of the node.
        mjcf, site: see :func:`make_policy_node`.
        seconds_per_goal: (s).
        patience_s: wait so long for joint states (s).
        say: prints a line.

    Raises:
        InputError: the policy cannot run on the arm, or a goal is no place.
        RobotBrainError: no joint states came.
    """
    places = np.asarray(goals, float)
    if places.ndim != 2 or places.shape[1] != 3 or not np.isfinite(places).all():
        raise InputError("goals", given=goals, expected="places (x, y, z) in m", fix="Try --goal 0.5 0.2 0.4.")
    link = link or LinkOptions()
    runtime, connect = _runtime(link)
    closing: list[Callable[[], None]] = []
    try:
        closing.append(connect(False, say))
        node = runtime.make(lambda: make_policy_node(policy, options, mjcf, site))
        sender: Any = None

        def make_sender() -> Any:
            nonlocal sender
            from geometry_msgs.msg import PoseStamped
            from rclpy.node import Node

            sender = Node("goals")
            sender.goal_publisher = sender.create_publisher(PoseStamped, "goal_pose", 1)
            return sender

        runtime.make(make_sender)
        if not runtime.run(lambda: node.ready, patience_s):
            raise RobotBrainError(f"no joint states within {patience_s:g} s: does the arm run, on this transport?")
        for goal in places:
            say(f"goal: {goal.tolist()} m")
            sender.goal_publisher.publish(_pose(goal, node.options.base_frame))
            began = node.commands, time.monotonic()
            runtime.run(lambda: False, seconds_per_goal)
            rate = (node.commands - began[0]) / (time.monotonic() - began[1])
            say(
                f"{rate:.1f} commands a second; {node.stale_periods} times without joint states, {node.refused} refused"
            )
        return int(node.commands)
    finally:
        for close in reversed(closing):
            close()
        runtime.close()


def make_policy_node(
    policy: str | Path | None,
    options: NodeOptions | None = None,
    mjcf: str | Path | None = None,
    site: str = "ee",
) -> Any:
    """Return a policy node with an arm's joint limits and forward kinematics.

    Args:
        policy: ONNX file; None for the shipped reaching policy.
        options: of the node.
        mjcf: file of the arm's model, its base at the origin; None for the kit's arm.
        site: of the model that reaches.

    Raises:
        InputError: no such file, or a policy for another robot.
    """
    import mujoco

    from robotbrain.rl.deployment import joint_order
    from robotbrain.rl.gap import shipped_policy
    from robotbrain.rl.onnx_policy import OnnxPolicy
    from robotbrain.rl.policy_node import PolicyNode
    from robotbrain.rl.surrogate.body import Kinematics, load_body, read_body

    loaded = OnnxPolicy(policy or shipped_policy())
    if mjcf is None:
        body = load_body("arm")
    else:
        try:
            model = mujoco.MjModel.from_xml_path(str(mjcf))
            carrier = model.body(int(model.site(site).bodyid[0])).name
        except (ValueError, KeyError) as error:
            raise InputError(
                "--mjcf", given=str(mjcf), expected=f"MJCF with a site {site!r}", fix=str(error)
            ) from error
        body = read_body(model, carrier)
    order = joint_order(loaded.meta.joint_names, body.joint_names)
    back, hand = np.argsort(order), Kinematics(body, site)
    return PolicyNode(loaded, body.limits[order], lambda q: hand(q[:, back]), options)


def _pose(place: Any, frame: str) -> Any:
    from geometry_msgs.msg import PoseStamped

    msg = PoseStamped()
    msg.header.frame_id = frame
    msg.pose.position.x, msg.pose.position.y, msg.pose.position.z = (float(v) for v in place)
    msg.pose.orientation.w = 1.0
    return msg


def _runtime(link: LinkOptions) -> tuple[Runtime, Callable[[bool, Say], Callable[[], None]]]:
    """Return what runs nodes, and what opens the transport (True: as the robot) and returns what closes it."""
    if link.transport == "rclpy":
        return RclpyRuntime(), lambda robot, say: lambda: None
    use_kit()
    runtime = KitRuntime()

    def connect(robot: bool, say: Say) -> Callable[[], None]:
        if link.transport == "dds":
            from robotbrain.link.dds import DdsBridge

            return DdsBridge(runtime.context, link.domain).close
        if not robot:
            from robotbrain.link.local import LinkClient

            return LinkClient(runtime.context, link.host, link.port, link.token).close
        from robotbrain.link.local import LinkServer

        server = LinkServer(runtime.context, link.host, link.port, link.token)
        host, port = server.address
        say(f"listening on {host}:{port}; token in {token_path(port)}")
        return server.close

    return runtime, connect
