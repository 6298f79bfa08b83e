"""Figures and pages can be read by everybody: alt text, contrast, and colours that are told apart by all eyes.

That no figure of a lesson relies on colour alone is tested where the lessons run (tests/lessons.py, tests/seeing.py).
"""

from __future__ import annotations

import ast
import importlib
import itertools
import json
import re
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import nbformat
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from nbconvert import HTMLExporter
from numpy.typing import NDArray
from skimage.color import deltaE_ciede2000, xyz2lab

from robotbrain import figures
from robotbrain.display import show
from robotbrain.errors import InputError
from robotbrain.figures import contrast, new_figure, text_on
from tests import seeing
from tests.lessons import Tags, execute

REPO = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted(
    path
    for folder in ("course", "solutions", "labs")
    for path in (REPO / folder).rglob("*.ipynb")
    if ".ipynb_checkpoints" not in path.parts
)
COLOURS = {name: getattr(figures, name) for name in ("INK", "BLUE", "SKY", "GREEN", "MAUVE", "BROWN", "VERMILLION")}
NAMES = tuple({"INK": 0, **COLOURS, "QUIET": 0, "GREY": 0})

# ---------------------------------------------------------------- alt text


DRAWS = re.compile(r"\bplt\.(?:subplots|figure|imshow|plot|hist|bar)\(|\bnew_figure\(|\bplot_\w+\(|\.plot\(\)")
SHOWS = re.compile(r"\bshow\w*\(|\bset_label\(|\.replay\(")


def defined(source: str) -> set[str]:
    """Return the functions that a cell defines; their calls are looked at where they happen."""
    try:
        return {node.name for node in ast.parse(source).body if isinstance(node, ast.FunctionDef)}
    except SyntaxError:  # a line that only IPython reads
        return set()


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.relative_to(REPO).as_posix())
def test_every_cell_that_draws_shows_its_figure_with_alt_text(path: Path) -> None:
    cells = [c for c in nbformat.read(path, as_version=4).cells if c.cell_type == "code"]
    helpers = {name for cell in cells if SHOWS.search(cell.source) for name in defined(cell.source)}
    for cell in cells:
        source = cell.source
        assert not re.search(r"\bplt\.show\(", source), f"{cell.id}: plt.show() has no place for alt text"
        assert "inline" not in source or "%matplotlib" not in source, cell.id
        for name in helpers:
            source = re.sub(rf"(?<!def )\b{name}\(", "show(", source)
        if DRAWS.search(source) and not defined(source):
            assert SHOWS.search(source), f"{cell.id} draws, and says nothing to those who cannot see it"


def test_a_figure_of_a_lab_has_its_alt_text_in_the_notebook_and_in_the_page_made_of_it(tmp_path: Path) -> None:
    """One real lab, as far as its first figure; nbgrader's feedback is made by nbconvert as this page is."""
    lab = nbformat.read(REPO / "solutions/lab_integration/lab_integration.ipynb", as_version=4)
    last = next(number for number, cell in enumerate(lab.cells) if cell.id == "meet-world")
    lab.cells = lab.cells[: last + 1]
    nbformat.write(lab, path := tmp_path / "lab.ipynb")
    executed = execute(path)
    images = [a for tag, a in Tags(HTMLExporter().from_notebook_node(executed)[0]).found if tag == "img"]
    shown = [image for image in images if (image["src"] or "").startswith("data:image/png")]
    assert len(shown) == 1 and "goal marker" in (shown[0]["alt"] or "") and len(shown[0]["alt"] or "") > 40
    kinds = [kind for cell in executed.cells for o in cell.get("outputs", []) for kind in o.get("data", {})]
    assert "image/png" not in kinds


def test_showing_closes_a_figure_of_pyplot_and_asks_for_words() -> None:
    figure, axes = plt.subplots()
    axes.plot([0, 1])
    with pytest.raises(InputError, match="alt text"):
        show(figure)
    assert plt.fignum_exists(figure.number)
    shown = show(figure, 'A line that rises from 0 to 1, "straight" & steep.')
    assert not plt.fignum_exists(figure.number)
    [(_, image)] = [(tag, a) for tag, a in Tags(shown._repr_html_()).found if tag == "img"]
    assert image["alt"] == 'A line that rises from 0 to 1, "straight" & steep.' == repr(shown)


# ---------------------------------------------------------------- colours

CONES = {
    "all": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "tritanopia": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}
"""What is seen of linear RGB (Machado, Oliveira and Fernandes, 2009, table 1, severity 1.0)."""

TO_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
"""Of linear sRGB (IEC 61966-2-1)."""


def linear(colour: str) -> NDArray[np.float64]:
    """Return a colour as intensities of light."""
    c = np.array(to_rgb(colour))
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def difference(one: str, other: str, cones: str) -> float:
    """Return the CIEDE2000 difference of two colours to somebody with these cones."""
    lab = [xyz2lab(TO_XYZ @ np.clip(CONES[cones] @ linear(colour), 0, 1)) for colour in (one, other)]
    return float(deltaE_ciede2000(*lab))


@pytest.mark.parametrize(
    ("colour", "ratio"), [("#000000", 21.0), ("#FFFFFF", 1.0), ("#767676", 4.54), ("#FF0000", 4.0), ("#0000FF", 8.59)]
)
def test_contrast_is_that_of_wcag(colour: str, ratio: float) -> None:
    """Against values that W3C's and WebAIM's checkers give."""
    assert contrast(colour) == pytest.approx(ratio, abs=0.005)
    assert contrast("#FFFFFF", colour) == contrast(colour)


@pytest.mark.parametrize("name", COLOURS)
def test_lines_stand_out_from_the_paper_and_text_from_areas(name: str) -> None:
    assert contrast(COLOURS[name]) >= 3.0
    assert contrast(COLOURS[name], text_on(COLOURS[name])) >= 4.5


@pytest.mark.parametrize("name", ["INK", "QUIET", "GREY"])
def test_colours_of_text_can_be_read(name: str) -> None:
    assert contrast(getattr(figures, name)) >= 4.5


@pytest.mark.parametrize("cones", CONES)
def test_colours_are_told_apart_by_all_eyes(cones: str) -> None:
    """About 2 is just noticeable side by side; 15 and more is another colour at a glance."""
    for (one, a), (other, b) in itertools.combinations(COLOURS.items(), 2):
        assert difference(a, b, cones) >= 15, (one, other)


def test_every_palette_entry_has_another_look_besides() -> None:
    assert set(figures.PALETTE) == set(COLOURS.values()) - {figures.INK}
    for looks in (figures.LINES, figures.MARKERS, figures.HATCHES):
        assert len({str(look) for look in looks}) == len(looks) == len(figures.PALETTE)


def test_lines_without_a_colour_of_their_own_take_the_palettes() -> None:
    axes = new_figure(4, 3).subplots()
    assert [axes.plot([0, 1])[0].get_color() for _ in figures.PALETTE] == list(figures.PALETTE)
    assert plt.rcParams["axes.prop_cycle"].by_key()["color"][0] not in figures.PALETTE  # others' figures stay theirs


@pytest.mark.parametrize("folder", ["course", "solutions"])
def test_notebooks_take_their_colours_from_the_palette(folder: str) -> None:
    """Figures are on white; the few colours that notebooks write out are of areas and frames, or of camera images."""
    allowed = {"#DDDDDD", "#BBBBBB", "#F0E442", "#FF00FF"}
    for path in (REPO / folder).rglob("*.ipynb"):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        code = "".join("".join(c["source"]) for c in cells if c["cell_type"] == "code")
        assert set(re.findall(r'"(#[0-9A-Fa-f]{6})"', code)) <= allowed, path


# ---------------------------------------------------------------- the rules themselves


def drawn(draw: Any, alt: str = "Two lines over time, one of which ends far above the other.") -> list[str]:
    figure = new_figure(4, 3)
    axes = figure.subplots()
    draw(axes)
    axes.legend()
    figure.set_label(alt)
    return seeing.problems(figure)


def test_what_keeps_people_from_reading_a_figure_is_found() -> None:
    assert drawn(lambda a: (a.plot([0, 1], label="a"), a.plot([1, 0], "--", label="b"))) == []
    assert "alt text" in drawn(lambda a: a.plot([0, 1], label="a"), alt="a plot")[0]
    assert "2.3:1" in drawn(lambda a: a.plot([0, 1], color="#E69F00", label="a"))[0]
    assert "only colour" in drawn(lambda a: (a.plot([0, 1], label="a"), a.plot([1, 0], label="b")))[0]
    assert "the text 'x'" in drawn(lambda a: (a.plot([0, 1], label="a"), a.text(0, 0, "x", color="#AAAAAA")))[0]
    assert "the bars 'a'" in drawn(lambda a: a.bar([0], [1], color="#F0E442", label="a"))[0]
    bars = [{"color": figures.BLUE, "label": "a"}, {"color": figures.GREEN, "label": "b"}]
    assert "only colour" in drawn(lambda a: [a.bar([0], [1], **one) for one in bars])[0]
    assert drawn(lambda a: [a.bar([0], [1], hatch=h, **one) for h, one in zip(("", "//"), bars, strict=True)]) == []


# ---------------------------------------------------------------- pages that the kit writes

PAGES = {
    "monitoring report": ("robotbrain.monitoring.report_page", "_PAGE"),
    "calibration report": ("robotbrain.jetson.report_words", "PAGE"),
    "replay in 3D": ("robotbrain.sim.meshcat_page", "_PAGE"),
    "demo": ("robotbrain.demo", "_PAGE"),
}


@pytest.mark.parametrize("name", PAGES)
def test_a_page_says_its_language_and_title_and_its_text_can_be_read(name: str) -> None:
    module, variable = PAGES[name]
    page = getattr(importlib.import_module(module), variable)
    assert '<html lang="en">' in page and re.search(r"<title>[^<]+</title>", page)
    for colour in re.findall(r"(?<![-\w])color: ?(#[0-9a-fA-F]{3,6})", page):
        assert contrast(colour) >= 4.5 and contrast(colour, "#f2f2f2") >= 4.5, colour  # on paper, on a table's head
