"""Names by regular expression, and numbers by name."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from robotbrain.errors import InputError
from robotbrain.rl.configclass import did_you_mean


def find_names(
    patterns: str | Sequence[str], names: Sequence[str], *, what: str, preserve_order: bool = False
) -> tuple[list[int], list[str]]:
    """Indices and names that match any of the patterns (each has to match a whole name).

    Args:
        patterns: one or more regular expressions.
        names: to search.
        what: what the names are of, for the error, e.g. ``"joint"``.
        preserve_order: order of the patterns instead of that of ``names``.

    Raises:
        InputError: a pattern that matches nothing or is no regular expression, or a name that two patterns match.
    """
    given = [patterns] if isinstance(patterns, str) else list(patterns)
    order: list[int] = []
    for pattern in given:
        try:
            expression = re.compile(pattern)
        except re.error as error:
            raise InputError(
                f"{what} name", given=pattern, expected="a regular expression", fix=f"Python says: {error}."
            ) from error
        hits = [i for i, name in enumerate(names) if expression.fullmatch(name)]
        if not hits:
            raise InputError(
                f"{what} name", given=pattern, expected=f"a name of a {what}", fix=did_you_mean(pattern, names)
            )
        twice = [names[i] for i in hits if i in order]
        if twice:
            raise InputError(
                f"{what} names",
                given=given,
                expected=f"patterns that match each {what} once",
                fix=f"More than one of them matches {twice[0]!r}.",
            )
        order += hits
    found = order if preserve_order else sorted(order)
    return found, [names[i] for i in found]


def values_by_name(
    values: Mapping[str, float], names: Sequence[str], *, what: str
) -> tuple[list[int], list[str], list[float]]:
    """Indices, names and values of those names that the patterns (the keys) match.

    Raises:
        InputError: as :func:`find_names`.
    """
    found: dict[int, float] = {}
    for pattern, value in values.items():
        for index in find_names(pattern, names, what=what)[0]:
            if index in found:
                raise InputError(
                    f"{what} names",
                    given=list(values),
                    expected=f"patterns that match each {what} once",
                    fix=f"More than one of them matches {names[index]!r}.",
                )
            found[index] = value
    order = sorted(found)
    return order, [names[i] for i in order], [found[i] for i in order]
