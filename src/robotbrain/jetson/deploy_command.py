"""``robotbrain jetson deploy`` and ``verify``: make a bundle for a board, and check one anywhere."""

from __future__ import annotations

import argparse
import json
from collections import Counter
from pathlib import Path
from typing import Any

from robotbrain.errors import InputError
from robotbrain.jetson.commands import split_words
from robotbrain.jetson.kernels import PRECISIONS


def deploy_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``robotbrain jetson deploy``."""
    parser.epilog = (
        "Make a bundle: the network, what it must compute, and a program that builds, checks and times its engine on "
        "the board with nothing but JetPack. Copy it there, `sh run.sh`, copy the result back, and "
        "`robotbrain jetson measure --from-bundle RESULT`."
    )
    parser.add_argument("model", type=Path, metavar="MODEL.onnx", help="the network")
    parser.add_argument("--module", required=True, type=str.lower, metavar="SLUG", help="for example orin-nano-8gb")
    parser.add_argument("--mode", help="power mode (default: the module's own)")
    parser.add_argument("--jetpack", metavar="VERSION", help="release on the board (default: the module's newest)")
    parser.add_argument("--precision", type=str.lower, choices=PRECISIONS, default="int8", help="default: int8")
    parser.add_argument(
        "--calibration",
        type=Path,
        metavar="FILE",
        help="TABLE.json of this network, or .npy/.npz inputs to calibrate it with; for INT8 without QDQ",
    )
    parser.add_argument(
        "--inputs",
        type=Path,
        metavar="FILE",
        help=".npy/.npz whose first become test vectors (default: made up)",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="BUNDLE", help="a folder, .tar.gz or .zip")
    parser.add_argument("--batch", type=int, default=1, help="inputs in one query (default: 1)")
    parser.add_argument("--seed", type=int, default=0, help="of the test vectors")
    parser.add_argument("--mean", metavar="R,G,B", help="of the normalisation, 0 to 1 (default: the kit's networks)")
    parser.add_argument("--std", metavar="R,G,B", help="of the normalisation (default: the kit's networks)")
    parser.add_argument("--classes", metavar="A,B,...", help="names of the classes, or a file with one a line")


def deploy_main(arguments: argparse.Namespace) -> int:
    """Make the bundle, verify it, and say what is in it."""
    from robotbrain.jetson.deploy import Preprocessing, make_bundle, verify_bundle
    from robotbrain.optimisation.inputs import read_inputs

    preprocessing = _preprocessing(arguments)
    normalisation = preprocessing or Preprocessing()
    mean, std = normalisation.mean, normalisation.std
    calibration: Any = arguments.calibration
    inputs = None if arguments.inputs is None else read_inputs(arguments.inputs, mean, std)
    if calibration is not None and calibration.suffix.lower() in (".npy", ".npz"):
        from robotbrain.optimisation.calibration import calibrate

        images = read_inputs(calibration, mean, std)
        calibration = calibrate(arguments.model, images, "entropy")
        inputs = images if inputs is None else inputs
    path = make_bundle(
        arguments.model,
        arguments.out,
        module=arguments.module,
        mode=arguments.mode,
        jetpack=arguments.jetpack,
        precision=arguments.precision,
        calibration=calibration,
        inputs=inputs,
        preprocessing=preprocessing,
        batch=arguments.batch,
        seed=arguments.seed,
    )
    report = verify_bundle(path)
    print(report)
    counts = Counter((found["severity"], found["message"]) for found in report.manifest["lint"]["findings"])
    for (severity, message), count in counts.items():
        print(f"  lint         {severity}, {count} x: {message}")
    print("Copy it to the board and run `sh run.sh` in it.")
    return 0


def verify_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``robotbrain jetson verify``."""
    parser.add_argument("bundle", type=Path, metavar="BUNDLE", help="a folder, .tar.gz or .zip")
    parser.add_argument("--json", action="store_true", help="print the manifest, nothing else")


def verify_main(arguments: argparse.Namespace) -> int:
    """Verify, and say what the bundle is."""
    from robotbrain.jetson.deploy import verify_bundle

    report = verify_bundle(arguments.bundle)
    print(json.dumps(report.manifest, indent=1) if arguments.json else report)
    return 0


def _preprocessing(arguments: argparse.Namespace) -> Any:
    from robotbrain.jetson.deploy import Preprocessing

    if arguments.mean is None and arguments.std is None and arguments.classes is None:
        return None
    default = Preprocessing(classes=())
    mean, std = _numbers("--mean", arguments.mean), _numbers("--std", arguments.std)
    if (mean is None) != (std is None):
        raise InputError("--mean, --std", given="one of them", expected="both or none", fix="Add the other one.")
    classes = () if arguments.classes is None else _classes(arguments.classes)
    return Preprocessing(mean or default.mean, std or default.std, classes)


def _classes(words: str) -> tuple[str, ...]:
    try:
        lines = Path(words).read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise InputError("--classes", given=words, expected="a file in UTF-8", fix="Save it so.") from error
    except (OSError, ValueError):  # no such file; a list of many names is not even a path
        return tuple(split_words(words))
    return tuple(name for line in lines if (name := line.strip()))


def _numbers(option: str, text: str | None) -> tuple[float, ...] | None:
    if text is None:
        return None
    try:
        return tuple(float(word) for word in text.split(","))
    except ValueError as error:
        raise InputError(option, given=text, expected="numbers with commas", fix="Try 0.45,0.45,0.45.") from error
