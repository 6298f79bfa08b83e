"""JupyterLab as a person at the screen uses it, and a few questions about what it holds."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from .server import LabServer, wait_until

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page

_FIND = "(path) => [...window.jupyterapp.shell.widgets('main')].find(w => w.context && w.context.path === path)"
_STATE = f"""(path) => {{
  const widget = window.jupyterapp && ({_FIND})(path);
  const cells = [];
  if (!widget || !widget.model || !widget.context.isReady) return null;
  for (const cell of widget.model.cells) cells.push({{
    id: cell.id,
    type: cell.type,
    source: cell.sharedModel.getSource(),
    count: cell.type === 'code' ? cell.executionCount : null,
    outputs: cell.type === 'code' ? cell.outputs.toJSON() : [],
  }});
  const session = widget.sessionContext.session;
  return {{status: session && session.kernel ? session.kernel.status : 'none', cells: cells}};
}}"""
_SHOW = f"""async ([path, id]) => {{
  const notebook = ({_FIND})(path).content;
  const index = notebook.widgets.findIndex(cell => cell.model.id === id);
  notebook.activeCellIndex = index;
  await notebook.scrollToItem(index, 'start');
  return index;
}}"""


class NotebookPage:
    """A window of JupyterLab with a notebook in front.

    Args:
        page: Playwright's page.
        server: where it comes from.
    """

    def __init__(self, page: Page, server: LabServer) -> None:
        self.page, self.server, self.path = page, server, ""

    def open(self, path: str, workspace: str) -> None:
        """Open the notebook at ``path`` (within the course) in a workspace of its own; wait until it can be used."""
        self.page.goto(self.server.address(path, workspace), wait_until="domcontentloaded")
        self.wait_for(path)

    def wait_for(self, path: str) -> None:
        """Wait until the notebook at ``path`` is open and its kernel idle, and bring it to the front."""
        self.path = path

        def ready() -> bool:
            state = self.state()
            return bool(state and state["status"] == "idle" and state["cells"])

        wait_until(ready, 120, lambda: f"an idle kernel; {self.summary()}")
        # A notebook that was opened by its address gets the focus late or never; menus act on the one that has it.
        self.page.locator(f'.lm-DockPanel-tabBar .lm-TabBar-tab[title*="{path}"]').click()
        self.page.locator(".lm-TabBar-tab.jp-mod-current").get_by_text(Path(path).name).wait_for()

    def state(self) -> dict[str, Any] | None:
        """The kernel's status and the cells (id, type, source, count, outputs) of the notebook, once it is loaded."""
        return self.page.evaluate(_STATE, self.path)  # type: ignore[no-any-return]

    def summary(self) -> str:
        """One line on how far the notebook has come."""
        state = self.state()
        if state is None:
            return f"{self.path} is not open"
        done = [cell["id"] for cell in state["cells"] if cell["count"]]
        return f"{self.path}: kernel {state['status']}, {len(done)} cells run, last {done[-1] if done else '(none)'}"

    def menu(self, *labels: str) -> None:
        """Choose an entry of the menu bar: ``menu("Run", "Run All Cells")``."""
        self.page.locator(".jp-MenuBar-anchor, .lm-MenuBar-item").get_by_text(labels[0], exact=True).first.click()
        for label in labels[1:]:
            self.page.locator(".lm-Menu-item:visible .lm-Menu-itemLabel").get_by_text(label, exact=True).click()

    def run_all(self, timeout_s: float) -> list[dict[str, Any]]:
        """Run all cells through the menu, wait until the last one has run, and return the code cells."""
        self.menu("Run", "Run All Cells")

        def finished() -> list[dict[str, Any]] | None:
            state = self.state()
            assert state is not None
            code = [cell for cell in state["cells"] if cell["type"] == "code"]
            errors = [cell["id"] for cell in code if any(o["output_type"] == "error" for o in cell["outputs"])]
            return code if state["status"] == "idle" and (code[-1]["count"] or errors) else None

        return wait_until(finished, timeout_s, lambda: f"all cells run; {self.summary()}", every_s=0.5)

    def show(self, cell_id: str) -> Locator:
        """Scroll a cell to the top of the screen and return it."""
        index = self.page.evaluate(_SHOW, [self.path, cell_id])
        cell = self.page.locator(f'.jp-NotebookPanel:visible .jp-Cell[data-windowed-list-index="{index}"]')
        cell.wait_for(state="visible")
        cell.scroll_into_view_if_needed()
        return cell

    def replace(self, cell_id: str, text: str) -> None:
        """Put the cursor into a code cell, mark everything in it, and type ``text`` over it, as from a clipboard."""
        editor = self.show(cell_id).locator(".cm-content")
        editor.click()
        self.page.keyboard.press("ControlOrMeta+A")
        self.page.keyboard.insert_text(text)
        wait_until(lambda: self._cell(cell_id)["source"] == text, 20, f"the text in cell {cell_id}")

    def run_cell(self, cell_id: str, timeout_s: float = 60) -> dict[str, Any]:
        """Run a code cell with Control + Enter and return it with its outputs."""
        before = self._cell(cell_id)["count"]
        self.show(cell_id).locator(".cm-content").click()
        self.page.keyboard.press("Control+Enter")

        def done() -> bool:
            state = self.state()
            return bool(state and state["status"] == "idle" and self._cell(cell_id)["count"] not in (None, before))

        wait_until(done, timeout_s, lambda: f"cell {cell_id} run; {self.summary()}")
        return self._cell(cell_id)

    def validate(self, timeout_s: float = 300) -> str:
        """Press Validate and return what the dialog says."""
        self.page.locator(".jp-NotebookPanel:visible .jp-NotebookPanel-toolbar").get_by_text("Validate").click()
        dialog = self.page.locator(".jp-Dialog")
        dialog.wait_for(state="visible", timeout=timeout_s * 1000)
        return dialog.inner_text()

    def _cell(self, cell_id: str) -> dict[str, Any]:
        state = self.state()
        assert state is not None, self.summary()
        return next(cell for cell in state["cells"] if cell["id"] == cell_id)

    def save_screenshot(self, name: str) -> None:
        """Keep a picture of the window; see :func:`keep`."""
        keep(self.page, name)


def keep(page: Page, name: str) -> None:
    """Keep a picture of the window where ``ROBOTBRAIN_SCREENSHOTS`` says, if it says."""
    if folder := os.environ.get("ROBOTBRAIN_SCREENSHOTS"):
        Path(folder).mkdir(parents=True, exist_ok=True)
        page.screenshot(path=str(Path(folder) / f"{name}.png"))


def wait_for_3d_view(cell: Locator, timeout_s: float = 60) -> Locator:
    """Wait until the 3D view in a cell's output has drawn a scene; return its frame.

    A canvas that nothing was drawn on has one colour; a hall with a robot has hundreds.
    """
    frame = cell.locator("iframe")
    frame.wait_for(state="visible")
    frame.scroll_into_view_if_needed()
    canvas = frame.content_frame.locator("canvas").first
    canvas.wait_for(state="visible", timeout=timeout_s * 1000)
    seen: list[int] = []

    def drawn() -> bool:
        pixels = np.asarray(Image.open(io.BytesIO(frame.screenshot())).convert("RGB"))
        height, width, _ = pixels.shape
        middle = pixels[
            height // 4 : -height // 4, width // 4 : -width // 4
        ]  # meshcat's own controls sit in the corner
        seen.append(len(np.unique(middle.reshape(-1, 3), axis=0)))
        return seen[-1] >= 100

    wait_until(drawn, timeout_s, lambda: f"a drawn scene in the 3D view; numbers of colours seen: {seen}")
    return frame
