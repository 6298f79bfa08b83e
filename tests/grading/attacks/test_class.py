"""A class with hostile submissions in it, from the folder of submissions to gradebook, results and feedback pages."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import nbformat
import pytest
from nbgrader.api import Gradebook

from robotbrain.grading import classroom, course
from robotbrain.grading.bench import Bench
from tests.grading.attacks import exfiltration, files, forgery, notebook_file
from tests.grading.attacks.attack import Attack
from tests.grading.attacks.harness import HONEST, LIMITS, NEIGHBOUR, PARTLY, Arena, operator_environment
from tests.grading.attacks.vault import LAB, POINTS

pytestmark = pytest.mark.timeout(1800)
_STRANGE_NAMES = {
    "<script>alert(77030)<": HONEST,
    "=HYPERLINK(77031)": HONEST,
    "-rf": HONEST,
    "\x1b[2Jred": HONEST,
    ".executed": HONEST,
    "Honest": PARTLY,
    "results": PARTLY,
    "a'; drop table grade; --": PARTLY,
    "%2e%2e": PARTLY,
}


def _attacks() -> list[Attack]:
    chosen = exfiltration.pages()
    wanted = ("the gradebook", "results and feedback", "names of files that the grader writes", "symbolic links to")
    chosen += [a for a in forgery.attacks() + files.attacks() if any(w in a.name for w in wanted)]
    edits = ("more points", "a graded cell of one's own", "a graded cell with somebody's id", "halves of characters")
    chosen += [a for a in notebook_file.attacks() if any(a.name.endswith(e) for e in edits)]
    return chosen + [a for a in exfiltration.attacks() if a.name.startswith("hidden input shown by another")][:4]


@pytest.fixture(scope="module")
def arena(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Arena]:
    arena = Arena(tmp_path_factory.mktemp("class"))
    with operator_environment(arena):
        with Bench(arena.vault.autograder) as bench:
            if not all(layer.active for layer in bench.layers if layer.name in ("bubblewrap", "namespaces")):
                pytest.skip("hostile submissions need a sandbox")
        yield arena
    arena.close()


@pytest.fixture(scope="module")
def submissions(arena: Arena) -> dict[str, Attack]:
    """Student -> what was handed in."""
    named = {f"s{number:02d}": attack for number, attack in enumerate(_attacks())}
    named |= {"honest": HONEST, "zz-partly": PARTLY, **_STRANGE_NAMES}
    for student, attack in named.items():
        arena.submit(student, attack)
    return {NEIGHBOUR: HONEST, **named}


def _grade(arena: Arena) -> classroom.ClassResult:
    home = course.find_course(arena.vault.root)
    return classroom.grade_class(home, LAB, submitted=arena.submitted, out=arena.out, workers=2, limits=LIMITS)


@pytest.fixture(scope="module")
def result(arena: Arena, submissions: dict[str, Attack]) -> classroom.ClassResult:
    (arena.out / "gradebook.db").unlink(missing_ok=True)
    assert submissions
    return _grade(arena)


def _allowed(attack: Attack) -> float:
    return sum(attack.earns(name) for name in POINTS)


def _scores(arena: Arena) -> dict[str, float]:
    with Gradebook(f"sqlite:///{arena.out / 'gradebook.db'}") as gradebook:
        return {s.student.id: s.score for s in gradebook.assignment_submissions(LAB)}


def test_marks_and_gradebook_are_the_honest_ones(
    arena: Arena, submissions: dict[str, Attack], result: classroom.ClassResult
) -> None:
    scores = _scores(arena)
    assert scores == {row.student: row.earned for row in result.rows}
    assert set(scores) <= {*submissions, *map(str.strip, submissions)}  # nobody made up
    assert submissions.keys() - scores.keys() == {".executed"}  # hidden folders are no students
    for student, attack in submissions.items():
        assert scores.get(student, 0.0) <= _allowed(attack), attack.name
    for student in ("honest", NEIGHBOUR, "zz-partly"):
        assert scores[student] == _allowed(submissions[student])


def test_no_secret_is_in_anything_that_leaves(arena: Arena, result: classroom.ClassResult) -> None:
    pages = {p: p.read_text(encoding="utf-8") for p in result.feedback.rglob("*.html")}
    assert len(pages) > 30
    for page, text in pages.items():
        assert arena.vault.secrets.leaked(text) == ([NEIGHBOUR] if NEIGHBOUR in page.parts else []), page
    for path in (result.results, result.table):
        assert arena.vault.secrets.leaked(path.read_text(encoding="utf-8")) == []


def test_pages_and_notebooks_run_nothing_in_a_browser(arena: Arena, result: classroom.ClassResult) -> None:
    for page in result.feedback.rglob("*.html"):
        assert _active(page.read_text(encoding="utf-8")) == [], page
    shown = 0
    for path in (arena.out / "autograded").rglob("*.ipynb"):
        shown += 1
        assert _active(_as_formgrader_shows(arena, path)) == [], path
    assert shown > 30


def _as_formgrader_shows(arena: Arena, path: Path) -> str:
    """The page of nbconvert with the course's configuration, as formgrader makes it from an autograded notebook."""
    from nbconvert.exporters import HTMLExporter

    config = course.nbgrader_config(course.find_course(arena.vault.root))
    html, _ = HTMLExporter(config=config).from_notebook_node(nbformat.read(path, as_version=4))
    return str(html)


def _active(html: str) -> list[str]:
    """What of the attacks' markup a browser would run."""
    from html.parser import HTMLParser

    class Finder(HTMLParser):
        def __init__(self) -> None:
            super().__init__(convert_charrefs=True)
            self.found: list[str] = []
            self.in_script = False

        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            self.in_script = tag == "script"
            for name, value in attrs:
                text = (value or "").replace("\n", "")
                if (name.startswith("on") and "alert" in text) or "javascript:alert" in text.lower().replace(" ", ""):
                    self.found.append(f"{tag} {name}={text[:60]}")
                if name == "srcdoc" or (tag == "iframe" and "77" in text):
                    self.found.append(f"{tag} {name}")

        def handle_endtag(self, tag: str) -> None:
            self.in_script = False

        def handle_data(self, data: str) -> None:
            if self.in_script and ("alert(77" in data or "/formgrader/api/" in data):
                self.found.append(f"script {data[:60]}")

    finder = Finder()
    finder.feed(html)
    return finder.found


def test_a_second_run_finds_everything_as_it_was(
    arena: Arena, submissions: dict[str, Attack], result: classroom.ClassResult
) -> None:
    before = _scores(arena)
    again = _grade(arena)
    assert _scores(arena) == before
    rows = {row.student: row for row in again.rows}
    assert rows["honest"].cached
    assert {s: r.earned for s, r in rows.items()} == {r.student: r.earned for r in result.rows}
    assert rows.keys() == before.keys()


def test_text_for_terminals_and_spreadsheets_is_plain(result: classroom.ClassResult) -> None:
    from robotbrain.grading.marks import table

    shown = table(result.rows) + result.table.read_text(encoding="utf-8")
    assert not [c for c in shown if ord(c) < 32 and c != "\n"]
    cells = [cell for line in result.table.read_text(encoding="utf-8").splitlines() for cell in line.split(",")]
    assert not [cell for cell in cells if cell[:1] in ("=", "+", "@") and len(cell) > 1]


def test_the_course_is_untouched_and_nothing_is_left(arena: Arena, result: classroom.ClassResult) -> None:
    assert json.loads(result.results.read_text(encoding="utf-8"))["lab"] == LAB
    assert arena.changes() == []
    assert arena.survivors() == []
    assert [p for p in arena.litter() if "mark-of" in p or "intruder" in p] == []
