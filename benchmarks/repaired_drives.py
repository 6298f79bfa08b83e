"""Drives of the brains that homework 3's repairs are likely to make, for grading to look up.

Without the student's own planner a run depends on the deployment alone, and most students deploy alike. With it, and
all on one thread, it hardly matters on the slower module: even one that takes next to no time leaves it too slow. Run
this again when the pipeline, a profile or the simulation changes; tests/test_hw3_performance.py drives some of them
again.

    python benchmarks/repaired_drives.py autograder/reference/hw3_performance_drives.json
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
from collections.abc import Iterator
from pathlib import Path

from tqdm import tqdm

from robotbrain.files import write_text
from robotbrain.grading.suites.hw3_performance_drives import NANO, NX, TIME_LIMIT, driven, free_planner, key_of
from robotbrain.pipeline.inherited import BrainSetup, cropped_planner, inherited_brain, whole_map_planner

DRIVES = ((NANO, 1, TIME_LIMIT), (NANO, 4, TIME_LIMIT), (NX, 3, 4.0))
"""Module, world and time limit (s) that the tests drive with."""


def likely_drives() -> Iterator[tuple[BrainSetup, int, float]]:
    """Yield setups that keep the requirements, with the world and time limit (s) that they drive in."""
    given = inherited_brain()
    for one_thread, precision, queue, planner, age in itertools.product(
        (False, True),
        ("int8", "fp16"),
        (1, 2, None),
        (cropped_planner, whole_map_planner, free_planner),
        (0.25, 0.5, 1.0, 1.5, 2.0),
    ):
        deployment = dataclasses.replace(
            given.deployment, image_size=(640, 480), precision=precision, camera_queue=queue, one_thread=one_thread
        )
        repaired = dataclasses.replace(given, deployment=deployment, planner=planner, replan_after=age)
        for module, world, limit in DRIVES:
            if planner is not free_planner or (one_thread and module == NX):
                yield dataclasses.replace(repaired, module=module), world, limit


def main() -> None:
    """Write the table and print how long the drives took on the modules."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("path", type=Path, help="JSON file to write")
    path = parser.parse_args().path
    drives = tqdm(list(likely_drives()), unit="drive")
    rows = [(key_of(*drive), dataclasses.asdict(driven(*drive))) for drive in drives]
    write_text(path, "[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n")
    print(f"{len(rows)} drives, {sum(run['success'] for _, run in rows)} arrived")


if __name__ == "__main__":
    main()
