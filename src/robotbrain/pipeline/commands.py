"""``robotbrain drive``: let the brain drive in worlds of your choice, from the terminal."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


def _detector(one_thread: bool) -> Any:
    from robotbrain.pipeline.devices import detector_deployment

    return detector_deployment(one_thread=one_thread)


_DEPLOYMENTS: dict[str, Callable[[], Any]] = {
    "small": lambda: None,
    "detector-one-thread": lambda: _detector(one_thread=True),
    "detector": lambda: _detector(one_thread=False),
}


def _p99(values: NDArray[np.float64]) -> str:
    return f"{np.percentile(values, 99):.0f} ms" if len(values) else "unknown"


def drive_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``robotbrain drive``."""
    parser.add_argument("--seeds", default="0", help="worlds to drive in: one seed, or a range such as 0:100")
    parser.add_argument("--difficulty", type=float, default=0.5, help="of the worlds, 0 to 1 (default 0.5)")
    parser.add_argument("--robot", choices=["nominal", "surrogate"], default="nominal", help="which robot")
    parser.add_argument("--profile", default="orin-nano-8gb", help="Jetson that the brain runs on, e.g. nano-4gb:5W")
    parser.add_argument("--mode", help="its power mode (default: the module's)")
    parser.add_argument(
        "--deployment",
        choices=sorted(_DEPLOYMENTS),
        default="small",
        help="what is charged for: the simulator's small camera and network, or a 640x480 camera with a network of "
        "ResNet-50's size, with all nodes in one thread or each in a process of its own",
    )
    parser.add_argument("--html", type=Path, help="write a 3D replay of the last run to this file")


def drive_main(arguments: argparse.Namespace) -> int:
    """Drive, one line a run, and a summary."""
    from robotbrain.errors import InputError
    from robotbrain.pipeline.brain import drive

    first, _, last = arguments.seeds.partition(":")
    try:
        seeds = range(int(first), int(last) if last else int(first) + 1)
    except ValueError:
        seeds = range(0)
    if not seeds or seeds.start < 0:
        raise InputError("--seeds", given=arguments.seeds, expected="a seed or FIRST:END", fix="Try --seeds 0:10.")
    successes = 0
    for seed in seeds:
        run = drive(
            seed,
            difficulty=arguments.difficulty,
            robot=arguments.robot,
            profile=arguments.profile,
            mode=arguments.mode,
            deployment=_DEPLOYMENTS[arguments.deployment](),
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
