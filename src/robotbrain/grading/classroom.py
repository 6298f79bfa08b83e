"""Grading a class: many submissions run side by side, one writer enters them in nbgrader's gradebook."""

from __future__ import annotations

import contextlib
import gc
import itertools
import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from robotbrain.errors import InputError
from robotbrain.grading import backups, intake, jobs, roster, scheduler
from robotbrain.grading.changes import Change
from robotbrain.grading.classresult import ClassResult, Rows, feedback_page, write_results
from robotbrain.grading.course import CONFIG_NAME, Course, generate
from robotbrain.grading.entry import Entry, Person
from robotbrain.grading.execute import Limits
from robotbrain.grading.gradebook import Standing, wait_until_free
from robotbrain.grading.lock import only_run
from robotbrain.grading.marks import Marks, marks_of
from robotbrain.grading.reports.feedback import write_feedback
from robotbrain.grading.runner import TIME_SCALE_VARIABLE, time_scale
from robotbrain.grading.suite import AUTOGRADER_VARIABLE
from robotbrain.grading.writer import Writer, student_ids

__all__ = ["ClassResult", "Options", "feedback_page", "grade_class", "grade_notebook", "open_bench", "progress_bar"]

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Options:
    """How a class is graded.

    Attributes:
        workers: how many submissions run at the same time; at least as many as a cluster has room for.
        fresh: run every submission anew, whatever is cached.
        require_sandbox: refuse to run without a sandbox.
        cluster: address of a Dask scheduler whose workers run the submissions.
        dry_run: run everything and say what would change, but write neither marks nor reports.
        feedback: write the students' pages.
    """

    workers: int = 1
    limits: Limits = field(default_factory=Limits)
    fresh: bool = False
    require_sandbox: bool = False
    cluster: str = ""
    dry_run: bool = False
    feedback: bool = True


@contextlib.contextmanager
def progress_bar() -> Iterator[Progress]:
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
    db_url: str | None = None,
    workers: int = 1,
    limits: Limits | None = None,
    fresh: bool = False,
    options: Options | None = None,
    progress: Progress | None = None,
    confirm: Callable[[list[Change]], bool] | None = None,
    say: Callable[[str], None] | None = None,
) -> ClassResult:
    """Grade all submissions of ``lab``.

    Each submission runs in a process of its own, and its outcome is kept the moment it ends: a run that is stopped or
    killed goes on where it was when started again. Submissions already executed with the same tests are not run again.
    Marks are entered in the gradebook while others still run, one transaction per student; students who have marks
    run first, and where any of these would change, nothing is entered before all have run and ``confirm`` agrees.

    Args:
        submitted: folder with ``<student>/<lab>/`` in it; default: the course's own.
        out: folder for a grading run of its own (gradebook, feedback, results); default: the course's gradebook.
        db_url: SQLAlchemy address of the gradebook; default: the one in ``nbgrader_config.py``, or in ``out``.
        workers, limits, fresh: the fields of ``options`` used most; ignored if that is given.
        progress: called with (done, total, student) after each submission.
        confirm: asked before marks that are there already are written over; default: they may be.
        say: told what takes long or needs attention; default: print on stderr.
    """
    options = options or Options(workers=workers, limits=limits or Limits(), fresh=fresh)
    say = say or (lambda text: print(text, file=sys.stderr))
    sources = course.sources(lab)
    folder = submitted or course.root / course.submitted
    in_place = out is None and folder.resolve() == (course.root / course.submitted).resolve()
    students = roster.handed_in(folder, lab, in_place=in_place)
    os.environ[AUTOGRADER_VARIABLE] = str(course.autograder)
    with only_run((course.results if out is None else out) / ".executed"):
        target = (course if out is None else course.isolated(out, lab)).with_gradebook(db_url)
        run = _Run(target, lab, folder, sources, options, say)
        return run.grade(students, progress, confirm)


@contextlib.contextmanager
def _settled_heap() -> Iterator[None]:
    """Spare the garbage collector what is there to stay, above all imported modules: one second in twenty was its.

    Nothing is collected here: in a forked process that could end thread pools which are not there any more.
    """
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


@contextlib.contextmanager
def _stretched_limits(workers: int) -> Iterator[None]:
    """Give tests more time where more submissions run than there are cores: their limits are in wall time."""
    before = os.environ.get(TIME_SCALE_VARIABLE)
    os.environ[TIME_SCALE_VARIABLE] = str(time_scale() * max(1.0, workers / scheduler.usable_cores()))
    try:
        yield
    finally:
        if before is None:
            del os.environ[TIME_SCALE_VARIABLE]
        else:
            os.environ[TIME_SCALE_VARIABLE] = before


class _Registrar:
    """Takes people whose notebooks have run, and enters their marks as soon as that cannot need anybody's agreement.

    That is when all who had marks before have run, and none of these would change. A failure of the machine waits for
    the end, and writes over no mark that is there.

    Args:
        students: everybody who will come.
        hold: enter nothing until :meth:`enter_rest`.

    Attributes:
        marked: who had marks before.
    """

    def __init__(self, entry: Entry, students: Sequence[str], *, hold: bool) -> None:
        self._entry, self._hold = entry, hold
        self.marked = frozenset(s for s in students if entry.standing(s).marked)
        self._awaited, self._here, self._unsound = set(self.marked), list[Person](), list[Person]()
        self._failed: list[str] = []

    def hand_in(self, person: Person) -> None:
        """Take a person, and enter all who are here if it is time."""
        self._awaited.discard(person.student)
        (self._here if all(done.sound for done in person.done) else self._unsound).append(person)
        if self._awaited or self._hold:
            return
        try:
            standings = self._standings()
            self._hold = bool(self._changes(standings))
            if not self._hold:
                self._enter(standings)
        except Exception:  # what ails the gradebook need not keep the others from being run; at the end it is told
            self._entry.writer.log.exception("entering marks was put off")
            self._hold = True

    def changes(self) -> list[Change]:
        """What entering those who are here would change now: somebody may have given marks meanwhile."""
        return self._changes(self._standings())

    def postponed(self) -> tuple[list[str], set[str]]:
        """Whose notebooks the machine failed to run, and who of them keeps the marks they have."""
        unsound = sorted(p.student for p in self._unsound)
        return unsound, {s for s in unsound if self._entry.standing(s).marked}

    def enter_rest(self) -> list[str]:
        """Enter everybody who has not been entered yet; return all who could not be."""
        _, kept = self.postponed()
        self._here += [p for p in self._unsound if p.student not in kept]
        self._enter(self._standings())
        return self._failed

    def _standings(self) -> list[Standing]:
        return [self._entry.standing(p.student) for p in self._here]

    def _changes(self, standings: Sequence[Standing]) -> list[Change]:
        found = (self._entry.change(p, s) for p, s in zip(self._here, standings, strict=True))
        return sorted(filter(None, found), key=lambda c: c.student)

    def _enter(self, standings: Sequence[Standing]) -> None:
        for standing in standings:
            person = self._here[0]
            if not self._entry.enter(person, standing):
                self._failed.append(person.student)
            del self._here[0]  # not before: if this one raises, it is tried again


class _Run:
    """One grading run, with everything its steps share."""

    def __init__(
        self,
        course: Course,
        lab: str,
        folder: Path,
        sources: Sequence[Path],
        options: Options,
        say: Callable[[str], None],
    ) -> None:
        self.course, self.lab, self.folder, self.sources = course, lab, folder, sources
        self.options, self.say = options, say
        self.kept = course.results / ".executed"
        self.log = course.results / "nbgrader.log"

    def grade(
        self, students: list[str], progress: Progress | None, confirm: Callable[[list[Change]], bool] | None
    ) -> ClassResult:
        _sweep(self.kept, self.course.root / self.course.feedback, self.course.results / "results")
        if not self.options.dry_run:
            wait_until_free(self.course.gradebook_url, self.say)
            backups.backup(self.course.gradebook_url, self.course.results / "backups")
            generate(self.course, self.lab, log=self.log)
        with contextlib.ExitStack() as stack:
            stack.enter_context(_stretched_limits(self.options.workers))
            bench = stack.enter_context(open_bench(self.course, self.lab, self.options))
            journal = self._journal(bench)
            writer = stack.enter_context(self._writer())
            entry = Entry(writer, journal, self.kept / "entered" / self.lab)
            stack.enter_context(_settled_heap())
            everybody = [*students, *self._absent(entry, students)]
            registrar = _Registrar(entry, everybody, hold=self.options.dry_run)
            people = self._execute(everybody, journal, bench, registrar, progress)
            people, rows = self._postpone(registrar, people), Rows(journal, people)
            changes = registrar.changes()
            if self.options.dry_run or (changes and confirm is not None and not confirm(changes)):
                return self._result(rows, changes, entered=False)
            rows = rows.failed(registrar.enter_rest())
            if self.options.feedback:
                self._feedback(entry, people, rows)
        result = self._result(rows, changes, entered=True)
        write_results(result)
        return result

    def _journal(self, bench: jobs.Bench) -> jobs.Journal:
        autograder = self.course.autograder
        names = ("hidden", "reference", "profiles", CONFIG_NAME)
        tests = [*(autograder / name for name in names), self.sources[0].parent]
        layers = [layer.name for layer in bench.layers if layer.active]
        return jobs.Journal(self.kept / "cache", jobs.environment_digest(tests, self.options.limits, layers))

    @contextlib.contextmanager
    def _writer(self) -> Iterator[Writer]:
        """The writer; on a copy of the gradebook where nothing may be written."""
        with tempfile.TemporaryDirectory(prefix="robotbrain-") as scratch:
            course = self.course
            if self.options.dry_run:
                copy = backups.backup(course.gradebook_url, Path(scratch)) or Path(scratch) / "gradebook.db"
                course = replace(course, db_url=f"sqlite:///{copy.as_posix()}")
            with Writer(course, self.lab, log=self.log, on_wait=self.say) as writer:
                yield writer

    def _absent(self, entry: Entry, students: list[str]) -> list[str]:
        """Students in the gradebook who handed in nothing; whoever has marks from elsewhere keeps them."""
        others = sorted(set(student_ids(entry.writer.gradebook)) - set(students))
        return [s for s in others if entry.was_missing(s) or not entry.standing(s).marked]

    def _execute(
        self,
        students: list[str],
        journal: jobs.Journal,
        bench: jobs.Bench,
        registrar: _Registrar,
        progress: Progress | None,
    ) -> list[Person]:
        """Run everybody's notebooks; return the outcomes in the order of ``students``."""
        tasks = roster.tasks(self.folder, self.lab, self.sources, students)
        groups = itertools.groupby(tasks, key=lambda t: (t.student, t.folder))
        own = {student: (folder, list(group)) for (student, folder), group in groups}
        found: dict[tuple[str, str], jobs.Done] = {}

        def person(student: str) -> Person:
            folder, notebooks = own[student]
            return Person(student, folder, [found[student, t.notebook] for t in notebooks])

        def consume(done: jobs.Done) -> None:
            found[done.student, done.notebook] = done
            if progress is not None:
                progress(len(found), len(tasks), done.student)
            if all((done.student, t.notebook) in found for t in own[done.student][1]):
                registrar.hand_in(person(done.student))

        def work(task: jobs.Task) -> jobs.Done:
            return jobs.grade(self.course, task, journal, bench, fresh=self.options.fresh)

        try:
            workers = max(self.options.workers, getattr(bench, "slots", 1))
            ordered = sorted(tasks, key=lambda t: t.student not in registrar.marked)
            scheduler.run(ordered, work, consume, workers=workers, stop=bench.close)
        except KeyboardInterrupt:
            self.say(f"Stopped. {len(found)} of {len(tasks)} submissions are done and kept; the same command goes on.")
            raise
        return [person(student) for student in own]

    def _postpone(self, registrar: _Registrar, people: Sequence[Person]) -> list[Person]:
        """Those whose marks are to be entered: a failure of the machine writes over no mark that is there."""
        unsound, kept = registrar.postponed()
        if unsound:
            names = ", ".join(unsound[:10]) + ("…" if len(unsound) > 10 else "")
            self.say(f"{len(unsound)} submissions could not be run ({names}); the same command tries them again.")
        return [p for p in people if p.student not in kept]

    def _feedback(self, entry: Entry, people: Sequence[Person], rows: Rows) -> None:
        """Write the pages of those for whom anything has changed."""
        feedback = self.course.root / self.course.feedback
        outdated = {}
        for person in people:
            pages = [feedback / person.student / self.lab / f"{d.notebook}.html" for d in person.done]
            digest = entry.feedback_digest(person)
            if entry.noted_feedback(person.student) != digest or not all(p.is_file() for p in pages):
                outdated[person.student] = digest
        if not outdated:
            return
        names = [source.stem for source in self.sources]

        def notebooks(student: str) -> list[Path]:
            return [p for n in names if (p := entry.writer.folder(student) / f"{n}.ipynb").is_file()]

        write_feedback(feedback, self.lab, rows.only(outdated), notebooks, self.course.gradebook_url)
        for student, digest in outdated.items():
            entry.note_feedback(student, digest)

    def _result(self, rows: Rows, changes: list[Change], *, entered: bool) -> ClassResult:
        folder = self.course.results / "results" / self.lab
        feedback = self.course.root / self.course.feedback
        return ClassResult(self.lab, rows, folder / "results.json", folder / "grades.csv", feedback, changes, entered)


def open_bench(course: Course, lab: str, options: Options) -> Any:
    """What runs the submissions: a Bench here, or those of a cluster's workers."""
    if options.cluster:
        from robotbrain.grading.cluster import ClusterBench

        return ClusterBench(
            options.cluster, course, lab, limits=options.limits, require_sandbox=options.require_sandbox
        )
    from robotbrain.grading.bench import Bench

    return Bench(course.autograder, require_sandbox=options.require_sandbox, limits=options.limits, preload_labs=[lab])


def _sweep(*folders: Path) -> None:
    """Remove the unfinished files of a run that was killed."""
    for folder in folders:
        for path in folder.rglob(".*.tmp"):
            path.unlink(missing_ok=True)


def grade_notebook(
    course: Course, path: Path, *, lab: str | None = None, student: str = "", options: Options | None = None
) -> Marks:
    """Grade one notebook with the same machinery and leave nothing behind.

    Args:
        lab: default: the lab that has a source of the notebook's name.
    """
    if not path.is_file():
        raise InputError("notebook", given=str(path), expected="an existing file", fix="Check the path.")
    found = [(name, s) for name in ([lab] if lab else course.labs()) for s in course.sources(name)]
    right = [pair for pair in found if pair[1].name == path.name] or (found if lab and len(found) == 1 else [])
    if not right:
        raise InputError(
            "notebook",
            given=path.name,
            expected=f"one of {', '.join(s.name for _, s in found) or '(no labs)'}",
            fix="Name the lab with --lab.",
        )
    (name, source), options = right[0], options or Options()
    os.environ[AUTOGRADER_VARIABLE] = str(course.autograder)
    path = path.resolve()  # a teacher may name a link; the gate follows none
    healed = intake.heal(path, intake.master_of(source))
    files = jobs.received(course, path.parent).further()
    with open_bench(course, name, options) as bench:
        run = jobs.run_job(healed, files, lab=name, student=student, bench=bench)
    incidents = [*healed.repairs, *run.incidents]
    return Marks(student or path.stem, marks_of(run.notebook), incidents, run.seconds, layers=run.layers)
