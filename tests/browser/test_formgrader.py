"""A teacher's browser on formgrader: the grades, the student's feedback, and a manual grade that outlives a regrade."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import psutil
import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell

from ..conftest import need
from ..grading import toylab
from .server import CHROMIUM_ARGUMENTS, TOKEN, end_tree, free_port, user_environment, wait_for_server

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = [pytest.mark.browser, pytest.mark.timeout(900)]

ATTACK = "window.top.hacked = 1; window.hacked = 1"
HOSTILE = f"from IPython.display import HTML\nHTML('<script>{ATTACK}</script><img src=x onerror=\"{ATTACK}\">')"


@pytest.fixture(scope="module")
def course(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The toy course with two graded submissions in its own gradebook; one of them attacks the teacher's browser."""
    root = toylab.make_course(tmp_path_factory.mktemp("formgrader") / "course")
    hostile = toylab.solved(mean="def mean(values):\n    return 1.0")
    hostile.cells[2:2] = [new_code_cell(HOSTILE), new_markdown_cell(f"<script>{ATTACK}</script>")]
    toylab.submit(root / "autograder" / "submitted", "amara", toylab.solved(scale="def scale(x):\n    return x ** 2"))
    toylab.submit(root / "autograder" / "submitted", "mallory", hostile)
    grade(root)
    return root


def grade(root: Path) -> None:
    """Grade the class anew into its gradebook."""
    command = [sys.executable, "-m", "robotbrain.cli", "grade-class", "toy", "--yes", "--fresh"]
    done = subprocess.run(command, cwd=root, env=environment(root), capture_output=True, text=True, timeout=400)
    assert done.returncode == 0, done.stderr


def environment(root: Path) -> dict[str, str]:
    """A teacher's environment: the course's configuration, and nothing of this machine's."""
    kept = user_environment(root.parent / "home")
    return kept | {"ROBOTBRAIN_SUITES": str(root / "suites"), "JUPYTER_CONFIG_PATH": str(root / "autograder")}


@pytest.fixture(scope="module")
def formgrader(course: Path) -> Iterator[str]:
    """The address of formgrader on that course."""
    port = free_port()
    log = course.parent / "server.log"
    command = [sys.executable, "-m", "jupyter", "server", "--no-browser", "--allow-root", "--ServerApp.ip=127.0.0.1"]
    command += [f"--ServerApp.port={port}", "--ServerApp.port_retries=0", f"--ServerApp.root_dir={course}"]
    with log.open("wb") as output:
        process = psutil.Popen(command, cwd=course, env=environment(course), stdout=output, stderr=subprocess.STDOUT)
    try:
        wait_for_server(process, f"http://127.0.0.1:{port}", log)
        yield f"http://127.0.0.1:{port}/formgrader"
    finally:
        end_tree(process)


@pytest.fixture
def page(chromium: str, formgrader: str) -> Iterator[Page]:
    need(importlib.util.find_spec("playwright"), "no playwright (it is in the extra `dev`)")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=list(CHROMIUM_ARGUMENTS))
        opened = browser.new_page(viewport={"width": 1300, "height": 900})
        opened.goto(f"{formgrader}?token={TOKEN}", wait_until="domcontentloaded")
        yield opened
        if folder := os.environ.get("ROBOTBRAIN_SCREENSHOTS"):
            opened.screenshot(path=str(Path(folder) / "formgrader.png"))
        browser.close()


def open_submission(page: Page, formgrader: str, student: str) -> None:
    """Open a student's work from formgrader's table, in which names stand ready but hidden."""
    page.goto(f"{formgrader}/gradebook/toy/toy", wait_until="domcontentloaded")
    link = page.locator("a.name-shown", has_text=student)
    link.wait_for(state="attached", timeout=60_000)
    page.goto(formgrader.removesuffix("/formgrader") + str(link.get_attribute("href")), wait_until="domcontentloaded")
    page.locator("input.score").first.wait_for(state="visible", timeout=60_000)


def scores(page: Page) -> list[str]:
    """What the fields for points say, once they are filled in."""
    fields = page.locator("input.score")
    page.wait_for_function("[...document.querySelectorAll('input.score')].every(f => f.value || f.placeholder)")
    return [f.input_value() or f.get_attribute("placeholder") or "" for f in fields.all()]


def test_formgrader_shows_the_grades_and_runs_no_script_of_a_student(page: Page, formgrader: str) -> None:
    expected = {"amara": ["11 / 15", 0.0, 6.0, 5.0], "mallory": ["10 / 15", 4.0, 6.0, 0.0]}
    for student, (total, *points) in expected.items():
        page.goto(f"{formgrader}/gradebook/toy/toy", wait_until="domcontentloaded")
        row = page.locator("tr", has=page.locator("a.name-shown", has_text=student))
        row.wait_for(timeout=60_000)
        assert str(total) in row.inner_text()
        open_submission(page, formgrader, student)
        assert [float(score) for score in scores(page)] == points
        assert page.evaluate("window.hacked === undefined && window.top.hacked === undefined")
    assert "hacked" in page.locator("body").inner_text()  # it was there, as text


def test_feedback_opens_and_is_the_kits_page(page: Page, course: Path) -> None:
    for student, total in (("amara", "11 of 15 points"), ("mallory", "10 of 15 points")):
        path = course / "autograder" / "feedback" / student / "toy" / "toy.html"
        page.goto(path.as_uri())
        assert page.locator("h1").inner_text() == "Feedback on toy"
        assert total in page.locator("main").inner_text()
        assert page.evaluate("window.hacked === undefined")
        page.locator("nav a", has_text="Your work").click()
        assert page.locator("#work-head").is_visible()


def test_manual_grade_and_comment_survive_a_regrade(page: Page, formgrader: str, course: Path) -> None:
    open_submission(page, formgrader, "amara")
    field = page.locator("input.score").first
    field.fill("2.5")
    with page.expect_response(lambda r: "/api/grade" in r.url and r.request.method == "PUT"):
        field.press("Tab")
    remark = page.locator("textarea.comment").first
    remark.fill("Half of it was <b>right</b>.")
    with page.expect_response(lambda r: "/api/comment" in r.url and r.request.method == "PUT"):
        remark.press("Tab")
    grade(course)
    page.reload(wait_until="domcontentloaded")
    page.locator("input.score").first.wait_for(state="visible")
    assert float(scores(page)[0]) == 2.5
    page.goto((course / "autograder" / "feedback" / "amara" / "toy" / "toy.html").as_uri())
    text = page.locator("main").inner_text()
    assert "13.5 of 15 points" in text and "Graded by hand: 2.5" in text and "Half of it was <b>right</b>." in text
