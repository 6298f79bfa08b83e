"""The robot's side of the command line.

``robotbrain robot``: the simulated robot as a process; ``robotbrain safety``: the safety node for a physical one;
``robotbrain estop``: stop the former from another terminal.
"""

from __future__ import annotations

import argparse
import signal
from pathlib import Path
from typing import Any, NoReturn

from robotbrain.errors import InputError
from robotbrain.link.handshake import DEFAULT_PORT, parse_address


def robot_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``robotbrain robot``."""
    parser.add_argument("--world", type=int, default=0, metavar="SEED", help="world to stand in (default 0)")
    parser.add_argument("--difficulty", type=float, default=0.5, help="of the world, 0 to 1 (default 0.5)")
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--surrogate", type=int, metavar="SEED", help="a surrogate: a stand-in for a physical robot")
    which.add_argument("--nominal", action="store_true", help="the nominal robot (the default)")
    parser.add_argument(
        "--transport",
        choices=["local", "rclpy", "dds"],
        default="local",
        help="local: TCP on this computer (default); rclpy: genuine ROS 2; dds: a DDS network without ROS 2",
    )
    parser.add_argument("--host", default="127.0.0.1", help="interface to listen on (default: this computer only)")
    parser.add_argument("--port", type=int, default=DEFAULT_PORT, help=f"default {DEFAULT_PORT}; 0: any that is free")
    parser.add_argument("--token", help="that brains must know (default: a new one, left in this user's files)")
    parser.add_argument("--domain", type=int, default=0, help="DDS domain, for --transport dds")
    parser.add_argument("--clock", action="store_true", help="publish /clock")
    parser.add_argument(
        "--lockstep",
        type=float,
        metavar="MS",
        help="simulated time in lockstep with the brain, with this transport latency: repeatable to the byte",
    )
    parser.add_argument("--timeout", type=float, metavar="S", help="of the watchdog (default 0.5 s)")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="end after this long")
    parser.add_argument("--html", type=Path, help="write a 3D replay to this file at the end")
    parser.add_argument("--log", type=Path, help="write commands and true states to this file, a JSON object per line")


def robot_main(arguments: argparse.Namespace) -> int:
    """Run the robot until Ctrl-C."""
    from robotbrain.errors import InputError
    from robotbrain.link.robot import RobotOptions, run_robot

    if arguments.token == "":
        raise InputError("--token", given="nothing", expected="a word", fix="Leave the option out for a random one.")
    if arguments.lockstep is not None and not arguments.lockstep > 0:
        raise InputError("--lockstep", given=arguments.lockstep, expected="a latency > 0, ms", fix="Try --lockstep 1.")
    end_on_terminate()
    options = RobotOptions(
        world=arguments.world,
        difficulty=arguments.difficulty,
        surrogate=arguments.surrogate,
        transport=arguments.transport,
        host=arguments.host,
        port=arguments.port,
        token=arguments.token,
        domain=arguments.domain,
        clock_topic=arguments.clock,
        lockstep_ms=arguments.lockstep,
        seconds=arguments.seconds,
        log=arguments.log,
        safety={} if arguments.timeout is None else {"timeout_s": arguments.timeout},
    )

    def finish(robot: Any) -> None:
        if arguments.html:
            print(f"replay: {robot.replay.to_html(arguments.html)}", flush=True)

    run_robot(options, lambda text: print(text, flush=True), finish)
    return 0


def safety_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``robotbrain safety``."""
    parser.add_argument("--description", type=Path, help="TOML file of the robot; its table [safety] has the limits")


def safety_main(arguments: argparse.Namespace) -> int:
    """Run the safety node on genuine ROS 2, on the robot's own computer, until Ctrl-C."""
    from robotbrain.link.description import RobotDescription, load_description
    from robotbrain.link.runtime import RclpyRuntime

    end_on_terminate()
    robot = load_description(arguments.description) if arguments.description else RobotDescription()
    runtime = RclpyRuntime(robot.ros_arguments())
    try:
        from robotbrain.pipeline.nodes.safety import SafetyNode, limits_from

        limits = limits_from(robot.safety)
        runtime.make(lambda: SafetyNode(limits))
        print(f"cmd_vel becomes cmd_vel_safe; {limits}", flush=True)
        runtime.run(lambda: False)
    except KeyboardInterrupt:
        print("interrupted")
    finally:
        runtime.close()
    return 0


def estop_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``robotbrain estop``."""
    parser.add_argument("--release", action="store_true", help="let the robot move again")
    parser.add_argument("--address", default=f"127.0.0.1:{DEFAULT_PORT}", help="of the robot, host:port")
    parser.add_argument("--token", help="of the robot (default: the one it left in this user's files)")


def estop_main(arguments: argparse.Namespace) -> int:
    """Call the robot's emergency-stop service."""
    from robotbrain.link.estop import emergency_stop

    host, port = parse_address(arguments.address)
    print(emergency_stop(not arguments.release, host, port, arguments.token))
    return 0


def end_on_terminate() -> None:
    """Let SIGTERM end this process as Ctrl-C does: robot stopped, files closed."""

    def interrupt(*_: object) -> NoReturn:
        raise KeyboardInterrupt

    try:
        signal.signal(signal.SIGTERM, interrupt)
    except ValueError:
        raise InputError(
            "command", given="a thread", expected="the main thread", fix="Call it from the main thread."
        ) from None
