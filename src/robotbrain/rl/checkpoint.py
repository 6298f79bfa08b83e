"""Checkpoints of a training: written whole or not at all, loaded without running code from the file.

A checkpoint is a dict of tensors and plain Python values. The one before is kept beside it (``name.previous.pt``),
and whenever the process dies, both are complete.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from robotbrain.errors import InputError, RobotBrainError
from robotbrain.files import atomic_path

FORMAT = "robotbrain-rl-checkpoint"
SCHEMA = 1
"""Version of the file's outer layout; raised when an older kit could not read it any more."""

_PLAIN = (str, int, float, bool, bytes, type(None))


def previous_path(path: str | Path) -> Path:
    """Return where :func:`save_checkpoint` keeps the checkpoint before the one at ``path``."""
    path = Path(path)
    return path.with_name(f"{path.stem}.previous{path.suffix}")


def save_checkpoint(path: str | Path, state: Mapping[str, Any], *, kind: str = "", keep_previous: bool = True) -> Path:
    """Write ``state`` to ``path`` by way of a temporary file that is synced and renamed; return the path.

    Args:
        path: of the file; its folder is made. The usual ending is ``.pt``.
        state: string keys; values are tensors, str, int, float, bool, bytes, None, and dicts, lists and tuples of
            these (``state_dict()`` of modules and optimizers, ``generator.get_state()``,
            ``numpy_generator.bit_generator.state``). Tensors are stored detached, on the CPU.
        kind: what it is a checkpoint of, e.g. ``"ppo"``; :func:`load_checkpoint` can insist on it.
        keep_previous: keep the file that was at ``path`` as :func:`previous_path`.

    The same state gives the same bytes.

    Raises:
        InputError: for a value of another type (its place in ``state`` is named); nothing is written then.
        RobotBrainError: when the disk does not take it.
    """
    target = Path(path)
    content = {"format": FORMAT, "schema": SCHEMA, "kind": kind, "state": _stored(state, "state")}
    with atomic_path(target) as temporary:
        # Through an open file: torch would write the name of a path, which is random here, into the archive.
        with temporary.open("wb") as file:
            try:
                torch.save(content, file)
            except RuntimeError as error:  # what torch makes of a write that failed
                raise RobotBrainError(
                    f"{target} could not be written: is the disk full? What was there before is unharmed."
                ) from error
        if keep_previous and target.is_file():
            _keep(target)
    return target


def load_checkpoint(path: str | Path, *, kind: str | None = None) -> dict[str, Any]:
    """Return the state that :func:`save_checkpoint` stored at ``path``; tensors are on the CPU.

    Only tensors and plain values are read (``weights_only``): a file from elsewhere cannot run code.

    Args:
        path: of the file.
        kind: what it must be a checkpoint of; None takes any.

    Raises:
        InputError: for a file that is missing, cut short, not a checkpoint of this kit, of a newer kit, or of another
            kind.
    """
    source = Path(path)
    if not source.is_file():
        raise InputError("checkpoint", given=str(path), expected="an existing file", fix=_where_else(source))
    try:
        content = torch.load(source, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        raise _foreign(source) from error
    except (RuntimeError, EOFError, ValueError, KeyError, OSError) as error:
        raise InputError(
            "checkpoint",
            given=f"{source} ({source.stat().st_size} bytes)",
            expected="a complete checkpoint",
            fix=f"The file is cut short or damaged. {_where_else(source)}",
        ) from error
    if not (isinstance(content, dict) and content.get("format") == FORMAT and isinstance(content.get("state"), dict)):
        raise _foreign(source)
    if content["schema"] != SCHEMA:
        raise InputError(
            "checkpoint's version",
            given=content["schema"],
            expected=f"{SCHEMA}",
            fix="It was written by another version of this kit: use that one, or train again.",
        )
    if kind is not None and content["kind"] != kind:
        raise InputError(
            f"checkpoint {source}",
            given=f"one of {content['kind'] or 'unknown kind'}",
            expected=f"one of {kind}",
            fix="Choose the algorithm that made it, or another run folder.",
        )
    state: dict[str, Any] = content["state"]
    return state


def _stored(value: Any, where: str) -> Any:
    """Return ``value`` as it is stored. Exact types only: numpy's float64 is a float, but loads as foreign code."""
    if isinstance(value, torch.Tensor):
        plain = value.detach().cpu()
        # A view would drag all of its storage into the file.
        return plain.clone() if plain.untyped_storage().nbytes() > plain.nbytes else plain
    if isinstance(value, Mapping):
        for key in value:
            if type(key) not in (str, int):
                raise InputError(f"key in {where}", given=key, expected="a string or a whole number", fix="Rename it.")
        return {_same(key): _stored(item, f"{where}[{key!r}]") for key, item in value.items()}
    if type(value) in (list, tuple):
        return type(value)(_stored(item, f"{where}[{index}]") for index, item in enumerate(value))
    if type(value) in _PLAIN:
        return _same(value)
    raise InputError(
        where,
        given=type(value).__name__,
        expected="a tensor, a plain Python value, or dicts, lists and tuples of these",
        fix="torch.from_numpy() makes a tensor of an array, .item() a plain value of a numpy scalar.",
    )


def _same(value: Any) -> Any:
    """Return one object for equal strings: of pickle's bytes, identity decides how a second mention is written."""
    return sys.intern(value) if type(value) is str else value


def _keep(target: Path) -> None:
    """Give the file at ``target`` its second name, without a moment in which it is not at ``target``."""
    previous = previous_path(target)
    spare = target.with_name(f".{previous.name}.tmp")
    with contextlib.suppress(FileNotFoundError):
        spare.unlink()
    try:
        os.link(target, spare)
    except OSError:  # a file system without hard links
        shutil.copyfile(target, spare)
    spare.replace(previous)


def _where_else(source: Path) -> str:
    """Return a hint at what could be loaded instead of ``source``."""
    if (previous := previous_path(source)).is_file():
        return f"The one before is {previous}; under the name {source.name} a training goes on from it."
    if not source.parent.is_dir():
        return f"There is no folder {source.parent}."
    others = sorted(item.name for item in source.parent.glob("*.pt") if item != source)
    return (
        f"In {source.parent}: {', '.join(others[:8])}."
        if others
        else f"There is no other in {source.parent}: train first."
    )


def _foreign(source: Path) -> InputError:
    return InputError(
        "checkpoint",
        given=str(source),
        expected="a file written by robotbrain.rl.checkpoint.save_checkpoint",
        fix="A file of another program is not loaded, since it might run code of its own.",
    )
