"""``robotbrain train``: make a shipped network again."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from robotbrain.errors import InputError


def train_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``robotbrain train``."""
    parser.add_argument("network", choices=["segmentation", "teacher", "student"], help="which network")
    parser.add_argument("--out", type=Path, help="where to write the .onnx file (default: where it is shipped)")
    parser.add_argument("--seed", type=int, default=0, help="of weights, data and order (default: the shipped one's)")
    parser.add_argument("--plain", action="store_true", help="student: without the teacher, the baseline")
    parser.add_argument("--unlabelled", type=int, help="student: images that only the teacher labels")
    parser.add_argument("--run-dir", type=Path, help="keep a checkpoint here; go on from it after an interrupt")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def train_main(arguments: argparse.Namespace) -> int:
    """Train, export and report the figures on held-out worlds."""
    if arguments.network != "student" and (arguments.plain or arguments.unlabelled is not None):
        raise InputError(
            "--plain and --unlabelled", given=arguments.network, expected="student", fix="Leave the option out."
        )
    if arguments.plain and arguments.unlabelled:
        raise InputError(
            "--unlabelled", given=arguments.unlabelled, expected="no such images with --plain",
            fix="Without a teacher, nothing can be learned from them.",
        )  # fmt: skip
    out, provenance = _train(arguments)
    print(json.dumps(provenance, indent=2))
    print(f"written to {out}")
    return 0


def _train(arguments: argparse.Namespace) -> tuple[Path, dict[str, Any]]:
    import torch

    # The nets are small, and the same bytes come out only with the same number of threads.
    torch.set_num_threads(1)
    common: dict[str, Any] = {"run_dir": arguments.run_dir, "progress": not arguments.quiet}
    if arguments.network == "segmentation":
        from robotbrain.pipeline.brain import default_model
        from robotbrain.training.segmentation import TrainConfig, train

        out = arguments.out or default_model()
        return out, train(TrainConfig(seed=arguments.seed), out, **common)
    from robotbrain.optimisation.networks import network_path
    from robotbrain.training.perception import train_student, train_teacher

    if arguments.network == "teacher":
        out = arguments.out or network_path("teacher")
        return out, train_teacher(arguments.seed, out, **common)
    out = arguments.out or network_path("student_plain" if arguments.plain else "student")
    return out, train_student(arguments.seed, out, plain=arguments.plain, unlabelled=arguments.unlabelled, **common)
