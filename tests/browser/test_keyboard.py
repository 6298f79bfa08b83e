"""A lab without a mouse: from the landing page into a lab, an answer, its check, Validate, and out again.

All is done with keys. That the focus can be seen is measured in the picture: what has it looks different without it.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from PIL import Image

from .page import NotebookPage, keep
from .server import LabServer, copy_course, serve, wait_until

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = [pytest.mark.browser, pytest.mark.timeout(600)]

LANDING = "course/00_welcome.ipynb"
LAB = "labs/assessment/assessment.ipynb"  # its cells run in a second, so Validate does, too
MOST_TABS = 80  # keys from the landing page's last cell to the link; nobody wants to press more

_FOCUSED = """() => {
  const e = document.activeElement;
  return {
    tag: e.tagName,
    text: (e.innerText || e.ariaLabel || '').trim().slice(0, 80),
    href: e.getAttribute('href') || '',
    editing: e.classList.contains('cm-content'),
    inNotebook: !!e.closest('.jp-NotebookPanel .jp-Notebook'),
    inToolbar: !!e.closest('.jp-NotebookPanel-toolbar'),
  };
}"""
_CELL = """() => {
  const notebook = [...document.querySelectorAll('.jp-NotebookPanel .jp-Notebook')].find(n => n.offsetParent);
  const cell = notebook && notebook.querySelector('.jp-Cell.jp-mod-active');
  return cell ? Number(cell.dataset.windowedListIndex) : -1;
}"""


@pytest.fixture(scope="module")
def server(repo: Path, chromium: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[LabServer]:
    scratch = tmp_path_factory.mktemp("keyboard")
    with serve(copy_course(repo, scratch / "course"), scratch) as running:
        yield running


def press_until(
    page: Page, key: str, reached: Callable[[dict[str, Any]], bool], most: int, what: str
) -> dict[str, Any]:
    """Press a key until the focus is where it should be; return what has it."""
    seen = []
    for _ in range(most):
        page.keyboard.press(key)
        focused: dict[str, Any] = page.evaluate(_FOCUSED)
        if reached(focused):
            return focused
        seen.append(f"{focused['tag']} {focused['text'][:20]!r}")
    raise AssertionError(f"{most} times {key} did not lead to {what}, but to " + ", ".join(seen))


def focus_shows(page: Page) -> bool:
    """Whether what has the focus looks different without it, in at least as many pixels as a thin frame has."""
    box = page.evaluate(
        "() => { const r = document.activeElement.getBoundingClientRect();"
        " return {x: Math.max(0, r.x - 6), y: Math.max(0, r.y - 6), width: r.width + 12, height: r.height + 12}; }"
    )

    def picture() -> Any:
        return np.asarray(Image.open(io.BytesIO(page.screenshot(clip=box, caret="initial"))).convert("L"), dtype=int)

    page.evaluate("() => { window.focused = document.activeElement; }")
    before = picture()
    page.evaluate("() => window.focused.blur()")
    after = picture()
    page.evaluate("() => window.focused.focus()")
    return int((np.abs(before - after) > 40).sum()) >= 10


def go_to(page: Page, notebook: NotebookPage, cell_id: str) -> None:
    """Move to a cell with the arrow keys, from the cell that is active, in command mode."""
    state = notebook.state()
    assert state is not None
    wanted = [cell["id"] for cell in state["cells"]].index(cell_id)
    for _ in range(len(state["cells"])):
        here = page.evaluate(_CELL)
        if here == wanted:
            return
        page.keyboard.press("ArrowDown" if here < wanted else "ArrowUp")
    raise AssertionError(f"the arrow keys do not lead to {cell_id}")


def run(page: Page, notebook: NotebookPage, cell_id: str) -> dict[str, Any]:
    """Run the active cell, stay on it, and return it when it is done."""

    def cell() -> dict[str, Any]:
        state = notebook.state()
        assert state is not None
        return next(c for c in state["cells"] if c["id"] == cell_id)

    before = cell()["count"]
    page.keyboard.press("Control+Enter")
    wait_until(lambda: cell()["count"] not in (None, before), 90, f"{cell_id} run")
    return cell()


def test_a_lab_can_be_done_with_the_keyboard_alone(page: Page, server: LabServer) -> None:
    page.goto(server.address(), wait_until="domcontentloaded")
    notebook = NotebookPage(page, server)
    notebook.path = LANDING
    wait_until(lambda: (notebook.state() or {}).get("status") == "idle", 120, "the landing page")
    # From wherever the focus is: the skip link, the menus, the side bar, and then the page with its links.
    reached = press_until(
        page, "Tab", lambda f: LAB.removeprefix("labs/") in f["href"], MOST_TABS, "the link to the lab"
    )
    assert focus_shows(page), reached
    keep(page, "keyboard_link")
    page.keyboard.press("Enter")
    notebook.path = LAB
    wait_until(lambda: (notebook.state() or {}).get("status") == "idle", 120, "the lab")
    if not page.evaluate(_FOCUSED)["inNotebook"]:
        press_until(page, "Tab", lambda f: f["inNotebook"], MOST_TABS, "the lab's cells")

    page.keyboard.press("Escape")
    go_to(page, notebook, "setup")
    run(page, notebook, "setup")
    go_to(page, notebook, "q01")
    page.keyboard.press("Enter")
    assert page.evaluate(_FOCUSED)["editing"]
    keep(page, "keyboard_edit")
    page.keyboard.press("Control+A")
    page.keyboard.type("q01 = []")
    page.keyboard.press("Escape")
    assert not page.evaluate(_FOCUSED)["editing"]  # Tab indents in an editor: Escape must lead out of it
    run(page, notebook, "q01")
    go_to(page, notebook, "check-architecture")
    checked = run(page, notebook, "check-architecture")
    said = "".join("".join(o.get("data", {}).get("text/html", "")) for o in checked["outputs"])
    assert "q01" in said or "points" in said, checked
    keep(page, "keyboard_check")

    # Out of the cells again: into the notebook's toolbar, which is one stop for Tab, with arrows inside.
    press_until(page, "Shift+Tab", lambda f: f["inToolbar"], MOST_TABS, "the toolbar")
    press_until(page, "ArrowRight", lambda f: "Validate" in f["text"], 20, "Validate")
    assert focus_shows(page)
    page.keyboard.press("Enter")
    dialog = page.locator(".jp-Dialog")
    dialog.wait_for(state="visible", timeout=120_000)
    keep(page, "keyboard_validate")
    assert "failed" in dialog.inner_text()
    assert page.evaluate("() => !!document.activeElement.closest('.jp-Dialog')")
    page.keyboard.press("Escape")
    dialog.wait_for(state="hidden")
