"""``robotbrain train``: make a shipped network again."""

from __future__ import annotations

import argparse
import json
from pathlib import Path


def train_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``robotbrain train``."""
    parser.add_argument("network", choices=["segmentation"], help="which network")
    parser.add_argument("--out", type=Path, help="where to write the .onnx file (default: where it is shipped)")
    parser.add_argument("--seed", type=int, default=0, help="of weights, data and order (default: the shipped one's)")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def train_main(arguments: argparse.Namespace) -> int:
    """Train, export and report the figure on held-out worlds."""
    from robotbrain.pipeline.brain import default_model
    from robotbrain.training.segmentation import TrainConfig, train

    out = arguments.out or default_model()
    provenance = train(TrainConfig(seed=arguments.seed), out, progress=not arguments.quiet)
    print(json.dumps(provenance, indent=2))
    print(f"written to {out}")
    return 0
