"""``robotbrain rl surrogate`` and ``robotbrain rl policy``: a surrogate arm, and a policy, each as a process."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from robotbrain.link.handshake import DEFAULT_PORT

if TYPE_CHECKING:
    from robotbrain.rl.surrogate.process import LinkOptions


def _link_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--transport",
        choices=["local", "rclpy", "dds"],
        default="local",
        help="local: TCP on this computer (default); rclpy: genuine ROS 2; dds: a DDS network without ROS 2",
    )
    parser.add_argument("--host", default="127.0.0.1", help="of the arm (default: this computer)")
    parser.add_argument("--port", type=int, default=DEFAULT_PORT, help=f"of the arm (default {DEFAULT_PORT})")
    parser.add_argument("--token", help="of the arm (default: the one in this user's files)")
    parser.add_argument("--domain", type=int, default=0, help="DDS domain, for --transport dds")


def surrogate_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``robotbrain rl surrogate``."""
    parser.add_argument("--serial", type=int, default=0, help="serial number of the surrogate (default 0)")
    parser.add_argument("--seed", type=int, default=0, help="of its sensors' noise (default 0)")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="end after this long")
    parser.add_argument("--html", type=Path, help="write a 3D replay to this file at the end")
    _link_arguments(parser)


def surrogate_main(arguments: argparse.Namespace) -> int:
    """Run a surrogate arm until Ctrl-C."""
    from robotbrain.link.commands import end_on_terminate
    from robotbrain.rl.surrogate.process import run_surrogate

    end_on_terminate()
    motion = run_surrogate(arguments.serial, _link(arguments), seed=arguments.seed, seconds=arguments.seconds, say=_say)
    if arguments.html:
        from robotbrain.rl.view import MotionReplay

        _say(f"replay: {MotionReplay([motion]).to_html(arguments.html)}")
    return 0


def policy_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``robotbrain rl policy``."""
    parser.add_argument("policy", type=Path, nargs="?", help="ONNX policy of the reach task (default: the shipped one)")
    parser.add_argument(
        "--goal",
        type=float,
        nargs=3,
        action="append",
        metavar=("X", "Y", "Z"),
        help="place to reach in the arm's base frame, m; more than once: one after the other",
    )
    parser.add_argument("--seconds", type=float, default=3.0, help="for each goal (default 3)")
    parser.add_argument("--on-stale", choices=["hold", "stop"], default="hold", help="when joint states stop coming")
    parser.add_argument(
        "--max-step", type=float, default=0.5, help="largest step of a joint's target, rad (default 0.5)"
    )
    parser.add_argument(
        "--mjcf", type=Path, help="model of the arm, for limits and kinematics (default: the kit's arm)"
    )
    parser.add_argument("--site", default="ee", help="site of the model that reaches (default ee)")
    parser.add_argument("--base-frame", default="base", help="frame of the goals (default base)")
    _link_arguments(parser)


def policy_main(arguments: argparse.Namespace) -> int:
    """Run a policy against an arm: a surrogate, or with ``--transport rclpy`` a physical one."""
    from robotbrain.link.commands import end_on_terminate
    from robotbrain.rl.deployment import NodeOptions
    from robotbrain.rl.surrogate.process import run_policy

    end_on_terminate()
    goals = arguments.goal or [(0.5, 0.2, 0.4), (0.4, -0.3, 0.5), (0.6, 0.0, 0.2)]
    options = NodeOptions(base_frame=arguments.base_frame, on_stale=arguments.on_stale, max_step=arguments.max_step)
    run_policy(
        arguments.policy,
        goals,
        _link(arguments),
        options=options,
        mjcf=arguments.mjcf,
        site=arguments.site,
        seconds_per_goal=arguments.seconds,
        say=_say,
    )
    return 0


def _link(arguments: argparse.Namespace) -> LinkOptions:
    from robotbrain.rl.surrogate.process import LinkOptions

    return LinkOptions(arguments.transport, arguments.host, arguments.port, arguments.token, arguments.domain)


def _say(text: str) -> None:
    print(text, flush=True)
