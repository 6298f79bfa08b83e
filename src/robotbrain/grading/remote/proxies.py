"""Stand-ins for objects of the other process."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NoReturn

if TYPE_CHECKING:
    from robotbrain.grading.remote.peer import Peer

MAX_ITEMS = 1_000_000
"""Most items that iterating over a student's object gives."""
_ASKED_DUNDERS = frozenset({"__name__", "__qualname__", "__doc__"})


class Proxy:
    """A test's stand-in for an object in the student's process.

    It can be called, indexed, iterated over and asked for attributes and its length. It is never asked whether it is
    equal to something, true, or a number: whoever wrote the object could answer whatever a test wants to hear. A proxy
    is equal to itself only.
    """

    __slots__ = ("__weakref__", "_remote_count", "_remote_handle", "_remote_peer", "_remote_type")

    def __init__(self, peer: Peer, handle: int, type_name: str) -> None:
        for name, value in (("peer", peer), ("handle", handle), ("type", type_name), ("count", 1)):
            object.__setattr__(self, f"_remote_{name}", value)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call the object in its own process."""
        return self._remote_peer.request("call", self, args, kwargs)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") and name not in _ASKED_DUNDERS:
            raise AttributeError(name)  # protocols (numpy's, copy's) look here, and must get no answer of the student's
        return self._remote_peer.request("getattr", self, name)

    def __setattr__(self, name: str, value: Any) -> None:
        self._remote_peer.request("setattr", self, name, value)

    def __getitem__(self, key: Any) -> Any:
        return self._remote_peer.request("getitem", self, key)

    def __setitem__(self, key: Any, value: Any) -> None:
        self._remote_peer.request("setitem", self, key, value)

    def __len__(self) -> int:
        length: int = self._remote_peer.ask("len", int, self)
        return length if 0 <= length <= MAX_ITEMS else self._no_value()

    def __contains__(self, item: Any) -> bool:
        return self._remote_peer.ask("contains", bool, self, item)  # type: ignore[no-any-return]

    def __iter__(self) -> Iterator[Any]:
        iterator = self._remote_peer.request("iter", self)
        for _ in range(MAX_ITEMS):
            answer = self._remote_peer.ask("next", tuple, iterator)
            if len(answer) != 1:
                return
            yield answer[0]
        raise ValueError(f"the student's {type_name(self)} gives more than {MAX_ITEMS} items")

    def __next__(self) -> Any:
        answer = self._remote_peer.ask("next", tuple, self)
        if len(answer) != 1:
            raise StopIteration
        return answer[0]

    def _no_value(self, *args: Any, **kwargs: Any) -> NoReturn:
        raise TypeError(f"the answer is an object of type {type_name(self)}, not a plain value")

    __bool__ = __float__ = __int__ = __complex__ = __index__ = __array__ = _no_value
    __lt__ = __le__ = __gt__ = __ge__ = _no_value
    __array_ufunc__ = None  # an array compared with it is not equal to it, instead of taking it apart
    __reduce__ = __copy__ = __deepcopy__ = _no_value

    def __repr__(self) -> str:
        return f"<{type_name(self)} of the student>"

    def __del__(self) -> None:
        try:
            self._remote_peer.released.append((self._remote_handle, self._remote_count))
        except AttributeError:  # the interpreter is shutting down
            return


class Callback:
    """The student's stand-in for a test's function; all it can do is be called."""

    __slots__ = ("__name__", "_remote_handle", "_remote_peer")

    def __init__(self, peer: Peer, handle: int, name: str) -> None:
        self._remote_peer, self._remote_handle, self.__name__ = peer, handle, name

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call the object in its own process."""
        return self._remote_peer.request("call", self, args, kwargs)

    def __repr__(self) -> str:
        return f"<function {self.__name__} of the test>"


def type_name(value: Any) -> str:
    """The name of a value's type; for a student's object the name that its process gave."""
    if type(value) is Proxy:
        return str(value._remote_type)
    return type(value).__name__
