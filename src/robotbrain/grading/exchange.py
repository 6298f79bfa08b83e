"""The instructor's three errands to nbgrader's exchange: hand labs out, take submissions in, give feedback back.

JupyterLab's *Assignment List* is the students' side of it: they fetch, hand in and open feedback there. Releasing runs
nbgrader's own code, and collecting (:mod:`.collecting`) keeps its layout, so whoever prefers nbgrader's commands or
formgrader's buttons meets the same files.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from traitlets.config import Config

from robotbrain.errors import InputError, RobotBrainError
from robotbrain.exchange import Exchange
from robotbrain.grading.collecting import Entry, entries, take
from robotbrain.grading.course import Course, generate, nbgrader_config, nbgrader_logger
from robotbrain.grading.reports.feedback import CARRIED


@dataclass(frozen=True)
class Submission:
    """One collected submission.

    Attributes:
        handed_in: when, as nbgrader writes it.
        state: ``"new"``, ``"newer than before"``, ``"unchanged"`` or ``"refused"``.
        owner: whose folder it was in the exchange; another's than the student's is refused.
        left_out: what of it was not copied, in sentences.
    """

    student: str
    handed_in: str
    state: str
    owner: str
    left_out: tuple[str, ...] = ()


def release(course: Course, lab: str, exchange: Exchange, *, force: bool = False) -> Path:
    """Put a lab into the exchange, freshly generated, whatever anybody did in ``labs/``; return the folder.

    Raises:
        InputError: it is there already with other contents and ``force`` is not given: students may have fetched it.
    """
    root = exchange.usable()
    with tempfile.TemporaryDirectory(prefix="robotbrain-") as scratch:
        fresh = course.isolated(Path(scratch), lab)
        generate(fresh, lab)
        config = _config(fresh, root)
        target = _place(config) / "outbound" / lab
        made = fresh.root / fresh.release / lab
        if target.is_dir() and not force:
            if _contents(made) == _contents(target):
                return target
            raise InputError(
                f"release of {lab}",
                given=str(target),
                expected="a lab that is not released yet, or has not changed since",
                fix="Students who fetched it keep what they have. Release it again with --force.",
            )
        _run("ReleaseAssignment", config, lab, force=True)
    return target


def collect(course: Course, lab: str, exchange: Exchange, *, any_owner: bool = False) -> list[Submission]:
    """Copy the newest submission of each student to ``autograder/submitted``.

    Args:
        any_owner: also take folders that belong to another account than the student's: where a service, or one person
            who tries it all out, hands in for everybody.

    Raises:
        InputError: the lab was never released there, or nobody has handed it in.
    """
    course.sources(lab)
    config = _config(course, exchange.usable())
    place = _place(config)
    if not (place / "outbound" / lab).is_dir():
        raise InputError(
            f"submissions of {lab}",
            given=str(place),
            expected=f"a course that released {lab}; released are {_names(place / 'outbound')}",
            fix=f"Run: robotbrain exchange release {lab}",
        )
    handed_in = entries(place / "inbound", lab)
    if not handed_in:
        raise InputError(
            f"submissions of {lab}",
            given=f"none in {place / 'inbound'}",
            expected="at least one",
            fix="Students press Submit in Nbgrader > Assignment List. Collect again when they have.",
        )
    folder = course.root / course.submitted
    newest = {entry.student: entry for entry in handed_in if entry.own or any_owner}
    forged = [entry for entry in handed_in if not (entry.own or any_owner)]
    found = [_taken(entry, folder / entry.student / lab) for entry in newest.values()]
    return found + [Submission(e.student, e.stamp, "refused", e.owner) for e in forged]


def _taken(entry: Entry, target: Path) -> Submission:
    """Copy a submission to ``target`` unless it is there already."""
    then = _timestamp(target)
    left_out: list[str] = []
    if then != entry.stamp:
        try:
            left_out = take(entry, target)
        except OSError as error:
            why = (f"it cannot be read ({error.strerror})",)
            return Submission(entry.student, entry.stamp, "refused", entry.owner, why)
    now = _timestamp(target)
    state = "new" if not then else "newer than before" if now != then else "unchanged"
    return Submission(entry.student, now, state, entry.owner, tuple(left_out))


def release_feedback(course: Course, lab: str, exchange: Exchange) -> tuple[list[str], list[str]]:
    """Put the feedback pages of a lab where each student, and nobody else, can fetch them.

    Returns:
        The students whose feedback is there now, and those who did not hand in through the exchange.

    Raises:
        InputError: there is no feedback to release.
    """
    course.sources(lab)
    root = exchange.usable()
    folder = course.root / course.feedback
    pages = sorted(folder.glob(f"*/{lab}/*.html"))
    if not pages:
        raise InputError(
            f"feedback on {lab}",
            given=f"no page in {folder}",
            expected="pages that grading wrote",
            fix=f"Run: robotbrain grade-class {lab}",
        )
    students = sorted({page.parent.parent.name for page in pages})
    elsewhere = [s for s in students if not all((folder / s / lab / name).is_file() for name in CARRIED)]
    through = [s for s in students if s not in elsewhere]
    if not through:
        raise InputError(
            f"feedback on {lab}",
            given=f"{len(students)} pages of submissions from elsewhere",
            expected="submissions that came through the exchange",
            fix=f"Collect them with `robotbrain exchange collect {lab}` and grade, or hand the pages out yourself.",
        )
    config = _config(course, root)
    config.CourseDirectory.student_id_exclude = ",".join(elsewhere)
    _run("ReleaseFeedback", config, lab)
    return through, elsewhere


def overview(course: Course, exchange: Exchange) -> list[tuple[str, bool, int, int]]:
    """For each lab: its name, whether it is released, and how many students handed in and have feedback ready."""
    place = _place(_config(course, exchange.path))
    found = []
    for lab in course.labs():
        handed_in = {p.name.split("+")[0] for p in (place / "inbound").glob(f"*+{lab}+*")}
        ready = {p.parent.parent.name for p in (course.root / course.feedback).glob(f"*/{lab}/*.html")}
        found.append((lab, (place / "outbound" / lab).is_dir(), len(handed_in), len(ready & handed_in)))
    return found


def _config(course: Course, root: Path) -> Config:
    config = nbgrader_config(course)
    config.Exchange.root = str(root)
    return config


def _place(config: Config) -> Path:
    """The course's folder in the exchange."""
    return Path(config.Exchange.root) / str(config.CourseDirectory.course_id)


def _run(errand: str, config: Config, lab: str, **settings: Any) -> None:
    """Run one of nbgrader's errands, and say in words what it could not do."""
    from nbgrader.auth import Authenticator
    from nbgrader.coursedir import CourseDirectory
    from nbgrader.exchange import ExchangeError, ExchangeFactory

    logger, handler = nbgrader_logger(None)
    try:
        directory = CourseDirectory(config=config, log=logger)
        directory.assignment_id = lab
        kind = getattr(ExchangeFactory(config=config), errand)
        step = kind(coursedir=directory, authenticator=Authenticator(config=config), config=config, log=logger)
        for name, value in settings.items():
            setattr(step, name, value)
        step.start()
    except ExchangeError as error:
        raise RobotBrainError(f"nbgrader's exchange at {config.Exchange.root}: {error}") from error
    finally:
        logger.removeHandler(handler)
        handler.close()


def _contents(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def _names(folder: Path) -> str:
    return ", ".join(sorted(p.name for p in folder.glob("*"))) or "no labs"


def _timestamp(folder: Path) -> str:
    path = folder / CARRIED[0]
    return path.read_text(encoding="utf-8", errors="replace").strip()[:100] if path.is_file() else ""
