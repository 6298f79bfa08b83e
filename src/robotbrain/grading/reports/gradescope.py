"""Results in Gradescope's form, and a ready autograder to upload there.

The format is that of https://gradescope-autograders.readthedocs.io/en/latest/specs/. Where Gradescope's container has
no user namespaces, the sandbox is missing and the results say so.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import zipfile
from pathlib import Path
from typing import Any

from robotbrain.errors import InputError
from robotbrain.files import atomic_path, write_text
from robotbrain.grading.course import Course, find_course
from robotbrain.grading.marks import Mark, Marks
from robotbrain.grading.reports.model import outcomes_of, unprotected
from robotbrain.grading.reports.page import clean
from robotbrain.grading.results import TestResult

VISIBILITIES = ("visible", "after_due_date", "after_published", "hidden")
_COURSE_PARTS = ("autograder/nbgrader_config.py", "autograder/profiles")

_SETUP = """#!/usr/bin/env bash
# Runs once, when Gradescope builds the autograder's image (Ubuntu).
set -euo pipefail
apt-get update
apt-get install -y --no-install-recommends python3 python3-pip python3-venv bubblewrap
python3 -m venv /autograder/venv
# A wheel beside this file is the very version the course uses; without one the published package is installed.
if ls /autograder/source/*.whl >/dev/null 2>&1; then
  /autograder/venv/bin/pip install --no-cache-dir /autograder/source/*.whl
else
  /autograder/venv/bin/pip install --no-cache-dir "robotbrain=={version}"
fi
"""

_RUN = """#!/usr/bin/env bash
# Runs for each submission; the working directory is /autograder.
set -uo pipefail
exec /autograder/venv/bin/python -m robotbrain.grading.reports.gradescope \\
  --course /autograder/source/course --lab {lab} --submission /autograder/submission \\
  --metadata /autograder/submission_metadata.json --out /autograder/results/results.json
"""


def gradescope_results(row: Marks, *, hidden: str = "after_published") -> dict[str, Any]:
    """The content of ``results.json`` for one submission.

    Args:
        hidden: when students see the outcomes of hidden tests, one of :data:`VISIBILITIES`.
    """
    if hidden not in VISIBILITIES:
        raise InputError("visibility", given=hidden, expected=f"one of {', '.join(VISIBILITIES)}", fix="Choose one.")
    tests = []
    for number, mark in enumerate(row.marks, 1):
        if mark.earned is None:
            continue  # graded by hand, in Gradescope itself
        tests += _tests(number, mark, hidden)
    told = [*row.incidents]
    if missing := unprotected(row):
        told.append(f"{missing[0].upper()}{missing[1:]}.")
    return {
        "score": round(row.earned, 4),
        "execution_time": round(row.seconds, 2),
        "output": clean("\n".join(told), 4000),
        "output_format": "text",
        "test_output_format": "text",
        "test_name_format": "text",
        "visibility": "visible",
        "stdout_visibility": "hidden",
        "tests": tests,
        "extra_data": {"lab_points": row.points, "layers": row.layers},
    }


def _tests(number: int, mark: Mark, hidden: str) -> list[dict[str, Any]]:
    """The tests of an exercise, scaled to the points it gave: their sum is what counts."""
    outcomes = outcomes_of(mark)
    worth = sum(o.points for o in outcomes)
    if mark.error or worth <= 0:
        return [_entry(mark.exercise, f"{number}", mark.earned or 0.0, mark.points, mark.error, "visible", [])]
    scale = mark.points / worth
    return [
        _entry(
            f"{mark.exercise}: {o.name}",
            f"{number}.{i}",
            o.earned * scale,
            o.points * scale,
            _output(o),
            hidden if o.hidden else "visible",
            [str(o.verdict), *(["hidden"] if o.hidden else [])],
        )
        for i, o in enumerate(outcomes, 1)
    ]


def _entry(
    name: str, number: str, score: float, most: float, output: str, visibility: str, tags: list[str]
) -> dict[str, Any]:
    return {
        "name": clean(name, 200),
        "number": number,
        "score": round(score, 4),
        "max_score": round(most, 4),
        "status": "passed" if score >= most - 1e-9 else "failed",
        "output": clean(output, 4000),
        "visibility": visibility,
        "tags": tags,
    }


def _output(outcome: TestResult) -> str:
    parts = [
        ("", outcome.verdict.label),
        ("", outcome.message),
        ("given: ", outcome.given),
        ("expected: ", outcome.expected),
        ("got: ", outcome.got),
        ("likely mistake: ", outcome.misconception),
        ("hint: ", outcome.hint),
        ("reread: ", outcome.reread),
    ]
    return "\n".join(label + text for label, text in parts if text)


def write_autograder(folder: Path, course: Course, lab: str, version: str, wheel: Path | None = None) -> Path:
    """Write a folder and its ``.zip`` for Gradescope's *Configure Autograder*; return the zip.

    It holds the lab's source and hidden tests: it goes to Gradescope, never to students.
    """
    shutil.rmtree(folder, ignore_errors=True)
    target = folder / "course"
    ignore = shutil.ignore_patterns("__pycache__", ".ipynb_checkpoints")
    parts = [*_COURSE_PARTS, f"autograder/hidden/{lab}.py", f"autograder/reference/{lab}", f"solutions/{lab}"]
    for part in parts:
        source = course.home / part
        if source.is_dir():
            shutil.copytree(source, target / part, ignore=ignore)
        elif source.is_file():
            (target / part).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source, target / part)
    (target / "labs").mkdir(exist_ok=True)
    if wheel is not None:
        shutil.copy(wheel, folder / wheel.name)
    for name, text in (("setup.sh", _SETUP.format(version=version)), ("run_autograder", _RUN.format(lab=lab))):
        write_text(folder / name, text).chmod(0o755)
    return _zipped(folder)


def _zipped(folder: Path) -> Path:
    """The files of ``folder`` at the root of an archive, as Gradescope wants them, scripts executable."""
    archive = folder.with_suffix(".zip")
    with atomic_path(archive) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as made:
        for path in sorted(p for p in folder.rglob("*") if p.is_file()):
            made.write(path, path.relative_to(folder).as_posix())
    return archive


def main(argv: list[str] | None = None) -> int:
    """Grade the submission in Gradescope's container; always leaves a ``results.json``."""
    parser = argparse.ArgumentParser(prog="run_autograder")
    for name in ("course", "submission", "metadata", "out"):
        parser.add_argument(f"--{name}", type=Path, required=True)
    parser.add_argument("--lab", required=True)
    arguments = parser.parse_args(argv)
    try:
        results = gradescope_results(_graded(arguments))
    except Exception as error:  # whatever it is, Gradescope must not show a grade of an earlier run
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        told = f"The autograder failed: {clean(str(error), 500)}"
        results = {"score": 0, "output": told, "stdout_visibility": "hidden"}
    write_text(arguments.out, json.dumps(results, indent=1, ensure_ascii=True) + "\n")
    return 0


def _graded(arguments: argparse.Namespace) -> Marks:
    from robotbrain.grading.classroom import grade_notebook

    course = find_course(arguments.course)
    names = [source.name for source in course.sources(arguments.lab)]
    found = [p for p in sorted(arguments.submission.rglob("*.ipynb")) if p.is_file() and not p.is_symlink()]
    wanted = [p for p in found if p.name in names] or found[:1]
    if not wanted:
        raise InputError("submission", given="no notebook", expected=" or ".join(names), fix="Submit the notebook.")
    return grade_notebook(course, wanted[0], lab=arguments.lab, student=_who(arguments.metadata))


def _who(metadata: Path) -> str:
    """The submitter's email, for tests that draw numbers per student."""
    try:
        return str(json.loads(metadata.read_text(encoding="utf-8"))["users"][0]["email"])
    except (OSError, ValueError, KeyError, IndexError, TypeError):
        return ""


if __name__ == "__main__":
    sys.exit(main())
