"""``robotbrain optimise``: quantise, lint, prune, sweep, report, compare."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from robotbrain.errors import InputError
from robotbrain.jetson.tables import wrap
from robotbrain.optimisation.command_pieces import budget, budget_arguments, kb, positive
from robotbrain.optimisation.commands_sweep import (
    compare_arguments,
    compare_main,
    report_arguments,
    report_main,
    sweep_arguments,
    sweep_main,
)


class Subcommand(NamedTuple):
    """A subcommand: its options, what it does, one line of help."""

    arguments: Callable[[argparse.ArgumentParser], None]
    main: Callable[[argparse.Namespace], int | None]
    help: str


def optimise_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the subcommands of ``robotbrain optimise``."""
    parser.description = "Make networks smaller and faster, and say what that costs."
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = (
        "examples:\n"
        "  robotbrain optimise quantise net.onnx --out net.int8.onnx      INT8 for TensorRT, after training\n"
        "  robotbrain optimise lint net.int8.onnx --jetpack 6.2           will TensorRT take it?\n"
        "  robotbrain optimise prune --channels 0.5 --out small.onnx      half of the student's channels\n"
        "  robotbrain optimise sweep --out sweep                          25 compositions, under ten minutes\n"
        "  robotbrain optimise compare net.onnx net.int8.onnx             two files side by side\n"
    )
    subparsers = parser.add_subparsers(dest="optimise_command", metavar="SUBCOMMAND", required=True)
    for name, command in SUBCOMMANDS.items():
        sub = subparsers.add_parser(name, help=command.help, description=command.help)
        command.arguments(sub)
        sub.set_defaults(optimise_main=command.main)


def optimise_main(arguments: argparse.Namespace) -> int:
    """Run the chosen subcommand."""
    run: Callable[[argparse.Namespace], int | None] = arguments.optimise_main
    return run(arguments) or 0


# ---------------------------------------------------------------- quantise


def _quantise_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("model", type=Path, metavar="MODEL.onnx", help="a float32 network of the kit's perception task")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.onnx", help="where the INT8 network goes")
    parser.add_argument(
        "--target", default="tensorrt", metavar="T", help="tensorrt (default: symmetric, signed) or cpu (unsigned)"
    )
    parser.add_argument("--method", default="minmax", metavar="M", help="minmax (default), percentile or entropy")
    parser.add_argument("--percentile", type=float, default=99.99, metavar="P", help="for percentile (default: 99.99)")
    parser.add_argument("--per-tensor", action="store_true", help="one scale for a whole weight, not for each channel")
    parser.add_argument("--images", type=positive, default=128, metavar="N", help="to calibrate on (default: 128)")
    parser.add_argument(
        "--inputs",
        type=Path,
        metavar="FILE",
        help=".npy/.npz of own inputs, float32 (N, C, H, W) or images uint8 (N, H, W, 3), instead of the kit's images",
    )
    parser.add_argument("--exclude", nargs="+", default=[], metavar="NODE", help="nodes to leave in float32")


def _quantise_main(arguments: argparse.Namespace) -> int:
    from robotbrain.optimisation.ptq import quantise_onnx

    if arguments.inputs is None:
        from robotbrain.optimisation.data import scenes

        inputs = scenes("calibration", arguments.images, progress=True).inputs()
    else:
        from robotbrain.optimisation.inputs import read_inputs

        inputs = read_inputs(arguments.inputs)
    made = quantise_onnx(
        arguments.model,
        arguments.out,
        inputs,
        target=arguments.target,
        per_channel=not arguments.per_tensor,
        method=arguments.method,
        percentile=arguments.percentile,
        exclude=arguments.exclude,
    )
    print(f"{made.path}: INT8 for {made.target}, {made.method} over {len(inputs)} inputs, {len(made.nodes)} layers")
    if made.skipped:
        print(f"left in float32: {', '.join(made.skipped)}")
    if made.target == "tensorrt":
        print(
            wrap("The weights are still floats in this file, behind Q/DQ pairs; the engine built from it is smaller.")
        )
    return 0


# ---------------------------------------------------------------- lint


def _lint_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = "Exit code 0: TensorRT takes the file; 1: it has errors; 2: it cannot be read."
    parser.add_argument("model", type=Path, metavar="MODEL.onnx")
    parser.add_argument("--jetpack", metavar="V", help="judge it for this JetPack, for example 6.2")
    parser.add_argument("--dla", action="store_true", help="judge it for the deep learning accelerator, too")
    parser.add_argument("--json", action="store_true", help="one JSON array on standard output, nothing else")


def _lint_main(arguments: argparse.Namespace) -> int:
    from robotbrain.optimisation.qdq_lint import explain, lint

    findings = lint(arguments.model, jetpack=arguments.jetpack, dla=arguments.dla)
    if arguments.json:
        fields = ("code", "severity", "node", "message", "fix")
        print(json.dumps([{name: getattr(finding, name) for name in fields} for finding in findings], indent=1))
    else:
        print(explain(findings))
    return 1 if any(finding.severity == "error" for finding in findings) else 0


# ---------------------------------------------------------------- prune


def _prune_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Remove channels of a network, or set weights to zero, and train what is left. Removing channels makes it "
        "faster; zeros only make it compress better, and 2:4 patterns need an Ampere GPU and --sparsity=enable."
    )
    parser.add_argument("--network", default="student", metavar="N", help="teacher, student (default), student_plain")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--channels", type=float, metavar="SHARE", help="of each layer's channels to remove, e.g. 0.5")
    what.add_argument("--sparsity", metavar="SHARE", help="of the weights to set to zero, e.g. 0.8, or 2:4")
    parser.add_argument("--quantise", metavar="HOW", help="ptq or qat, afterwards")
    parser.add_argument("--no-teacher", action="store_true", help="train on the labels alone")
    parser.add_argument("--seed", type=int, default=0, metavar="N")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.onnx", help="where the network goes")
    budget_arguments(parser)


def _prune_main(arguments: argparse.Namespace) -> int:
    from robotbrain.files import write_bytes, write_text
    from robotbrain.optimisation.data import default_cache
    from robotbrain.optimisation.recipe import Recipe, apply

    if arguments.out.suffix != ".onnx":
        raise InputError("--out", given=str(arguments.out), expected="a name ending in .onnx", fix="Add the suffix.")
    recipe = Recipe(
        student=arguments.network,
        distil=not arguments.no_teacher,
        prune_channels=arguments.channels or 0.0,
        sparsity=_sparsity(arguments.sparsity),
        quantise=arguments.quantise,
        seed=arguments.seed,
    )
    if arguments.channels is not None and not recipe.prune_channels:
        raise InputError("--channels", given=arguments.channels, expected="a share above 0", fix="Half is 0.5.")
    # Steps are kept with the rendered images: the same command again only copies.
    artefact = apply(recipe, default_cache() / "recipes", budget=budget(arguments))
    write_bytes(arguments.out, artefact.onnx.read_bytes())
    facts = artefact.facts | {"onnx": arguments.out.name}
    write_text(arguments.out.with_suffix(".json"), json.dumps(facts, indent=1) + "\n")
    zeros = facts["zero_weights"] / max(1, facts["weights"])
    sizes = f"{kb(facts['size_bytes'])}, {kb(facts['gzip_bytes'])} compressed"
    print(f"{arguments.out}: {recipe.label}\n{facts['weights']} weights, {zeros:.0%} of them zero; {sizes}")
    return 0


def _sparsity(word: str | None) -> float | str | None:
    if word is None or word == "2:4":
        return word
    try:
        return float(word)
    except ValueError:
        raise InputError("--sparsity", given=word, expected="a share such as 0.8, or 2:4", fix="Half is 0.5.") from None


SUBCOMMANDS: dict[str, Subcommand] = {
    "quantise": Subcommand(_quantise_arguments, _quantise_main, "INT8 after training, calibrated on images"),
    "lint": Subcommand(_lint_arguments, _lint_main, "say what TensorRT would refuse in a quantised file, and why"),
    "prune": Subcommand(_prune_arguments, _prune_main, "remove channels or zero weights of a network, and train on"),
    "sweep": Subcommand(sweep_arguments, sweep_main, "make and judge many compositions; goes on where it was"),
    "report": Subcommand(report_arguments, report_main, "draw a sweep's figure and write its page again"),
    "compare": Subcommand(compare_arguments, compare_main, "accuracy, time and size of networks side by side"),
}
