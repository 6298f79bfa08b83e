"""Tables for a terminal."""

from __future__ import annotations

import textwrap
from collections.abc import Collection, Sequence

WIDTH = 120
"""Characters that prose is wrapped to."""


def format_table(head: Sequence[str], rows: Sequence[Sequence[object]], left: Collection[int] = (0,)) -> str:
    """Return a table as text with columns that line up.

    Args:
        head: column titles, with units.
        rows: cells, as many in each row as there are titles.
        left: columns that are set flush left; numbers are set flush right.
    """
    cells = [[str(cell) for cell in row] for row in (head, *rows)]
    widths = [max(len(row[index]) for row in cells) for index in range(len(head))]
    cells.insert(1, ["-" * width for width in widths])
    lines = (
        "  ".join(
            cell.ljust(width) if index in left else cell.rjust(width)
            for index, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in cells
    )
    return "\n".join(line.rstrip() for line in lines)


def wrap(text: str, indent: str = "", first: str | None = None) -> str:
    """Return prose wrapped to WIDTH; ``first`` stands before the first line, ``indent`` before the others."""
    return textwrap.fill(
        text,
        WIDTH,
        initial_indent=indent if first is None else first,
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
    )


def short(value: float) -> str:
    """Return a number with three digits, without an exponent."""
    if value == 0:
        return "0"
    if abs(value) >= 100:
        return f"{value:.0f}"
    if abs(value) >= 10:
        return f"{value:.1f}"
    return f"{value:.2f}" if abs(value) >= 1 else f"{value:.3f}"
