"""Has the tester judge the graded cells of one submission, and keeps the time.

The tester announces each test; past its limit the student's process is interrupted, after the grace it is killed. The
tester then gives that test its verdict, and the tests that remain get a fresh copy of the student's process.
"""

from __future__ import annotations

import ast
import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from nbformat.notebooknode import NotebookNode, from_dict

from robotbrain.grading import outputs
from robotbrain.grading.execute import Limits, label
from robotbrain.grading.sandbox.snapshots import Snapshot
from robotbrain.grading.tester_link import TesterDied, TesterProcess

_TESTER_GRACE_S = 10.0  # how long the tester may take to notice that the student's process is gone
_LOOK_S = 0.25  # how often the end of a student's process is looked for; what the tester says wakes us at once
_ENDING_S = 1.0  # between the end of a connection and that of the process that held it
_TIMEOUT, _CRASHED, _MEMORY, _DISTURBED = "timeout", "crashed", "memory", "disturbed"
_DID = {
    _DISTURBED: "broke the connection to the tests",
    _TIMEOUT: "hung and did not react to an interrupt",
    _CRASHED: "ended the Python process",
    _MEMORY: "used up the memory",
}


@dataclass(frozen=True)
class Question:
    """What a graded cell asks the tester.

    Attributes:
        exercise: the exercise to score, or ``""`` for a cell of ordinary asserts.
        hidden: whether hidden tests count.
    """

    exercise: str
    hidden: bool


def question_of(source: str) -> Question:
    """What a locked cell asks: ``lab.score("x", hidden=True)`` scores an exercise, all else is ordinary asserts.

    The last call of several counts, as it would in the notebook.
    """
    asserts = Question("", True)
    try:
        body = ast.parse(source).body
    except SyntaxError:
        return asserts
    found = asserts
    for statement in body:
        call = statement.value if isinstance(statement, ast.Expr) else None
        if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Attribute) and call.func.attr == "score"):
            return asserts
        values = [a.value for a in call.args if isinstance(a, ast.Constant)]
        named = {k.arg: k.value.value for k in call.keywords if isinstance(k.value, ast.Constant)}
        if len(values) != len(call.args) or not values or not isinstance(values[0], str):
            return asserts
        found = Question(values[0], bool(values[1] if len(values) > 1 else named.get("hidden", False)))
    return found


@dataclass
class Graded:
    """A graded cell that the tester judges.

    Attributes:
        snapshot: the student's process as it was at this cell; None until there is one.
        outputs: what the tester answered.
    """

    index: int
    cell: NotebookNode
    question: Question
    snapshot: Snapshot | None = None
    outputs: list[NotebookNode] | None = None

    @property
    def name(self) -> str:
        """How incidents call it."""
        return self.question.exercise or label(self.cell, self.index)


class Scorer:
    """Has ``graded`` cells judged, in two rounds: the visible tests of all, then the hidden ones of all.

    Args:
        start_tester: makes a tester.
        fresh: makes a copy of the student's process as the notebook left it; None if that is not possible any more.
        memory_kills: how many of the student's processes have run out of memory so far.
        look: called when a snapshot or the tester has ended; raises if it was the machine that ended them.
        limits: of this run.
        incidents: what goes wrong is added here, in words.
    """

    def __init__(
        self,
        graded: Sequence[Graded],
        *,
        start_tester: Callable[[], TesterProcess],
        fresh: Callable[[], Snapshot | None],
        memory_kills: Callable[[], int],
        look: Callable[[], None],
        limits: Limits,
        incidents: list[str],
    ) -> None:
        self._graded, self._start, self._fresh = graded, start_tester, fresh
        self._memory_kills, self._look = memory_kills, look
        self._limits, self._incidents = limits, incidents
        self._tester: TesterProcess | None = None
        self._deaths: dict[int, int] = {}
        self._numbers = itertools.count()
        self._deadline = time.monotonic() + limits.wall_s

    def run(self) -> None:
        """Fill in every graded cell's outputs."""
        try:
            for graded in self._graded:
                self._judge(graded, hidden=False)
            for graded in self._graded:
                if graded.question.hidden:
                    self._judge(graded, hidden=True)
        finally:
            if self._tester is not None:
                self._tester.close()

    def _judge(self, graded: Graded, *, hidden: bool) -> None:
        if time.monotonic() >= self._deadline:
            self._fail(graded, "NotRun", f"not run: the tests used up their {self._limits.wall_s:g} s")
            return
        question: dict[str, Any] = {}
        if graded.question.exercise:
            question |= {"op": "score", "exercise": graded.question.exercise, "hidden": hidden}
        else:
            grade_id = str(graded.cell.metadata.get("nbgrader", {}).get("grade_id", ""))
            question |= {"op": "cell", "source": graded.cell.source, "grade_id": grade_id, "hidden": hidden}
        try:
            answer = self._ask(graded, question)
        except TesterDied as died:
            self._look()
            self._lose_tester()
            self._incidents.append(f"{graded.name}: the tester ended or did not answer ({died})")
            self._fail(graded, "TesterDied", "the test of this exercise ended its own process; tell the teacher")
            return
        if answer is not None:
            graded.outputs = [from_dict(o) for o in answer]

    def _ask(self, graded: Graded, question: dict[str, Any]) -> list[dict[str, Any]] | None:
        """Have one question answered; None if there is no student's process left to ask."""
        if self._tester is None:
            self._tester = self._start()
        tester = self._tester
        number = self._connect(graded)
        if number is None:
            return None
        tester.send({**question, "student": number})
        clock = _Clock(min(self._deadline, time.monotonic() + self._limits.graded_s), self._limits.grace_s)
        kills = self._memory_kills()
        while True:
            event = tester.event(clock.left(_LOOK_S)) or {"event": "silence"}
            match event["event"]:
                case "begun":
                    clock.begin(float(event["limit_s"]), str(event["test"]))
                case "ended":
                    clock.end()
                case "lost":
                    kills = self._replace(graded, number, clock, kills)
                case "outputs":
                    self._incidents += [f"{graded.name}: {text}" for text in event.get("incidents", [])]
                    if event.get("error"):
                        self._incidents.append(f"{graded.name}: its tests are broken ({event['error']})")
                    return list(event["outputs"])
            if graded.snapshot is not None:
                clock.act(graded.snapshot)
            if clock.overdue(_TESTER_GRACE_S):
                raise TesterDied("no answer")

    def _connect(self, graded: Graded) -> int | None:
        """The number by which the tester knows the cell's snapshot; it is introduced if need be."""
        if graded.snapshot is not None and not graded.snapshot.alive():
            self._look()
            graded.snapshot.close()
            graded.snapshot = None
        if graded.snapshot is None:
            graded.snapshot = self._fresh()
        if graded.snapshot is None:
            self._fail(graded, "KernelEnded", "the Python process ended, and could not be started again")
            return None
        if graded.snapshot.number is None:
            self._introduce(graded.snapshot, next(self._numbers))
        return graded.snapshot.number

    def _introduce(self, snapshot: Snapshot, number: int) -> None:
        assert self._tester is not None
        self._tester.send({"op": "student", "student": number}, snapshot.rpc)
        snapshot.number = number

    def _replace(self, graded: Graded, number: int, clock: _Clock, kills: int) -> int:
        """The tester has lost a snapshot: say why, and give it another unless that would only cost time.

        Returns:
            how many processes have run out of memory so far.
        """
        assert self._tester is not None
        if graded.snapshot is None:
            why = _CRASHED
        else:
            by_itself = graded.snapshot.ends_within(_ENDING_S)
            if by_itself and not clock.killed:
                self._look()
            why = _TIMEOUT if clock.killed else _CRASHED if by_itself else _DISTURBED
            graded.snapshot.kill()
            graded.snapshot.close()
            graded.snapshot = None
        if self._memory_kills() > kills:
            why, kills = _MEMORY, self._memory_kills()
        deaths = self._deaths[graded.index] = self._deaths.get(graded.index, 0) + 1
        during = f" during the test {clock.test!r}" if clock.test else ""
        self._incidents.append(f"{graded.name}: the code {_DID[why]}{during}")
        # A second death, or a hang, which costs minutes: the rest of this exercise's tests would do the same.
        fresh = self._fresh() if deaths < 2 and why != _TIMEOUT and not clock.used_up() else None
        self._tester.send({"op": "gone", "student": number, "why": why, "again": fresh is not None})
        if fresh is not None:
            graded.snapshot = fresh
            self._introduce(fresh, number)
        clock.end()
        return kills

    def _lose_tester(self) -> None:
        if self._tester is not None:
            self._tester.close()
            self._tester = None
        for graded in self._graded:  # their connections ended with it
            if graded.snapshot is not None:
                graded.snapshot.close()
                graded.snapshot = None

    def _fail(self, graded: Graded, name: str, message: str) -> None:
        graded.outputs = [outputs.error(name, message)]


class _Clock:
    """When to interrupt and when to kill the student's process.

    Args:
        last: when the whole question must be answered.
        grace_s: between interrupt and kill (s).
    """

    def __init__(self, last: float, grace_s: float) -> None:
        self._last, self._grace_s = last, grace_s
        self._limit: float | None = None
        self._kill_at: float | None = None
        self._dead_since: float | None = None
        self.test = ""
        self.killed = False

    def begin(self, limit_s: float, test: str) -> None:
        """A test begins."""
        self._limit, self._kill_at, self.test = time.monotonic() + limit_s, None, test

    def end(self) -> None:
        """A test has ended."""
        self._limit = self._kill_at = None
        self._dead_since = None
        self.test, self.killed = "", False

    def overdue(self, patience_s: float) -> bool:
        """Whether the tester should have noticed long ago that the process is gone, or that its time is over."""
        now = time.monotonic()
        since = [t for t in (self._dead_since, self._last + self._grace_s) if t is not None]
        return any(now > t + patience_s for t in since)

    def used_up(self) -> bool:
        """Whether the whole question's time is over."""
        return time.monotonic() >= self._last

    def left(self, at_most: float) -> float:
        """How long to wait for the tester before looking at the clock again."""
        now = time.monotonic()
        due = [t - now for t in (self._limit, self._kill_at, self._last) if t is not None and t > now]
        return max(0.0, min([at_most, *due]))

    def act(self, snapshot: Snapshot) -> None:
        """Interrupt or kill if it is time."""
        now = time.monotonic()
        if not snapshot.alive():
            snapshot.cut()  # something that it started may hold the connection
            self._dead_since = self._dead_since or now
        elif self._kill_at is not None and now >= self._kill_at:
            self.killed = True
            snapshot.kill()
        elif self._kill_at is None and now >= min(self._limit or self._last, self._last):
            snapshot.interrupt()
            self._kill_at = now + self._grace_s
