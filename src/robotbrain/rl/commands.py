"""``robotbrain rl``: the table of its subcommands, each loaded only when it is called."""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Callable
from typing import Any, NamedTuple


class Subcommand(NamedTuple):
    """Where a subcommand's ``<prefix>_arguments`` and ``<prefix>_main`` are, and one line of help."""

    module: str
    prefix: str
    help: str


SUBCOMMANDS: dict[str, Subcommand] = {
    "list": Subcommand("commands_list", "list", "the tasks, or the terms of one"),
    "train": Subcommand("commands_train", "train", "train a policy; the same command again goes on"),
    "resume": Subcommand("commands_train", "resume", "go on with a training"),
    "evaluate": Subcommand("commands_policy", "evaluate", "try a policy on episodes that it was not trained on"),
    "export": Subcommand("commands_policy", "export", "write a trained policy as ONNX"),
    "export-isaaclab": Subcommand("isaaclab.commands", "export_isaaclab", "write a task for Isaac Lab"),
    "watch": Subcommand("view", "watch", "see a policy move, in a browser"),
    "surrogate": Subcommand("surrogate.commands", "surrogate", "a surrogate arm as a process, behind ROS 2 topics"),
    "policy": Subcommand("surrogate.commands", "policy", "run a policy on such an arm, or on a physical one"),
    "gap": Subcommand("gap", "gap", "how much worse policies are on the surrogate robot than in simulation"),
}


class _LazyParser(argparse.ArgumentParser):
    """A parser that asks a subcommand's module for its arguments when it is used, not when it is made."""

    subcommand: Subcommand | None = None

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Add the arguments, then parse (see argparse)."""
        if self.subcommand is not None:
            chosen, self.subcommand = self.subcommand, None
            module = importlib.import_module(f"robotbrain.rl.{chosen.module}")
            getattr(module, f"{chosen.prefix}_arguments")(self)
            self.set_defaults(rl_main=getattr(module, f"{chosen.prefix}_main"))
        return super().parse_known_args(args, namespace)


def rl_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the subcommands of ``robotbrain rl``."""
    parser.description = "Reinforcement learning: tasks, training, evaluation, export and the step to a robot."
    subparsers = parser.add_subparsers(dest="rl_command", metavar="SUBCOMMAND", required=True, parser_class=_LazyParser)
    for name, subcommand in SUBCOMMANDS.items():
        sub: _LazyParser = subparsers.add_parser(name, help=subcommand.help, description=subcommand.help)
        sub.subcommand = subcommand


def rl_main(arguments: argparse.Namespace) -> int:
    """Run the chosen subcommand."""
    run: Callable[[argparse.Namespace], int | None] = arguments.rl_main
    return run(arguments) or 0
