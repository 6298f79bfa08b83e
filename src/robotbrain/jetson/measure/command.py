"""The command line for the ``trtexec`` that is there: its own ``--help`` says which options it has.

Options came and went: ``--workspace`` until 8.6, ``--memPoolSize`` since 8.4, ``--explicitBatch`` needed by 7 and gone
in 10, lists in ``--percentile`` since 8.5, ``--fp16`` and ``--int8`` gone in 11 (networks are strongly typed there).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from robotbrain.errors import InputError
from robotbrain.jetson.kernels import PRECISIONS
from robotbrain.jetson.measure.trtexec import banner_version

_OPTION = re.compile(r"--([A-Za-z][A-Za-z0-9]*)")
_VERSION = re.compile(r"\[TensorRT v([\d.]+)\]")


@dataclass(frozen=True)
class Capabilities:
    """What a ``trtexec`` can do.

    Attributes:
        version: of TensorRT; None if its help does not say (TensorRT 7).
        options: names of its options, without dashes.
        percentiles: whether ``--percentile`` takes a list.
    """

    version: str | None
    options: frozenset[str]
    percentiles: bool

    @staticmethod
    def from_help(text: str) -> Capabilities:
        """Read the output of ``trtexec --help``.

        Raises:
            InputError: if this is not trtexec's help.
        """
        # What follows "# " in the banner is the command itself, whose --help is no listing.
        options = frozenset(_OPTION.findall("\n".join(x for x in text.splitlines() if not x.startswith("&&&&"))))
        if "onnx" not in options:
            raise InputError(
                "trtexec --help",
                given=text.strip()[:200],
                expected="a list of options with --onnx",
                fix="Does `trtexec --help` work on the board? Name another program with --trtexec.",
            )
        version = _VERSION.search(text)
        return Capabilities(banner_version(version.group(1)) if version else None, options, "--percentile=P1" in text)


@dataclass(frozen=True)
class Request:
    """What is to be timed.

    Attributes:
        onnx: path of the model on the board.
        precision: ``fp32``, ``fp16`` or ``int8``.
        shapes: of inputs with dynamic axes, by name.
        iterations: at least so many queries.
        duration_s: at least so long.
        warm_up_ms: before.
        workspace_mb: builder's workspace, MiB; None leaves TensorRT's default (all memory since 8.4).
        cuda_graph: capture the launches in a CUDA graph.
        data_transfers: time the copies to and from the device as well.
        save_engine: where to keep the engine; None throws it away.
        typed: the ONNX itself carries the precision (strongly typed networks of TensorRT 10 and 11).
    """

    onnx: str
    precision: str = "fp16"
    shapes: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    iterations: int = 100
    duration_s: int = 10
    warm_up_ms: int = 1000
    workspace_mb: int | None = None
    cuda_graph: bool = False
    data_transfers: bool = False
    save_engine: str | None = None
    typed: bool = False

    def __post_init__(self) -> None:
        if self.precision not in PRECISIONS:
            raise InputError(
                "precision", given=self.precision, expected="one of " + ", ".join(PRECISIONS), fix="Choose one."
            )
        for name in ("iterations", "duration_s", "warm_up_ms"):
            if getattr(self, name) < (name == "iterations"):
                raise InputError(name, given=getattr(self, name), expected="a positive whole number", fix="Raise it.")


def build_command(program: Sequence[str], capabilities: Capabilities, request: Request) -> list[str]:
    """Return the command line that times the request with this trtexec.

    Raises:
        InputError: if this trtexec cannot do what is asked.
    """
    have = capabilities.options
    words = [*program, f"--onnx={request.onnx}"]
    words += _precision(capabilities, request)
    if request.shapes:
        # trtexec takes --shapes for the build as well when no range is given, from 8.0 on
        words.append("--shapes=" + ",".join(f"{_quoted(n)}:{'x'.join(map(str, s))}" for n, s in request.shapes.items()))
    if "explicitBatch" in have and _major(capabilities) < 8:
        words.append("--explicitBatch")
    if request.workspace_mb is not None:
        pool = f"--memPoolSize=workspace:{request.workspace_mb}"
        words.append(pool if "memPoolSize" in have else f"--workspace={request.workspace_mb}")
    elif "memPoolSize" not in have and "workspace" in have:
        words.append("--workspace=1024")  # these versions default to 16 MiB, too little for most tactics
    words += [
        f"--iterations={request.iterations}",
        f"--duration={request.duration_s}",
        f"--warmUp={request.warm_up_ms}",
        "--avgRuns=100",
        "--percentile=90,95,99" if capabilities.percentiles else "--percentile=99",
        "--useSpinWait",
    ]
    words += [] if request.data_transfers else ["--noDataTransfers"]
    words += ["--useCudaGraph"] if request.cuda_graph else []
    words += [f"--saveEngine={request.save_engine}"] if request.save_engine else []
    asked = {word.partition("=")[0].removeprefix("--") for word in words if word.startswith("--")}
    missing = sorted(asked - have)
    if missing:
        raise InputError(
            "trtexec",
            given=f"TensorRT {capabilities.version or 'of unknown version'} without " + ", ".join(missing),
            expected="TensorRT 7 to 11",
            fix="Measure by hand and read the log with --from-logs.",
        )
    return words


def parse_shapes(specifications: Sequence[str]) -> dict[str, tuple[int, ...]]:
    """Return the shapes in ``name:1x3x224x224`` specifications (several in one, separated by commas, are fine).

    Raises:
        InputError: for anything else.
    """
    shapes: dict[str, tuple[int, ...]] = {}
    for part in (piece for text in specifications for piece in text.split(",")):
        name, colon, dims = part.strip().rpartition(":")  # names may contain colons themselves
        if not colon or not name or not re.fullmatch(r"[1-9]\d{0,8}(?:x[1-9]\d{0,8})*", dims):
            raise InputError("--shape", given=part, expected="name:1x3x224x224", fix="Name the input as the ONNX does.")
        shapes[name] = tuple(int(size) for size in dims.split("x"))
    return shapes


def _precision(capabilities: Capabilities, request: Request) -> list[str]:
    have = capabilities.options
    if request.typed:
        # Since 11 there is nothing but strong typing, and no option for it.
        return ["--stronglyTyped"] if "stronglyTyped" in have else []
    # With --int8 alone, layers that are not quantised would run in FP32.
    wanted = {"fp32": [], "fp16": ["--fp16"], "int8": ["--int8", "--fp16"]}[request.precision]
    if not all(word.removeprefix("--") in have for word in wanted):
        raise InputError(
            "precision",
            given=f"{request.precision} with TensorRT {capabilities.version or '?'}",
            expected="a model that carries its precision itself: this TensorRT has no --fp16 and --int8",
            fix="Export the ONNX in that precision (QDQ for int8) and add --typed.",
        )
    return wanted


def _quoted(name: str) -> str:
    return f"'{name}'" if ":" in name else name


def _major(capabilities: Capabilities) -> int:
    return int(capabilities.version.partition(".")[0]) if capabilities.version else 7
