"""Calibration: run a network on typical inputs and note what range each of its tensors takes.

The result is a table from tensor name to range, kept as JSON. It can also be written in the text format of TensorRT's
calibration cache. Those caches belong to *implicit* quantisation, which TensorRT deprecates since 10.1 in favour of
Q/DQ nodes in the model (https://docs.nvidia.com/deeplearning/tensorrt/api/c_api/deprecated.html) and which 11, being
strongly typed only, no longer has; up to 10.x a cache still works (``trtexec --int8 --calib=FILE``), and it is what
DLA builds have been made with. For everything else write Q/DQ: :mod:`robotbrain.optimisation.ptq`.
"""

from __future__ import annotations

import hashlib
import json
import re
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robotbrain.errors import InputError
from robotbrain.files import write_text
from robotbrain.jetson.engine.plan import onnx_digest
from robotbrain.optimisation.affine import choose_qparams
from robotbrain.optimisation.observers import (
    METHODS,
    EntropyObserver,
    Histogram,
    MinMaxObserver,
    Observer,
    PercentileObserver,
    make_observer,
)
from robotbrain.optimisation.onnx_files import batches, check_feed, read_model, session

__all__ = [
    "METHODS",
    "CalibrationTable",
    "EntropyObserver",
    "Histogram",
    "MinMaxObserver",
    "Observer",
    "PercentileObserver",
    "calibrate",
    "calibrate_model",
    "parse_tensorrt_cache",
]

_FORMAT = "robotbrain calibration 1"


@dataclass(frozen=True)
class CalibrationTable:
    """What range each tensor takes.

    Attributes:
        method: minmax, percentile or entropy.
        ranges: tensor name -> (low, high), finite, low <= high.
        samples: that were run.
        percentile: that was kept, per cent; None for other methods.
        model_sha256: of the model file, with weights beside it (``plan.onnx_digest``); empty if it was no file.
        inputs_sha256: of the calibration inputs.
    """

    method: str
    ranges: Mapping[str, tuple[float, float]]
    samples: int
    percentile: float | None = None
    model_sha256: str = ""
    inputs_sha256: str = ""

    def __post_init__(self) -> None:
        ranges = {str(name): (float(low), float(high)) for name, (low, high) in self.ranges.items()}
        for name, (low, high) in ranges.items():
            if not (np.isfinite(low) and np.isfinite(high) and low <= high):
                raise InputError(
                    f"range of {name!r}",
                    given=(low, high),
                    expected="finite numbers, low <= high",
                    fix="Calibrate again; NaN means that the network or its inputs are broken.",
                )
        object.__setattr__(self, "ranges", ranges)

    def scale(self, name: str) -> float:
        """Return the INT8 scale of a tensor as TensorRT defines it: the largest magnitude / 127.

        Raises:
            InputError: for a tensor that is not in the table.
        """
        low, high = self.range(name)
        return float(choose_qparams(low, high, symmetric=True).scale)

    def range(self, name: str) -> tuple[float, float]:
        """Return (low, high) of a tensor.

        Raises:
            InputError: for a tensor that is not in the table.
        """
        if name not in self.ranges:
            raise InputError(
                "calibration table",
                given=f"no tensor {name!r}",
                expected=f"a range for it; the table has {len(self.ranges)} tensors",
                fix="The table was made with another model: calibrate again.",
            )
        return self.ranges[name]

    def merged(self, groups: Iterable[Iterable[str]]) -> CalibrationTable:
        """Return the table with one common range for the tensors of each group: the union of theirs.

        Raises:
            InputError: for a tensor that is not in the table.
        """
        ranges = dict(self.ranges)
        for group in groups:
            names = list(group)
            lows, highs = zip(*(self.range(name) for name in names), strict=True)
            ranges.update(dict.fromkeys(names, (min(lows), max(highs))))
        return CalibrationTable(
            self.method, ranges, self.samples, self.percentile, self.model_sha256, self.inputs_sha256
        )

    def save(self, path: str | Path) -> Path:
        """Write the table as JSON, whole or not at all; return the path."""
        content = {
            "format": _FORMAT,
            "method": self.method,
            "percentile": self.percentile,
            "samples": self.samples,
            "model_sha256": self.model_sha256,
            "inputs_sha256": self.inputs_sha256,
            "ranges": {name: list(self.ranges[name]) for name in sorted(self.ranges)},
        }
        return write_text(path, json.dumps(content, indent=1) + "\n")

    @classmethod
    def load(cls, path: str | Path) -> CalibrationTable:
        """Read what :meth:`save` wrote.

        Raises:
            InputError: for a missing file, or one that is no such table.
        """
        try:
            content = json.loads(Path(path).read_text(encoding="utf-8"))
            if content["format"] != _FORMAT or content["method"] not in METHODS:
                raise ValueError("another format or method")
            ranges = {str(name): (float(pair[0]), float(pair[1])) for name, pair in content["ranges"].items()}
            kept = content["percentile"]
            return cls(
                content["method"],
                ranges,
                int(content["samples"]),
                None if kept is None else float(kept),
                str(content["model_sha256"]),
                str(content["inputs_sha256"]),
            )
        except InputError:
            raise
        except (OSError, ValueError, KeyError, TypeError, IndexError, AttributeError) as error:
            raise InputError(
                "calibration table",
                given=str(path),
                expected="a JSON file written by CalibrationTable.save",
                fix=f"Calibrate again ({type(error).__name__}: {str(error)[:80]}).",
            ) from error

    def tensorrt_cache(self, tensorrt: str = "8.6.1") -> str:
        """Return the table as the text of a TensorRT calibration cache, for TensorRT up to 10.x.

        After a line with version and calibrator, every line is a tensor's name and its scale, the largest magnitude
        divided by 127, as the hexadecimal digits of a big-endian float32.

        Args:
            tensorrt: version for the first line, e.g. ``"10.3.0"``; TensorRT ignores a cache of another version.

        Raises:
            InputError: for a version that is none or from 11 on, or a name that would break a line.
        """
        parts = re.fullmatch(r"(\d+)\.(\d+)(?:\.(\d+))?(?:\.\d+)*", tensorrt)
        if parts is None or int(parts[1]) > 10:
            raise InputError(
                "tensorrt",
                given=tensorrt,
                expected="a version up to 10.x, such as 8.6.1",
                fix="TensorRT 11 has no calibration caches: write Q/DQ with quantise_onnx.",
            )
        major, minor, patch = int(parts[1]), int(parts[2]), int(parts[3] or 0)
        number = major * 10000 + minor * 100 + patch if major >= 10 else major * 1000 + minor * 100 + patch
        lines = [f"TRT-{number}-{'MinMaxCalibration' if self.method == 'minmax' else 'EntropyCalibration2'}"]
        for name in sorted(self.ranges):
            if not name or "\n" in name or "\r" in name:
                raise InputError(
                    "tensor name", given=name, expected="one line of text", fix="Rename the tensor in the model."
                )
            lines.append(f"{name}: {struct.pack('>f', self.scale(name)).hex()}")
        return "\n".join(lines) + "\n"

    def save_tensorrt_cache(self, path: str | Path, tensorrt: str = "8.6.1") -> Path:
        """Write :meth:`tensorrt_cache` to a file, whole or not at all; return the path."""
        return write_text(path, self.tensorrt_cache(tensorrt))


def parse_tensorrt_cache(text: str) -> dict[str, float]:
    """Return tensor name -> scale of a TensorRT calibration cache.

    Raises:
        InputError: for text that is no calibration cache, or scales that are not positive and finite.
    """
    lines = text.splitlines()
    if not lines or not re.fullmatch(r"TRT-\d+-\w+", lines[0]):
        raise InputError(
            "calibration cache",
            given=lines[0] if lines else "nothing",
            expected="a first line such as TRT-8601-EntropyCalibration2",
            fix="Write it with CalibrationTable.save_tensorrt_cache.",
        )
    scales: dict[str, float] = {}
    for line in lines[1:]:
        name, _, digits = line.rpartition(": ")
        scale = struct.unpack(">f", bytes.fromhex(digits))[0] if re.fullmatch(r"[0-9a-f]{8}", digits) else -1.0
        if not name or not 0 < scale < float("inf"):
            raise InputError(
                "calibration cache",
                given=line,
                expected="NAME: eight hexadecimal digits of a positive float32",
                fix="The file was cut off or edited: write it again.",
            )
        scales[name] = scale
    return scales


def calibrate(
    model: str | Path,
    inputs: NDArray[np.float32] | Mapping[str, NDArray[np.float32]],
    method: str = "minmax",
    *,
    percentile: float = 99.99,
    batch_size: int = 16,
) -> CalibrationTable:
    """Return the ranges of every floating-point tensor of a network: its inputs, and what its nodes compute.

    The samples are run in order; memory holds the tensors of one batch at a time.

    Args:
        model: path of an ONNX file.
        inputs: (N, ...) float32, preprocessed as for inference; by input name if there are several.
        method: ``minmax``, ``percentile`` or ``entropy``.
        percentile: of the values that are kept, per cent; for ``percentile``.
        batch_size: samples at a time, where the model does not fix it.

    Raises:
        InputError: for a missing, damaged or huge model, no samples, samples that do not fit, NaN or infinity in
            samples, weights or the network's tensors, or an unknown method.
    """
    proto = read_model(model)
    digest = onnx_digest(Path(model))
    return calibrate_model(proto, inputs, method, percentile=percentile, batch_size=batch_size, model_sha256=digest)


def calibrate_model(
    proto: Any,
    inputs: NDArray[np.float32] | Mapping[str, NDArray[np.float32]],
    method: str = "minmax",
    *,
    percentile: float = 99.99,
    batch_size: int = 16,
    model_sha256: str = "",
) -> CalibrationTable:
    """Do what :func:`calibrate` does for a parsed ``onnx.ModelProto``, which is left alone."""
    import onnx

    make_observer(method, percentile)  # an unknown method is told before the work, not after
    feed = check_feed(proto, inputs)
    opened = onnx.ModelProto()
    opened.CopyFrom(proto)
    known = {info.name for info in opened.graph.output}
    for node in opened.graph.node:
        if node.op_type != "Constant":
            # Without a type: ONNX Runtime infers it.
            opened.graph.output.extend(
                onnx.ValueInfoProto(name=name) for name in node.output if name not in known | {""}
            )
    runner = session(opened)
    names = [value.name for value in runner.get_outputs() if value.type == "tensor(float)"]
    observers = {name: make_observer(method, percentile) for name in [*feed, *names]}
    samples = 0
    for batch in batches(proto, feed, batch_size):
        samples += len(next(iter(batch.values())))
        for name, array in [*batch.items(), *zip(names, runner.run(names, batch), strict=True)]:
            if not np.isfinite(array).all():
                raise InputError(
                    f"tensor {name!r}",
                    given="NaN or infinity while calibrating",
                    expected="finite values",
                    fix="The network overflows on these inputs: check weights and preprocessing.",
                )
            observers[name].update(array)
    digest = hashlib.sha256()
    for name in sorted(feed):
        digest.update(f"{name} {feed[name].shape}".encode() + np.ascontiguousarray(feed[name]).tobytes())
    return CalibrationTable(
        method,
        {name: observer.range() for name, observer in observers.items()},
        samples,
        percentile if method == "percentile" else None,
        model_sha256,
        digest.hexdigest(),
    )
