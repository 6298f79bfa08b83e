"""Settings from the command line: ``env.rewards.time.weight=-1 agent.algorithm.gamma=0.98``, as Isaac Lab's scripts
take them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from robotbrain.errors import InputError
from robotbrain.rl.configclass import did_you_mean, lookup

ROOTS = ("env", "agent")


def split_overrides(texts: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return path and value of each ``env.path=value`` and ``agent.path=value``, under ``"env"`` and ``"agent"``.

    Values are YAML: numbers, true, null, [1, 2], text.

    Raises:
        InputError: for a text of another form.
    """
    import yaml  # type: ignore[import-untyped]

    found: dict[str, dict[str, Any]] = {root: {} for root in ROOTS}
    for text in texts:
        path, equals, value = text.partition("=")
        root, _, rest = path.strip().partition(".")
        if not equals or root not in ROOTS or not rest:
            raise InputError(
                "--set",
                given=text,
                expected="env.PATH=VALUE for the task or agent.PATH=VALUE for the learner",
                fix="For example --set env.episode_length_s=10 --set agent.algorithm.gamma=0.98",
            )
        try:
            parsed = yaml.safe_load(value)
        except yaml.YAMLError as error:
            raise InputError("--set", given=text, expected="a YAML value", fix="Quote text that has signs.") from error
        found[root][rest] = _number(parsed)
    return found


def apply_overrides(config: Any, values: dict[str, Any], root: str) -> Any:
    """Return ``config`` with these values (dotted path to value) set; it is changed where that is possible.

    Args:
        config: a configclass (changed in place), or a frozen dataclass of plain fields (replaced).
        values: what to set.
        root: how messages call it, ``"env"`` or ``"agent"``.

    Raises:
        InputError: for a path that is not there (the nearest is proposed) or a value of another kind.
    """
    params = getattr(type(config), "__dataclass_params__", None)
    for path, value in values.items():
        *parents, last = path.split(".")
        target, where = config, root
        for part in parents:
            target, where = _child(target, part, where), f"{where}.{part}"
            if target is None:
                raise InputError(where, given=None, expected="something to set", fix="It is switched off in this task.")
        new = _fitting(_child(target, last, where), value, f"{where}.{last}")
        if params is not None and params.frozen and target is config:
            config = dataclasses.replace(config, **{last: new})
        elif isinstance(target, dict):
            target[last] = new
        elif isinstance(target, list):
            target[int(last)] = new
        else:
            setattr(target, last, new)
    return config


def _child(target: Any, name: str, where: str) -> Any:
    if isinstance(target, dict):
        if name not in target:
            raise InputError(f"{where}.{name}", given=name, expected="a key", fix=did_you_mean(name, map(str, target)))
        return target[name]
    if isinstance(target, list | tuple):
        if not (name.isdigit() and int(name) < len(target)):
            raise InputError(f"{where}.{name}", given=name, expected=f"0 to {len(target) - 1}", fix="Give its place.")
        return target[int(name)]
    if not dataclasses.is_dataclass(target):
        raise InputError(f"{where}.{name}", given=name, expected="a field", fix=f"{where} has none.")
    return lookup(target, name)


def _fitting(old: Any, new: Any, where: str) -> Any:
    """Return the new value as the kind that the old one is; null may replace anything."""
    if new is None or old is None or old is dataclasses.MISSING:
        return new
    if isinstance(old, tuple) and isinstance(new, list):
        return tuple(new)
    whole = isinstance(old, int) and not isinstance(old, bool)
    if isinstance(old, float) and isinstance(new, int) and not isinstance(new, bool):
        return float(new)
    if whole and isinstance(new, float) and new.is_integer():
        return int(new)
    if whole and isinstance(new, float) and where.rpartition(".")[2] in ("weight", "scale"):
        return new  # a whole number where the task wrote, say, a weight of 1
    if callable(old) or dataclasses.is_dataclass(old) or type(new) is not type(old):
        kind = "null, or one of its fields" if dataclasses.is_dataclass(old) else f"a {type(old).__name__}"
        raise InputError(where, given=new, expected=f"{kind} (now {old!r})", fix="Give a value of that kind.")
    return new


def _number(value: Any) -> Any:
    if isinstance(value, str):  # YAML 1.1 takes 1e-3 for text
        try:
            return float(value)
        except ValueError:
            return value
    return [_number(item) for item in value] if isinstance(value, list) else value
