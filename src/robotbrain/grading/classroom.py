"""Grading a class: many submissions run side by side, one writer enters them in nbgrader's gradebook."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import nbformat

from robotbrain.errors import InputError
from robotbrain.files import write_text
from robotbrain.grading import intake, jobs
from robotbrain.grading.course import Course, generate, run_nbgrader
from robotbrain.grading.execute import Limits
from robotbrain.grading.marks import Marks, csv_text, marks_of
from robotbrain.grading.suite import AUTOGRADER_VARIABLE


@dataclass(frozen=True)
class ClassResult:
    """A graded class: the rows, and where everything was written."""

    lab: str
    rows: list[Marks]
    results: Path
    table: Path
    feedback: Path

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready form, as in ``results.json``."""
        return {"version": 1, "lab": self.lab, "students": [r.to_dict() for r in self.rows]}


@dataclass(frozen=True)
class _Task:
    student: str
    source: Path
    healed: intake.Healed
    folder: Path
    cache: Path


@contextlib.contextmanager
def progress_bar() -> Iterator[Callable[[int, int, str], None]]:
    """Show a bar on a terminal; gives the ``progress`` function of :func:`grade_class`."""
    from tqdm import tqdm

    with tqdm(unit="submission", file=sys.stderr, disable=None) as bar:

        def progress(done: int, total: int, student: str) -> None:
            bar.total = total
            bar.set_postfix_str(student, refresh=False)
            bar.update(done - bar.n)

        yield progress


def grade_class(
    course: Course,
    lab: str,
    *,
    submitted: Path | None = None,
    out: Path | None = None,
    workers: int = 1,
    limits: Limits | None = None,
    fresh: bool = False,
    progress: Callable[[int, int, str], None] | None = None,
) -> ClassResult:
    """Grade all submissions of ``lab``.

    Each submission runs in a process of its own; then nbgrader's autograde enters the outcome in the gradebook and
    nbgrader's generate_feedback writes the pages. Submissions already executed with the same tests are not run again.

    Args:
        submitted: folder with ``<student>/<lab>/`` in it; default: the course's own.
        out: folder for a grading run of its own (gradebook, feedback, results); default: the course's gradebook.
        workers: how many submissions run at the same time.
        fresh: run every submission anew, whatever is cached.
        progress: called with (done, total, student) after each submission.
    """
    limits = limits or Limits()
    sources = course.sources(lab)
    handed_in = submitted or course.root / course.submitted
    in_place = out is None and handed_in.resolve() == (course.root / course.submitted).resolve()
    students = _students(handed_in, lab, in_place=in_place)
    target = course if out is None else course.isolated(out, lab)
    log = target.results / "nbgrader.log"
    generate(target, lab, log=log)
    own = target.root / target.submitted
    _stage(handed_in, own, lab, students, sources, in_place=in_place)
    tests = [course.autograder / "hidden", course.autograder / "profiles", sources[0].parent]
    environment = jobs.environment_fingerprint(tests)
    tasks = []
    for student in students:
        for source in sources:
            folder = own / student / lab
            healed = intake.heal(folder / source.name, intake.master_of(source))
            key = jobs.fingerprint(healed, folder, limits, environment + student)
            cache = target.results / ".executed" / "cache" / f"{key}.ipynb"
            if fresh:
                cache.unlink(missing_ok=True)
            tasks.append(_Task(student, source, healed, folder, cache))
    done = _run_all(tasks, limits, workers, progress)
    rows = _enter(target, lab, tasks, done, log)
    return _write(target, lab, rows)


def _students(handed_in: Path, lab: str, *, in_place: bool) -> list[str]:
    """Who handed in, in order. In the course's own folder, having only other labs means not having handed in."""
    if not handed_in.is_dir():
        raise InputError(
            "submissions",
            given=str(handed_in),
            expected=f"a folder with <student>/{lab}/ in it",
            fix="Name it with --submitted, or collect the submissions there.",
        )
    folders = [p for p in sorted(handed_in.iterdir()) if p.is_dir() and not p.name.startswith(".")]
    students = [p.name for p in folders if (p / lab).is_dir() or not (in_place and any(p.iterdir()))]
    if not students:
        raise InputError(
            "submissions", given=str(handed_in), expected=f"<student>/{lab}/ in it", fix="Is it the right folder?"
        )
    return students


def _stage(handed_in: Path, own: Path, lab: str, students: list[str], sources: list[Path], *, in_place: bool) -> None:
    """Bring the submissions to where nbgrader looks for them, with a placeholder for each missing notebook."""
    if not in_place:
        for student in students:
            shutil.rmtree(own / student / lab, ignore_errors=True)
            _copy(handed_in / student / lab, own / student / lab)
    for student in students:
        for source in sources:
            path = own / student / lab / source.name
            if not path.is_file():
                path.parent.mkdir(parents=True, exist_ok=True)
                write_text(path, nbformat.writes(intake.placeholder(intake.master_of(source))))


def _copy(folder: Path, target: Path) -> None:
    """Copy the plain files of a submission; links could point at another student's work."""
    target.mkdir(parents=True, exist_ok=True)
    for path in sorted(folder.iterdir()) if folder.is_dir() else []:
        if path.is_file() and not path.is_symlink():
            shutil.copy(path, target / path.name)


def _run_all(
    tasks: list[_Task], limits: Limits, workers: int, progress: Callable[[int, int, str], None] | None
) -> dict[int, jobs.Executed]:
    done: dict[int, jobs.Executed] = {}
    with ThreadPoolExecutor(max_workers=max(1, workers)) as pool:
        running = {
            pool.submit(jobs.run_job, t.healed, t.folder, limits, t.student, t.cache): number
            for number, t in enumerate(tasks)
        }
        try:
            for future in as_completed(running):
                number = running[future]
                done[number] = future.result()
                if progress is not None:
                    progress(len(done), len(tasks), tasks[number].student)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return done


def _enter(course: Course, lab: str, tasks: list[_Task], done: dict[int, jobs.Executed], log: Path) -> list[Marks]:
    """Let nbgrader save the grades and write the feedback; return the marks of each student."""
    executed = course.results / ".executed" / lab
    shutil.rmtree(executed, ignore_errors=True)
    rows: dict[str, Marks] = {}
    for number, task in enumerate(tasks):
        result = done[number]
        write_text(executed / task.student / task.source.name, nbformat.writes(result.notebook))
        row = rows.setdefault(task.student, Marks(task.student, [], cached=True))
        row.marks += marks_of(result.notebook)
        row.incidents += [*task.healed.repairs, *result.incidents]
        row.seconds += result.seconds
        row.cached = row.cached and result.cached
    submitted = course.root / course.submitted
    settings = {
        "ResilientExecute__executed_directory": str(executed),
        # Nbgrader takes one student or all; whoever else is in the folder from an earlier run is left as is.
        "CourseDirectory__student_id_exclude": ",".join(p.name for p in submitted.iterdir() if p.name not in rows),
    }
    error = run_nbgrader(course, "Autograde", lab, log=log, **settings)
    if error:
        _zero_where_missing(course, lab, list(rows.values()))
    run_nbgrader(course, "GenerateFeedback", lab, log=log, **settings)
    return list(rows.values())


def _zero_where_missing(course: Course, lab: str, rows: list[Marks]) -> None:
    """Give students whom nbgrader itself could not grade an explicit zero with its reason."""
    from nbgrader.api import Gradebook

    for row in rows:
        if (course.root / course.autograded / row.student / lab).is_dir():
            continue
        row.incidents.append("nbgrader could not process this submission (see nbgrader.log)")
        with Gradebook(course.gradebook_url) as gradebook:
            gradebook.update_or_create_student(row.student)
            submission = gradebook.update_or_create_submission(lab, row.student)
            for notebook in submission.notebooks:
                for grade in notebook.grades:
                    grade.auto_score, grade.needs_manual_grade = 0, False
            gradebook.db.commit()
        for mark in row.marks:
            mark.earned, mark.error = 0.0, "not processed"


def _write(course: Course, lab: str, rows: list[Marks]) -> ClassResult:
    folder = course.results / "results" / lab
    result = ClassResult(lab, rows, folder / "results.json", folder / "grades.csv", course.root / course.feedback)
    write_text(result.results, json.dumps(result.to_dict(), indent=1, ensure_ascii=False) + "\n")
    write_text(result.table, csv_text(rows))
    return result


def feedback_page(result: ClassResult, student: str) -> Path | None:
    """The first feedback page of ``student``, or None if nbgrader made none."""
    return next(iter(sorted((result.feedback / student / result.lab).glob("*.html"))), None)


def grade_notebook(
    course: Course, path: Path, *, lab: str | None = None, student: str = "", limits: Limits | None = None
) -> Marks:
    """Grade one notebook with the same machinery and leave nothing behind.

    Args:
        lab: default: the lab that has a source of the notebook's name.
    """
    if not path.is_file():
        raise InputError("notebook", given=str(path), expected="an existing file", fix="Check the path.")
    sources = [s for name in ([lab] if lab else course.labs()) for s in course.sources(name)]
    source = next((s for s in sources if s.name == path.name), sources[0] if lab and len(sources) == 1 else None)
    if source is None:
        raise InputError(
            "notebook",
            given=path.name,
            expected=f"one of {', '.join(s.name for s in sources) or '(no labs)'}",
            fix="Name the lab with --lab.",
        )
    os.environ[AUTOGRADER_VARIABLE] = str(course.autograder)
    healed = intake.heal(path, intake.master_of(source))
    result = jobs.run_job(healed, path.parent, limits or Limits(), student, None)
    incidents = [*healed.repairs, *result.incidents]
    return Marks(student or path.stem, marks_of(result.notebook), incidents, result.seconds)
