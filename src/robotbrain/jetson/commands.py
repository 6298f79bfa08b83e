"""``robotbrain jetson``: the table of its subcommands, each loaded only when it is called."""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple


class Subcommand(NamedTuple):
    """Where a subcommand's ``<prefix>_arguments`` and ``<prefix>_main`` are, and one line of help."""

    module: str
    prefix: str
    help: str


SUBCOMMANDS: dict[str, Subcommand] = {
    "list": Subcommand("catalogue_command", "list", "the modules of the catalogue"),
    "show": Subcommand("catalogue_command", "show", "all about one module, each number with its origin"),
    "jetpack": Subcommand("catalogue_command", "jetpack", "which JetPack has which CUDA, TensorRT and ONNX opset"),
    "predict": Subcommand("predict_command", "predict", "latency, memory and power of a network on a module"),
    "compare": Subcommand("predict_command", "compare", "one network on all modules"),
    "calibrate": Subcommand("calibrate_command", "calibrate", "fit the twin to the published measurements again"),
    "reference": Subcommand("reference", "reference", "make or check the labs' reference numbers"),
    "measure": Subcommand("measure_command", "measure", "measure on a real board, or from its logs"),
    "deploy": Subcommand("deploy_command", "deploy", "bundle a network for a board: build, check and time it there"),
    "verify": Subcommand("deploy_command", "verify", "check a bundle offline: every byte, and that its parts fit"),
}


class _LazyParser(argparse.ArgumentParser):
    """A parser that asks a subcommand's module for its arguments when it is used, not when it is made."""

    subcommand: Subcommand | None = None

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Add the arguments, then parse (see argparse)."""
        if self.subcommand is not None:
            chosen, self.subcommand = self.subcommand, None
            module = importlib.import_module(f"robotbrain.jetson.{chosen.module}")
            getattr(module, f"{chosen.prefix}_arguments")(self)
            self.set_defaults(jetson_main=getattr(module, f"{chosen.prefix}_main"))
        return super().parse_known_args(args, namespace)


def jetson_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the subcommands of ``robotbrain jetson``."""
    parser.description = (
        "The Jetson twin: what a network takes on a Jetson module, and where each number comes from. "
        "Module names, power modes, precisions and harnesses are the same in upper and lower case."
    )
    subparsers = parser.add_subparsers(
        dest="jetson_command", metavar="SUBCOMMAND", required=True, parser_class=_LazyParser
    )
    for name, subcommand in SUBCOMMANDS.items():
        sub: _LazyParser = subparsers.add_parser(name, help=subcommand.help, description=subcommand.help)
        sub.subcommand = subcommand


def jetson_main(arguments: argparse.Namespace) -> int:
    """Run the chosen subcommand."""
    run: Callable[[argparse.Namespace], int | None] = arguments.jetson_main
    return run(arguments) or 0


def split_words(text: str) -> Sequence[str]:
    """Return the words of a comma-separated list in their order, each once."""
    return list(dict.fromkeys(word.strip() for word in text.split(",") if word.strip()))
