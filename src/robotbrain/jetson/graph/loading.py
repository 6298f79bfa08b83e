"""From whatever the caller has to a parsed model: reading, hashing, refusing what is no ONNX."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import onnx

from robotbrain.errors import InputError

MAX_BYTES = 2**31 - 1
"""Protocol buffers end at 2 GiB; larger models keep their weights in a file beside them."""

MIN_OPSET = 7
"""Broadcasting changed here; exporters of the last eight years write newer opsets."""


@dataclass(frozen=True, slots=True)
class Loaded:
    """A parsed model.

    Attributes:
        graph: GraphProto, with model-local functions inlined.
        initializers: the TensorProtos that hold (or point to) the weights.
        opsets: version by domain; ONNX's own domain is ``""``.
        ir_version: of the file.
        name: what to call the model.
        sha256: of the file's bytes; empty if it was given as a ModelProto.
    """

    graph: Any
    initializers: tuple[Any, ...]
    opsets: dict[str, int]
    ir_version: int
    name: str
    sha256: str


def load(model: str | Path | bytes | Any, name: str | None) -> Loaded:
    """Parse a model; weights are neither copied nor read, and external data is not looked for.

    Args:
        model: path, file content, or ``onnx.ModelProto``.
        name: what to call it; by default the file's stem or the graph's own name.

    Raises:
        InputError: if there is no such file, it is no ONNX, or its opset is not supported.
    """
    sha256, title = "", name
    if isinstance(model, (str, Path)):
        path = Path(model)
        title = title or path.stem
        data = _read(path)
        sha256 = hashlib.sha256(data).hexdigest()
        proto = _parse(data, str(path))
    elif isinstance(model, (bytes, bytearray, memoryview)):
        data = bytes(model)
        _check_size(len(data), f"{len(data)} bytes")
        sha256 = hashlib.sha256(data).hexdigest()
        proto = _parse(data, f"{len(data)} bytes")
    elif isinstance(model, onnx.ModelProto):
        proto = model
    else:
        raise InputError(
            "model",
            given=type(model).__name__,
            expected="the path of an ONNX file, its bytes, or an onnx.ModelProto",
            fix="Export the network first, e.g. with torch.onnx.export.",
        )
    return _unpack(proto, title, sha256)


def _read(path: Path) -> bytes:
    fix = "Check the path."
    try:
        if path.is_file():
            _check_size(path.stat().st_size, str(path))
            return path.read_bytes()
        given = f"{path} (a directory)" if path.is_dir() else f"{path} (no such file)"
    except InputError:
        raise
    except (OSError, ValueError) as error:
        given, fix = str(path), f"The system says: {error}"
    raise InputError("model", given=given, expected="the path of an ONNX file", fix=fix)


def _check_size(size: int, given: str) -> None:
    if not 0 < size <= MAX_BYTES:
        raise InputError(
            "model",
            given=given if size else f"{given} (empty)",
            expected=f"an ONNX file of 1 to {MAX_BYTES} bytes",
            fix="Save large models with save_as_external_data=True." if size else "Was the export or download cut off?",
        )


def _parse(data: bytes, given: str) -> Any:
    proto = onnx.ModelProto()
    try:
        proto.ParseFromString(data)
    except Exception as error:  # protobuf's implementations raise classes of their own
        raise InputError(
            "model",
            given=given,
            expected="an ONNX file",
            fix="It does not parse: cut short, damaged, or another format. Export or download it again.",
        ) from error
    return proto


def _unpack(proto: Any, title: str | None, sha256: str) -> Loaded:
    if not proto.HasField("graph") or not (proto.graph.node or proto.graph.output):
        raise InputError(
            "model",
            given="a file without a graph",
            expected="an ONNX model with nodes and outputs",
            fix="Is it an ONNX file at all, or only a tensor or a text file?",
        )
    if not proto.graph.output:
        raise InputError(
            "model", given="a graph without outputs", expected="at least one output", fix="Export the network again."
        )
    opsets: dict[str, int] = {}
    for entry in proto.opset_import:
        opsets["" if entry.domain == "ai.onnx" else entry.domain] = entry.version
    _check_opset(opsets)
    initializers = tuple(proto.graph.initializer)
    if proto.functions:
        proto = _inlined(proto)
        opsets.update({entry.domain: entry.version for entry in proto.opset_import if entry.domain != "ai.onnx"})
    return Loaded(
        proto.graph, initializers, opsets, proto.ir_version or 3, title or proto.graph.name or "model", sha256
    )


def _check_opset(opsets: dict[str, int]) -> None:
    newest = onnx.defs.onnx_opset_version()
    version = opsets.get("")
    if version is None or not MIN_OPSET <= version <= newest:
        raise InputError(
            "opset of the model",
            given=version,
            expected=f"{MIN_OPSET} to {newest} (what the installed onnx {onnx.__version__} knows)",
            fix="Convert it with onnx.version_converter, or export it again with another opset_version.",
        )


def _inlined(proto: Any) -> Any:
    """Return the model with its local functions replaced by their bodies (its initialisers stay with the caller)."""
    import onnx.inliner

    bare = onnx.ModelProto()
    for descriptor, value in proto.ListFields():
        if descriptor.name in ("ir_version", "producer_name", "domain", "model_version"):
            setattr(bare, descriptor.name, value)
        elif descriptor.name in ("opset_import", "functions"):
            getattr(bare, descriptor.name).extend(value)
    bare.graph.name = proto.graph.name
    for part in ("node", "input", "output", "value_info"):
        getattr(bare.graph, part).extend(getattr(proto.graph, part))
    try:
        inlined = onnx.inliner.inline_local_functions(bare)
    except Exception as error:  # the C++ side raises several kinds
        raise InputError(
            "functions of the model",
            given=[function.name for function in proto.functions][:8],
            expected="model-local functions that can be inlined",
            fix=f"onnx says: {str(error).splitlines()[0][:160] if str(error) else type(error).__name__}",
        ) from error
    if inlined.functions:
        raise InputError(
            "functions of the model",
            given=[function.name for function in inlined.functions][:8],
            expected="functions that do not call themselves",
            fix="Inline them before saving, with onnx.inliner.inline_local_functions.",
        )
    return inlined
