"""Requests and answers between two processes, each of which may ask while it is being asked."""

from __future__ import annotations

import socket
import weakref
from collections.abc import Callable
from typing import Any, TypeVar

from robotbrain.grading.expect import CannotCrossError, CheckFailure
from robotbrain.grading.remote import values, wire
from robotbrain.grading.remote.proxies import Proxy
from robotbrain.grading.remote.raised import StudentGone, StudentInterrupted, kind_of, make_raised
from robotbrain.grading.remote.values import Decoder, Encoder
from robotbrain.grading.remote.wire import WireError

MAX_HANDLES = 1_000_000
MAX_NESTING = 20
"""How deep calls may go back and forth between a test's callbacks and a student's functions."""
REQUEST, ANSWER, ERROR = 0, 1, 2
Kind = TypeVar("Kind")
INTERRUPTED = "interrupted"  # the kind of error that says that the executor interrupted the code


class Peer:
    """One end of a connection; :class:`TestersPeer` and the student's server differ in what they answer."""

    def __init__(self, sock: socket.socket) -> None:
        self.sock = sock
        self.released: list[tuple[int, int]] = []
        self._reader = wire.Reader(sock)
        self._number = 0
        self._nesting = 0
        self._exported: dict[int, Any] = {}
        self._handles: dict[int, int] = {}  # id of an object -> its handle
        self._counts: dict[int, int] = {}
        self._next_handle = 1

    def request(self, operation: str, *args: Any) -> Any:
        """Ask the other side and return its answer; raises what it raised."""
        raise NotImplementedError

    def ask(self, operation: str, kind: type[Kind], *args: Any) -> Kind:
        """As :meth:`request`, for an answer that must be of exactly this type."""
        raise NotImplementedError

    def send(self, kind: int, number: int, head: list[Any], arguments: Any = ()) -> None:
        """Send a message; raises :class:`CannotCrossError` before anything is sent if a value cannot go."""
        encoder = Encoder(self.export, self.by_value)
        coded = [encoder.encode(argument) for argument in arguments]
        try:
            pieces = wire.pack([kind, number, *head, coded], encoder.blobs)
        except WireError as error:
            raise CannotCrossError(str(error)) from None
        wire.send(self.sock, pieces)

    def decoder(self, blobs: list[memoryview]) -> Decoder:
        """What reads the values of a message."""
        return Decoder(blobs, self.resolve, self.find_class)

    def by_value(self, cls: type) -> bool:
        """Whether instances of a dataclass or enum go by value."""
        raise NotImplementedError

    def find_class(self, name: str) -> type | None:
        """The class that the other side names, or None where it may not."""
        raise NotImplementedError

    def export(self, value: object) -> list[Any]:
        """A handle of an object of this side."""
        raise NotImplementedError

    def resolve(self, tag: int, parts: list[Any]) -> Any:
        """What a handle stands for."""
        raise NotImplementedError

    def keep(self, value: object) -> int:
        """Give an object a handle; the same object has the same one."""
        handle = self._handles.get(id(value))
        if handle is None:
            if len(self._exported) >= MAX_HANDLES:
                raise CannotCrossError(f"more than {MAX_HANDLES} objects are in use")
            handle, self._next_handle = self._next_handle, self._next_handle + 1
            self._handles[id(value)], self._exported[handle] = handle, value
        self._counts[handle] = self._counts.get(handle, 0) + 1
        return handle

    def kept(self, handle: object) -> Any:
        """The object of a handle given out by :meth:`keep`."""
        if type(handle) is not int or handle not in self._exported:
            raise WireError("a handle that was never given out")
        return self._exported[handle]

    def release(self, handle: int, count: int) -> None:
        """The other side no longer needs ``count`` mentions of a handle."""
        left = self._counts.get(handle, 0) - count
        if left > 0:
            self._counts[handle] = left
        elif handle in self._exported:
            del self._handles[id(self._exported.pop(handle))], self._counts[handle]

    def forget_exports(self) -> None:
        """Take back all handles given out; they are never given out again."""
        self._exported.clear()
        self._handles.clear()
        self._counts.clear()


class TestersPeer(Peer):
    """The trusted end. What arrives is checked; anything irregular ends the connection for good.

    Args:
        crossing: classes whose instances may arrive by value.
    """

    __test__ = False  # the name begins with "Test", but this is no pytest class

    def __init__(self, sock: socket.socket, crossing: tuple[type, ...] = ()) -> None:
        super().__init__(sock)
        self.disturbed = ""
        self.broke_rules = False
        self._crossing = {values.class_name(cls): cls for cls in crossing}
        self._proxies: weakref.WeakValueDictionary[int, Proxy] = weakref.WeakValueDictionary()
        self._failure: BaseException | None = None

    def request(self, operation: str, *args: Any) -> Any:
        """Ask the student's process; raises what student code raised, or :class:`StudentGone`."""
        if self.disturbed:
            raise StudentGone(self.disturbed)
        released, self.released = self.released[:1000], self.released[1000:]
        self._number += 1
        number = self._number
        finished = False
        try:
            try:
                self.send(REQUEST, number, [operation, [part for pair in released for part in pair]], args)
            except CannotCrossError:
                finished = True  # nothing was sent
                raise
            kind, head, coded, blobs = self._answer(number)
            finished = True
            return self._result(kind, head, coded, blobs)
        except WireError as error:
            raise self._disturb(error) from None
        finally:
            if not finished and not self.disturbed:  # e.g. a time limit struck here: the answer would come too late
                self.disturbed = "a question was not answered"

    def ask(self, operation: str, kind: type[Kind], *args: Any) -> Kind:
        """As :meth:`request`, for an answer of exactly this type."""
        answer = self.request(operation, *args)
        if type(answer) is not kind:
            raise self._disturb(WireError(f"an answer to {operation!r} that is no {kind.__name__}"))
        return answer

    def _disturb(self, error: WireError) -> StudentGone:
        gone = isinstance(error, wire.ConnectionLostError)
        self.broke_rules = not gone
        self.disturbed = str(error) if gone else f"the student's process sent {error}"
        return StudentGone(self.disturbed)

    def _answer(self, number: int) -> tuple[int, list[Any], Any, list[memoryview]]:
        """Wait for the answer to a request, and serve the callbacks that come before it."""
        while True:
            header, blobs = self._reader.read()
            if len(header) < 3 or any(type(part) is not int for part in header[:2]):
                raise WireError("a message without a kind and a number")
            kind, its_number, *head, coded = header
            if kind == REQUEST:
                self._serve(its_number, head, coded, blobs)
            elif kind in (ANSWER, ERROR) and its_number == number:
                return kind, head, coded, blobs
            else:
                raise WireError("an answer that nobody asked for")

    def _result(self, kind: int, head: list[Any], coded: Any, blobs: list[memoryview]) -> Any:
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure
        if kind == ERROR:
            if [type(part) for part in head] != [str, str, str, str, int, str]:
                raise WireError("an exception that is none")
            if head[0] == INTERRUPTED:
                raise StudentInterrupted
            raise make_raised(*head)
        if head or type(coded) is not list or len(coded) != 1:
            raise WireError("an answer of several values")
        return self.decoder(blobs).decode(coded[0])

    def _serve(self, number: int, head: list[Any], coded: Any, blobs: list[memoryview]) -> None:
        """Call a function that this side gave out, the only thing the student's side may ask for."""
        if len(head) != 2 or head[0] != "call" or type(coded) is not list or len(coded) != 3:
            raise WireError("a request that is no call")
        if self._nesting >= MAX_NESTING:
            self.send(ERROR, number, ["RecursionError", "", "too many calls back and forth", "", 0, ""])
            return
        decoder = self.decoder(blobs)
        function, args, kwargs = (decoder.decode(part) for part in coded)
        if type(args) is not tuple or type(kwargs) is not dict or any(type(name) is not str for name in kwargs):
            raise WireError("a call without proper arguments")
        if id(function) not in self._handles:
            raise WireError("a call of something that was not given out")
        self._nesting += 1
        try:
            self._call_back(number, function, args, kwargs)
        finally:
            self._nesting -= 1

    def _call_back(self, number: int, function: Callable[..., Any], args: Any, kwargs: Any) -> None:
        try:
            answer = function(*args, **kwargs)
            self.send(ANSWER, number, [], [answer])
        except CannotCrossError as error:
            self._failure = error
            self.send(ERROR, number, ["TypeError", "", "the test's function failed", "", 0, ""])
        except CheckFailure as failure:  # the test has its verdict, whatever the student's code makes of it
            self._failure = failure
            self.send(ERROR, number, ["AssertionError", "", "the test ends here", "", 0, ""])
        except StudentInterrupted as interrupted:
            self._failure = interrupted
            self.send(ERROR, number, ["KeyboardInterrupt", "", "", "", 0, ""])
        except WireError:
            raise
        except Exception as error:
            message = str(error)[:2000]
            self.send(ERROR, number, [kind_of(error), "", message, "", 0, ""])

    def by_value(self, cls: type) -> bool:
        """Whether instances of a class go by value: those of this package."""
        return values.is_own_class(cls)

    def find_class(self, name: str) -> type | None:
        """One of the classes that the suite lets cross."""
        return self._crossing.get(name)

    def export(self, value: object) -> list[Any]:
        """A stand-in for a test's function, or a student's object that goes home."""
        if type(value) is Proxy:
            if value._remote_peer is not self:
                raise CannotCrossError(f"{value!r} belongs to a process that has ended")
            return [values.YOURS, value._remote_handle]
        if isinstance(value, type) or not callable(value):
            raise CannotCrossError(
                f"a test passes {type(value).__name__} objects to student code: pass plain values, arrays, dataclasses "
                "of robotbrain, a SimpleNamespace of functions, or make the object in a probe (student.run)"
            )
        return [values.THEIRS, self.keep(value), getattr(value, "__name__", type(value).__name__)]

    def resolve(self, tag: int, parts: list[Any]) -> Any:
        """One of the test's own functions, or a stand-in for a student's object."""
        if tag == values.YOURS:
            (handle,) = parts
            return self.kept(handle)
        handle, name = parts
        if type(handle) is not int or not 0 < handle < 2**63 or type(name) is not str:
            raise WireError("a handle that is none")
        proxy = self._proxies.get(handle)
        if proxy is not None:
            object.__setattr__(proxy, "_remote_count", proxy._remote_count + 1)
            return proxy
        if len(self._proxies) >= MAX_HANDLES:
            raise WireError("too many handles")
        shown = name[:80] if name.isidentifier() else "object"
        proxy = self._proxies[handle] = Proxy(self, handle, shown)
        return proxy
