"""Showing figures and tables in a notebook so that everybody can read them: alt text, captions, header cells."""

from __future__ import annotations

import html
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from robotbrain.errors import InputError
from robotbrain.jetson.tables import format_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, repr=False)
class Html:
    """Something to show as the last line of a cell.

    Attributes:
        markup: for a notebook.
        words: for a terminal.
    """

    markup: str
    words: str

    def __repr__(self) -> str:
        return self.words

    def _repr_html_(self) -> str:
        return self.markup


def show(figure: Figure) -> Html:
    """Return a figure of :mod:`robotbrain.jetson.plots` (or any whose label says what it shows) with its alt text.

    Raises:
        InputError: for a figure without a label.
    """
    from robotbrain.jetson.plots import alt_text, to_html

    if not alt_text(figure).strip():
        raise InputError(
            "figure", given="no label", expected="its alt text", fix="Say what it shows: figure.set_label('...')."
        )
    return Html(to_html(figure), alt_text(figure))


def table(caption: str, head: Sequence[str], rows: Sequence[Sequence[object]], left: Collection[int] = (0,)) -> Html:
    """Return a table whose first column names its rows.

    Args:
        caption: what the table holds.
        head: column titles, with units.
        rows: cells, as many in each row as there are titles.
        left: columns that are set flush left; numbers are set flush right.

    Raises:
        InputError: for a row with another number of cells.
    """
    for row in rows:
        if len(row) != len(head):
            raise InputError(
                f"table {caption!r}",
                given=f"a row of {len(row)} cells",
                expected=str(len(head)),
                fix="Compare the two.",
            )

    def cell(tag: str, index: int, value: object) -> str:
        side = "left" if index in left else "right"
        style = f"text-align:{side};vertical-align:top;padding:3px 10px;white-space:normal"
        return f'<{tag} style="{style}">{html.escape(str(value))}</{tag.partition(" ")[0]}>'

    top = "".join(cell('th scope="col"', index, title) for index, title in enumerate(head))
    body = "".join(
        "<tr>" + "".join(cell("td" if i else 'th scope="row"', i, value) for i, value in enumerate(row)) + "</tr>"
        for row in rows
    )
    markup = (
        '<table style="border-collapse:collapse">'
        f'<caption style="text-align:left;padding:3px 10px">{html.escape(caption)}</caption>'
        f"<thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"
    )
    return Html(markup, f"{caption}\n{format_table(head, rows, left)}")
