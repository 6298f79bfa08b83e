"""What the figures of the twin have in common: how they look, what they say in words, how they are stored."""

from __future__ import annotations

import base64
import html
import io
import math
from pathlib import Path
from typing import TYPE_CHECKING

from robotbrain.errors import InputError
from robotbrain.files import atomic_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FORMATS = ("png", "svg", "pdf")
"""What figures can be written as."""

INK = "#1b1b1b"
QUIET = "#6b6b6b"


def alt_text(figure: Figure) -> str:
    """Return what a figure of this module shows, in words."""
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
    """Return an empty figure of this size in inches that lays itself out."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained", facecolor="white")


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
