"""Grading subcommands of ``robotbrain``."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import robotbrain.grading.quick_import  # noqa: F401
from robotbrain.grading.execute import Limits


def _course_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--course", type=Path, metavar="DIR", help="the course folder (default: found from here)")


def _limit_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--cell-timeout", type=float, metavar="S", default=Limits.cell_s, help="seconds per cell")
    parser.add_argument("--wall", type=float, metavar="S", default=Limits.wall_s, help="seconds per notebook")


def _limits(arguments: argparse.Namespace) -> Limits:
    return replace(Limits(), cell_s=arguments.cell_timeout, wall_s=arguments.wall)


def grade_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``robotbrain grade``."""
    parser.add_argument("notebook", type=Path)
    parser.add_argument("--lab", help="its lab (default: the one with a notebook of this name)")
    parser.add_argument("--student", default="", help="whose it is, for tests that draw numbers per student")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    _course_argument(parser)
    _limit_arguments(parser)


def grade_main(arguments: argparse.Namespace) -> int:
    """Run ``robotbrain grade``; the exit code says nothing about the points."""
    from robotbrain.grading.classroom import grade_notebook
    from robotbrain.grading.course import find_course
    from robotbrain.grading.marks import table

    course = find_course(arguments.course)
    marks = grade_notebook(
        course, arguments.notebook, lab=arguments.lab, student=arguments.student, limits=_limits(arguments)
    )
    if arguments.json:
        print(json.dumps(marks.to_dict(), indent=1, ensure_ascii=False))
        return 0
    print(table([marks], widest_reason=1000))
    for mark in marks.marks:
        for test in mark.tests:
            if test["verdict"] != "passed":
                told = test["message"] + (f" Hint: {test['hint']}" if test["hint"] else "")
                print(f"  {mark.exercise}: {test['name']}: {told}")
    return 0


def grade_class_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``robotbrain grade-class``."""
    parser.add_argument("lab")
    parser.add_argument("--submitted", type=Path, metavar="DIR", help="folder with <student>/<lab>/ in it")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="submissions that run at the same time")
    parser.add_argument("--out", type=Path, metavar="DIR", help="grade into a folder of its own, not the gradebook")
    parser.add_argument("--fresh", action="store_true", help="run everything again, also what has not changed")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    _course_argument(parser)
    _limit_arguments(parser)


def grade_class_main(arguments: argparse.Namespace) -> int:
    """Run ``robotbrain grade-class``."""
    from robotbrain.grading.classroom import grade_class, progress_bar
    from robotbrain.grading.course import find_course
    from robotbrain.grading.marks import table

    with progress_bar() as progress:
        result = grade_class(
            find_course(arguments.course),
            arguments.lab,
            submitted=arguments.submitted,
            out=arguments.out,
            workers=arguments.jobs,
            limits=_limits(arguments),
            fresh=arguments.fresh,
            progress=progress,
        )
    if arguments.json:
        print(json.dumps(result.to_dict(), indent=1, ensure_ascii=False))
    else:
        print(table(result.rows))
        print(f"\nresults {result.results}\ngrades  {result.table}\nfeedback {result.feedback}")
    return 0


def generate_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``robotbrain generate``."""
    parser.add_argument("labs", nargs="*", metavar="LAB", help="default: every lab")
    parser.add_argument("--check", action="store_true", help="only say whether labs/ is up to date")
    _course_argument(parser)


def generate_main(arguments: argparse.Namespace) -> int:
    """Run ``robotbrain generate``; 1 if ``--check`` finds a difference."""
    from robotbrain.grading.course import find_course, generate, release_differences

    course = find_course(arguments.course)
    outdated = 0
    for lab in arguments.labs or course.labs():
        if not arguments.check:
            generate(course, lab)
            print(f"labs/{lab} generated")
            continue
        with tempfile.TemporaryDirectory(prefix="robotbrain-") as scratch:
            differences = release_differences(course, lab, Path(scratch))
        for difference in differences:
            print(f"labs/{lab}: {difference}", file=sys.stderr)
        if differences:
            outdated += 1
            print(f"Run: robotbrain generate {lab}", file=sys.stderr)
    return 1 if outdated else 0


def sample_class_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``robotbrain sample-class``."""
    parser.add_argument("lab")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    _course_argument(parser)


def sample_class_main(arguments: argparse.Namespace) -> int:
    """Run ``robotbrain sample-class``."""
    from robotbrain.grading.course import find_course
    from robotbrain.grading.sample import make_class

    made = make_class(find_course(arguments.course), arguments.lab, arguments.out)
    for student, entry in made.items():
        print(f"{student:<8} {entry['kind']} {entry['name']}")
    return 0


def mutation_test_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``robotbrain mutation-test``."""
    parser.add_argument("lab")
    parser.add_argument("--jobs", type=int, default=1, metavar="N")
    parser.add_argument("--out", type=Path, metavar="DIR", help="keep the graded class here")
    _course_argument(parser)
    _limit_arguments(parser)


def mutation_test_main(arguments: argparse.Namespace) -> int:
    """Run ``robotbrain mutation-test``; 1 if a sample submission is not graded as it should be."""
    from robotbrain.grading import mutation
    from robotbrain.grading.classroom import grade_class
    from robotbrain.grading.course import find_course
    from robotbrain.grading.sample import make_class

    course = find_course(arguments.course)
    with tempfile.TemporaryDirectory(prefix="robotbrain-") as scratch:
        out = arguments.out or Path(scratch)
        manifest = make_class(course, arguments.lab, out / "class")
        graded = grade_class(
            course,
            arguments.lab,
            submitted=out / "class",
            out=out / "graded",
            workers=arguments.jobs,
            limits=_limits(arguments),
        ).to_dict()
    rows = mutation.judge(graded, manifest)
    print(mutation.table(rows))
    idle = mutation.idle_tests(graded, rows)
    if idle:
        print("\nTests that find no mutant:\n" + "\n".join(f"  {name}" for name in idle))
    return 1 if any(row.problems for row in rows) else 0
