"""``robotbrain exchange``: hand labs out, take submissions in, give feedback back."""

from __future__ import annotations

import argparse
from pathlib import Path

import robotbrain.grading.quick_import  # noqa: F401

ERRANDS = {
    "where": "say which folder the exchange is, and what is in it (the default)",
    "release": "put labs where students can fetch them",
    "collect": "copy the newest submissions to autograder/submitted",
    "feedback": "put the pages of a graded lab where each student can fetch theirs",
}


def exchange_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``robotbrain exchange``."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = "\n".join(f"{name:<10} {text}" for name, text in ERRANDS.items())
    parser.add_argument("errand", nargs="?", choices=ERRANDS, default="where", help="see below")
    parser.add_argument("labs", nargs="*", metavar="LAB", help="one or several (release: default every lab)")
    parser.add_argument("--force", action="store_true", help="release again what has changed since")
    parser.add_argument("--any-owner", action="store_true", help="collect also what one account handed in for others")
    parser.add_argument("--exchange", metavar="DIR", help="the folder (default: as `where` says)")
    parser.add_argument("--course", type=Path, metavar="DIR", help="the course folder (default: found from here)")


def exchange_main(arguments: argparse.Namespace) -> int:
    """Run ``robotbrain exchange``."""
    from robotbrain.errors import InputError
    from robotbrain.exchange import EXCHANGE_VARIABLE, find_exchange
    from robotbrain.grading import exchange as errands
    from robotbrain.grading.course import find_course

    course = find_course(arguments.course).with_gradebook()
    place = find_exchange({EXCHANGE_VARIABLE: arguments.exchange} if arguments.exchange else None)
    if arguments.errand == "where":
        print(f"{place.path}  ({place.why})")
        print(f"\n{'lab':<24}{'released':<10}{'handed in':>9}{'feedback':>10}")
        for lab, released, handed_in, ready in errands.overview(course, place):
            print(f"{lab:<24}{'yes' if released else 'no':<10}{handed_in:>9}{ready:>10}")
        place.usable()
        return 0
    if not arguments.labs and arguments.errand != "release":
        raise InputError("lab", given="none", expected=f"one of {', '.join(course.labs())}", fix="Name the lab.")
    for lab in arguments.labs or course.labs():
        if arguments.errand == "release":
            print(f"{lab} is released: {errands.release(course, lab, place, force=arguments.force)}")
        elif arguments.errand == "collect":
            for submission in errands.collect(course, lab, place, any_owner=arguments.any_owner):
                whose = "" if submission.owner == submission.student else f", from a folder of {submission.owner}"
                print(f"{submission.student:<20}{submission.handed_in:<34}{submission.state}{whose}")
                for sentence in submission.left_out:
                    print(f"{'':<20}left out: {sentence}")
            print(f"\nGrade with: robotbrain grade-class {lab}")
        else:
            through, elsewhere = errands.release_feedback(course, lab, place)
            students = "student" if len(through) == 1 else "students"
            print(f"{lab}: feedback of {len(through)} {students} can be fetched: {', '.join(through)}")
            if elsewhere:
                print(f"not through the exchange, so not here: {', '.join(elsewhere)}")
    return 0
