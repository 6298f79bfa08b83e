"""The ``robotbrain`` command: one table of subcommands, each loaded only when it is called.

To add one, write a module with ``add_arguments(parser)`` and ``main(arguments) -> int | None`` and name it in
:data:`COMMANDS` (``"module"``, or ``"module:prefix"`` for functions ``prefix_arguments`` and ``prefix_main``).
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Callable, Sequence
from typing import NamedTuple

from robotbrain import __version__
from robotbrain.errors import RobotBrainError


class Command(NamedTuple):
    """A subcommand: where its code is, and one line of help."""

    target: str
    help: str


COMMANDS: dict[str, Command] = {
    "demo": Command("robotbrain.demo", "grade the sample class, drive the robot, show one page"),
    "drive": Command("robotbrain.pipeline.commands:drive", "let a brain drive in worlds of your choice"),
    "robot": Command("robotbrain.link.commands:robot", "the simulated robot as a process of its own"),
    "safety": Command("robotbrain.link.commands:safety", "the safety node of a physical robot, on ROS 2"),
    "estop": Command("robotbrain.link.commands:estop", "set or release the emergency stop of such a robot"),
    "bag": Command("robotbrain.ros.bag_command:bag", "look into a recorded run, check it, make it whole"),
    "lab": Command("robotbrain.jupyter", "open JupyterLab on the course"),
    "monitor": Command("robotbrain.monitoring.commands:monitor", "watch a brain drive, or this machine"),
    "jetson": Command("robotbrain.jetson.commands:jetson", "what a network takes on a Jetson module: the twin"),
    "rl": Command("robotbrain.rl.commands:rl", "reinforcement learning: tasks, training, evaluation, export"),
    "train": Command("robotbrain.training.commands:train", "train a shipped network again"),
    "optimise": Command("robotbrain.optimisation.commands:optimise", "quantise, prune and distil a network; a sweep"),
    "grade": Command("robotbrain.grading.commands:grade", "grade one notebook and print the report"),
    "grade-class": Command("robotbrain.grading.commands:grade_class", "grade all submissions of a lab"),
    "report": Command("robotbrain.grading.reports.commands:report", "pages and tables of a graded class, exports"),
    "generate": Command("robotbrain.grading.commands:generate", "make the students' version of a lab"),
    "exchange": Command(
        "robotbrain.grading.exchange_commands:exchange", "hand labs out, take submissions in, feedback"
    ),
    "bundle": Command("robotbrain.bundle.commands:bundle", "the course as a zip for students, without the key"),
    "sample-class": Command("robotbrain.grading.commands:sample_class", "make submissions to try grading on"),
    "mutation-test": Command("robotbrain.grading.commands:mutation_test", "test the tests of a lab"),
    "assessment": Command("robotbrain.assessment.commands:assessment", "draw papers for a class, check the bank"),
    "notebooks": Command("robotbrain.notebooks", "check or fix the stored form of notebooks"),
    "doctor": Command("robotbrain.doctor.commands:doctor", "what is wrong with this installation, and how to mend it"),
}


def _load(target: str) -> tuple[Callable[[argparse.ArgumentParser], None], Callable[[argparse.Namespace], int | None]]:
    module_name, _, prefix = target.partition(":")
    module = importlib.import_module(module_name)
    start = f"{prefix}_" if prefix else ""
    return getattr(module, f"{start}{'' if prefix else 'add_'}arguments"), getattr(module, f"{start}main")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line ``argv`` (default: this process's); return the exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    parser = argparse.ArgumentParser(prog="robotbrain", description="Course and autograded labs on robot brains.")
    parser.add_argument("--version", action="version", version=f"robotbrain {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    chosen = next((w for w in words if not w.startswith("-")), None)
    run: Callable[[argparse.Namespace], int | None] | None = None
    for name, command in COMMANDS.items():
        sub = commands.add_parser(name, help=command.help, description=command.help)
        if name == chosen:
            add_arguments, run = _load(command.target)
            add_arguments(sub)
    arguments = parser.parse_args(words)
    assert run is not None  # argparse has refused every other case
    try:
        return run(arguments) or 0
    except RobotBrainError as error:
        print(f"robotbrain {chosen}: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        # Whoever read our output (`| head`) has had enough. Python would complain once more when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        print(f"robotbrain {chosen}: {error.strerror or error}: {error.filename or ''}".rstrip(": "), file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\nstopped; run the same command again to continue", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
