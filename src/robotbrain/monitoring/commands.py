"""``robotbrain monitor``: drive and look at how the brain did, or look at the machine."""

from __future__ import annotations

import argparse
from pathlib import Path


def monitor_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the subcommands of ``robotbrain monitor``."""
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    drive = actions.add_parser("drive", help="let the brain drive in one world and say how it did")
    drive.add_argument("--world", type=int, default=0, help="seed of the world (default 0)")
    drive.add_argument("--difficulty", type=float, default=0.5, help="of the world, 0 to 1 (default 0.5)")
    drive.add_argument("--robot", choices=["nominal", "surrogate"], default="nominal", help="which robot")
    drive.add_argument("--profile", default="orin-nano-8gb", help="Jetson that the brain runs on, e.g. nano-4gb:5W")
    drive.add_argument("--mode", help="its power mode (default: the module's)")
    drive.add_argument(
        "--deployment",
        choices=["small", "detector", "detector-one-thread"],
        default="small",
        help="what is charged for: the simulator's small camera and network, or a 640x480 camera with a network of "
        "ResNet-50's size, each node in a process of its own or all in one thread",
    )
    drive.add_argument("--seconds", type=float, help="stop after this much simulated time")
    drive.add_argument("--report", type=Path, metavar="FILE.html", help="write a report to this file")
    drive.add_argument("--perfetto", type=Path, metavar="FILE.json", help="write a trace for ui.perfetto.dev (or .gz)")
    drive.add_argument("--json", type=Path, metavar="FILE.json", help="write the figures as JSON")
    resources = actions.add_parser("resources", help="say what this machine is doing, what is missing, and why")
    resources.add_argument("--seconds", type=float, default=0.0, help="how long to watch, s (default: one reading)")
    resources.add_argument("--period", type=float, default=0.5, help="between readings, s (default 0.5)")


def monitor_main(arguments: argparse.Namespace) -> int:
    """Run one subcommand."""
    return _drive(arguments) if arguments.action == "drive" else _resources(arguments)


def _drive(arguments: argparse.Namespace) -> int:
    from robotbrain.files import write_text
    from robotbrain.monitoring.metrics import measure
    from robotbrain.pipeline.brain import TIME_LIMIT, drive
    from robotbrain.pipeline.devices import detector_deployment

    deployment = None
    if arguments.deployment != "small":
        deployment = detector_deployment(one_thread=arguments.deployment == "detector-one-thread")
    run = drive(
        arguments.world,
        difficulty=arguments.difficulty,
        robot=arguments.robot,
        profile=arguments.profile,
        mode=arguments.mode,
        deployment=deployment,
        time_limit=TIME_LIMIT if arguments.seconds is None else arguments.seconds,
        trace=True,
    )
    assert run.trace is not None
    summary = measure(run.trace)
    print(f"{run.reason} after {run.seconds:.1f} s and {run.path_length:.1f} m\n")
    print(summary)
    if arguments.json:
        print(f"\nfigures: {write_text(arguments.json, summary.to_json() + chr(10))}")
    if arguments.report:
        from robotbrain.monitoring.report import write_report

        print(f"\nreport: {write_report(run.trace, arguments.report)}")
    if arguments.perfetto:
        from robotbrain.monitoring.perfetto import write_perfetto

        print(f"\ntrace: {write_perfetto(run.trace, arguments.perfetto)} (open it at https://ui.perfetto.dev)")
    return 0


def _resources(arguments: argparse.Namespace) -> int:
    import time

    from robotbrain.monitoring.resources import Sampler, local_source

    began = time.monotonic()
    with Sampler(local_source(), period_s=arguments.period) as sampler:
        while True:
            # The first reading comes at once, too soon to know how busy the processors are.
            time.sleep(1.2 * arguments.period)
            reading = sampler.latest
            print(reading if reading is not None else "no reading yet", flush=True)
            if time.monotonic() - began >= arguments.seconds:
                return 0
            print()
