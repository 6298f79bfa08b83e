"""The same brain on five Jetsons: success, end-to-end latency, control rate and energy over unseen worlds.

Usage: python benchmarks/devices.py [--first 8000] [--count 20]
"""

from __future__ import annotations

import argparse
import sys

from tqdm import tqdm

from robotbrain.pipeline import devices


def main() -> None:
    """Print one table: one thread for all nodes on each Jetson, then a process per node on the smallest."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=8000, help="first world")
    parser.add_argument("--count", type=int, default=20, help="worlds")
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.count)
    total = (len(devices.DEVICES) + 1) * len(seeds)
    with tqdm(total=total, unit="drive", file=sys.stderr, disable=None) as bar:

        def progress(_run: object) -> None:
            bar.update()

        found = devices.compare_devices(seeds, label="one thread", progress=progress)
        apart = devices.detector_deployment(one_thread=False)
        found += devices.compare_devices(
            seeds, devices.DEVICES[:1], deployment=apart, label="node by node", progress=progress
        )
    print(devices.table(found))
    for summary in found:
        if summary.reasons:
            print(f"{summary.profile} {summary.power_mode} {summary.label}: " + "; ".join(summary.reasons))


if __name__ == "__main__":
    main()
