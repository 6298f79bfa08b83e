"""A policy that was handed in as a file: found, read with suspicion, and opened once for all tests."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotbrain.errors import InputError
from robotbrain.grading import fail

if TYPE_CHECKING:
    from robotbrain.rl.onnx_policy import OnnxPolicy


def handed_in(student: Any, name: str) -> OnnxPolicy:
    """Return the policy in the file ``name`` beside the notebook, or fail and say what is there instead."""
    path = student.files / name
    if not path.is_file():
        fail(f"there is no file {name} beside the notebook", hint="file-beside-the-notebook")
    try:
        return opened(path)
    except InputError as error:
        fail(f"{name} cannot be used: {error.what}", got=error.given, expected=error.expected, hint="not-a-policy")
        raise  # for the type checker: fail always raises


def opened(path: Path) -> OnnxPolicy:
    """Return the policy in a file; the same one as long as the file has not changed.

    Raises:
        InputError: it holds no policy.
    """
    state = path.stat()
    return _opened(path, (state.st_ino, state.st_size, state.st_mtime_ns))


@functools.lru_cache(maxsize=4)
def _opened(path: Path, _state: tuple[int, ...]) -> OnnxPolicy:
    from robotbrain.rl.onnx_policy import OnnxPolicy

    return OnnxPolicy(path)
