"""``robotbrain jetson predict`` and ``compare``: what a network takes on one module, or on all of them."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotbrain.errors import InputError
from robotbrain.jetson.commands import split_words
from robotbrain.jetson.tables import format_table, short, wrap

if TYPE_CHECKING:
    from robotbrain.jetson.kernels import KernelGraph
    from robotbrain.jetson.twin import Prediction

SHOWN_KERNELS = 15
"""Kernels that ``--kernels`` lists unless a number is given."""


def _common_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "model",
        metavar="MODEL",
        help="an ONNX file, or a .json file with a list of kernels (op, macs, in_elems, out_elems, weight_elems); "
        "FILE.json#NAME takes one of several lists in a file",
    )
    parser.add_argument("--precision", default="fp16", metavar="P", help="fp32, fp16 (default) or int8")
    parser.add_argument(
        "--harness",
        default="trtexec",
        metavar="H",
        help="kind of timing to predict: trtexec (default), torch2trt, tf_to_trt, efficientvit, ultralytics, mlperf",
    )
    parser.add_argument("--batch", type=int, default=1, metavar="N", help="inputs in one inference (default: 1)")
    parser.add_argument(
        "--bind", nargs="+", action="extend", default=[], metavar="AXIS=N", help="lengths of dynamic axes, by name"
    )
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output, nothing else")
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="write a figure (.png, .svg or .pdf)")


def predict_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``robotbrain jetson predict``."""
    parser.epilog = (
        "Exit code 0 means that there is a prediction, also where its verdict is that the network runs out of memory "
        "(see fits in the JSON); 2 means that something given cannot be used."
    )
    _common_arguments(parser)
    parser.add_argument("--device", required=True, metavar="MODULE", help="for example orin-nano-8gb")
    parser.add_argument("--mode", metavar="M", help="power mode by name, alias or number (default: the module's own)")
    parser.add_argument(
        "--kernels",
        nargs="?",
        type=int,
        const=SHOWN_KERNELS,
        metavar="N",
        help=f"list the slowest kernels and what bounds them (default: {SHOWN_KERNELS})",
    )


def predict_main(arguments: argparse.Namespace) -> int:
    """Predict, and print it."""
    suffix = _plot_format(arguments.plot)
    if arguments.kernels is not None and arguments.kernels < 1:
        raise InputError("--kernels", given=arguments.kernels, expected="1 or more", fix="Leave the number out.")
    from robotbrain.jetson.twin import predict

    prediction = predict(
        read_model(arguments.model),
        arguments.device,
        mode=arguments.mode,
        precision=arguments.precision,
        harness=arguments.harness,
        batch=arguments.batch,
        bindings=parse_bindings(arguments.bind),
    )
    if arguments.json:
        data = prediction.to_dict()
        if arguments.kernels is not None:
            data["slowest_kernels"] = [_kernel_json(prediction, i) for i in _slowest(prediction, arguments.kernels)]
        print(json.dumps(data, indent=1))
    else:
        if not prediction.fits:
            print(_out_of_memory([prediction]) + "\n")
        print(prediction)
        if arguments.kernels is not None:
            print("\n" + kernel_table(prediction, arguments.kernels))
    if suffix:
        from robotbrain.jetson import plots

        _say_written(plots.save(plots.plot_prediction(prediction), arguments.plot), arguments.json)
    return 0


def compare_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``robotbrain jetson compare``."""
    _common_arguments(parser)
    parser.add_argument("--devices", metavar="A,B", help="modules (default: all)")
    parser.add_argument("--modes", default="default", metavar="WHICH", help="default (default), fastest or all")


def compare_main(arguments: argparse.Namespace) -> int:
    """Predict on each module, and print a table, fastest first."""
    suffix = _plot_format(arguments.plot)
    devices = None if arguments.devices is None else split_words(arguments.devices.lower())
    if devices is not None and not devices:
        raise InputError("--devices", given=arguments.devices, expected="modules", fix="Try --devices nano-4gb,tx2.")
    from robotbrain.jetson.twin import as_graph, compare

    graph = as_graph(read_model(arguments.model), parse_bindings(arguments.bind))
    predictions = compare(
        graph,
        devices,
        precision=arguments.precision,
        harness=arguments.harness,
        batch=arguments.batch,
        modes=arguments.modes,
    )
    predictions.sort(key=lambda p: p.latency_ms)
    first = predictions[0]
    if arguments.json:
        head = {"model": first.model, "precision": first.precision, "harness": first.harness, "batch": first.batch}
        print(json.dumps({**head, "predictions": [p.to_dict() for p in predictions]}, indent=1))
    else:
        print(
            f"{first.model}, {first.macs / 1e9:.3g} GMAC in {len(first.kernels)} kernels, batch {first.batch}, "
            f"{first.precision}, timed as by {first.harness}\n"
        )
        print(comparison_table(predictions))
        if not all(p.fits for p in predictions):
            print("\n" + _out_of_memory([p for p in predictions if not p.fits]))
        print(_notes(predictions))
    if suffix:
        from robotbrain.jetson import plots

        _say_written(plots.save(plots.plot_devices(predictions), arguments.plot), arguments.json)
    return 0


def read_model(given: str) -> str | KernelGraph:
    """Return what the twin takes: the path of an ONNX file, or the kernels that a JSON file lists.

    Args:
        given: ``FILE.onnx``, ``FILE.json`` (a list of kernels) or ``FILE.json#NAME`` (one of several lists by name).

    Raises:
        InputError: for a JSON file without such a list.
    """
    from robotbrain.jetson.kernels import KernelGraph

    name, _, chosen = given.rpartition("#") if ".json#" in given.lower() else (given, "", "")
    path = Path(name)
    if path.suffix.lower() != ".json":
        return given
    try:
        data: Any = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(
            f"kernel list {path}", given=str(error), expected="a readable JSON file", fix="Give a list of kernels."
        ) from error
    title = path.stem
    if isinstance(data, dict) and data:
        if chosen not in data:
            raise InputError(
                f"kernel list {path}",
                given=f"several lists, and the name {chosen!r}",
                expected="one of " + ", ".join(sorted(data)),
                fix=f"Name one, for example {path}#{min(data)}.",
            )
        data, title = data[chosen], chosen
    if not isinstance(data, list) or any(not isinstance(k, dict) or not isinstance(k.get("op"), str) for k in data):
        raise InputError(
            f"kernel list {path}",
            given=data,
            expected="a list of objects with op (text), macs, in_elems, out_elems and weight_elems",
            fix="Compare with autograder/profiles/calibration/kernels.json.",
        )
    return KernelGraph.from_list(data, title)


def parse_bindings(words: Sequence[str]) -> dict[str, int] | None:
    """Return lengths of dynamic axes from words like ``height=640``; None if there are none.

    Raises:
        InputError: for another form, or a length that is not a whole number of at least 1.
    """
    lengths: dict[str, int] = {}
    for word in words:
        name, equals, number = word.rpartition("=")
        if not (name and equals and number.isdecimal() and int(number) >= 1):
            raise InputError(
                "--bind", given=word, expected="AXIS=N with a whole number N, 1 or more", fix="Try --bind batch=1."
            )
        lengths[name] = int(number)
    return lengths or None


def _slowest(prediction: Prediction, count: int) -> list[int]:
    order = sorted(range(len(prediction.kernels)), key=lambda i: (-prediction.kernels[i].total_ms, i))
    return order[:count]


def _kernel_json(prediction: Prediction, index: int) -> dict[str, Any]:
    time = prediction.kernels[index]
    return {
        "index": index,
        "name": time.kernel.name,
        "op": time.kernel.op,
        "precision": time.precision,
        "latency_ms": round(time.total_ms, 5),
        "compute_ms": round(time.compute_ms, 5),
        "memory_ms": round(time.memory_ms, 5),
        "launch_ms": round(time.launch_ms, 5),
        "bound": time.bound,
        "mflop": round(time.flops / 1e6, 4),
        "mbytes": round(time.bytes_moved / 1e6, 4),
    }


def kernel_table(prediction: Prediction, count: int) -> str:
    """Return a table of the slowest kernels with what bounds them."""
    whole = prediction.fixed_ms + sum(time.total_ms for time in prediction.kernels)
    chosen = _slowest(prediction, count)
    rows: list[tuple[object, ...]] = []
    for index in chosen:
        time = prediction.kernels[index]
        rows.append(
            (
                index,
                _clip(time.kernel.name or "-", 48),
                time.kernel.op,
                time.precision,
                f"{time.total_ms:.4f}",
                f"{100 * time.total_ms / whole:.1f}",
                time.bound,
                f"{time.flops / 1e6:.1f}",
                f"{time.bytes_moved / 1e6:.2f}",
                f"{time.flops / max(1.0, time.bytes_moved):.1f}",
            )
        )
    head = ("#", "kernel", "op", "runs in", "ms", "%", "bound by", "MFLOP", "MB", "FLOP/byte")
    share = 100 * sum(prediction.kernels[i].total_ms for i in chosen) / whole
    launch = 100 * sum(time.launch_ms for time in prediction.kernels) / whole
    note = (
        f"The {len(chosen)} slowest of {len(prediction.kernels)} kernels take {share:.0f} % of the predicted time; all"
        f" launches together {launch:.0f} %, the fixed cost of an inference {100 * prediction.fixed_ms / whole:.0f} %."
    )
    return format_table(head, rows, left=(1, 2, 3, 6)) + "\n\n" + wrap(note)


def _clip(text: str, width: int) -> str:
    return text if len(text) <= width else text[: width - 3] + "..."


def comparison_table(predictions: Sequence[Prediction]) -> str:
    """Return a table of predictions."""
    head = ("module", "mode", "ms", "80 % from", "to", "per s", "MB", "W", "W at the wall", "mJ", "degC", "origin", "")
    rows = [
        (
            p.device,
            p.mode,
            short(p.latency_ms),
            short(p.latency_low_ms),
            short(p.latency_high_ms),
            short(p.throughput),
            f"{p.memory_mb:.0f}",
            f"{p.power_w:.1f}",
            f"{p.wall_power_w:.1f}",
            short(p.energy_mj),
            f"{p.temperature_c:.0f}",
            p.provenance,
            "OUT OF MEMORY" if not p.fits else "throttles" if p.throttles else "",
        )
        for p in predictions
    ]
    return format_table(head, rows, left=(0, 1, 11, 12))


def _out_of_memory(predictions: Sequence[Prediction]) -> str:
    each = "; ".join(
        f"{p.device} (needs {p.memory_mb:.0f} MB of {p.memory.available_mb:.0f} MB)"
        for p in {p.device: p for p in predictions}.values()
    )
    return wrap(f"*** OUT OF MEMORY: it does not run on {each} ***")


def _notes(predictions: Sequence[Prediction]) -> str:
    """Warnings, each once with the modules it is about."""
    about: dict[str, list[str]] = {}
    for prediction in predictions:
        for warning in prediction.warnings:
            if not warning.startswith("out of memory"):
                about.setdefault(warning, []).append(prediction.device)
    every = {p.device for p in predictions}
    lines = []
    for warning, devices in about.items():
        who = "all" if set(devices) == every else ", ".join(dict.fromkeys(devices))
        lines.append(wrap(f"{warning} ({who})", indent="  ", first="warning: "))
    return "\n" + "\n".join(lines) if lines else ""


def _plot_format(path: Path | None) -> str:
    """Check the name of a figure's file before anything is computed; return its format, empty for no figure."""
    if path is None:
        return ""
    from robotbrain.jetson.plots import check_format

    return check_format(path)


def _say_written(path: Path, quiet: bool) -> None:
    print(f"figure: {path}", file=sys.stderr if quiet else sys.stdout)
