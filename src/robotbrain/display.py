"""Showing figures and tables in a notebook so that everybody can read them: alt text, captions, header cells."""

from __future__ import annotations

import html
import sys
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


def show(figure: Figure, alt: str | None = None) -> Html:
    """Return a figure with its alt text, to stand in the last line of a cell.

    Matplotlib's own way of showing figures in notebooks has no place for alt text; an ``<img>`` has one wherever the
    notebook goes: JupyterLab, a page of feedback, the book.

    Args:
        figure: of Matplotlib. One of pyplot's is closed, or it would appear a second time.
        alt: what is to be seen in it, in words; figures that the kit draws say so themselves.

    Raises:
        InputError: for a figure without alt text.
    """
    from robotbrain.figures import alt_text, to_html

    if alt is not None:
        figure.set_label(alt)
    if not alt_text(figure).strip():
        raise InputError(
            "figure", given="no alt text", expected="what it shows, in words", fix='Write show(figure, "...").'
        )
    if pyplot := sys.modules.get("matplotlib.pyplot"):
        pyplot.close(figure)
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
