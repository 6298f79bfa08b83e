"""What all figures have in common: colours, how they look, what they say in words, how they are stored.

A figure's label (``figure.set_label``) is its alt text: what is to be seen in it, in words.
:func:`robotbrain.display.show` puts both into a notebook, and so into the book and the feedback made from it.

The palette follows WCAG 2.2: each colour has a contrast of 3:1 or more with white, as lines and marks need, and INK,
QUIET and GREY have the 4.5:1 that text needs. Any two of its colours differ by a CIEDE2000 of 15 or more, also for
people without one kind of cones (as simulated by Machado, Oliveira and Fernandes, 2009). Colour is never the only
difference all the same: take a line style, a marker or a hatch besides, from LINES, MARKERS and HATCHES.
"""

from __future__ import annotations

import base64
import html
import io
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotbrain.errors import InputError
from robotbrain.files import atomic_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FORMATS = ("png", "svg", "pdf")
"""What figures can be written as."""

INK, QUIET = "#1b1b1b", "#6b6b6b"
"""Of text: titles and labels; remarks."""

BLUE, VERMILLION, GREEN = "#123485", "#E66000", "#127257"
SKY, MAUVE, BROWN = "#1C9AE6", "#91628C", "#733F01"
GREY = "#767676"
"""Of what is there for comparison."""

PALETTE = (BLUE, SKY, GREEN, MAUVE, BROWN, VERMILLION)
"""In the order to take them; vermillion comes last, since it also marks trouble."""

LINES: tuple[Any, ...] = ("-", "--", ":", "-.", (0, (6, 1, 1, 1, 1, 1)), (0, (1, 3)))
MARKERS = ("o", "s", "^", "D", "v", "X")
HATCHES = ("", "////", "....", "\\\\\\\\", "xxxx", "++")
"""One for each colour of PALETTE, so that nothing depends on seeing colours."""


def contrast(one: str, other: str = "#FFFFFF") -> float:
    """Return the contrast of two colours as WCAG 2.2 defines it, from 1 (none) to 21 (black on white)."""
    from matplotlib.colors import to_rgb

    def luminance(colour: str) -> float:
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in to_rgb(colour)]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


def text_on(colour: str) -> str:
    """Return what text on an area of this colour is best written in: white or INK."""
    return "white" if contrast(colour) > contrast(colour, INK) else INK


def alt_text(figure: Figure) -> str:
    """Return what a figure shows, in words."""
    return str(figure.get_label())


def check_format(path: str | Path) -> str:
    """Return the format that a file's name asks for.

    Raises:
        InputError: for one that is not in FORMATS.
    """
    suffix = Path(path).suffix.lower().lstrip(".")
    if suffix not in FORMATS:
        raise InputError(
            "file for a figure",
            given=str(path),
            expected="a name that ends in " + ", ".join(f".{name}" for name in FORMATS),
            fix="Try figure.png.",
        )
    return suffix


def save(figure: Figure, path: str | Path, dpi: int = 130) -> Path:
    """Write a figure; its alt text goes with it as far as the format has a place for one.

    Raises:
        InputError: for a name that does not end in one of FORMATS, or a place that cannot be written to.
    """
    kind, target = check_format(path), Path(path)
    place = {"png": "Description", "svg": "Description", "pdf": "Subject"}[kind]
    try:
        with atomic_path(target) as temporary:
            figure.savefig(temporary, format=kind, dpi=dpi, metadata={place: alt_text(figure)})
    except OSError as error:
        raise InputError(
            "file for a figure", given=str(path), expected="a place that can be written to", fix=str(error)
        ) from error
    return target


def to_html(figure: Figure, dpi: int = 110) -> str:
    """Return the figure as an ``<img>`` with its alt text and its content inside."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi, metadata={"Software": None})
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    width = round(figure.get_figwidth() * 96)
    return f'<img src="data:image/png;base64,{data}" alt="{html.escape(alt_text(figure))}" width="{width}">'


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of this size in inches that lays itself out; lines take the colours of PALETTE in turn."""
    from cycler import cycler
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    class PaletteFigure(Figure):
        def add_subplot(self, *args: Any, **kwargs: Any) -> Any:
            with rc_context({"axes.prop_cycle": cycler(color=PALETTE)}):  # axes read it when they are made
                return super().add_subplot(*args, **kwargs)

    return PaletteFigure(figsize=(width, height), layout="constrained", facecolor="white")


def tidy(axes: Axes) -> None:
    """Remove the frame's upper and right line, and draw a faint grid behind everything."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(True, which="major", color="#E4E4E4", lw=0.7)
    axes.set_axisbelow(True)


def title(axes: Axes, text: str) -> None:
    """Set a title flush left."""
    axes.set_title(text, loc="left", fontsize=11, color=INK)


def plain_ticks(axes: Axes, *names: str) -> None:
    """Write 1, 2, 5, 10 ... on logarithmic axes (``"x"``, ``"y"``) instead of powers of ten."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    for name in names:
        axis = axes.xaxis if name == "x" else axes.yaxis
        low, high = sorted(axis.get_view_interval())
        decades = math.log10(high / low)
        steps = (
            (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)
            if decades < 0.9
            else (1.0, 2.0, 5.0)
            if decades < 2.5
            else (1.0, 3.0)
            if decades < 4
            else (1.0,)
        )
        axis.set_major_locator(LogLocator(base=10, subs=steps, numticks=20))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.10g}"))
        axis.set_minor_locator(NullLocator())
