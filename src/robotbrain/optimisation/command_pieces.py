"""What the subcommands of ``robotbrain optimise`` share."""

from __future__ import annotations

import argparse
from typing import Any

from robotbrain.jetson.tables import short


def budget_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that say how much training may cost."""
    parser.add_argument("--train-images", type=positive, default=1500, metavar="N", help="(default: 1500)")
    parser.add_argument(
        "--epochs",
        type=positive,
        default=3,
        metavar="N",
        help="of a training with zeros in the weights, half of one after channels were removed (default: 3)",
    )


def budget(arguments: argparse.Namespace) -> Any:
    """Return the Budget of :func:`budget_arguments`."""
    from robotbrain.optimisation.recipe import Budget

    return Budget(images=arguments.train_images, epochs=arguments.epochs, channel_epochs=2 * arguments.epochs)


def positive(word: str) -> int:
    """Return an option's number of 1 or more, for ``type=``."""
    try:
        value = int(word)
    except ValueError:
        value = 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"{word!r} is not a whole number of at least 1")
    return value


def kb(size: int) -> str:
    """Return a number of bytes in kB."""
    return f"{short(size / 1e3)} kB"
