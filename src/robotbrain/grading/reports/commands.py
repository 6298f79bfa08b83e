"""``robotbrain report``: pages and tables of a class that was graded."""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Mapping
from pathlib import Path

import robotbrain
from robotbrain.errors import InputError
from robotbrain.files import write_text
from robotbrain.grading.course import Course, find_course
from robotbrain.grading.reports.export import FORMATS


def report_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``robotbrain report``."""
    parser.add_argument("graded", metavar="LAB|results.json", help="a lab that was graded, or the results of a run")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for the report (default: beside the results)")
    parser.add_argument("--similarity", action="store_true", help="compare the submissions with each other")
    parser.add_argument("--export", action="append", choices=FORMATS, default=[], help="write points for an LMS, too")
    parser.add_argument("--roster", type=Path, metavar="CSV", help="who is who: student,name,email,id,sis_id,login")
    parser.add_argument("--column", default="", metavar="ID", help="number of the assignment or column in the LMS")
    parser.add_argument("--title", default="", help="name of the column in the LMS (default: the lab's name)")
    parser.add_argument("--no-gradebook", action="store_true", help="leave out manual grades and comments")
    parser.add_argument("--course", type=Path, metavar="DIR", help="the course folder (default: found from here)")


def report_main(arguments: argparse.Namespace) -> int:
    """Run ``robotbrain report``."""
    from robotbrain.grading.reports import classpage, feedback
    from robotbrain.grading.reports.items import analyse
    from robotbrain.grading.reports.material import find_graded

    course = _course(arguments.course)
    found = find_graded(arguments.graded, course)
    graded, out = found.graded, arguments.out or found.results.parent / "report"
    url = None if arguments.no_gradebook else _gradebook(found.base, course)
    pages = feedback.write_feedback(out / "feedback", graded.lab, graded.rows, found.notebooks, url)
    links = {student: os.path.relpath(paths[0], out).replace(os.sep, "/") for student, paths in pages.items()}
    similar: frozenset[str] = frozenset()
    index = ""
    if arguments.similarity:
        similar, index = _similarity(course, found, out)
    page = write_text(out / "class.html", classpage.class_page(graded, links, similar=similar, similarity=index))
    text = classpage.items_text(analyse(graded.rows))
    write_text(out / "items.txt", text + "\n")
    print(text)
    print(f"\nclass   {page}\nfeedback {out / 'feedback'}")
    for name in dict.fromkeys(arguments.export):
        print(f"{name:<11}{_export(name, found, out, arguments, course)}")
    return 0


def _course(folder: Path | None) -> Course | None:
    """The course, which a ``results.json`` can do without."""
    try:
        return find_course(folder)
    except InputError:
        if folder is not None:
            raise
        return None


def _gradebook(base: Path, course: Course | None) -> str | None:
    """The address of the gradebook that belongs to the graded class, or None."""
    if course is not None and course.results.resolve() == base:
        return course.gradebook_url
    path = base / "gradebook.db"
    return f"sqlite:///{path.as_posix()}" if path.is_file() else None


def _similarity(course: Course | None, found: object, out: Path) -> tuple[frozenset[str], str]:
    from robotbrain.grading.reports import material, similarity, similarity_page

    assert isinstance(found, material.Graded)
    lab = found.graded.lab
    known = course if course is not None and lab in course.labs() else None
    result = similarity.compare_class(
        material.submitted_code(found),
        given=material.given_sources(known, lab) if known else (),
        references=material.reference_sources(known, lab) if known else {},
    )
    index = similarity_page.write_similarity(out / "similarity", lab, result)
    print(similarity_page.similarity_text(result) + f"\n\nsimilarity {index}\n")
    return frozenset(p.name for pair in result.pairs if pair.notable for p in (pair.a, pair.b)), "similarity/index.html"


def _export(name: str, found: object, out: Path, arguments: argparse.Namespace, course: Course | None) -> Path:
    from robotbrain.grading.marks import csv_text
    from robotbrain.grading.reports import export, gradescope, material

    assert isinstance(found, material.Graded)
    rows, title = found.graded.rows, arguments.title or found.graded.lab
    roster: Mapping[str, export.Person] | None = export.read_roster(arguments.roster) if arguments.roster else None
    if name == "gradescope":
        for row in rows:
            results = json.dumps(gradescope.gradescope_results(row), indent=1) + "\n"
            write_text(out / "gradescope" / "results" / f"{row.student}.json", results)
        if course is not None and found.graded.lab in course.labs():
            version = robotbrain.__version__
            return gradescope.write_autograder(out / "gradescope" / "autograder", course, found.graded.lab, version)
        return out / "gradescope"
    if name == "canvas":
        return write_text(out / "canvas.csv", export.canvas(rows, title, arguments.column, roster))
    if name == "moodle":
        return write_text(out / "moodle.csv", export.moodle(rows, title, roster))
    if name == "blackboard":
        return write_text(out / "blackboard.txt", export.blackboard(rows, title, arguments.column, roster))
    return write_text(out / "grades.csv", csv_text(rows))
