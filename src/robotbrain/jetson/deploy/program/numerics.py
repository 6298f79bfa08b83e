"""Whether the engine computes what the network computes: its outputs against the bundle's expected ones."""

import array
import json
import math
import re
import sys
from pathlib import Path
from typing import Any

from .problem import Refused
from .trtexec import Trtexec, quoted, run, shape_flags


def check(
    program: Trtexec, manifest: "dict[str, Any]", folder: Path, work: Path, engine: Path
) -> "list[dict[str, Any]]":
    """Return the errors of each vector and output.

    Raises:
        Refused: if one is above the tolerance of the bundle.
    """
    rows = []  # type: list[dict[str, Any]]
    for index, vector in enumerate(manifest["numerics"]["vectors"]):
        answer = work / f"outputs_{index}.json"
        # Relative: a comma or colon in the path would end it.
        inputs = ",".join(quoted(name) + ":" + file for name, file in vector["inputs"].items())
        command = [program.path, "--loadEngine=" + str(engine), *shape_flags(manifest["network"])]
        command += ["--loadInputs=" + inputs]
        command += ["--iterations=1", "--duration=0", "--warmUp=0", "--exportOutput=" + str(answer)]
        try:
            run(command, work / f"numerics_{index}.log", f"check {index + 1}", folder)
            outputs = read_outputs(answer)
        finally:
            if answer.exists():
                answer.unlink()
        for name, expected in vector["outputs"].items():
            if name not in outputs:
                raise Refused("outputs of the engine", sorted(outputs), name, "Was the engine built from this ONNX?")
            row = compare(outputs[name], (folder / expected["file"]).read_bytes(), expected["shape"])
            rows.append(dict(row, vector=index, output=name))
            judge(rows[-1], manifest["numerics"])
    return rows


def read_outputs(path: Path) -> "dict[str, list[float]]":
    """Return the values of each output in trtexec's --exportOutput.

    Raises:
        Refused: if it is none.
    """
    try:
        text = re.sub(r"(?<![\w.\"])-?(?:nan|inf)\b", "NaN", path.read_text(encoding="utf-8"))
        return {str(entry["name"]): list(map(float, entry["values"])) for entry in json.loads(text)}
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise Refused("trtexec --exportOutput", error, "outputs as JSON", "See the log beside the result.") from error


def compare(values: "list[float]", expected: bytes, shape: "list[int]") -> "dict[str, float]":
    """Return the errors of one output: rms, peak (both relative), agreement of the largest class (axis 1), positions.

    Args:
        values: of the engine, in C order.
        expected: little-endian float32 in C order.
        shape: of the output.

    Raises:
        Refused: if there are not as many values, or some are not finite.
    """
    right = array.array("f", expected)
    if sys.byteorder == "big":
        right.byteswap()
    if len(values) != len(right):
        raise Refused("output", f"{len(values)} values", f"{len(right)} ({shape})", "Is it the right engine?")
    if not all(map(math.isfinite, values)):
        raise Refused("output", "NaN or infinity", "finite values", "The precision overflows: try another one.")
    errors = [a - b for a, b in zip(values, right)]  # noqa: B905  (3.6)
    size, peak = math.fsum(b * b for b in right), max(map(abs, right))
    positions, agreement = _agreement(values, right, shape)
    return {
        "rms": math.sqrt(math.fsum(e * e for e in errors) / (size or 1.0)),
        "peak": max(map(abs, errors)) / (peak or 1.0),
        "agreement": agreement,
        "positions": positions,
    }


def _agreement(found: "list[float]", right: "array.array[float]", shape: "list[int]") -> "tuple[int, float]":
    """Return how many positions there are, and the share of them at which both have the same largest class."""
    batch, classes = (shape[0], shape[1]) if len(shape) > 1 else (1, 1)
    inner = len(right) // (batch * classes)  # positions of one input
    same = 0
    for start in range(0, len(right), classes * inner):
        for position in range(start, start + inner):
            rows = range(position, position + classes * inner, inner)
            same += max(rows, key=found.__getitem__) == max(rows, key=right.__getitem__)
    return batch * inner, same / (batch * inner)


def judge(row: "dict[str, Any]", allowed: "dict[str, Any]") -> None:
    """Refuse errors above the tolerance; one position may always differ, for a tie falls either way.

    Raises:
        Refused: naming the figure.
    """
    flipped = round((1 - row["agreement"]) * row["positions"])
    for name, bad in (
        ("rms", row["rms"] > allowed["rms"]),
        ("peak", row["peak"] > allowed["peak"]),
        ("agreement", row["agreement"] < allowed["agreement"] and flipped > 1),
    ):
        if bad:
            sign = "at least" if name == "agreement" else "at most"
            fix = "The engine does not compute what the network does: build it in fp32 or fp16 to find the cause."
            where = "numerics of output {}, vector {}: {}".format(row["output"], row["vector"], name)
            raise Refused(where, f"{row[name]:.4g}", f"{sign} {allowed[name]:g}", fix)
