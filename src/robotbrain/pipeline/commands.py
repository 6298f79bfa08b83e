"""``robotbrain drive``: let the brain drive in worlds of your choice, from the terminal."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robotbrain.errors import InputError
from robotbrain.jetson.kernels import PRECISIONS

if TYPE_CHECKING:
    from robotbrain.pipeline.deployment import Deployment


def _detector(one_thread: bool) -> Any:
    from robotbrain.pipeline.devices import detector_deployment

    return detector_deployment(one_thread=one_thread)


_DEPLOYMENTS: dict[str, Callable[[], Any]] = {
    "small": lambda: None,
    "detector-one-thread": lambda: _detector(one_thread=True),
    "detector": lambda: _detector(one_thread=False),
}


def _deployment(name: str, network: Path | None, precision: str | None) -> Deployment | None:
    """Return how the brain is put onto its Jetson; None, the default way, unless something was asked for.

    Raises:
        InputError: for a network that is none for this robot's camera and classes.
    """
    from robotbrain.pipeline.deployment import Deployment

    chosen: Deployment | None = _DEPLOYMENTS[name]()
    if network is None and precision is None:
        return chosen
    chosen = chosen or Deployment()
    if network is not None:
        _check_network(network)
        chosen = replace(chosen, network=None)  # the one that runs is charged for, in every deployment
    return chosen if precision is None else replace(chosen, precision=precision)


def _check_network(path: Path) -> None:
    from robotbrain.jetson.engine import OnnxEngine
    from robotbrain.pipeline.segmentation import CLASSES, preprocess
    from robotbrain.sim.camera import CameraIntrinsics

    camera = CameraIntrinsics.from_fov()
    answer = OnnxEngine(path).infer(preprocess(np.zeros((camera.height, camera.width, 3), np.uint8)))
    wanted = (1, len(CLASSES), camera.height, camera.width)
    if answer.shape != wanted:
        raise InputError(
            "--network",
            given=f"an output of shape {answer.shape}",
            expected=f"logits {wanted} of the classes {', '.join(CLASSES)}",
            fix="Give a segmentation network made for this robot (`robotbrain train student`).",
        )


def _p99(values: NDArray[np.float64]) -> str:
    return f"{np.percentile(values, 99):.0f} ms" if len(values) else "unknown"


def drive_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``robotbrain drive``."""
    parser.add_argument("--seeds", default="0", help="worlds to drive in: one seed, or a range such as 0:100")
    parser.add_argument("--difficulty", type=float, default=0.5, help="of the worlds, 0 to 1 (default 0.5)")
    parser.add_argument(
        "--robot",
        choices=["nominal", "surrogate", "ros"],
        default="nominal",
        help="which robot: simulated here, or (ros) one in another process or a physical one, in wall-clock time",
    )
    parser.add_argument("--profile", default="orin-nano-8gb", help="Jetson that the brain runs on, e.g. nano-4gb:5W")
    parser.add_argument("--mode", help="its power mode (default: the module's)")
    parser.add_argument(
        "--deployment",
        choices=sorted(_DEPLOYMENTS),
        default="small",
        help="what is charged for: the simulator's small camera and network, or a 640x480 camera with a network of "
        "ResNet-50's size, with all nodes in one thread or each in a process of its own",
    )
    parser.add_argument(
        "--network",
        type=Path,
        metavar="FILE",
        help="ONNX file of the segmentation network that the brain runs, and whose latency it is charged for",
    )
    parser.add_argument(
        "--precision",
        choices=PRECISIONS,
        help="that the network's latency is charged for (default: fp16); what it computes is what its file says",
    )
    parser.add_argument("--html", type=Path, help="write a 3D replay of the last run to this file")
    _ros_arguments(parser.add_argument_group("with --robot ros"))


def _ros_arguments(group: argparse._ArgumentGroup) -> None:
    from robotbrain.link.handshake import DEFAULT_PORT

    group.add_argument(
        "--transport",
        choices=["local", "rclpy", "dds"],
        default="local",
        help="local: `robotbrain robot` on this computer; rclpy: genuine ROS 2; dds: a DDS network without ROS 2 here",
    )
    group.add_argument("--address", default=f"127.0.0.1:{DEFAULT_PORT}", help="of the robot, host:port (local)")
    group.add_argument("--token", help="of the robot (local; default: the one it left in this user's files)")
    group.add_argument("--domain", type=int, default=0, help="DDS domain (dds)")
    group.add_argument("--description", type=Path, help="TOML file that describes the robot (default: the kit's)")
    group.add_argument("--use-sim-time", action="store_true", help="take the time from /clock")
    group.add_argument("--no-preflight", action="store_true", help="drive without checking rates, frames and clocks")
    group.add_argument("--time-limit", type=float, default=120.0, help="end the drive after this long, s")
    group.add_argument("--bag", type=Path, help="record all topics to a rosbag2 folder of this name")
    group.add_argument("--decisions", type=Path, help="write commands, plans and goals to this file, as JSON lines")
    group.add_argument(
        "--part",
        action="append",
        default=[],
        metavar="ROLE=FILE:CLASS",
        help="a node of your own, from a .py file or a notebook",
    )


def _drive_ros(arguments: argparse.Namespace) -> int:
    """Drive a robot outside this process."""
    from robotbrain.link.commands import end_on_terminate
    from robotbrain.link.description import RobotDescription, load_description
    from robotbrain.link.handshake import parse_address
    from robotbrain.link.parts import load_part
    from robotbrain.link.runtime import use_kit
    from robotbrain.pipeline.remote import RemoteOptions, drive_remote

    end_on_terminate()
    host, port = parse_address(arguments.address)
    options = RemoteOptions(
        transport=arguments.transport,
        host=host,
        port=port,
        token=arguments.token,
        domain=arguments.domain,
        follow_clock=arguments.use_sim_time,
        preflight=not arguments.no_preflight,
        time_limit=arguments.time_limit,
        bag=arguments.bag,
        decisions=arguments.decisions,
    )
    robot = load_description(arguments.description) if arguments.description else RobotDescription()
    if arguments.transport != "rclpy":
        use_kit()  # before the files of --part import rclpy
    parts = dict(load_part(spec) for spec in arguments.part)
    run = drive_remote(options, robot, parts=parts, say=lambda text: print(text, flush=True))
    print(f"{run.reason}, after {run.seconds:.1f} s and {run.commands} commands")
    if run.decisions:
        print("  decisions: " + ", ".join(f"{topic} {count}" for topic, count in run.decisions.items()))
    for topic, (count, mean, worst, dropped) in run.links.items():
        print(f"  {topic}: {count} messages, {mean:.2f} ms old on arrival (worst {worst:.1f}), {dropped} dropped")
    if run.pace:
        print(f"pace: {run.pace}")
    if run.log_sha256:
        print(f"decision log of the brain: {run.log_sha256}")
    return 0 if run.reached else 1


SIMULATED_ONLY = ("seeds", "difficulty", "profile", "mode", "deployment", "network", "precision", "html")
OUTSIDE_ONLY = (
    "transport",
    "address",
    "token",
    "domain",
    "description",
    "use_sim_time",
    "no_preflight",
    "time_limit",
    "bag",
    "decisions",
    "part",
)
"""Options of ``robotbrain drive`` that one kind of robot knows, and the other does not."""


def _refuse_foreign(arguments: argparse.Namespace) -> None:
    """Raise InputError for an option that would be ignored."""
    parser = argparse.ArgumentParser()
    drive_arguments(parser)
    outside = arguments.robot == "ros"
    for name in SIMULATED_ONLY if outside else OUTSIDE_ONLY:
        if getattr(arguments, name) != parser.get_default(name):
            raise InputError(
                "--" + name.replace("_", "-"),
                given=str(getattr(arguments, name)),
                expected="no such option " + ("with --robot ros" if outside else "without --robot ros"),
                fix="`robotbrain robot` takes the world of a simulated robot."
                if outside
                else "Add --robot ros, or leave it out.",
            )
    if outside and not arguments.time_limit > 0:
        raise InputError("--time-limit", given=arguments.time_limit, expected="seconds > 0", fix="120 is the default.")


def drive_main(arguments: argparse.Namespace) -> int:
    """Drive, one line a run, and a summary."""
    _refuse_foreign(arguments)
    if arguments.robot == "ros":
        return _drive_ros(arguments)
    from robotbrain.pipeline.brain import drive

    first, _, last = arguments.seeds.partition(":")
    try:
        seeds = range(int(first), int(last) if last else int(first) + 1)
    except ValueError:
        seeds = range(0)
    if not seeds or seeds.start < 0:
        raise InputError("--seeds", given=arguments.seeds, expected="a seed or FIRST:END", fix="Try --seeds 0:10.")
    deployment = _deployment(arguments.deployment, arguments.network, arguments.precision)
    successes = 0
    for seed in seeds:
        run = drive(
            seed,
            difficulty=arguments.difficulty,
            robot=arguments.robot,
            profile=arguments.profile,
            mode=arguments.mode,
            deployment=deployment,
            model=arguments.network,
        )
        successes += run.success
        print(
            f"world {seed}: {run.reason} after {run.seconds:.1f} s and {run.path_length:.1f} m,"
            f" {run.control_hz:.1f} commands a second, end-to-end latency {_p99(run.e2e_ms)} (99th percentile)"
            f" ({run.real_time_factor:.1f} x real time)",
            flush=True,
        )
    print(f"{successes} of {len(seeds)} reached the goal without touching anything")
    if arguments.html:
        print(f"replay: {run.replay().to_html(arguments.html)}")
    return 0 if successes == len(seeds) else 1
