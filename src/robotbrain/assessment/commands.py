"""``robotbrain assessment``: draw papers for a class, look at one, check the bank."""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

from robotbrain.errors import InputError


def assessment_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``robotbrain assessment``."""
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    draw = actions.add_parser("draw", help="draw a paper for each student, and record it")
    draw.add_argument("--students", type=Path, required=True, metavar="FILE", help="names, one a line, or a CSV file")
    draw.add_argument("--out", type=Path, required=True, metavar="DIR", help="gets <student>/assessment/paper.json")
    draw.add_argument("--seed", default="", help="from which all papers follow (default: by chance)")
    key = actions.add_parser("key", help="papers with right answers and explanations, for after the assessment")
    key.add_argument("student", nargs="?", default="practice", help="whose, to print (default: the practice paper)")
    key.add_argument("--out", type=Path, metavar="DIR", help="write those of the class: <student>/assessment/key.md")
    check = actions.add_parser("check", help="check the bank, and say what is in it")
    for action in (draw, key, check):
        action.add_argument("--course", type=Path, metavar="DIR", help="the course folder (default: found from here)")


def assessment_main(arguments: argparse.Namespace) -> int:
    """Run ``robotbrain assessment``."""
    autograder = course_autograder(arguments.course)
    if arguments.action == "draw":
        _draw(autograder, arguments.students, arguments.out, arguments.seed)
    elif arguments.action == "key" and arguments.out is not None:
        _write_keys(autograder, arguments.out)
    elif arguments.action == "key":
        print(_key(autograder, arguments.student))
    else:
        print(_checked(autograder))
    return 0


def course_autograder(course: Path | None) -> Path:
    """The autograder's folder of a course."""
    from robotbrain.grading.course import find_course

    return find_course(course).autograder


def _draw(autograder: Path, students: Path, out: Path, seed: str) -> None:
    from robotbrain.assessment.records import PAPER, RECORD, draw_class, read_students

    draws = draw_class(autograder, read_students(students), seed)
    for student, made in draws.items():
        path = made.paper.save(out / student / "assessment" / PAPER)
        print(f"{student:<20} {made.paper.code}  {path}")
    print(f"recorded in {autograder / 'assessment' / RECORD}: keep it, grading goes by it")


def _write_keys(autograder: Path, out: Path) -> None:
    from robotbrain.assessment.records import read_records
    from robotbrain.files import write_text

    records = read_records(autograder)
    if not records:
        raise InputError("draws", given="none", expected="recorded draws", fix="Run `robotbrain assessment draw`.")
    for student in records:
        print(write_text(out / student / "assessment" / "key.md", _key(autograder, student) + "\n"))


def _key(autograder: Path, student: str) -> str:
    from robotbrain.assessment.marking import right_answer
    from robotbrain.assessment.records import practice_draw, recorded_draw

    draw = practice_draw() if student == "practice" else recorded_draw(autograder, student)
    parts = [f"# Paper {draw.paper.code} of {student}, with its key"]
    for drawn in draw.questions:
        right = right_answer(drawn)
        shown = f"```python\n{right.strip()}\n```" if drawn.question.kind == "code" else f"`{right}`"
        parts += [drawn.item.markdown(), f"**Right answer:** {shown}", f"**Why:** {drawn.question.explain}"]
    return "\n\n".join(parts)


def _checked(autograder: Path) -> str:
    from robotbrain.assessment.bank import FOLDER, load_bank
    from robotbrain.assessment.draw import draw
    from robotbrain.assessment.questions import check_values

    bank = load_bank(autograder / FOLDER)
    for question in bank.questions:
        if question.kind == "numeric":
            for values in question.combinations():
                check_values(question, values)
    for seed in range(100):
        draw(bank, f"check {seed}")
    if len({q.text for q in bank.questions}) != len(bank.questions):
        raise InputError("bank", given="a text twice", expected="different questions", fix="Remove one.")
    counts = [Counter(values) for values in ((q.topic for q in bank.questions), (q.kind for q in bank.questions))]
    lines = [", ".join(f"{name} {number}" for name, number in count.items()) for count in counts]
    return "\n".join([f"{len(bank.questions)} questions", *lines, "papers can be drawn"])
