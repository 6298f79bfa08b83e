"""A class of one, in the browser from end to end: a lab is released, fetched, worked out, validated, handed in,
collected, graded, looked at in formgrader, given back, and its feedback opened.

The student's copy of the course has no solutions, no tests and, at first, not this lab; the instructor's has all. They
share an exchange and nothing else. With ``ROBOTBRAIN_PROOF=browser`` (``make proof-browser``) every lab goes this way,
and all its cells are run.
"""

from __future__ import annotations

import contextlib
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from robotbrain.exchange import EXCHANGE_VARIABLE
from robotbrain.grading.course import find_course
from robotbrain.grading.sample import Reference

from .page import NotebookPage, keep
from .server import WHOLE, LabServer, copy_course, serve, user_environment, wait_until

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page

pytestmark = [pytest.mark.browser, pytest.mark.timeout(1800)]

LABS = ("lab_integration", "hw1_rl", "hw2_optimisation", "hw3_performance") if WHOLE else ("lab_integration",)


@dataclass
class Walk:
    """Where everybody is, and what was found on the way."""

    lab: str
    repo: Path
    student: LabServer
    teacher: Path
    exchange: Path

    @property
    def notebook(self) -> str:
        """The lab's notebook in the student's course."""
        return f"labs/{self.lab}/{self.lab}.ipynb"

    def instruct(self, *words: str) -> str:
        """Run ``robotbrain ...`` as the instructor; return what it printed."""
        done = subprocess.run(
            [sys.executable, "-m", "robotbrain.cli", *words],
            cwd=self.teacher,
            env=user_environment(self.teacher.parent / "home") | {EXCHANGE_VARIABLE: str(self.exchange)},
            capture_output=True,
            text=True,
            timeout=900,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout


@pytest.fixture(scope="module", params=LABS)
def walk(
    request: pytest.FixtureRequest, repo: Path, chromium: str, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Walk]:
    lab, scratch = request.param, tmp_path_factory.mktemp("walk")
    teacher = copy_course(repo, scratch / "teacher" / "course")
    shutil.copy(repo / "autograder" / "nbgrader_config.py", teacher / "autograder")
    if (repo / "autograder" / "reference").is_dir():
        shutil.copytree(repo / "autograder" / "reference", teacher / "autograder" / "reference")
    course = copy_course(repo, scratch / "student" / "my course")
    for folder in ("solutions", "autograder", f"labs/{lab}"):
        shutil.rmtree(course / folder)
    exchange = scratch / "exchange"
    exchange.mkdir()
    with serve(course, scratch / "student", "--exchange", str(exchange)) as server:
        yield Walk(lab, repo, server, teacher, exchange)


def assignment_list(page: Page, server: LabServer) -> Locator:
    """Open nbgrader's assignment list through the menu and return it."""
    page.goto(server.address(), wait_until="domcontentloaded")
    lab = NotebookPage(page, server)
    lab.wait_for("course/00_welcome.ipynb")
    lab.menu("Nbgrader", "Assignment List")
    found = page.locator("#assignments")
    found.locator("#course_list_default", has_text="robotbrain").wait_for(timeout=60_000)
    return found


def test_released_lab_is_fetched_into_labs(page: Page, walk: Walk) -> None:
    walk.instruct("exchange", "release", walk.lab)
    shown = assignment_list(page, walk.student)
    released = shown.locator("#released_assignments_list .list_item", has_text=walk.lab)
    released.wait_for(timeout=60_000)
    keep(page, f"{walk.lab}_released")
    released.get_by_role("button", name="Fetch").click()
    shown.locator("#fetched_assignments_list .list_item", has_text=walk.lab).first.wait_for(timeout=60_000)
    released_file = walk.exchange / "robotbrain" / "outbound" / walk.lab / f"{walk.lab}.ipynb"
    assert (walk.student.course / walk.notebook).read_bytes() == released_file.read_bytes()


def test_typed_solutions_turn_every_check_green(page: Page, walk: Walk) -> None:
    notebook = NotebookPage(page, walk.student)
    notebook.open(walk.notebook, "solve")
    given = {cell["id"]: cell["source"] for cell in (notebook.state() or {})["cells"]}
    solved = Reference(find_course(walk.teacher), walk.lab).notebooks[f"{walk.lab}.ipynb"].cells
    code = [cell for cell in solved if cell.cell_type == "code"]
    checks = [cell.id for cell in code if cell.source.startswith("lab.check(")]
    seen: list[str] = []
    for cell in code:
        if cell.id == checks[0]:  # what a student sees who has written nothing yet
            assert "written yet" in reports(notebook.run_cell(cell.id))
            for answer in (c for c in code[: code.index(cell)] if c.source != given[c.id]):
                notebook.replace(answer.id, answer.source)
                no_error(notebook.run_cell(answer.id))
        elif cell.source != given[cell.id] and seen:
            notebook.replace(cell.id, cell.source)
        if not WHOLE and "skip-grading" in cell.metadata.get("tags", []):
            continue
        done = notebook.run_cell(cell.id, timeout_s=900 if WHOLE else 60)
        if cell.id not in checks:
            if seen:
                no_error(done)
            continue
        seen.append(cell.id)
        no_error(done)
        notebook.show(cell.id).locator("caption", has_text="all tests passed").wait_for(timeout=20_000)
        if len(seen) == len(checks) // 2:
            keep(page, f"{walk.lab}_green")
    assert seen == checks
    for cell in solved:
        if cell.cell_type == "markdown" and given[cell.id].startswith("YOUR ANSWER"):
            notebook.show(cell.id).dblclick()
            notebook.replace(cell.id, cell.source)
            page.keyboard.press("Shift+Enter")
    text = notebook.validate()  # saves the notebook, too
    keep(page, f"{walk.lab}_validated")
    assert "passes all the tests" in text, text


def no_error(cell: dict[str, Any]) -> None:
    """The cell ran without an exception."""
    assert not [o for o in cell["outputs"] if o["output_type"] == "error"], cell


def reports(cell: dict[str, Any]) -> str:
    """The HTML that a cell's outputs hold."""
    return "".join("".join(output.get("data", {}).get("text/html", "")) for output in cell["outputs"])


def test_wrong_answer_gets_its_reason_and_a_link_that_opens_the_lesson(page: Page, walk: Walk) -> None:
    if walk.lab != "lab_integration":
        pytest.skip("once is enough")
    notebook = NotebookPage(page, walk.student)
    notebook.open(walk.notebook, "wrong")
    notebook.run_cell("setup")
    forgetful = "def deadline_slack_ms(profile, rate_hz):\n    return 1000 / rate_hz - profile.segmentation_ms"
    notebook.replace("deadline_slack_ms", forgetful)
    notebook.run_cell("deadline_slack_ms")
    notebook.run_cell("check-deadline")
    report = notebook.show("check-deadline").locator(".robotbrain-report")
    text = report.inner_text()
    keep(page, "wrong_answer")
    for part in ("expected:", "got:", "hint:", "reread:"):
        assert part in text, text
    report.locator("a", has_text="lesson 7").first.click()
    notebook.wait_for("course/07_perception_control.ipynb")
    heading = page.locator(".jp-NotebookPanel:visible h2", has_text='What "real time" means')
    heading.wait_for(timeout=20_000)
    wait_until(lambda: 0 < (heading.bounding_box() or {"y": -1})["y"] < 800, 20, "the heading in view")
    keep(page, "reread")


def test_submitted_work_is_collected_and_graded(page: Page, walk: Walk) -> None:
    shown = assignment_list(page, walk.student)
    fetched = shown.locator("#fetched_assignments_list .list_item", has_text=walk.lab).first
    fetched.wait_for(timeout=60_000)
    fetched.get_by_role("button", name="Submit").first.click()
    shown.locator("#submitted_assignments_list .list_item", has_text=walk.lab).first.wait_for(timeout=60_000)
    keep(page, f"{walk.lab}_submitted")
    assert "new" in walk.instruct("exchange", "collect", walk.lab)
    graded = walk.instruct("grade-class", walk.lab, "--yes")
    assert len(list((walk.teacher / "autograder" / "submitted").glob(f"*/{walk.lab}/{walk.lab}.ipynb"))) == 1, graded


def test_formgrader_opens_for_the_instructor_who_grades_the_report(page: Page, walk: Walk) -> None:
    scratch = walk.teacher.parent / "server"
    scratch.mkdir()
    with serve(walk.teacher, scratch, "--instructor", "--exchange", str(walk.exchange)) as server:
        page.goto(server.address(), wait_until="domcontentloaded")
        inside = page.frame_locator(".jp-MainAreaWidget:visible iframe")
        row = inside.locator("tr", has_text=walk.lab)
        row.wait_for(timeout=90_000)
        assert "released" in row.inner_text()
        keep(page, f"{walk.lab}_formgrader")
        row.locator("td", has_text="1").locator("a").last.click()
        inside.locator("td", has_text="needs manual grading").wait_for(timeout=60_000)
        keep(page, f"{walk.lab}_formgrader_submissions")
        inside.locator("a", has_text="Manual Grading").first.click()
        for name in (walk.lab, walk.lab, "Submission #1"):
            inside.locator("tbody a:visible", has_text=name).first.click()
        fields = inside.locator("input.score")
        fields.first.wait_for(timeout=60_000)
        report = fields.last
        report.scroll_into_view_if_needed()
        report.fill("7")
        with page.expect_response(lambda r: "/api/grade" in r.url and r.request.method == "PUT"):
            report.press("Tab")
        keep(page, f"{walk.lab}_formgrader_work")


def test_feedback_is_fetched_and_opened_by_the_student(page: Page, walk: Walk) -> None:
    walk.instruct("grade-class", walk.lab, "--yes")  # runs nothing again; the report's points go into the page
    assert "1 student" in walk.instruct("exchange", "feedback", walk.lab)
    from playwright.sync_api import TimeoutError as PlaywrightTimeout

    file = page.locator(".jp-DirListing-item", has_text=f"{walk.lab}.html")
    for _ in range(5):  # where it is slow, JupyterLab still restores its own tabs and folder; a person looks again, too
        shown = assignment_list(page, walk.student)
        submitted = shown.locator("#submitted_assignments_list .list_item", has_text=walk.lab).first
        view = shown.get_by_text("view feedback").first
        with contextlib.suppress(PlaywrightTimeout):
            submitted.wait_for(timeout=15_000)
            if not view.is_visible():
                submitted.get_by_role("button", name="Fetch Feedback").click(timeout=15_000)
            view.click(timeout=15_000)
            file.wait_for(timeout=15_000)
            break
    file.dblclick()
    feedback = page.frame_locator(".jp-HTMLViewer:visible iframe")
    feedback.locator("h1", has_text="Feedback on").wait_for(timeout=60_000)
    keep(page, f"{walk.lab}_feedback")
    text = feedback.locator("main").inner_text()
    assert "97 of 100 points" in text, text
    assert "Graded by hand: 7" in text, text
