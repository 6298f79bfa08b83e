"""Is a student's answer their own, or the library's reference in disguise?

Objects are judged, not text: what a function *is*, which modules its code imports, and which global objects it and
the helpers it calls refer to. This catches the shortcuts students take; it is no defence against an attacker.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from types import CodeType, FunctionType, ModuleType
from typing import Any

from robotbrain.grading.suite import Ban, Suite


def why_exercise_forbidden(exercise: str, suite: Suite, namespace: Mapping[str, Any]) -> str:
    """Return why the answer to ``exercise`` in a notebook is not acceptable, or ``""`` if it is."""
    ban = suite.ban_of(exercise)
    own = suite.exercises[exercise].provides
    others = frozenset(name for entry in suite.exercises.values() for name in entry.provides if name not in own)
    for name in own:
        if name in namespace:
            reference = suite.load_reference(name) if name in suite.references else None
            reason = why_forbidden(name, namespace[name], reference, ban, namespace, others)
            if reason:
                return reason
    return ""


def why_forbidden(
    name: str,
    answer: Any,
    reference: Any,
    ban: Ban,
    namespace: Mapping[str, Any],
    others: frozenset[str] = frozenset(),
) -> str:
    """Return why ``answer`` is not acceptable as the student's ``name``, or ``""`` if it is.

    ``others`` are names that other exercises provide: what they hold (perhaps the reference, standing in for a part
    that is not right yet) is judged there and not here.
    """
    if reference is not None and answer is reference:
        return f"`{name}` is the course's own solution; write your own"
    if module_banned(getattr(answer, "__module__", None), ban):
        return f"`{name}` comes from `{answer.__module__}`, which is the course's own solution; write your own"
    for base in answer.__mro__[1:] if isinstance(answer, type) else ():
        if base is reference or (module_banned(base.__module__, ban) and base.__name__ not in ban.allow):
            return f"`{name}` inherits from `{base.__module__}.{base.__name__}`, the course's own solution"
    seen: set[int] = set()
    todo = list(_functions(answer))
    while todo:
        function = todo.pop()
        if id(function) in seen:
            continue
        seen.add(id(function))
        for code in _codes(function.__code__):
            imported = next((n for n in (*code.co_names, *_strings(code)) if module_banned(n, ban)), None)
            if imported:
                return (
                    f"`{name}` imports `{imported}`, which holds the course's own solution; write your own"
                    " (import the helpers that the notebook names at the top of the cell)"
                )
            for used in code.co_names:
                if used in others:
                    continue
                value = function.__globals__.get(used)
                if isinstance(value, ModuleType) and module_banned(value.__name__, ban):
                    return f"`{name}` uses the module `{value.__name__}`, which holds the course's own solution"
                if value is not None and value is reference:
                    return f"`{name}` uses `{used}`, which is the course's own solution; write your own"
                if isinstance(value, FunctionType):
                    if module_banned(value.__module__, ban) and value.__name__ not in ban.allow:
                        return f"`{name}` calls `{value.__module__}.{value.__name__}`, the course's own solution"
                    if value.__globals__ is namespace:
                        todo.append(value)
    return ""


def module_banned(module: object, ban: Ban) -> bool:
    """Whether this is the name of a banned module, or of something in one."""
    return isinstance(module, str) and any(module == b or module.startswith(b + ".") for b in ban.imports)


def _functions(answer: Any) -> Iterator[FunctionType]:
    """The Python functions an answer is made of: itself, or a class's methods."""
    if isinstance(answer, FunctionType):
        yield answer
    elif isinstance(answer, type):
        for member in vars(answer).values():
            inner = getattr(member, "__func__", getattr(member, "fget", member))
            if isinstance(inner, FunctionType):
                yield inner


def _codes(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


def _strings(code: CodeType) -> Iterator[str]:
    yield from (c for c in code.co_consts if isinstance(c, str))
