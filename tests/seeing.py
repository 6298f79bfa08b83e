"""What a figure asks of the eyes of those who look at it, found in its artists.

Contrast is that of WCAG 2.2: 4.5:1 for text (1.4.3), 3:1 for lines and marks that carry meaning (1.4.11). What has a
label in a legend carries meaning; shading (less than half opaque) stands behind other things and is left out.
"""

from __future__ import annotations

import itertools
from typing import Any

from matplotlib.axes import Axes
from matplotlib.colors import to_hex, to_rgba
from matplotlib.container import BarContainer
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text

from robotbrain.figures import contrast

TEXT, MARK = 4.5, 3.0
LEAST_ALT = 40  # characters; "a plot of the error" would be shorter


def on_white(colour: Any, alpha: float | None = None) -> str:
    """Return a colour as it looks on white paper."""
    red, green, blue, opacity = to_rgba(colour, alpha)
    return to_hex([c * opacity + 1 - opacity for c in (red, green, blue)])


def problems(figure: Figure) -> list[str]:
    """Return what keeps somebody from reading this figure; nothing if all can."""
    found = []
    if len(str(figure.get_label())) < LEAST_ALT:
        found.append(f"the alt text is {figure.get_label()!r}")
    found += [
        f"the text {text.get_text()!r} has {ratio:.1f}:1"
        for text in figure.findobj(Text)
        if isinstance(text, Text) and text.get_visible() and text.get_text().strip()
        if not on_an_area(text) and (ratio := contrast(on_white(text.get_color(), text.get_alpha()))) < TEXT
    ]
    for axes in figure.findobj(Axes):
        assert isinstance(axes, Axes)
        found += of_lines(axes) + of_bars(axes)
    return found


def on_an_area(text: Text) -> bool:
    """Whether a text is white, as only one on a coloured area can be (``figures.text_on`` chose it)."""
    return to_hex(text.get_color()) == "#ffffff"


def of_lines(axes: Axes) -> list[str]:
    """What is wrong with the lines and marks that a legend names."""
    named = [line for line in axes.get_lines() if not str(line.get_label()).startswith("_")]
    found = [
        f"the line {line.get_label()!r} has {ratio:.1f}:1"
        for line in named
        if (ratio := contrast(on_white(line.get_color(), line.get_alpha()))) < MARK
    ]
    found += [
        f"only colour tells {one.get_label()!r} from {other.get_label()!r}"
        for one, other in itertools.combinations(named, 2)
        if one.get_color() != other.get_color() and look(one) == look(other)
    ]
    return found


def look(line: Line2D) -> tuple[object, ...]:
    """Return all of a line's looks but its colour."""
    dashes = getattr(line, "_unscaled_dash_pattern", line.get_linestyle())
    return str(dashes), str(line.get_marker()), line.get_linewidth(), line.get_fillstyle()


def of_bars(axes: Axes) -> list[str]:
    """What is wrong with the bars that a legend names."""
    named = [
        (str(bars.get_label()), bars.patches[0])
        for bars in axes.containers
        if isinstance(bars, BarContainer) and bars.patches and not str(bars.get_label()).startswith("_")
    ]
    fills = {name: on_white(bar.get_facecolor()) for name, bar in named}
    found = [
        f"the bars {name!r} have {contrast(fills[name]):.1f}:1"
        for name, bar in named
        if contrast(fills[name]) < MARK and contrast(on_white(bar.get_edgecolor())) < MARK
    ]
    found += [
        f"only colour tells the bars {one!r} from {other!r}"
        for (one, bar), (other, beside) in itertools.combinations(named, 2)
        if bar.get_hatch() == beside.get_hatch() and contrast(fills[one], fills[other]) < MARK
    ]
    return found


class Watch:
    """Looks at every figure that a notebook shows; put before its first cell, and asked after its last."""

    def __init__(self) -> None:
        from robotbrain import display

        self.found: list[str] = []
        self.figures = 0
        genuine = display.show

        def show(figure: Figure, alt: str | None = None) -> Any:
            shown = genuine(figure, alt)
            self.figures += 1
            self.found += [f"figure {self.figures} ({str(figure.get_label())[:40]}…): {p}" for p in problems(figure)]
            return shown

        display.show = show

    def ask(self) -> None:
        """Raise an AssertionError that says what is wrong with the figures shown so far."""
        assert not self.found, "\n".join(self.found)
