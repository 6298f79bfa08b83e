"""The student against the FP32 teacher: mIoU over three seeds, latency and size, both in ONNX Runtime at one thread.

Run: ``python benchmarks/opt_student.py [--seeds 0 1 2] [--run-dir DIR]``. Trains nine students (about half an hour on a
free core); with ``--run-dir`` it goes on after an interrupt. All take the same number of steps:

- ``plain``: 144 labelled images and no teacher: the baseline;
- ``same images``: these 144 and the teacher's opinion of them;
- ``and unlabelled``: also 2,856 images without labels, which only a teacher makes useful: what is shipped.

Figures are on the test split (1,200 images of worlds that no training and no choice has seen).
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from pathlib import Path
from typing import Any

import torch

from robotbrain.optimisation.data import scenes
from robotbrain.optimisation.evaluate import mean_iou
from robotbrain.optimisation.latency import host_latency, speedup
from robotbrain.optimisation.networks import NAMES, network_path, provenance
from robotbrain.optimisation.ptq import quantise_onnx
from robotbrain.optimisation.training import TeacherTargets, teacher_targets
from robotbrain.training.perception import TEST_IMAGES, images_of, student_recipe, train_student

VARIANTS: dict[str, dict[str, Any]] = {
    "plain": {"plain": True},
    "same images": {"unlabelled": 0},
    "and unlabelled": {},
}


def students(seeds: list[int], folder: Path) -> dict[str, list[float]]:
    """Return the test mIoU of each variant and seed, from files of ``folder`` where they are there."""
    asked: list[TeacherTargets] = []  # the teacher looks at each image once, for all seeds and variants
    figures: dict[str, list[float]] = {name: [] for name in VARIANTS}
    for seed in seeds:
        for name, options in VARIANTS.items():
            out = folder / f"{name.replace(' ', '-')}-{seed}.onnx"
            if not out.with_suffix(".json").is_file():
                if not options.get("plain") and not asked:
                    asked.append(teacher_targets(network_path("teacher"), images_of(student_recipe()), progress=True))
                train_student(seed, out, **options, targets=asked[0] if asked else None, run_dir=out.with_suffix(""))
            figures[name].append(mean_iou(out, scenes("test", TEST_IMAGES)).mean)
    return figures


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--run-dir", type=Path, help="keep trainings here and go on from them")
    parser.add_argument("--rounds", type=int, default=15, help="alternating turns of the latency (default 15)")
    options = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.run_dir or Path(temporary)
        figures = students(options.seeds, folder)
        best = mean_iou(network_path("teacher"), scenes("test", TEST_IMAGES)).mean
        print(f"\nteacher: {provenance('teacher')['parameters']} parameters, test mIoU {100 * best:.2f} %\n")
        print(f"{'student':<16}{'mIoU':>8}{'drop':>8}{'spread':>8}   of seeds {options.seeds}")
        for name, values in figures.items():
            mean, spread = statistics.mean(values), max(values) - min(values)
            each = " ".join(f"{100 * v:.2f}" for v in values)
            print(f"{name:<16}{100 * mean:>8.2f}{100 * (best - mean):>8.2f}{100 * spread:>8.2f}   {each}")

        paths = {name: network_path(name) for name in NAMES if name != "student_plain"}
        int8 = folder / "student-int8.onnx"
        quantise_onnx(network_path("student"), int8, scenes("calibration", 200).inputs())
        measured = host_latency(paths, rounds=options.rounds)
        teacher, student = measured["teacher"], measured["student"]
        size = {name: path.stat().st_size for name, path in {**paths, "INT8": int8}.items()}
        accuracy = mean_iou(int8, scenes("test", TEST_IMAGES), optimise=False).mean
        wall, processor = speedup(teacher, student), speedup(teacher, student, cpu=True)
        print(f"\nprocessor time: {teacher.cpu_ms:.2f} ms / {student.cpu_ms:.3f} ms, {processor:.1f} times faster")
        print(f"wall clock: {teacher.median_ms:.2f} ms / {student.median_ms:.3f} ms, {wall:.1f} times")
        if wall > 1.3 * processor:
            print("  the machine is busy: a longer inference is interrupted more often; quote the processor time")
        print(
            f"size: {size['teacher']} / {size['student']} bytes, {size['teacher'] / size['student']:.1f} times smaller"
        )
        ratio, drop = size["teacher"] / size["INT8"], 100 * (best - accuracy)
        print(f"shipped student after INT8 PTQ: {size['INT8']} bytes, {ratio:.1f} times smaller, drop {drop:.2f}")


if __name__ == "__main__":
    main()
