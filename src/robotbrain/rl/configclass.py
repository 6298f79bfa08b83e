"""``@configclass``: dataclasses for nested configurations, with the conventions of Isaac Lab's decorator.

What it adds to :func:`dataclasses.dataclass`:

* class attributes without an annotation become fields too (``rewards = MyRewards()``);
* every default is deep-copied for each instance, so mutable defaults are safe;
* ``MISSING`` marks a field the user has to fill in, wherever it stands; :meth:`Config.validate` finds those left;
* ``__post_init__`` may always call ``super().__post_init__()``;
* the methods of :class:`Config`: ``to_dict``, ``from_dict``, ``replace``, ``copy``, ``validate``.

Functions, properties and classes written in the body of the class stay what they are: methods and nested classes.
"""

from __future__ import annotations

import copy
import dataclasses
import difflib
import inspect
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Self, TypeVar, dataclass_transform

from robotbrain.errors import InputError

MISSING: Any = dataclasses.MISSING
"""Stands for a value that the user has to give; the same object as ``dataclasses.MISSING``."""

_T = TypeVar("_T")
_NOT_FIELDS = (property, classmethod, staticmethod, type)


class Config:
    """The methods every configclass has (inherit from it where a type checker should know them)."""

    if TYPE_CHECKING:  # at run time it would pass for a dataclass, which only its subclasses are
        __dataclass_fields__: ClassVar[dict[str, Any]] = {}

    def __post_init__(self) -> None:
        """Nothing to do; ends the chain of ``super().__post_init__()`` calls."""

    def to_dict(self) -> dict[str, Any]:
        """Nested dictionary of plain values; functions and classes become ``"module:qualname"``."""
        return {f.name: _plain(getattr(self, f.name)) for f in dataclasses.fields(self)}

    def from_dict(self, values: Mapping[str, Any]) -> None:
        """Overwrite fields in place, nested mappings field by field, dotted keys from their first dot on.

        Raises:
            InputError: a key that is no field, with the nearest field's name.
        """
        for key, value in values.items():
            head, _, rest = key.partition(".")
            new = {rest: value} if rest else value
            old = lookup(self, head)
            if isinstance(new, Mapping) and dataclasses.is_dataclass(old):
                Config.from_dict(old, new)  # type: ignore[arg-type]
            elif rest and isinstance(old, dict):
                old[rest] = value
            else:
                setattr(self, head, new)

    def replace(self, **changes: Any) -> Self:
        """A copy with some fields changed (``__post_init__`` runs again, as with ``dataclasses.replace``)."""
        for key in changes:
            lookup(self, key)
        own = {f.name: deep_copy(getattr(self, f.name)) for f in dataclasses.fields(self) if f.name not in changes}
        return type(self)(**own, **changes)

    def copy(self) -> Self:
        """A deep copy."""
        copied: Self = deep_copy(self)
        return copied

    def validate(self, where: str = "") -> None:
        """Check that nothing is ``MISSING``, here and in everything nested.

        Raises:
            InputError: naming every field that is.
        """
        missing = list(_missing(self, where or type(self).__name__))
        if missing:
            raise InputError(
                ", ".join(missing),
                given="MISSING",
                expected="a value for each of these fields",
                fix="Set them in the class, in __post_init__ or when you create the configuration.",
            )


@dataclass_transform(field_specifiers=(dataclasses.field,))
def configclass(cls: type[_T]) -> type[_T]:
    """Turn ``cls`` into a configuration dataclass (see the module's docstring for the rules).

    Fields keep the order in which the body of the class names them, after those of the base classes.
    """
    annotations: dict[str, Any] = dict(inspect.get_annotations(cls))
    ordered: dict[str, Any] = {}
    pending = list(annotations)
    for name, value in list(cls.__dict__.items()):
        if name in annotations:
            while pending:  # annotated names without a value stand where their annotation stands
                first = pending.pop(0)
                ordered[first] = annotations[first]
                if first == name:
                    break
        elif _is_field(name, value):
            ordered[name] = _inherited_annotation(cls, name, value)
    ordered.update((name, annotations[name]) for name in pending)
    for name, annotation in ordered.items():
        if not _is_classvar(annotation):
            setattr(cls, name, _as_field(cls.__dict__.get(name, MISSING)))
    cls.__annotations__ = ordered
    for name, method in vars(Config).items():
        if callable(method) and not hasattr(cls, name):
            setattr(cls, name, method)
    return dataclasses.dataclass(cls)


def deep_copy(value: Any) -> Any:
    """A deep copy in which ``MISSING`` stays the same object (``copy.deepcopy`` would make another one of it)."""
    return copy.deepcopy(value, {id(MISSING): MISSING})


def lookup(config: object, name: str) -> Any:
    """``config.name``, or an InputError that proposes the nearest field."""
    fields = getattr(config, "__dataclass_fields__", vars(config) if hasattr(config, "__dict__") else {})
    if name not in fields and not (not dataclasses.is_dataclass(config) and hasattr(config, name)):
        raise InputError(
            f"{type(config).__name__}.{name}",
            given=name,
            expected="a field of this configuration",
            fix=did_you_mean(name, fields),
        )
    return getattr(config, name)


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """A sentence with the nearest known name, and all of them when they are few."""
    names = list(known)
    near = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    guess = f"Did you mean {near[0]!r}? " if near else ""
    shown = ", ".join(repr(n) for n in names[:20]) + (", ..." if len(names) > 20 else "")
    return f"{guess}There is: {shown}." if names else f"{guess}There is none."


def _is_field(name: str, value: object) -> bool:
    if name.startswith("__") or isinstance(value, _NOT_FIELDS):
        return False
    return not (callable(value) and hasattr(value, "__get__"))  # functions in a class body are methods


def _is_classvar(annotation: object) -> bool:
    text = annotation if isinstance(annotation, str) else str(annotation)
    return text.startswith(("ClassVar", "typing.ClassVar"))


def _inherited_annotation(cls: type, name: str, value: object) -> Any:
    for base in cls.__mro__[1:]:
        if name in (own := inspect.get_annotations(base)):
            return own[name]
    return type(value)


def _as_field(default: Any) -> Any:
    if isinstance(default, dataclasses.Field):
        return default
    return dataclasses.field(default_factory=_Default(default))


class _Default:
    """Factory of a deep copy of one default."""

    def __init__(self, value: Any) -> None:
        self.value = value

    def __call__(self) -> Any:
        return deep_copy(self.value)


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_plain(item) for item in value)
    if isinstance(value, slice):
        return str(value)
    if callable(value):
        return f"{value.__module__}:{getattr(value, '__qualname__', type(value).__qualname__)}"
    return value


def _missing(value: Any, where: str) -> Iterable[str]:
    if isinstance(value, type(MISSING)):  # also a copy of it
        yield where
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        for field in dataclasses.fields(value):
            yield from _missing(getattr(value, field.name), f"{where}.{field.name}")
    elif isinstance(value, Mapping):
        for key, item in value.items():
            yield from _missing(item, f"{where}[{key!r}]")
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            yield from _missing(item, f"{where}[{index}]")
