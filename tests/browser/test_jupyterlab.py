"""The course in a real JupyterLab in a real browser, as a student meets it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import psutil
import pytest

from ..conftest import REPO
from .page import NotebookPage, wait_for_3d_view
from .server import WHOLE, LabServer, copy_course, serve

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = [pytest.mark.browser, pytest.mark.timeout(900)]

LANDING = "course/00_welcome.ipynb"
STUB = "labs/lab_integration/lab_integration.ipynb"
SOLUTION = "solutions/lab_integration/lab_integration.ipynb"
QUICK = "01_ai_robot_brain"
LESSONS = sorted(p.stem for p in (REPO / "course").glob("[0-9]*.ipynb") if p.stem[:2] != "00") if WHOLE else [QUICK]


@pytest.fixture(scope="module")
def server(repo: Path, chromium: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[LabServer]:
    scratch = tmp_path_factory.mktemp("jupyterlab")
    with serve(copy_course(repo, scratch / "my course"), scratch) as running:
        yield running


@pytest.fixture
def notebook(browser: Browser, server: LabServer, request: pytest.FixtureRequest) -> Iterator[NotebookPage]:
    context = browser.new_context(viewport={"width": 1400, "height": 900})
    opened = NotebookPage(context.new_page(), server)
    yield opened
    opened.save_screenshot(f"last_{request.node.name}")
    context.close()


def test_robotbrain_lab_opens_the_landing_notebook_and_its_cell_drives_in_3d(notebook: NotebookPage) -> None:
    notebook.page.goto(notebook.server.address())
    notebook.wait_for(LANDING)
    assert notebook.page.locator(".jp-Dialog").count() == 0
    notebook.page.get_by_role("tab", name="Table of Contents").click()
    contents = notebook.page.locator(".jp-TableOfContents-tree")
    contents.get_by_text("Exercises, and handing in").wait_for(timeout=30_000)
    notebook.save_screenshot("landing")
    no_errors(notebook.run_all(timeout_s=120))
    wait_for_3d_view(notebook.show("try"))
    notebook.save_screenshot("landing_replay")
    notebook.page.locator(".jp-MarkdownOutput a", has_text="Lab: put a brain together").first.click()
    notebook.wait_for(STUB)


@pytest.mark.parametrize("lesson", LESSONS)
def test_lesson_opens_from_the_landing_notebook_and_runs_to_its_end(notebook: NotebookPage, lesson: str) -> None:
    notebook.open(LANDING, f"lesson-{lesson[:2]}")
    notebook.show("contents").locator(f'a[href*="{lesson}"]').first.click()
    notebook.wait_for(f"course/{lesson}.ipynb")
    cells = notebook.run_all(timeout_s=900)
    no_errors(cells)
    assert [c["id"] for c in cells if not c["count"]] == []
    notebook.save_screenshot(f"lesson_{lesson}")


def no_errors(cells: list[dict[str, Any]]) -> None:
    """No cell ended with an exception."""
    assert [c["id"] for c in cells if any(o["output_type"] == "error" for o in c["outputs"])] == []


def test_validate_button_says_what_is_wrong_with_an_empty_lab(notebook: NotebookPage) -> None:
    notebook.open(STUB, "validate")
    text = notebook.validate()
    notebook.save_screenshot("validate_stub")
    assert "The following cell failed" in text, text
    for exercise in ("1.1 What the network eats", "2.2 A*", "5.1 The gap"):
        assert f"{exercise}: 0 of " in text, f"{exercise} is missing in:\n{text}"
    assert "astar is not written yet" in text
    assert "Traceback" not in text


if WHOLE:

    def test_solved_lab_runs_to_the_end_and_shows_its_drives_in_3d(notebook: NotebookPage) -> None:
        notebook.open(SOLUTION, "solution")
        cells = notebook.run_all(timeout_s=480)
        no_errors(cells)
        assert [c["id"] for c in cells if not c["count"]] == []
        for cell_id in ("meet-replay", "drive-mine"):
            wait_for_3d_view(notebook.show(cell_id))
            notebook.save_screenshot(f"solution_{cell_id}")


def test_server_listens_on_loopback_only(server: LabServer) -> None:
    family = [server.process, *server.process.children(recursive=True)]
    listening = {c.laddr.ip for p in family for c in p.net_connections("tcp") if c.status == psutil.CONN_LISTEN}
    assert listening == {"127.0.0.1"}


def test_only_notebooks_and_their_checkpoints_are_written(server: LabServer, repo: Path) -> None:
    """Everything above ran before this: nothing of it may litter the course or change the user's configuration."""
    there = {p.relative_to(server.course) for p in server.course.rglob("*") if p.is_file()}
    new = {p for p in there if not {".ipynb_checkpoints", "__pycache__"} & set(p.parts) and not (repo / p).is_file()}
    assert not new
    config = {p.name for p in (server.home / "jupyter" / "config").rglob("*") if p.is_file()}
    assert config - {"migrated"} == {"jupyter_server_config.json", "jupyter_lab_config.json"}
