"""Grading subcommands of ``robotbrain``."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import robotbrain.grading.quick_import  # noqa: F401
from robotbrain.grading.execute import Limits

if TYPE_CHECKING:
    from robotbrain.grading.changes import Change


def _course_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--course", type=Path, metavar="DIR", help="the course folder (default: found from here)")


def _limit_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--cell-timeout", type=float, metavar="S", default=Limits.cell_s, help="seconds per cell")
    parser.add_argument("--wall", type=float, metavar="S", default=Limits.wall_s, help="seconds per notebook")

    parser.add_argument("--require-sandbox", action="store_true", help="refuse to run without a complete sandbox")


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
    from robotbrain.grading.classroom import Options, grade_notebook
    from robotbrain.grading.course import find_course
    from robotbrain.grading.marks import table

    course = find_course(arguments.course)
    options = Options(limits=_limits(arguments), require_sandbox=arguments.require_sandbox)
    marks = grade_notebook(course, arguments.notebook, lab=arguments.lab, student=arguments.student, options=options)
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
    parser.add_argument(
        "--jobs", type=int, metavar="N", help="submissions that run at the same time (default: one per core, and one)"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="grade into a folder of its own, not the gradebook")
    parser.add_argument(
        "--db-url",
        metavar="URL",
        help="the gradebook, e.g. postgresql://user@host/course (default: the configured one)",
    )
    parser.add_argument(
        "--cluster", default="", metavar="URL", help="run on the workers of a Dask scheduler, e.g. tcp://host:8786"
    )
    parser.add_argument("--fresh", action="store_true", help="run everything again, also what has not changed")
    parser.add_argument("--no-feedback", action="store_true", help="write no pages for the students")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    mode = parser.add_mutually_exclusive_group()
    mode.add_argument("--yes", action="store_true", help="write over marks that are there without asking")
    mode.add_argument("--dry-run", action="store_true", help="run everything, say what would change, write no marks")
    _course_argument(parser)
    _limit_arguments(parser)


def grade_class_main(arguments: argparse.Namespace) -> int:
    """Run ``robotbrain grade-class``; 3 if marks that are there already were left as they are, 130 after Ctrl-C."""
    from robotbrain.grading.changes import changes_text
    from robotbrain.grading.classroom import Options, grade_class, progress_bar
    from robotbrain.grading.course import find_course
    from robotbrain.grading.marks import table
    from robotbrain.grading.scheduler import fitting_workers

    options = Options(
        workers=fitting_workers() if arguments.jobs is None else arguments.jobs,
        limits=_limits(arguments),
        fresh=arguments.fresh,
        require_sandbox=arguments.require_sandbox,
        cluster=arguments.cluster,
        dry_run=arguments.dry_run,
        feedback=not arguments.no_feedback,
    )
    try:
        with progress_bar() as progress:
            result = grade_class(
                find_course(arguments.course),
                arguments.lab,
                submitted=arguments.submitted,
                out=arguments.out,
                db_url=arguments.db_url,
                options=options,
                progress=progress,
                confirm=None if arguments.yes else _may_write,
            )
    except KeyboardInterrupt:
        return 130
    if arguments.yes or arguments.dry_run:
        _show_changes(changes_text(result.changes) if result.changes else "No marks that were there change.")
    if arguments.json:
        json.dump(result.to_dict(), sys.stdout, indent=1, ensure_ascii=False)
        print()
    else:
        print(table(result.rows))
        if result.entered:
            print(f"\nresults {result.results}\ngrades  {result.table}\nfeedback {result.feedback}")
    return 0 if result.entered or arguments.dry_run else 3


def _show_changes(text: str) -> None:
    print(f"Changes of marks in the gradebook:\n{text}", file=sys.stderr)


def _may_write(changes: list[Change]) -> bool:
    """Show what would change and decide: a person at a terminal is asked; otherwise nothing may go down."""
    from robotbrain.grading.changes import changes_text

    _show_changes(changes_text(changes))
    if sys.stdin is not None and sys.stdin.isatty():
        print("Write these marks? [y/N] ", end="", file=sys.stderr, flush=True)
        return sys.stdin.readline().strip().lower() in ("y", "yes")
    if any(change.lower for change in changes):
        print("Some marks would go down, so none were written. Look at them; then add --yes.", file=sys.stderr)
        return False
    return True


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
    parser.add_argument("labs", nargs="*", metavar="LAB", help="default: every lab that has mutants")
    parser.add_argument("--all", action="store_true", help="every lab that has mutants, as without a LAB")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="submissions that run at the same time")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="where to work and to put the tables (default: build/mutation)"
    )
    parser.add_argument("--fresh", action="store_true", help="run everything again, also what has not changed")
    parser.add_argument("--strict", action="store_true", help="also fail where a test finds no mutant")
    _course_argument(parser)
    _limit_arguments(parser)


def mutation_test_main(arguments: argparse.Namespace) -> int:
    """Run ``robotbrain mutation-test``; 1 if a sample submission is not graded as it should be."""
    from robotbrain.grading.classroom import Options, progress_bar
    from robotbrain.grading.course import find_course
    from robotbrain.grading.mutation_run import run, with_mutants

    course = find_course(arguments.course)
    options = Options(
        workers=arguments.jobs,
        limits=_limits(arguments),
        fresh=arguments.fresh,
        require_sandbox=arguments.require_sandbox,
        feedback=False,
    )
    labs = arguments.labs if arguments.labs and not arguments.all else with_mutants(course)
    sound = True
    for lab in labs:
        with progress_bar() as progress:
            outcome = run(course, lab, arguments.out or course.home / "build" / "mutation", options, progress)
        print(outcome.text(), flush=True)
        sound = sound and outcome.sound and not (arguments.strict and outcome.idle)
    return 0 if sound else 1
