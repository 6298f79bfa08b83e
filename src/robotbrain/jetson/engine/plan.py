"""Built plans kept on disk, found again by everything that they depend on.

A plan belongs to one ONNX file, one TensorRT version, one GPU and one set of options. The sidecar (``.json``) beside
each plan says which, so that a plan from elsewhere is refused with the reason before TensorRT sees it.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from robotbrain import files
from robotbrain.errors import InputError

SUFFIXES = (".plan", ".engine", ".trt")
"""What files with plans are called."""


@dataclass(frozen=True)
class PlanInfo:
    """What a plan depends on.

    Attributes:
        onnx_sha256: of the ONNX file and its external weights.
        tensorrt: full version that built it.
        device: GPU that built it.
        options: precision, batches and workspace, in words.
        simulated: whether the stand-in built it.
    """

    onnx_sha256: str
    tensorrt: str
    device: str
    options: str
    simulated: bool

    @property
    def key(self) -> str:
        """Sixteen hexadecimal digits; another for any other content."""
        text = json.dumps(asdict(self), sort_keys=True)
        return hashlib.sha256(text.encode("utf-8")).hexdigest()[:16]


def onnx_digest(model: Path) -> str:
    """Return the SHA-256 of an ONNX file; if it keeps weights in other files, of it and their SHA-256 together."""
    content = model.read_bytes()
    digest = hashlib.sha256(content)
    for name in sorted(_named_files(content)):
        path = model.parent / name
        if path.is_file():
            digest.update(_digest(path))
    return digest.hexdigest()


def _named_files(content: bytes) -> set[str]:
    # Without the package onnx, which a board need not have: protobuf's encoding of the pair ("location", NAME). Bytes
    # of weights that happen to look like it name no file.
    names = set()
    for found in re.finditer(rb"\x0a\x08location\x12([\x80-\xff]?)([\x00-\x7f])", content):
        low, last = found.groups()
        size = (low[0] & 0x7F) + (last[0] << 7) if low else last[0]
        if size < 256:  # no file system takes longer names
            names.add(os.fsdecode(content[found.end() : found.end() + size]))
    return names


def _digest(path: Path) -> bytes:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        for block in iter(lambda: file.read(1 << 20), b""):
            digest.update(block)
    return digest.digest()


def find(directory: Path, stem: str, info: PlanInfo) -> Path | None:
    """Return the path of the whole plan built from exactly this, or None."""
    path = _path(directory, stem, info)
    try:
        found, sha256 = read_sidecar(path)
        whole = found == info and hashlib.sha256(path.read_bytes()).hexdigest() == sha256
    except (OSError, InputError):
        return None
    return path if whole else None


def put(directory: Path, stem: str, info: PlanInfo, plan: bytes) -> Path:
    """Write a plan and its sidecar, each whole or not at all; return the plan's path."""
    path = files.write_bytes(_path(directory, stem, info), plan)
    sidecar = dict(asdict(info), plan_sha256=hashlib.sha256(plan).hexdigest())
    files.write_bytes(_sidecar(path), json.dumps(sidecar, indent=2, sort_keys=True).encode("utf-8"))
    return path


def read_sidecar(plan: Path) -> tuple[PlanInfo, str]:
    """Return what a plan depends on, and the SHA-256 that the plan should have.

    Raises:
        FileNotFoundError: if the plan has no sidecar.
        InputError: for a sidecar that does not hold what it must.
    """
    path = _sidecar(plan)
    text = path.read_text(encoding="utf-8")
    names = {field.name: field.type for field in fields(PlanInfo)}
    try:
        held = json.loads(text)
        sha256 = held.pop("plan_sha256")
        right = isinstance(sha256, str) and set(held) == set(names)
        right = right and all(isinstance(held[name], bool if kind == "bool" else str) for name, kind in names.items())
    except (ValueError, AttributeError, KeyError, TypeError):
        right = False
    if not right:
        raise InputError(
            f"sidecar {path.name}",
            given=text[:80],
            expected="JSON as `open_engine` writes it",
            fix="Delete the plan and its sidecar, and build again.",
        )
    return PlanInfo(**held), sha256


def check_fits(plan: Path, tensorrt: str, device: str, simulated: bool) -> None:
    """Check by the sidecar, if there is one, that a plan was built for this TensorRT and GPU and is whole.

    Raises:
        InputError: if it was not.
    """
    try:
        info, sha256 = read_sidecar(plan)
    except FileNotFoundError:
        return
    reasons = []
    if info.simulated != simulated:
        reasons.append("by the simulated runtime" if info.simulated else "by a genuine TensorRT")
    if info.tensorrt != tensorrt:
        reasons.append(f"by TensorRT {info.tensorrt} (here is {tensorrt})")
    if info.device != device:
        reasons.append(f"on another GPU: {info.device} (here is {device})")
    if hashlib.sha256(plan.read_bytes()).hexdigest() != sha256:
        reasons.append("and changed since: its checksum differs")
    if reasons:
        raise InputError(
            f"plan {plan.name}",
            given="built " + "; ".join(reasons),
            expected="a plan built by this TensorRT on this GPU",
            fix="Plans do not travel: open the ONNX file here, which builds one.",
        )


def timing_cache_path(directory: Path, tensorrt: str, device: str) -> Path:
    """Return where the timing cache of one TensorRT on one GPU is kept."""
    key = hashlib.sha256(f"{tensorrt}\n{device}".encode()).hexdigest()[:16]
    return directory / f"timing-{key}.cache"


def _path(directory: Path, stem: str, info: PlanInfo) -> Path:
    return directory / f"{stem}-{info.key}.plan"


def _sidecar(plan: Path) -> Path:
    return plan.with_name(plan.name + ".json")
