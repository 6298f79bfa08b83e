"""The book: its parts, and what a reader meets.

Without more ado it is built without running the notebooks, and a browser looks at some of its pages and at one more,
which holds outputs of every kind. ``ROBOTBRAIN_BOOK=FOLDER`` names a finished book: then it looks at every page, light
and dark, wide and narrow (``make proof-book``).
"""

from __future__ import annotations

import html
import importlib.util
import io
import os
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import nbformat
import numpy as np
import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output
from PIL import Image

from robotbrain.bundle.contents import Item
from robotbrain.bundle.key import Key
from robotbrain.grading.course import find_course
from robotbrain.outline import read_outline

from .book_browser import DESKTOP, PHONE, Visit, axe_script, browser, drawn, inspect, is_animated, reader, watch
from .book_site import Book, malformed, read_page, serve
from .browser.server import wait_until
from .conftest import REPO, need

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.timeout(3600)

SAMPLE = ("index.html", "course/00_welcome.html", "references.html", "search.html")
"""Pages for the browser when the book has not been executed."""
LOOKS = (("light", DESKTOP), ("dark", DESKTOP), ("light", PHONE))
KERNEL = {
    "kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"},
    "language_info": {"name": "python", "pygments_lexer": "ipython3"},
}
WIDGET = "application/vnd.jupyter.widget-view+json"
WIDGETS = {
    "widgets": {
        "application/vnd.jupyter.widget-state+json": {
            "state": {"w": {"model_name": "HTMLModel", "state": {"value": "<p>what the widget showed last</p>"}}},
            "version_major": 2,
            "version_minor": 0,
        }
    }
}
TERMS = ("quantisation", "costmap", "percentile", "odometry")


@pytest.fixture(scope="module")
def maker() -> Iterator[Any]:
    """The modules in ``book/``."""
    need(importlib.util.find_spec("myst_nb"), "no Sphinx with MyST-NB (they are in the extra `book`)")
    sys.path.insert(0, str(REPO / "book"))
    import anchors
    import build
    import references
    import replays
    import staging
    import widgets

    yield type("Maker", (), {m.__name__: m for m in (anchors, build, references, replays, staging, widgets)})
    sys.path.remove(str(REPO / "book"))


@pytest.fixture(scope="module")
def book(maker: Any, tmp_path_factory: pytest.TempPathFactory) -> Book:
    """The finished book, or the quick one."""
    if finished := os.environ.get("ROBOTBRAIN_BOOK"):
        return Book(Path(finished).resolve())
    work = tmp_path_factory.mktemp("book")
    command = [sys.executable, str(REPO / "book" / "build.py"), "--no-execution", "--work", str(work)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return Book(work / "html")


def scene() -> str:
    """A replay as a notebook holds it: a box that turns."""
    import meshcat.geometry as g

    from robotbrain.sim.geometry import Pose2D
    from robotbrain.sim.meshcat_page import MeshcatPage, inline_frame

    page = MeshcatPage("A box")
    page.add("box", g.Box([1.0, 2.0, 0.5]), (0.8, 0.3, 0.1))
    page.animate_pose("box", np.array([0.0, 1.0, 2.0]), [Pose2D(0, 0, 0), Pose2D(0, 0, 1.5), Pose2D(0, 0, 3.0)])
    return inline_frame(page.html(), 320)


def output(markup: str) -> Any:
    return new_output("display_data", {"text/html": markup, "text/plain": "an output"})


@pytest.fixture(scope="module")
def demo(maker: Any, tmp_path_factory: pytest.TempPathFactory) -> Book:
    """A page with outputs of every kind: the executed book where it is there, else one that is made for it."""
    if os.environ.get("ROBOTBRAIN_BOOK"):
        return Book(Path(os.environ["ROBOTBRAIN_BOOK"]).resolve())
    work = tmp_path_factory.mktemp("demo")
    table = "<table><caption>Numbers</caption><tr><th>wide</th>" + "<td>1234567890</td>" * 20 + "</tr></table>"
    card = '<div class="robotbrain-report" style="background:#fff;color:#1a1a1a">'  # as the answer of a check
    link = card + '<a href="index.ipynb#cell-id=maths">reread</a></div>'
    cells = [
        new_markdown_cell("# Outputs\n\nA formula: $a^2 + b^2 = c^2$\n\n$$\\int_0^1 x\\,dx = \\tfrac12$$", id="maths"),
        new_code_cell("watch()", id="watch", outputs=[output(scene())]),
        new_code_cell("table()", id="table", outputs=[output(table + link)]),
        new_code_cell("widget()", id="widget", outputs=[new_output("display_data", {WIDGET: {"model_id": "w"}})]),
    ]
    (work / "source").mkdir()
    nbformat.write(new_notebook(cells=cells, metadata=KERNEL | WIDGETS), work / "source" / "index.ipynb")
    assert maker.build.build(work / "source", work / "html", None) == 0
    return Book(work / "html")


# -- the parts --


def test_references_end_where_the_next_begins(maker: Any) -> None:
    found = maker.references.readings(
        "A. Bee et al., [One](https://a.example), 2001. A remark. C. D. Eff, *Three*, 1999."
    )
    assert found == ["A. Bee et al., [One](https://a.example), 2001. A remark", "C. D. Eff, *Three*, 1999"]
    assert maker.references.readings("A, “No. One. Two”, 1999 · [B](https://a.example)") == [
        "A, “No. One. Two”, 1999",
        "[B](https://a.example)",
    ]


def test_labs_come_in_the_order_of_the_course(maker: Any) -> None:
    order = maker.staging.labs_in_order(["zeta", "capstone", "hw1_rl", "lab_integration", "alpha"])
    assert order == ["lab_integration", "hw1_rl", "capstone", "alpha", "zeta"]


def test_links_to_cells_lead_to_their_places(maker: Any) -> None:
    mended = maker.anchors.to_pages('<a href="../a/b.ipynb#cell-id=c-1">x</a> <a href="d.ipynb">y</a>')
    assert mended == '<a href="../a/b.html#cell-c-1">x</a> <a href="d.html">y</a>'
    elsewhere = '<a href="https://a.example/b.ipynb">x</a>'
    assert maker.anchors.to_pages(elsewhere) == elsewhere


def test_what_no_replay_is_stays_where_it_is(maker: Any, tmp_path: Path) -> None:
    markup = '<iframe srcdoc="&lt;p&gt;other&lt;/p&gt;" title="t">'
    assert maker.replays.externalise(markup, tmp_path, "../_replays/", "script") == markup
    assert not list(tmp_path.iterdir())


def test_a_widget_leaves_what_it_showed_last(maker: Any) -> None:
    views = [f'<script type="application/vnd.jupyter.widget-view+json">{{"model_id": "{n}"}}</script>' for n in "abc"]
    state = {
        "a": {"model_name": "HTMLModel", "state": {"value": "<p>last</p>"}},
        "b": {"model_name": "IntSliderModel", "state": {"value": 3}},
    }
    assert maker.widgets.still("<i>x</i>".join(views), state) == "<p>last</p><i>x</i><i>x</i>"


def test_a_broken_link_a_missing_place_and_a_path_out_are_found(tmp_path: Path) -> None:
    (tmp_path / "html").mkdir()
    (tmp_path / "secret.html").write_text("<p>")
    links = ["b.html#here", "b.html#there", "c.html", "../secret.html", "https://a.example/", "#top", "#bottom"]
    (tmp_path / "html" / "a.html").write_text("<p id=top>" + "".join(f'<a href="{link}">x</a>' for link in links))
    (tmp_path / "html" / "b.html").write_text('<p id="here">')
    count, broken = Book(tmp_path / "html").broken_links()
    assert count == 6
    assert [line.split()[1] for line in broken] == ["b.html#there", "c.html", "../secret.html", "#bottom"]


@pytest.mark.parametrize(
    ("address", "fault"),
    [
        ("https://docs.a.example/x?y#z", ""),
        ("http://a.example", "http"),
        ("http://incompleteideas.net/book", ""),
        ("https://nowhere", "not an address"),
        ("https://a.example/ b", "not an address"),
        ("ftp://a.example", "scheme ftp"),
    ],
)
def test_addresses_elsewhere_are_judged(address: str, fault: str) -> None:
    assert malformed(address) == fault


def test_a_cell_that_fails_fails_the_build_by_name_and_what_ran_is_kept(
    maker: Any, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    source = tmp_path / "source"
    source.mkdir()
    notes = {"index": "print(40 + 2)", "broken": "1 / 0"}
    for name, code in notes.items():
        contents = "\n\n```{toctree}\nbroken\n```" if name == "index" else ""
        cells = [new_markdown_cell(f"# {name}{contents}", id="title"), new_code_cell(code, id=f"{name}-cell")]
        nbformat.write(new_notebook(cells=cells, metadata=KERNEL), source / f"{name}.ipynb")
    assert maker.build.build(source, tmp_path / "html", tmp_path / "cache") != 0
    assert "broken.ipynb, cell `broken-cell`: ZeroDivisionError: division by zero" in capfd.readouterr().err
    text = (source / "broken.ipynb").read_text(encoding="utf-8")
    (source / "broken.ipynb").write_text(text.replace("1 / 0", "1 / 2"), encoding="utf-8")
    assert maker.build.build(source, tmp_path / "html", tmp_path / "cache") == 0
    said = capfd.readouterr()
    assert re.search(r"index\.ipynb: Using cached notebook", said.out + said.err)
    assert "42" in (tmp_path / "html" / "index.html").read_text(encoding="utf-8")


# -- the pages as files --


def test_pages_have_a_title_a_language_and_headings_in_order(book: Book) -> None:
    assert {page.language for page in book.pages} == {"en"}
    assert len({page.title for page in book.pages}) == len(book.pages)
    for page in book.pages:
        assert page.headings[:1] == [1], page.path
        assert page.headings.count(1) == 1, page.path
        steps = zip(page.headings, page.headings[1:], strict=False)
        assert all(below <= above + 1 for above, below in steps), page.path
        assert not page.repeated, page.path


def test_every_image_says_what_is_to_be_seen(book: Book) -> None:
    for page in book.pages:
        for address, words in page.images:
            assert words, f"{page.path}: {address[:60]} has no alternative text"
            assert not re.search(r"\.(png|svg|jpe?g)$|^_?images/|^data:", words), f"{page.path}: {words[:60]}"
        assert all(title for _, title in page.frames), page.path


def test_no_link_within_the_book_is_broken(book: Book) -> None:
    count, broken = book.broken_links()
    assert count > 2000
    assert not broken, "\n".join(broken)


def test_links_elsewhere_are_well_formed_and_encrypted(book: Book) -> None:
    external = book.external()
    assert len(external) > 50
    faults = {address: fault for address in external if (fault := malformed(address))}
    assert not faults


def test_pages_name_nothing_elsewhere_that_a_browser_would_load(book: Book) -> None:
    loaded = [(p.path, a) for p in book.pages for tag, a in p.links if tag != "a" and "//" in a[:9]]
    assert not loaded
    for sheet in book.folder.rglob("*.css"):
        assert not re.search(r"url\(\s*['\"]?(https?:)?//", sheet.read_text(encoding="utf-8")), sheet.name


def test_all_lessons_and_labs_can_be_downloaded_as_they_are_released(book: Book) -> None:
    offered = {path.relative_to(book.folder / "_sources").as_posix(): path for path in book.downloads()}
    released = [p for pattern in ("course/*.ipynb", "labs/*/*.ipynb") for p in REPO.glob(pattern)]
    assert offered.keys() == {path.relative_to(REPO).as_posix() for path in released}
    assert all(offered[p.relative_to(REPO).as_posix()].read_bytes() == p.read_bytes() for p in released)
    for name, path in offered.items():
        notebook = nbformat.read(path, 4)
        nbformat.validate(notebook)
        assert not any(cell.get("outputs") for cell in notebook.cells), name
        page = read_page(name, (book.folder / name).with_suffix(".html").read_text(encoding="utf-8"))
        assert any(address.endswith(f"_sources/{name}") for _, address in page.links), name


def test_the_key_is_nowhere_in_the_book(book: Book) -> None:
    texts = {
        p.relative_to(book.folder).as_posix(): p for p in book.folder.rglob("*") if p.suffix in (".html", ".ipynb")
    }
    items = []
    for name, path in texts.items():
        text = path.read_text(encoding="utf-8")
        assert "### BEGIN" not in text, name
        plain = html.unescape(re.sub(r"<[^>]*>", "", text)) if path.suffix == ".html" else text
        assert "### BEGIN SOLUTION" not in plain, name
        assert "### BEGIN HIDDEN" not in plain, name
        source = str(PurePosixPath(name.removeprefix("_sources/")).with_suffix(".ipynb"))  # what PUBLIC calls it
        items.append(Item(source, plain.encode()))
    leaks = Key(find_course(REPO)).leaks(items)
    assert not leaks, "\n".join(map(str, leaks))


def test_the_map_of_the_outline_links_to_each_cell(book: Book) -> None:
    outline = read_outline(REPO / "course" / "outline.toml")
    by_path = {page.path: {address for _, address in page.links} for page in book.pages}
    for page, rows in (("course/OUTLINE.html", outline.entries), ("course/CHANGES.html", outline.changes)):
        places = {address.rpartition("/")[2] for address in by_path[page]}
        missing = {f"{c.path.stem}.html#cell-{c.id}" for row in rows for c in row.cells} - places
        assert not missing, page


def test_the_references_hold_every_address_that_notebooks_recommend(book: Book) -> None:
    listed = {address for page in book.pages if page.path == "references.html" for _, address in page.links}
    texts = [
        c.source for p in book.downloads() for c in nbformat.read(p, 4).cells if "**Further reading.**" in c.source
    ]
    wanted = {
        a for text in texts for a in re.findall(r"\]\((https?://[^)\s]+)\)", text.split("**Further reading.**")[1])
    }
    assert len(wanted) > 40
    assert wanted <= listed


# -- the pages in a browser --


@pytest.fixture(scope="module")
def shown(chromium: str) -> Iterator[Browser]:
    need(importlib.util.find_spec("playwright"), "no playwright (it is in the extra `dev`)")
    with browser(chromium) as opened:
        yield opened


@pytest.fixture(scope="module")
def base(book: Book) -> Iterator[str]:
    with serve(book.folder) as address:
        yield address


@pytest.fixture(scope="module")
def visits(book: Book, demo: Book, base: str, shown: Browser) -> list[Visit]:
    """What every page (or the sample) showed, light and dark, wide and narrow."""
    need(importlib.util.find_spec("axe_playwright_python"), "no axe-playwright-python (it is in the extra `dev`)")
    axe = axe_script()
    paths = [page.path for page in book.pages] if book.executed else list(SAMPLE)
    found = []
    with serve(demo.folder) as second:
        for mode, size in LOOKS:
            with reader(shown, mode, size) as context:
                found += [inspect(context, base, path, mode, axe) for path in paths]
                if not book.executed:
                    found.append(inspect(context, second, "index.html", mode, axe))
    return found


def test_axe_finds_nothing_serious(visits: list[Visit]) -> None:
    impacts = Counter(impact for visit in visits for impact, *_ in visit.violations)
    told = [f"{v.path} ({v.mode}): {' | '.join(one)}" for v in visits for one in v.violations]
    print(len(visits), "visits; violations by impact:", dict(impacts), *told, sep="\n")
    assert not impacts["critical"] + impacts["serious"], "\n".join(told)


def test_nothing_is_loaded_from_elsewhere(visits: list[Visit]) -> None:
    assert not [(visit.path, visit.outside) for visit in visits if visit.outside]


def test_nothing_fails_in_the_browser(visits: list[Visit]) -> None:
    assert not [(visit.path, visit.failed) for visit in visits if visit.failed]


def test_no_page_is_wider_than_the_window(visits: list[Visit]) -> None:
    assert not [(visit.path, visit.mode, visit.too_wide) for visit in visits if visit.too_wide > 0]


def test_axe_and_the_watch_would_see_faults(shown: Browser, tmp_path: Path) -> None:
    bad = '<html lang="en"><title>x</title><p style="color:#ddd">pale</p><img src="http://127.0.0.1:9/x.png"></html>'
    (tmp_path / "bad.html").write_text(bad)
    with serve(tmp_path) as address, reader(shown) as context:
        visit = inspect(context, address, "bad.html", "", axe_script())
    assert {"color-contrast", "image-alt"} <= {rule for _, rule, *_ in visit.violations}
    assert visit.outside == ["http://127.0.0.1:9/x.png"]


@pytest.mark.parametrize("term", TERMS)
@pytest.mark.parametrize("served", [True, False], ids=["served", "from the disk"])
def test_search_finds_and_its_results_open(book: Book, base: str, shown: Browser, term: str, served: bool) -> None:
    start = base if served else book.folder.as_uri() + "/"
    with reader(shown) as context:
        context.set_offline(not served)
        page = context.new_page()
        page.goto(f"{start}search.html?q={term}")
        results = page.locator("#search-results li a")
        results.first.wait_for()
        results.first.click()
        page.wait_for_load_state()
        assert "search.html" not in page.url
        assert term.lower() in page.locator("article").inner_text().lower()


def test_the_search_field_opens_by_the_keyboard(base: str, shown: Browser) -> None:
    with reader(shown) as context:
        page = context.new_page()
        page.goto(base + "index.html")
        page.keyboard.press("Control+k")
        page.keyboard.type("costmap")
        page.keyboard.press("Enter")
        page.locator("#search-results li a").first.wait_for()


def test_light_and_dark_are_kept_from_page_to_page(base: str, shown: Browser) -> None:
    with reader(shown) as context:
        page = context.new_page()
        page.goto(base + "index.html")
        seen = {}
        for mode in ("dark", "light"):
            page.goto(base + "index.html")
            page.locator("button.theme-switch-button:visible").click()
            page.locator(f'button.theme-change-button[data-mode="{mode}"]').click()
            page.goto(base + "course/00_welcome.html")
            assert page.evaluate("document.documentElement.dataset.theme") == mode
            seen[mode] = page.evaluate("getComputedStyle(document.body).backgroundColor")
        assert seen["light"] != seen["dark"]


def test_every_replay_draws_and_moves(demo: Book, shown: Browser) -> None:
    owners = {src: page.path for page in demo.pages for src, _ in page.frames}
    assert {Path(src).name for src in owners} == {Path(replay.path).name for replay in demo.replays}
    with serve(demo.folder) as address, reader(shown) as context:
        for source, path in owners.items():
            visit = Visit(path, "")
            page = context.new_page()
            watch(page, address, visit)
            page.goto(address + path)
            frame = page.locator(f'iframe[src="{source}"]').first
            frame.scroll_into_view_if_needed()
            frame.content_frame.locator("canvas").first.wait_for(timeout=60_000)
            moves = is_animated((demo.folder / path).parent.joinpath(source).read_text(encoding="utf-8"))

            def alive(page: Any = page, frame: Any = frame, moves: bool = moves) -> bool:
                first, second = drawn(page, frame)
                colours = np.asarray(Image.open(io.BytesIO(second)).convert("RGB")).reshape(-1, 3)
                return len(np.unique(colours, axis=0)) >= 20 and (first != second or not moves)

            wait_until(alive, 60, f"{path}: {source} draws{' and moves' if moves else ''}")
            assert not visit.outside + visit.failed, path
            page.close()


def test_widgets_show_their_last_state_and_load_nothing(demo: Book) -> None:
    text = "".join((demo.folder / page.path).read_text(encoding="utf-8") for page in demo.pages)
    assert "widget-view+json" not in text
    assert "widget-state+json" not in text
    assert ("what the widget showed last" in text) != bool(os.environ.get("ROBOTBRAIN_BOOK"))


def test_formulas_need_no_script(book: Book, base: str, shown: Browser) -> None:
    with reader(shown) as context:
        page = context.new_page()
        page.goto(base + "course/08_model_optimisation.html")
        formulas = page.locator("math").all()
        assert len(formulas) > 20
        box = formulas[0].bounding_box()
        assert box is not None
        assert box["width"] > 5
    sources = " ".join((book.folder / p.path).read_text(encoding="utf-8") for p in book.pages)
    assert not re.search(r"<script[^>]*(mathjax|katex)", sources, re.IGNORECASE)
    text = re.sub(r"<(pre|code|annotation|script).*?</\1>", "", sources, flags=re.DOTALL)
    assert not re.search(r"\\(frac|mathrm|sum|hat|begin)\b", text)
