"""Tests against a notebook in another process, which may hang, die or lie."""

from __future__ import annotations

import contextlib
import dataclasses
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar

from robotbrain.grading.limits import EndedFromOutsideError
from robotbrain.grading.quiet import BoundedText, quiet, seeded
from robotbrain.grading.remote.peer import TestersPeer
from robotbrain.grading.remote.raised import RemoteRaised, StudentGone, StudentInterrupted
from robotbrain.grading.remote.student import RemoteNamespace, RemoteStudent, connect, substitute
from robotbrain.grading.results import TestResult, Verdict
from robotbrain.grading.runner import Outcome, Place, judge, result_of, time_scale, timed_out
from robotbrain.grading.suite import Suite, Test

PREPARING_S = 10.0
"""Time for what the tester asks between tests (s): it takes milliseconds."""
_KEPT_REASON = 300  # characters of why the student's side refuses an answer
_GONE = {
    "timeout": Verdict.TIMEOUT,
    "memory": Verdict.MEMORY,
    "crashed": Verdict.CRASHED,
}
_SENTENCES = {
    Verdict.MEMORY: "needed more memory than there is",
    Verdict.CRASHED: "your code ended the Python process during this test",
    Verdict.ERROR: "your code broke the connection to the tests",
}
Answer = TypeVar("Answer")


class StudentLost(EndedFromOutsideError):  # noqa: N818 - an event
    """The student's process ended during a stretch of time; ``outcome`` is what a test then is."""

    def __init__(self, outcome: Outcome) -> None:
        super().__init__(outcome.message)
        self.outcome = outcome


class Executor(Protocol):
    """Whoever runs the student's process and watches the clock."""

    def begun(self, exercise: str, test: str, limit_s: float) -> None:
        """From now on the student's process has ``limit_s`` to answer (s)."""

    def ended(self) -> None:
        """The clock can stop."""

    def lost(self, number: int, why: str) -> tuple[str, socket.socket | None]:
        """The student's process ``number`` no longer answers: return why, and the connection to a fresh one."""


class RemoteWorld:
    """The student's process as a :class:`robotbrain.grading.runs.World`.

    Args:
        suite: the lab's tests.
        files: the folder of the submission's further files.
        refusal: why the source of the answer to an exercise is refused, or ``""``.
    """

    def __init__(
        self, suite: Suite, executor: Executor, files: Path | None, refusal: Callable[[str], str] = lambda _: ""
    ) -> None:
        self._suite, self._executor, self._files, self._refusal = suite, executor, files, refusal
        self._number = -1
        self._sock: socket.socket | None = None
        self._peers: dict[int, TestersPeer] = {}
        self._sockets: dict[int, socket.socket | None] = {}
        self._substituted: tuple[str, ...] = ()
        self._over: dict[int, Outcome] = {}
        self._reasons: dict[str, str] = {}  # exercise -> why it is refused
        self._sealed = False

    def connected(self, number: int, sock: socket.socket | None, why: str = "crashed") -> None:
        """From now on this is the connection to the student's process ``number``; None: there is none any more."""
        self._drop(number)
        self._sockets[number] = sock
        self._over.pop(number, None)
        if sock is None:
            verdict = _GONE.get(why, Verdict.ERROR)
            self._over[number] = Outcome(verdict, message="not run: the process of your code ended")

    def use(self, number: int) -> None:
        """Test what is in the student's process ``number``: the notebook as it was at one graded cell."""
        self._number = number
        if number not in self._sockets:
            self.connected(number, None)

    def namespace(self) -> RemoteNamespace:
        """The notebook's names, for a cell of plain assertions; to be used inside :meth:`timed`."""
        return RemoteNamespace(self._peer())

    def cell(self) -> object:
        """Nothing tells graded cells apart here: an exercise's results stand, wherever it is needed again."""
        return 0

    def state(self) -> dict[str, Any]:
        """Nothing: whether something has changed would be the student's process's word."""
        return {}

    @contextlib.contextmanager
    def substituting(self, suite: Suite, names: Sequence[str]) -> Iterator[None]:
        """Let the visible suite's references stand in, in the student's process."""
        self._substitute(tuple(names))
        try:
            yield
        finally:
            self._substitute(())

    def _substitute(self, names: tuple[str, ...]) -> None:
        if names != self._substituted:
            self._substituted = names
            nothing: frozenset[str] = frozenset()
            self._ask(lambda peer: substitute(peer, names), nothing)

    def why_forbidden(self, exercise: str, suite: Suite) -> str:
        """What the source says, which cannot lie, or else what the student's process says of the objects."""
        if exercise not in self._reasons:
            said = self._refusal(exercise) or self._ask(lambda peer: peer.ask("forbidden", str, exercise), "")
            self._reasons[exercise] = (
                "uses what this exercise forbids" if said and self._sealed else said[:_KEPT_REASON]
            )
        return self._reasons[exercise]

    def seal(self) -> None:
        """Let no word of the student's process into a result from now on: it has seen what hidden tests pass in."""
        self._sealed = True

    def run(self, test: Test, suite: Suite, references: frozenset[str]) -> TestResult:
        """Run one test."""
        if not self._sealed:
            return self._run(test, suite, references)
        result = self._run(dataclasses.replace(test, hidden=True), suite, references)
        return dataclasses.replace(result, hidden=test.hidden, seconds=0.0)

    def _run(self, test: Test, suite: Suite, references: frozenset[str]) -> TestResult:
        start = time.perf_counter()
        try:
            return self._run_once(test, suite, references)
        except StudentInterrupted:
            if time.perf_counter() - start > 0.9 * test.time_limit_s * time_scale():
                return result_of(test, suite, timed_out(test.time_limit_s * time_scale()))
        with contextlib.suppress(StudentInterrupted):  # that one was meant for the test before
            return self._run_once(test, suite, references)
        return result_of(test, suite, timed_out(test.time_limit_s * time_scale()))

    def _run_once(self, test: Test, suite: Suite, references: frozenset[str]) -> TestResult:
        if self._number in self._over:
            return result_of(test, suite, self._over[self._number])
        limit = test.time_limit_s * time_scale()
        output = BoundedText()
        printed = ""
        start = time.perf_counter()
        try:
            with self.timed(test.exercise, test.name, limit):
                peer = self._peer()
                peer.request("begin", suite.name, test.name)
                with quiet(output), seeded(suite.name, test.name):
                    student = RemoteStudent(peer, suite.name, references, self._files)
                    outcome = judge(test, student, _place_of)
                if outcome.verdict is not Verdict.PASSED and not test.hidden:
                    printed = peer.ask("printed", str)
        except StudentLost as lost:
            outcome = lost.outcome
        seconds = time.perf_counter() - start
        if seconds > limit:
            outcome = timed_out(limit)
        return result_of(test, suite, outcome, printed or output.getvalue(), seconds)

    @contextlib.contextmanager
    def timed(self, exercise: str, what: str, limit: float) -> Iterator[None]:
        """A stretch of time in which the student's process must answer.

        Raises:
            StudentLost: it ended meanwhile.
        """
        self._executor.begun(exercise, what, limit)
        try:
            yield
        except StudentGone:
            raise StudentLost(self._lost(limit)) from None
        finally:
            self._executor.ended()
            peer = self._peers.get(self._number)
            if peer is not None:
                peer.forget_exports()

    def _ask(self, question: Callable[[TestersPeer], Answer], otherwise: Answer) -> Answer:
        """The answer to a question between tests; where the process ends at it, that of the next, or ``otherwise``."""
        for again in (False, True):
            if self._number in self._over:
                break
            try:
                with self.timed("", "", PREPARING_S):
                    if again:  # an interrupt of the test before may still stand there
                        self._peer().request("begin", self._suite.name, "")
                    return question(self._peer())
            except (StudentInterrupted, StudentLost):
                continue
            except Exception:  # what the student's process says it raised
                break
        return otherwise

    def _peer(self) -> TestersPeer:
        """The connection, ready for questions; raises :class:`StudentGone`."""
        peer = self._peers.get(self._number)
        if peer is None:
            sock = self._sockets.get(self._number)
            if sock is None:
                raise StudentGone("there is no process")
            peer = self._peers[self._number] = connect(sock, self._suite)
            if self._substituted:
                substitute(peer, self._substituted)
        return peer

    def _lost(self, limit: float) -> Outcome:
        """What became of the test during which the connection ended; a fresh process takes the place of the old."""
        if self._number in self._over:
            return self._over[self._number]
        peer = self._peers.get(self._number)
        broke = peer is not None and peer.broke_rules
        reason = "its process broke the rules of the connection" if broke else "the connection was closed"
        self._drop(self._number)
        why, fresh = self._executor.lost(self._number, reason)
        self.connected(self._number, fresh, why)
        verdict = _GONE.get(why, Verdict.ERROR)
        return timed_out(limit) if verdict is Verdict.TIMEOUT else Outcome(verdict, message=_SENTENCES[verdict])

    def _drop(self, number: int) -> None:
        self._peers.pop(number, None)
        sock = self._sockets.pop(number, None)
        if sock is not None:
            sock.close()


def _place_of(error: BaseException) -> Place | None:
    """Where in the notebook's code an exception arose, as its process says."""
    if isinstance(error, RemoteRaised) and error.function:
        return Place(error.function, error.line, error.text)
    return None
