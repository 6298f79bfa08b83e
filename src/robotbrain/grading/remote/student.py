"""A test's view of a notebook that lives in another process."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from robotbrain.grading.remote import values
from robotbrain.grading.remote.peer import TestersPeer
from robotbrain.grading.student import Student
from robotbrain.grading.suite import Suite


class RemoteNamespace(Mapping[str, Any]):
    """The notebook's global variables, asked for one by one."""

    def __init__(self, peer: TestersPeer) -> None:
        self._peer = peer

    def __getitem__(self, name: str) -> Any:
        answer = self._peer.ask("name", tuple, name)
        if len(answer) != 1:
            raise KeyError(name)
        return answer[0]

    def __contains__(self, name: object) -> bool:
        return self._peer.ask("has", bool, name)

    def __iter__(self) -> Iterator[str]:
        raise TypeError("a test asks for the names it knows")

    def __len__(self) -> int:
        raise TypeError("a test asks for the names it knows")


class RemoteStudent(Student):
    """As :class:`~robotbrain.grading.student.Student`, for a notebook in the process at the other end of ``peer``."""

    def __init__(
        self, peer: TestersPeer, suite_name: str, references: frozenset[str] = frozenset(), files: Path | None = None
    ) -> None:
        super().__init__(RemoteNamespace(peer), suite_name, references)
        self._peer, self._files = peer, files

    def close(self) -> None:
        """End the connection; the other side then stops serving."""
        self._peer.sock.close()

    @property
    def files(self) -> Path:
        """The tester's own copy of the files handed in beside the notebook."""
        return self._files if self._files is not None else Path.cwd()

    def hold(self, value: Any) -> Any:
        """Send ``value`` to the student's process to stay there."""
        return self._peer.request("hold", value)

    def fetch(self, held: Any) -> Any:
        """What became of it."""
        return self._peer.request("fetch", held)

    def run(self, probe: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """Call ``probe`` in the student's process."""
        return self._peer.request("probe", probe.__module__, probe.__qualname__, args, kwargs)


def connect(sock: socket.socket, suite: Suite) -> TestersPeer:
    """The trusted end of a connection to a notebook that ``suite`` will test."""
    peer = TestersPeer(sock, tuple(suite.crossing))
    peer.request("hello", suite.name, [values.class_name(cls) for cls in suite.crossing])
    return peer


def substitute(peer: TestersPeer, names: Sequence[str]) -> frozenset[str]:
    """Let the visible suite's references stand in for ``names`` in the notebook; return those that it has."""
    answer = peer.ask("substitute", list, list(names))
    return frozenset(names) & frozenset(name for name in answer if type(name) is str)
