"""The manifest of a bundle: its form, its canonical bytes, and its own digest."""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Mapping
from typing import Any

from robotbrain.jetson.deploy.contents import AGAIN, refuse

SCHEMA, VERSION = "robotbrain-bundle", 1
"""Name and version of the format."""

MANIFEST, DIGEST = "manifest.json", "manifest.sha256"
"""The two files that the manifest does not list; the second holds the digest of the first, as sha256sum has it."""

LABEL = "prediction of the twin, not a measurement"
"""What every prediction in a bundle is labelled as."""

_MAX = 1024 * 1024
_SHA = re.compile(r"[0-9a-f]{64}")
_NUMBER, _WHOLE, _TEXT, _FLAG = (float, int), int, str, bool
_LARGEST = 2**53  # beyond it JSON's numbers are not the same everywhere, and integers do not fit into numpy's
_WORD = re.compile(r"[A-Za-z0-9_.+-]{1,40}")  # what is printed must not steer a terminal

FORM: Mapping[str, Any] = {
    "schema": _TEXT,
    "version": _WHOLE,
    "kit": _WORD,
    "name": re.compile(r"[A-Za-z0-9_][A-Za-z0-9_-]{0,60}"),
    "parameters": {
        "module": _TEXT,
        "mode": _TEXT,
        "jetpack": _TEXT,
        "precision": _TEXT,
        "batch": _WHOLE,
        "seed": _WHOLE,
        "vectors_from": _TEXT,
    },
    "target": {
        "module": _TEXT,
        "name": _TEXT,
        "mode": _TEXT,
        "mode_names": [_TEXT],
        "parts": [_TEXT],
        "parts_by_memory_gib": {"*": [_WHOLE]},
        "jetpack": _TEXT,
        "jetson_linux": _TEXT,
        "tensorrt": _TEXT,
        "cuda": _TEXT,
        "cudnn": (str, type(None)),
        "ubuntu": _TEXT,
        "python": _TEXT,
        "newest_opset": _WHOLE,
    },
    "network": {
        "file": _TEXT,
        "sha256": _SHA,
        "opset": _WHOLE,
        "inputs": [{"name": _TEXT, "dtype": _TEXT, "shape": [_WHOLE]}],
        "outputs": [{"name": _TEXT, "dtype": _TEXT}],
        "dynamic": _FLAG,
        "quantised": _FLAG,
        "half": _FLAG,
    },
    "preprocessing": (
        None,
        {"mean": [_NUMBER], "std": [_NUMBER], "classes": [_TEXT], "layout": _TEXT, "colour": _TEXT},
    ),
    "calibration": (None, {"file": _TEXT, "method": _TEXT, "network_sha256": _SHA, "tensors": _WHOLE}),
    "lint": {"findings": [{"code": _TEXT, "severity": _TEXT, "node": _TEXT, "message": _TEXT}]},
    "numerics": {
        "arithmetic": _TEXT,
        "rms": _NUMBER,
        "peak": _NUMBER,
        "agreement": _NUMBER,
        "vectors": [{"inputs": {"*": _TEXT}, "outputs": {"*": {"file": _TEXT, "shape": [_WHOLE]}}}],
    },
    "prediction": {
        "label": _TEXT,
        "harness": _TEXT,
        "latency_ms": _NUMBER,
        "latency_low_ms": _NUMBER,
        "latency_high_ms": _NUMBER,
        "power_w": _NUMBER,
        "energy_mj": _NUMBER,
        "memory_mb": _NUMBER,
        "provenance": _WORD,
        "sources": [_TEXT],
        "warnings": [_TEXT],
    },
    "files": {"*": {"bytes": _WHOLE, "sha256": _SHA}},
}
"""What a manifest holds: a type, a pattern, a list of one form, a mapping, or (None, form) for what may be null."""


def to_bytes(data: Mapping[str, Any]) -> bytes:
    """Return a JSON document in its canonical bytes: keys in order, ASCII, one line end."""
    return (json.dumps(data, indent=1, sort_keys=True, allow_nan=False) + "\n").encode("ascii")


def digest_line(content: bytes, name: str = MANIFEST) -> bytes:
    """Return the line that ``sha256sum`` prints for a file."""
    return f"{hashlib.sha256(content).hexdigest()}  {name}\n".encode("ascii")


def files_section(files: Mapping[str, bytes]) -> dict[str, dict[str, Any]]:
    """Return size in bytes and SHA-256 by name."""
    return {n: {"bytes": len(c), "sha256": hashlib.sha256(c).hexdigest()} for n, c in sorted(files.items())}


def read_json(files: Mapping[str, bytes], name: str, digest: str, form: Mapping[str, Any]) -> dict[str, Any]:
    """Return a JSON document, its digest file, its form and its canonical spelling checked.

    Raises:
        InputError: if any of these is not right.
    """
    for needed in (name, digest):
        if needed not in files:
            raise refuse(needed, "no such file", f"{name} and {digest}", AGAIN)
    raw = files[name]
    if files[digest] != digest_line(raw, name):
        given = f"a file whose SHA-256 is {hashlib.sha256(raw).hexdigest()}"
        raise refuse(name, given, f"the one that {digest} names", AGAIN)
    try:
        if len(raw) > _MAX:
            raise ValueError(f"{len(raw)} bytes")
        data = json.loads(raw.decode("ascii"))
        canonical = to_bytes(data) == raw
    except (ValueError, RecursionError, TypeError, AttributeError) as error:
        raise refuse(name, str(error)[:100], "a JSON object as this kit writes it", AGAIN) from error
    if not canonical:
        raise refuse(name, "another spelling, or a key twice", "JSON as this kit writes it", AGAIN)
    check_form(data, form, name)
    return dict(data)


def check_form(value: object, form: Any, where: str) -> None:
    """Refuse a value that is not of this form (see FORM).

    Raises:
        InputError: naming the place.
    """
    if isinstance(form, tuple) and form[0] is None:
        if value is not None:
            check_form(value, form[1], where)
    elif isinstance(form, re.Pattern):
        if not isinstance(value, str) or not form.fullmatch(value):
            raise refuse(where, value, f"text of the form {form.pattern}", AGAIN)
    elif isinstance(form, list):
        if not isinstance(value, list) or len(value) > 10_000:
            raise refuse(where, value, "a list", AGAIN)
        for index, item in enumerate(value):
            check_form(item, form[0], f"{where}[{index}]")
    elif isinstance(form, Mapping):
        if not isinstance(value, dict):
            raise refuse(where, value, "an object", AGAIN)
        missing, foreign = form.keys() - value.keys() - {"*"}, value.keys() - form.keys() if "*" not in form else set()
        if missing or foreign:
            raise refuse(where, f"without {sorted(missing)}, with {sorted(foreign)}", "exactly its keys", AGAIN)
        for key, item in value.items():
            check_form(item, form["*"] if "*" in form else form[key], f"{where}: {key}")
    else:
        kinds = form if isinstance(form, tuple) else (form,)
        right = isinstance(value, kinds) and (bool in kinds or not isinstance(value, bool))
        right = right and not (isinstance(value, float) and not math.isfinite(value))
        if not right or (isinstance(value, int) and abs(value) > _LARGEST):
            raise refuse(where, value, "of type " + " or ".join(kind.__name__ for kind in kinds), AGAIN)
