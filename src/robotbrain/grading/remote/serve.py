"""The student's side: answers what the tester asks about the notebook's objects.

This runs in the untrusted process; student code may replace any of it. Nothing here decides anything about a grade.
"""

from __future__ import annotations

import builtins
import contextlib
import importlib
import linecache
import operator
import select
import signal
import socket
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator, MutableMapping
from types import FrameType
from typing import Any, Protocol

from robotbrain.grading.expect import CannotCrossError
from robotbrain.grading.forbidden import why_exercise_forbidden
from robotbrain.grading.quiet import BoundedText, seed_generators, settings_keeper
from robotbrain.grading.remote import values, wire
from robotbrain.grading.remote.peer import ANSWER, ERROR, INTERRUPTED, REQUEST, Peer
from robotbrain.grading.remote.proxies import Callback
from robotbrain.grading.remote.raised import kind_of
from robotbrain.grading.state import state_of, token_of
from robotbrain.grading.student import Student
from robotbrain.grading.suite import Suite, load_suite

_SUITES_PACKAGE = "robotbrain.grading.suites."


class SupportsFileno(Protocol):
    """Something that ``select`` can wait for."""

    def fileno(self) -> int:
        """The file descriptor."""


def serve(rpc: socket.socket, namespace: MutableMapping[str, Any], stop: SupportsFileno | None = None) -> bool:
    """Answer the tester's requests about the notebook whose globals are ``namespace``.

    Call it in the main thread: SIGINT then interrupts the student's code, and only that.

    Args:
        stop: serving ends when this becomes readable while nothing is asked.

    Returns:
        True after ``stop``, False once the tester has closed the connection.
    """
    return Server(rpc, namespace).serve(stop)


class _Held:
    """Marks an answer that goes by handle although it could go by value."""

    def __init__(self, value: Any) -> None:
        self.value = value


class Server(Peer):
    """The student's end of the connection; keep it to serve the same connection again."""

    def __init__(self, rpc: socket.socket, namespace: MutableMapping[str, Any]) -> None:
        super().__init__(rpc)
        self._namespace = namespace
        self._suite_name = ""
        self._crossing: frozenset[str] = frozenset()
        self._replaced: dict[str, Any] = {}
        self._references: frozenset[str] = frozenset()
        self._output = BoundedText()
        self._running = False  # the student's code, which an interrupt may break into
        self._interrupted = False
        self._restore_settings: Callable[[], None] = lambda: None
        with contextlib.suppress(Exception):  # the student's code may have changed what is asked here
            self._restore_settings = settings_keeper()
        self._operations: dict[str, Callable[..., Any]] = {
            "hello": self._hello,
            "name": self._name,
            "has": self._namespace.__contains__,
            "state": self._state,
            "substitute": self._substitute,
            "begin": self._begin,
            "printed": self._printed,
            "forbidden": self._forbidden,
            "probe": self._probe,
            "hold": _Held,
            "fetch": lambda held: held,
            "call": lambda function, args, kwargs: function(*args, **kwargs),
            "getattr": getattr,
            "setattr": setattr,
            "getitem": operator.getitem,
            "setitem": operator.setitem,
            "len": len,
            "contains": operator.contains,
            "iter": lambda value: _Held(iter(value)),
            "next": self._next,
        }

    def serve(self, stop: SupportsFileno | None = None) -> bool:
        """As the module's function of this name."""
        with self._surroundings():
            while True:
                if stop is not None and self._reader.idle:
                    ready, _, _ = select.select([self.sock, stop], [], [])
                    if self.sock not in ready:
                        return True
                try:
                    header, blobs = self._reader.read()
                    self._handle(header, blobs)
                except wire.ConnectionLostError:
                    return False

    def request(self, operation: str, *args: Any) -> Any:
        """Ask the tester, that is call one of its functions from student code."""
        self._number += 1
        number = self._number
        before, self._running = self._running, False
        try:
            self.send(REQUEST, number, [operation, []], args)
            while True:
                header, blobs = self._reader.read()
                kind, its_number, *head, coded = header
                if kind != REQUEST and its_number == number:
                    break
                self._handle(header, blobs)
        finally:
            self._running = before
        if self._interrupted:
            raise KeyboardInterrupt
        if kind == ERROR:
            kind_of = getattr(builtins, head[0], None)
            known = isinstance(kind_of, type) and issubclass(kind_of, Exception)
            raise (kind_of if known else RuntimeError)(head[2])  # type: ignore[misc]
        return self.decoder(blobs).decode(coded[0])

    def _handle(self, header: list[Any], blobs: list[memoryview]) -> None:
        """Do what the tester asks, and answer."""
        _, number, name, released, coded = header
        for handle, count in zip(released[::2], released[1::2], strict=True):
            self.release(handle, count)
        head: list[Any] = []
        answer: list[Any] = []
        kind = ERROR
        try:
            decoder = self.decoder(blobs)
            args = [decoder.decode(part) for part in coded]
            before, self._running = self._running, True
            try:
                if self._interrupted and name != "begin":
                    raise KeyboardInterrupt
                answer = [self._operations[name](*args)]
                kind = ANSWER
            finally:
                self._running = before
        except (wire.ConnectionLostError, SystemError):
            raise
        except BaseException as error:
            head = self._described(error)
        if self._interrupted:
            kind, head, answer = ERROR, [INTERRUPTED, "", "", "", 0, ""], []
        try:
            self.send(kind, number, head, answer)
        except wire.ConnectionLostError:
            raise
        except BaseException as error:  # an answer that cannot be sent, or that raises while it is looked at
            what = f"the answer cannot be handed to the test: {error}" if isinstance(error, CannotCrossError) else ""
            head = self._described(error)
            self.send(ERROR, number, [*head[:2], what or head[2], *head[3:]])

    def _described(self, error: BaseException) -> list[Any]:
        """Type, text and place of an exception, made of plain values whatever the exception's class does."""
        name = "TypeError" if isinstance(error, CannotCrossError) else str(type(error).__name__)
        try:
            text = str.__str__(str(error))[:2000]
        except Exception:
            text = ""
        found = ("", 0, "")
        trace = error.__traceback__
        while trace is not None:
            if trace.tb_frame.f_globals is self._namespace:
                code, line = trace.tb_frame.f_code, trace.tb_lineno
                shown = linecache.getline(code.co_filename, line, trace.tb_frame.f_globals).strip()
                found = (code.co_name, line, shown[:200])
            trace = trace.tb_next
        traceback.clear_frames(error.__traceback__)
        return ["TypeError" if isinstance(error, CannotCrossError) else kind_of(error), name, text, *found]

    @contextlib.contextmanager
    def _surroundings(self) -> Iterator[None]:
        """Let SIGINT break into student code, and into nothing else; keep prints."""
        if threading.current_thread() is not threading.main_thread():
            yield  # a loopback: the process's signals and prints are not the student's
            return

        def on_interrupt(signum: int, frame: FrameType | None) -> None:
            self._interrupted = True
            if self._running:
                raise KeyboardInterrupt

        before = signal.signal(signal.SIGINT, on_interrupt)
        try:
            with contextlib.redirect_stdout(self._output), contextlib.redirect_stderr(self._output):
                yield
        finally:
            signal.signal(signal.SIGINT, before)

    # ------------------------------------------------------------------ operations

    def _hello(self, suite_name: str, crossing: list[str]) -> None:
        self._suite_name, self._crossing = suite_name, frozenset(crossing)

    def _name(self, name: str) -> tuple[Any, ...]:
        return (self._namespace[name],) if name in self._namespace else ()

    def _next(self, iterator: Any) -> tuple[Any, ...]:
        try:
            return (next(iterator),)
        except StopIteration:
            return ()

    def _state(self) -> dict[str, Any]:
        return {name: token_of(value) for name, value in state_of(self._namespace).items()}

    def _substitute(self, names: list[str]) -> list[str]:
        """Let the references of the visible suite stand in for these names, and for no others."""
        for name, value in self._replaced.items():
            if value is _ABSENT:
                self._namespace.pop(name, None)
            else:
                self._namespace[name] = value
        self._replaced = {}
        known: list[str] = []
        if names:
            suite = self._suite()
            known = [name for name in names if name in suite.references]
            references = {name: suite.load_reference(name) for name in known}
            self._replaced = {name: self._namespace.get(name, _ABSENT) for name in known}
            self._namespace.update(references)
        self._references = frozenset(known)
        return known

    def _begin(self, *labels: str) -> None:
        """A test begins: whatever an earlier one left is put aside."""
        self._interrupted = False
        self._output.clear()
        with contextlib.suppress(Exception):
            self._restore_settings()
        if threading.current_thread() is threading.main_thread():
            warnings.simplefilter("ignore")
        seed_generators(*labels)

    def _printed(self) -> str:
        return self._output.getvalue()

    def _forbidden(self, exercise: str) -> str:
        return why_exercise_forbidden(exercise, self._suite(), self._namespace)

    def _probe(self, module: str, name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        if not module.startswith(_SUITES_PACKAGE):
            self._suite()  # a suite outside of the package is loaded under a name of its own
        probe = getattr(sys.modules.get(module) or importlib.import_module(module), name)
        return probe(Student(self._namespace, self._suite_name, self._references), *args, **kwargs)

    def _suite(self) -> Suite:
        return load_suite(self._suite_name)

    # ------------------------------------------------------------------ handles

    def by_value(self, cls: type) -> bool:
        """Whether instances of a dataclass or enum go by value: those that the suite names."""
        return values.class_name(cls) in self._crossing

    def find_class(self, name: str) -> type | None:
        """The class of this package that the tester names."""
        return values.find_own_class(name)

    def export(self, value: object) -> list[Any]:
        """A handle of an object of the notebook, or of the tester's function that came as an argument."""
        if type(value) is Callback:
            return [values.YOURS, value._remote_handle]
        if type(value) is _Held:
            value = value.value
        return [values.THEIRS, self.keep(value), str(type(value).__name__)]

    def resolve(self, tag: int, parts: list[Any]) -> Any:
        """The object of a handle."""
        return self.kept(parts[0]) if tag == values.YOURS else Callback(self, *parts)


_ABSENT = object()
