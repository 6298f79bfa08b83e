"""The wire between tester and student's process: what goes through it, and what a hostile other end can do."""

from __future__ import annotations

import collections
import dataclasses
import enum
import math
import os
import pathlib
import signal
import socket
import struct
import subprocess
import sys
import textwrap
import threading
import types
from collections.abc import Callable, Iterator
from typing import Any

import msgpack
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from robotbrain.grading import CheckFailure, Suite, expect, expect_close, fail
from robotbrain.grading.expect import CannotCrossError
from robotbrain.grading.remote import Proxy, RemoteError, RemoteRaised, StudentGone, loopback, proxies, type_name
from robotbrain.grading.remote import values as wire_values
from robotbrain.grading.remote.peer import ANSWER, MAX_NESTING, REQUEST, TestersPeer
from robotbrain.grading.remote.serve import Server
from robotbrain.grading.remote.student import RemoteStudent
from robotbrain.grading.remote.values import THEIRS, YOURS, Decoder, Encoder
from robotbrain.grading.remote.wire import MAX_MESSAGE, ConnectionLostError, Reader, WireError, pack, unpack
from robotbrain.sim.geometry import Pose2D

PLAIN = (type(None), bool, int, float, complex, str, bytes, list, tuple, dict, set, frozenset, range, slice)
EXACT = {*PLAIN, type(pathlib.Path()), types.SimpleNamespace, np.ndarray, torch.Tensor}
DTYPES = ["bool", "int8", "uint16", "int64", "float16", "float32", "float64", "complex64"]


def is_exact(value: Any) -> bool:
    """Whether a value and all that it holds are exactly of types that cannot lie."""
    if isinstance(value, np.generic):
        return type(value).__module__ == "numpy"
    if type(value) not in EXACT:
        return False
    parts: list[Any] = []
    if type(value) in (list, tuple, set, frozenset):
        parts = list(value)
    elif type(value) is dict:
        parts = [*value, *value.values()]
    elif type(value) is types.SimpleNamespace:
        assert not any(name.startswith("__") for name in vars(value))
        parts = list(vars(value).values())
    return all(map(is_exact, parts))


def refuse(tag: int, parts: list[Any]) -> Any:
    raise WireError("no handles here")


def cannot(value: object) -> list[Any]:
    raise CannotCrossError(type(value).__name__)


def decode(frame: bytes) -> Any:
    header, blobs = unpack(bytearray(frame[4:]))
    return Decoder(blobs, refuse, lambda name: None).decode(header)


def encode(value: Any) -> bytes:
    encoder = Encoder(cannot, lambda cls: False)
    return b"".join(pack(encoder.encode([value]), encoder.blobs))


def through(value: Any) -> Any:
    return decode(encode(value))[0]


def same(a: Any, b: Any) -> bool:
    """Equality that minds types, NaN and arrays."""
    if type(a) is not type(b):
        return False
    if isinstance(a, (np.ndarray, np.generic)):
        return (
            a.dtype == b.dtype and np.shape(a) == np.shape(b) and np.array_equal(a, b, equal_nan=a.dtype.kind in "fc")
        )
    if isinstance(a, torch.Tensor):
        return a.dtype == b.dtype and torch.equal(a, b)
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, dict):
        return list(map(repr, a)) == list(map(repr, b)) and all(map(same, a.values(), b.values()))
    if isinstance(a, types.SimpleNamespace):
        return same(vars(a), vars(b))
    return bool(a == b) or (isinstance(a, float) and math.isnan(a) and math.isnan(b)) or repr(a) == repr(b)


SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.complex_numbers(),
    st.binary(max_size=600),
    st.text(st.characters(), max_size=400),
    st.integers(-(10**3000), 10**3000),
)
KEYS = st.one_of(
    st.integers(), st.text(max_size=5), st.tuples(st.integers(), st.booleans()), st.floats(allow_nan=False)
)
ARRAYS = st.builds(
    lambda dtype, shape, seed: np.random.default_rng(seed).uniform(0, 9, shape).astype(dtype),
    st.sampled_from(DTYPES),
    st.lists(st.integers(0, 4), max_size=3),
    st.integers(0, 9),
)
LEAVES = st.one_of(
    SCALARS,
    ARRAYS,
    ARRAYS.map(lambda a: np.asarray(a).reshape(-1)[:1].sum(dtype=a.dtype)),
    ARRAYS.filter(lambda a: a.dtype != np.uint16).map(torch.from_numpy),
    st.lists(st.floats(), min_size=14, max_size=40),
    st.lists(st.integers(-(2**65), 2**65), min_size=14, max_size=20),
    st.builds(range, st.integers(-9, 9), st.integers(-9, 99), st.integers(1, 5)),
    st.builds(slice, st.none() | st.integers(), st.integers()),
    st.just(pathlib.Path("a/b.onnx")),
    st.builds(types.SimpleNamespace, _a=SCALARS, b=SCALARS),
    st.sets(KEYS),
    st.frozensets(KEYS),
)
VALUES = st.recursive(
    LEAVES,
    lambda v: st.lists(v, max_size=5) | st.lists(v, max_size=4).map(tuple) | st.dictionaries(KEYS, v, max_size=4),
)


# ------------------------------------------------------------------ the codec


@settings(max_examples=80, deadline=None)
@given(VALUES)
def test_values_arrive_as_they_were(value: Any) -> None:
    got = through(value)
    assert same(got, value) and is_exact(got)


@settings(max_examples=80, deadline=None)
@given(st.binary(max_size=300))
def test_garbage_is_a_wire_error(data: bytes) -> None:
    with pytest.raises(WireError):
        decode(b"1234" + data)


@settings(max_examples=100, deadline=None)
@given(VALUES, st.data())
def test_a_damaged_frame_is_refused_or_plain(value: Any, data: st.DataObject) -> None:
    frame = bytearray(encode(value))
    for _ in range(data.draw(st.integers(1, 4))):
        frame[data.draw(st.integers(4, len(frame) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(4, len(frame)))
    for damaged in (frame, frame[:cut]):
        try:
            assert is_exact(decode(bytes(damaged)))
        except WireError:
            continue


FORGED = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-3, 30)
    | st.floats()
    | st.text(max_size=3)
    | st.binary(max_size=9)
    | st.sampled_from(["float64", "bool", "__class__", "__array_interface__", "robotbrain.sim.geometry:Pose2D", 2**62]),
    lambda inner: (
        st.lists(inner, max_size=5)
        | st.tuples(st.integers(0, 24), inner, inner).map(list)
        | st.tuples(
            st.integers(0, 24), st.sampled_from(DTYPES), st.lists(st.integers(-1, 4)), st.binary(max_size=64)
        ).map(list)
    ),
    max_leaves=20,
)


@settings(max_examples=200, deadline=None)
@given(st.lists(FORGED, min_size=1, max_size=3), st.lists(st.binary(max_size=40), max_size=2))
def test_forged_tags_are_refused_or_plain(header: list[Any], blobs: list[bytes]) -> None:
    frame = b"".join(pack(header, blobs))
    try:
        assert is_exact(decode(frame))
    except WireError:
        return


def raw(header: bytes, blobs: tuple[bytes, ...] = ()) -> bytes:
    return (
        b"1234" + struct.pack(f"<II{len(blobs)}I", len(header), len(blobs), *map(len, blobs)) + header + b"".join(blobs)
    )


def colliding(n: int) -> list[Any]:
    """Different tuples that all have one hash, for hash(-1) == hash(-2)."""
    return [[1, *(-1 - (k >> bit & 1) for bit in range(10))] for k in range(n)]


BOMBS = {
    "nested arrays": msgpack.packb([]) and b"\x91" * 100_000 + b"\xc0",
    "nested lists": msgpack.packb(__import__("functools").reduce(lambda inner, _: [0, inner], range(60), [0])),
    "arrays that claim millions": b"\xdd\x00\x7f\xff\xff" * 400,
    "an array that claims gigabytes": msgpack.packb([13, "float64", [2**31, 2**31], b""]),
    "an empty array of enormous sides": msgpack.packb([13, "float64", [0, 2**62], b""]),
    "a negative side": msgpack.packb([13, "float64", [-1, -1], b"12345678"]),
    "an object array": msgpack.packb([13, "object", [1], b"12345678"]),
    "a long integer": msgpack.packb([5, b"\x7f" * 5000]),
    "a range without end": msgpack.packb([7, 0, 2**62, 1]),
    "a range of step 0": msgpack.packb([7, 0, 9, 0]),
    "colliding keys": msgpack.packb([2, *colliding(1000)]),
    "unhashable keys": msgpack.packb([4, [0], 1]),
    "half a pair": msgpack.packb([4, 1]),
    "extension types": b"\x91\xd4\x01\x00",
    "timestamps": b"\x91\xd6\xff\x00\x00\x00\x01",
    "a map": b"\x91\x81\xa1a\x01",
    "dunder attributes": msgpack.packb([17, "__array_interface__", 1]),
    "no identifier": msgpack.packb([17, "a b", 1]),
    "an unknown class": msgpack.packb([18, "os:system", "a", 1]),
    "a blob that is not there": msgpack.packb([9, 7]),
    "a blob before the first": msgpack.packb([9, -1]),
    "a truth value as a number": msgpack.packb([True, 1]),
    "bad text": msgpack.packb([9, b"\xff\xfe"]),
}


@pytest.mark.parametrize("header", BOMBS.values(), ids=BOMBS.keys())
def test_bombs_are_wire_errors(header: bytes) -> None:
    with pytest.raises(WireError):
        decode(raw(header))


def test_one_blob_cannot_be_named_until_memory_is_full() -> None:
    blob = bytes(1 << 20)
    header = msgpack.packb([0, *([13, "uint8", [1 << 20], 0] for _ in range(1 + (MAX_MESSAGE >> 20)))])
    with pytest.raises(WireError):
        decode(raw(header, (blob,)))


def test_a_truth_value_counts_once() -> None:
    got = decode(raw(msgpack.packb([13, "bool", [3], b"\x02\x00\xff"])))
    assert got.sum() == 2 and got.mean() < 1


def test_what_is_too_big_is_refused_before_it_is_sent() -> None:
    deep: list[Any] = []
    for _ in range(50):
        deep = [deep]
    for value in (deep, np.zeros(9_000_000), "x" * (17 << 20), 10**5000, range(10**9)):
        with pytest.raises((CannotCrossError, WireError)):
            encode(value)
    circle: list[Any] = []
    circle.append(circle)
    with pytest.raises(CannotCrossError):
        encode(circle)


def test_a_frame_may_come_in_pieces() -> None:
    ours, theirs = socket.socketpair()
    frame = encode({"a": [1.5] * 100})
    with ours, theirs:
        reader = Reader(ours)
        thread = threading.Thread(target=lambda: [theirs.sendall(frame[i : i + 7]) for i in range(0, len(frame), 7)])
        thread.start()
        header, blobs = reader.read()
        thread.join()
        assert Decoder(blobs, refuse, lambda name: None).decode(header) == [{"a": [1.5] * 100}]
        assert reader.idle


@pytest.mark.parametrize("data", [b"", b"\x01", struct.pack("<I", 4), struct.pack("<I", 2**32 - 1), b"\x20\0\0\0abc"])
def test_cut_or_oversized_frames_end_the_connection(data: bytes) -> None:
    ours, theirs = socket.socketpair()
    with ours:
        theirs.sendall(data)
        theirs.close()
        with pytest.raises(WireError):
            Reader(ours).read()


# ------------------------------------------------------------------ a student at the other end


STUDENT = """
import collections, enum, types
import numpy as np, torch
from dataclasses import dataclass
from robotbrain.sim.geometry import Pose2D

def square(x): return x * x
def echo(x): return x
def fill(a): a[:] = 7
def call(f, *args): return f(*args)
def gen():
    n = 0
    while True:
        yield n
        n += 1
def deep(f, n): return f(n)

class Tracker:
    def __init__(self): self.seen = []
    def add(self, x): self.seen.append(x); return self
    def __len__(self): return len(self.seen)
    def __getitem__(self, i): return self.seen[i]
    def __setitem__(self, i, v): self.seen[i] = v
    def __contains__(self, x): return x in self.seen

class Yes:
    '''Says yes to everything.'''
    def __eq__(self, other): return True
    def __ne__(self, other): return True
    def __lt__(self, other): return True
    __gt__ = __le__ = __ge__ = __lt__
    def __bool__(self): return True
    def __float__(self): return 1.0
    def __int__(self): return 1
    def __index__(self): return 1
    def __hash__(self): return 1
    def __array__(self, *a, **k): return np.ones(3)
    __array_interface__ = {"shape": (3,), "typestr": "<f8", "data": (1, False), "version": 3}
    def __len__(self): return 3
    def __iter__(self): return iter([1, 1, 1])
    def __getattr__(self, name): return lambda *a, **k: True
    def __instancecheck__(self, x): return True
    __class__ = float

class List(list):
    def __eq__(self, other): return True
    def __len__(self): return 99
    def __iter__(self): return iter([1, 2])
class Int(int):
    def __eq__(self, other): return True
    def __add__(self, other): return 42
    def __index__(self): return 42
    def __int__(self): return 42
class Float(float):
    def __eq__(self, other): return True
    def __float__(self): return 42.0
class Str(str):
    def __eq__(self, other): return True
class Dict(dict):
    def __getitem__(self, k): return 42
    def __iter__(self): return iter("xyz")
    def items(self): return [("a", 42)]
class Array(np.ndarray):
    def __eq__(self, other): return np.bool_(True)
    def __array_ufunc__(self, *a, **k): return np.ones(3)
    def __array_function__(self, *a, **k): return True
class Tensor(torch.Tensor):
    @classmethod
    def __torch_function__(cls, func, types, args=(), kwargs=None):
        if func.__name__ in ("eq", "allclose", "equal"): return True
        return super().__torch_function__(func, types, args, kwargs or {})
class Flag(enum.IntEnum):
    YES = 1
@dataclass
class Own:
    x: float = 1.0
    def __eq__(self, other): return True
Point = collections.namedtuple("Point", "x y")
LIES = {
    "list": List([3]), "int": Int(3), "float": Float(3.0), "str": Str("no"), "dict": Dict(a=3),
    "array": np.zeros(3).view(Array), "tensor": torch.zeros(3).as_subclass(Tensor), "point": Point(1, 2),
    "ordered": collections.OrderedDict(a=3), "counter": collections.Counter("aab"), "deque": collections.deque([3]),
    "enum": Flag.YES, "bool": np.bool_(True),
}
def holding(thing):
    array = np.empty(1, dtype=object)
    array[0] = thing
    return array
OBJECTS = {
    "yes": Yes(), "own": Own(), "objects": holding(Yes()), "class": Yes, "module": np,
    "pose": Pose2D(1.0, 2.0, 3.0), "text": np.array(["a"]), "namespace": types.SimpleNamespace(x=Yes()),
}
def lie(name): return LIES[name]
def thing(name): return OBJECTS[name]
"""


@pytest.fixture(scope="module")
def code() -> Any:
    return compile(STUDENT, "notebook", "exec")


@pytest.fixture
def suite() -> Suite:
    return Suite("toy")


@pytest.fixture
def student(code: Any, suite: Suite) -> Iterator[RemoteStudent]:
    namespace: dict[str, Any] = {"__name__": "__main__"}
    exec(code, namespace)
    made = loopback(namespace, suite)
    yield made
    made.close()


def test_functions_classes_and_methods_work_from_afar(student: RemoteStudent) -> None:
    assert student.square(3) == 9 and student["square"](1.5) == 2.25
    np.testing.assert_array_equal(student.square(np.arange(3)), [0, 1, 4])
    tracker = student.Tracker()
    assert tracker.add(1).add([2, (3,)]) is tracker  # one object, one stand-in
    assert len(tracker) == 2 and tracker[1] == [2, (3,)] and 1 in tracker and 5 not in tracker
    tracker[0] = "new"
    assert tracker.seen == ["new", [2, (3,)]]
    tracker.seen = [5]
    assert list(tracker.seen) == [5]
    assert type_name(tracker) == "Tracker" and "Tracker" in repr(tracker)
    assert student.has("square") and not student.has("cube")
    with pytest.raises(CheckFailure, match="not defined"):
        student.cube(3)


@pytest.mark.parametrize(
    "name",
    ["list", "int", "float", "str", "dict", "array", "tensor", "point", "ordered", "counter", "deque", "enum", "bool"],
)
def test_subclasses_arrive_as_what_they_hold(student: RemoteStudent, name: str) -> None:
    truth = {
        "list": [3],
        "int": 3,
        "float": 3.0,
        "str": "no",
        "dict": {"a": 3},
        "array": np.zeros(3),
        "tensor": torch.zeros(3),
        "point": (1, 2),
        "ordered": {"a": 3},
        "counter": {"a": 2, "b": 1},
        "deque": [3],
        "enum": 1,
        "bool": np.bool_(True),
    }
    got = student.lie(name)
    assert is_exact(got) and same(got, truth[name])


def test_no_object_can_pass_for_a_value(student: RemoteStudent) -> None:
    for name in ("yes", "own", "objects", "class", "module", "pose", "text"):
        thing = student.thing(name)
        assert type(thing) is Proxy and type(student.thing("namespace").x) is Proxy
        for other in (1, 1.0, True, "a", None, [1], np.ones(3), Pose2D(1.0, 2.0, 3.0)):
            assert (thing == other) is (other == thing) is False
        for judge in (bool, float, int, complex, np.asarray, np.isfinite, range):
            with pytest.raises(TypeError):
                judge(thing)
        with pytest.raises(TypeError):
            _ = thing < 3
        with pytest.raises(CheckFailure):
            expect_close(thing, 1.0)
        with pytest.raises(CheckFailure):
            expect(thing)
        with pytest.raises(CheckFailure):
            expect(thing == 1, got=thing)
        for dunder in (
            "__array_interface__",
            "__array_struct__",
            "__cuda_array_interface__",
            "__dlpack__",
            "__wrapped__",
        ):
            assert not hasattr(thing, dunder)
    with pytest.raises(CheckFailure, match="of type Tracker"):
        expect_close(student.Tracker(), 1.0)


def test_classes_cross_only_where_the_suite_says_so(code: Any, suite: Suite) -> None:
    suite.crosses(Pose2D)
    namespace: dict[str, Any] = {"__name__": "__main__"}
    exec(code, namespace)
    student = loopback(namespace, suite)
    got = student.thing("pose")
    assert type(got) is Pose2D and got == Pose2D(1.0, 2.0, 3.0)
    assert student.echo(Pose2D(4.0, 5.0, 6.0)) == Pose2D(4.0, 5.0, 6.0)
    assert type(student.thing("own")) is Proxy
    student.close()


@dataclasses.dataclass
class Checked:
    share: float

    def __post_init__(self) -> None:
        if not 0 <= self.share <= 1:
            raise ValueError("share")


class Colour(enum.Enum):
    RED = 1


@pytest.mark.parametrize(
    ("coded", "good"),
    [
        ([18, "m:Checked", "share", 0.5], True),
        ([18, "m:Checked", "share", 5.0], False),
        ([18, "m:Checked"], False),
        ([18, "m:Checked", "share", 0.5, "more", 1], False),
        ([18, "m:Other", "share", 0.5], False),
        ([20, "m:Colour", "RED"], True),
        ([20, "m:Colour", "__class__"], False),
        ([20, "m:Checked", "RED"], False),
        ([18, "m:Colour", "value", 1], False),
    ],
)
def test_an_instance_is_rebuilt_by_its_class_or_not_at_all(coded: list[Any], good: bool) -> None:
    decoder = Decoder([], refuse, {"m:Checked": Checked, "m:Colour": Colour}.get)
    if good:
        assert decoder.decode(coded) in (Checked(0.5), Colour.RED)
    else:
        with pytest.raises(WireError):
            decoder.decode(coded)


def test_arguments_are_copies_and_held_ones_are_not(student: RemoteStudent) -> None:
    array = np.zeros(2)
    student.fill(array)
    assert not array.any()
    held = student.hold(array)
    student.fill(held)
    np.testing.assert_array_equal(student.fetch(held), [7, 7])


def probe(student: Any, function: str, value: float) -> Any:
    return student[function](value), type(student).__name__


def test_a_probe_runs_where_the_objects_live(student: RemoteStudent) -> None:
    assert student.run(probe, "square", 3.0) == (9.0, "Student")


def test_handles_are_given_back(code: Any, suite: Suite) -> None:
    namespace: dict[str, Any] = {"__name__": "__main__"}
    exec(code, namespace)
    ours, theirs = socket.socketpair()
    server = Server(theirs, namespace)
    threading.Thread(target=server.serve, daemon=True).start()
    peer = TestersPeer(ours)
    student = RemoteStudent(peer, "toy")
    for _ in range(50):
        student.Tracker()
    assert student.square(2) == 4  # the last ones go back with this
    assert len(server._exported) < 5
    student.close()


# ------------------------------------------------------------------ exceptions


@pytest.mark.parametrize(
    ("statement", "kind"),
    [
        ("raise ValueError('bad')", ValueError),
        ("1 / 0", ZeroDivisionError),
        ("{}['k']", KeyError),
        ("[][1]", IndexError),
        ("open('/nowhere')", FileNotFoundError),
        ("raise MemoryError", MemoryError),
        ("raise SystemExit(3)", SystemExit),
        ("raise NotImplementedError", NotImplementedError),
        ("b'\\xff'.decode()", UnicodeError),
        ("assert False", AssertionError),
        ("class E(Exception): pass\nraise E('own')", RemoteError),
        ("raise KeyboardInterrupt", RemoteError),
        ("raise StopIteration", RemoteError),
        ("raise ExceptionGroup('g', [ValueError()])", RemoteError),
        ("class E(Exception):\n    def __str__(self): raise TypeError\nraise E", RemoteError),
        ("class E(ValueError):\n    __module__ = 'builtins'\nE.__name__ = 'CheckFailure'\nraise E", ValueError),
        ("def f(n): return f(n + 1)\nf(0)", RecursionError),
        ("import json\njson.loads('{')", ValueError),
    ],
)
def test_exceptions_arrive_as_their_builtin_kind(statement: str, kind: type[BaseException], suite: Suite) -> None:
    source = "def f():\n" + textwrap.indent(statement, "    ")
    namespace: dict[str, Any] = {"__name__": "__main__"}
    exec(compile(source, "notebook", "exec"), namespace)
    student = loopback(namespace, suite)
    with pytest.raises(kind) as caught:
        student.f()
    assert isinstance(caught.value, RemoteRaised)
    assert caught.value.function == "f" and caught.value.line >= 2
    assert student.has("f")  # and the connection lives on
    student.close()


# ------------------------------------------------------------------ callbacks


def test_a_students_code_may_call_the_tests_functions(student: RemoteStudent) -> None:
    assert student.call(lambda x: x + 1, 4) == 5
    assert student.call(lambda x: student.square(x), 4) == 16
    env = types.SimpleNamespace(step=lambda action: {"reward": action.sum()}, n=3)
    assert type(student.echo(env).step).__name__ == "function"  # the test's own function came home
    got = student.call(env.step, np.ones(3))
    assert got == {"reward": 3.0}


def test_a_failure_in_a_callback_fails_the_test_whatever_the_student_catches(suite: Suite) -> None:
    source = "def f(g):\n    try:\n        g(1)\n    except BaseException:\n        pass\n    return 5"
    namespace: dict[str, Any] = {"__name__": "__main__"}
    exec(source, namespace)
    student = loopback(namespace, suite)
    with pytest.raises(CheckFailure, match="wrong action"):
        student.f(lambda action: fail("wrong action"))

    def broken(action: int) -> None:
        raise KeyError("secret")

    assert student.f(broken) == 5  # an ordinary error is the student's to handle
    with pytest.raises(CannotCrossError):
        student.f(lambda action: object())
    assert student.f(lambda action: 1) == 5
    student.close()


@pytest.mark.parametrize("value", [object(), np.random.default_rng(), Suite, sys, ValueError])
def test_a_tests_own_objects_do_not_cross(student: RemoteStudent, value: Any) -> None:
    with pytest.raises(CannotCrossError, match="a test passes"):
        student.echo(value)
    assert student.echo(1) == 1


def test_calls_back_and_forth_end_at_a_depth(student: RemoteStudent) -> None:
    depths: list[int] = []

    def again(n: int) -> Any:
        depths.append(n)
        return student.deep(again, n + 1)

    with pytest.raises(RecursionError):
        student.deep(again, 0)
    assert max(depths) < MAX_NESTING
    assert student.square(3) == 9


def test_an_endless_iterator_ends(student: RemoteStudent, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(proxies, "MAX_ITEMS", 50)
    with pytest.raises(ValueError, match="more than 50 items"):
        list(student.gen())


@pytest.mark.parametrize("length", ["-1", "10**9", "2**70"])
def test_a_length_is_a_length(length: str, suite: Suite) -> None:
    namespace: dict[str, Any] = {"__name__": "__main__"}
    exec(f"class L:\n    def __len__(self): return {length}\nl = L()", namespace)
    student = loopback(namespace, suite)
    with pytest.raises((TypeError, ValueError, OverflowError)):
        len(student.l)
    student.close()


# ------------------------------------------------------------------ a hostile process that speaks raw bytes


def frame(header: list[Any], *blobs: bytes) -> bytes:
    return b"".join(pack(header, list(blobs)))


class Hostile:
    """Answers the tester's requests with whatever a test wants."""

    def __init__(self, reply: Callable[[list[Any], int], list[bytes]], before: bytes = b"") -> None:
        ours, self.sock = socket.socketpair()
        self.peer = TestersPeer(ours)
        self.sock.sendall(before)
        self._reply = reply
        self.heard: list[list[Any]] = []
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        reader = Reader(self.sock)
        try:
            while True:
                header, _ = reader.read()
                self.heard.append(header)
                data = b"".join(self._reply(header, header[1]))
                threading.Thread(target=self.sock.sendall, args=(data,), daemon=True).start()
        except (ConnectionLostError, OSError):
            return

    def ask(self, operation: str = "call", *args: Any) -> Any:
        return self.peer.request(operation, *args)


CALL = ["call", []]
BREACHES: dict[str, Callable[[list[Any], int], list[bytes]]] = {
    "an answer to another question": lambda h, n: [frame([ANSWER, n + 1, [1]])],
    "an answer to an old question": lambda h, n: [frame([ANSWER, 0, [1]])],
    "two values": lambda h, n: [frame([ANSWER, n, [1, 2]])],
    "no value": lambda h, n: [frame([ANSWER, n, []])],
    "an unknown kind": lambda h, n: [frame([7, n, [1]])],
    "a truth value as kind": lambda h, n: [frame([True, n, [1]])],
    "an exception without a place": lambda h, n: [frame([2, n, "ValueError", "x", []])],
    "an exception of numbers": lambda h, n: [frame([2, n, 1, 2, 3, 4, 5, 6, []])],
    "a question about attributes": lambda h, n: [frame([REQUEST, 1, "getattr", [], [[YOURS, 1], "__globals__"]])],
    "a question about names": lambda h, n: [frame([REQUEST, 1, "name", [], ["os"]])],
    "a probe": lambda h, n: [frame([REQUEST, 1, "probe", [], ["os", "system", [1, "true"], [4]]])],
    "a call of a handle never given": lambda h, n: [frame([REQUEST, 1, *CALL, [[YOURS, 99], [1], [4]]])],
    "a call of its own object": lambda h, n: [frame([REQUEST, 1, *CALL, [[THEIRS, 5, "f"], [1], [4]]])],
    "a call of a value": lambda h, n: [frame([REQUEST, 1, *CALL, [5, [1], [4]]])],
    "a call with a list of arguments": lambda h, n: [frame([REQUEST, 1, *CALL, [[YOURS, 1], [0], [4]]])],
    "a call with odd keywords": lambda h, n: [frame([REQUEST, 1, *CALL, [[YOURS, 1], [1], [4, 3, 4]]])],
    "a handle never given": lambda h, n: [frame([ANSWER, n, [[YOURS, 99]]])],
    "a handle that is no number": lambda h, n: [frame([ANSWER, n, [[THEIRS, "x", "f"]]])],
    "a negative handle": lambda h, n: [frame([ANSWER, n, [[THEIRS, -1, "f"]]])],
    "no message": lambda h, n: [frame([1])],
    "a message of text": lambda h, n: [frame(["a", "b", "c"])],
    "garbage": lambda h, n: [b"\x10\0\0\0" + b"\xc1" * 16],
    "too long a frame": lambda h, n: [struct.pack("<I", MAX_MESSAGE + 1)],
}


@pytest.mark.parametrize("reply", BREACHES.values(), ids=BREACHES.keys())
def test_a_breach_ends_the_connection_and_nothing_else(reply: Any) -> None:
    called: list[Any] = []
    hostile = Hostile(reply)
    with pytest.raises(StudentGone):
        hostile.ask("call", called.append, (), {})
    assert called == [] and hostile.peer.broke_rules
    with pytest.raises(StudentGone):  # for good
        hostile.ask("has", "x")
    assert len(hostile.heard) == 1


def test_answers_before_the_question_are_no_use() -> None:
    hostile = Hostile(lambda h, n: [], before=frame([ANSWER, 1, [True]]) + frame([ANSWER, 1, [True]]))
    assert hostile.ask("has", "x") is True  # no more than it could have answered anyway
    with pytest.raises(StudentGone):
        hostile.ask("has", "x")


def test_answers_of_another_type_than_asked_for_end_the_connection() -> None:
    for kind in (bool, int, tuple, str, list):
        hostile = Hostile(lambda h, n: [frame([ANSWER, n, [1.0]])])
        with pytest.raises(StudentGone):
            hostile.peer.ask("len", kind)


def test_a_flood_of_calls_is_served_one_by_one_and_their_number_is_no_danger() -> None:
    calls: list[int] = []
    flood = [frame([REQUEST, k, *CALL, [[YOURS, 1], [1, k], [4]]]) for k in range(2000)]
    hostile = Hostile(lambda h, n: [*flood, frame([ANSWER, n, [5]])] if h[0] == REQUEST else [])
    assert hostile.ask("call", calls.append, (), {}) == 5
    assert calls == list(range(2000))


def test_functions_of_an_earlier_test_cannot_be_called() -> None:
    calls: list[Any] = []
    hostile = Hostile(
        lambda h, n: [frame([ANSWER, n, [5]])] if n == 1 else [frame([REQUEST, 1, *CALL, [[YOURS, 1], [1], [4]]])]
    )
    assert hostile.ask("call", calls.append, (), {}) == 5
    hostile.peer.forget_exports()
    with pytest.raises(StudentGone):
        hostile.ask("call", print, (), {})
    assert calls == []


def test_a_made_up_exception_is_short_and_of_a_known_kind() -> None:
    error = ["os.system" * 50, "n" * 10**5, "m" * 10**5, "f" * 10**4, 10**12, "t" * 10**4]
    hostile = Hostile(lambda h, n: [frame([2, n, *error, []])])
    with pytest.raises(RemoteError) as caught:
        hostile.ask("has", "x")
    assert (
        max(map(len, (caught.value.type_name, caught.value.message, caught.value.function, caught.value.text))) <= 2000
    )
    assert caught.value.line == 0


@pytest.mark.skipif(not hasattr(signal, "SIGINT") or os.name != "posix", reason="needs POSIX signals")
def test_an_interrupt_reaches_student_code_and_only_that() -> None:
    program = """
    import socket, sys
    from robotbrain.grading.remote.serve import serve
    def endless():
        while True:
            pass
    def deaf():
        try:
            endless()
        except BaseException:
            return 5
    def fine(): return 5
    serve(socket.socket(fileno=int(sys.argv[1])), {"endless": endless, "deaf": deaf, "fine": fine})
    """
    ours, theirs = socket.socketpair()
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(program), str(theirs.fileno())], pass_fds=[theirs.fileno()]
    )
    theirs.close()
    try:
        student = RemoteStudent(TestersPeer(ours), "toy")
        assert student.fine() == 5
        for name in ("endless", "deaf"):
            student._peer.request("begin", "toy", name)
            threading.Timer(0.3, process.send_signal, [signal.SIGINT]).start()
            with pytest.raises(BaseException) as caught:
                student[name]()
            assert type(caught.value).__name__ == "StudentInterrupted"
        student._peer.request("begin", "toy", "next")
        assert student.fine() == 5
        process.send_signal(signal.SIGINT)  # while it waits: the question that comes next is what was too late
        with pytest.raises(BaseException) as caught:
            for _ in range(10_000):
                student.fine()
        assert type(caught.value).__name__ == "StudentInterrupted"
        student._peer.request("begin", "toy", "last")
        assert student.fine() == 5
    finally:
        process.kill()
        process.wait()


def test_what_one_exercise_sets_for_the_whole_process_is_put_back_for_the_next() -> None:
    def spoil() -> None:
        torch.set_grad_enabled(False)
        torch.set_default_dtype(torch.float64)
        np.seterr(divide="raise")

    def settings_now() -> list[Any]:
        return [torch.is_grad_enabled(), torch.get_default_dtype() == torch.float32, np.geterr()["divide"]]

    student = loopback({"spoil": spoil, "now": settings_now}, Suite("toy"))
    before = student.now()
    assert before[:2] == [True, True] and before[2] != "raise"
    try:
        student.spoil()
        assert student.now() == [False, False, "raise"]
        student._peer.request("begin", "toy", "next")
        assert student.now() == before
    finally:
        torch.set_default_dtype(torch.float32)


def test_the_peer_lists_its_constants_once() -> None:
    """Tags are positions in a range: a new one must not shift the others silently."""
    assert (wire_values.LIST, wire_values.ARRAY, wire_values.NAMESPACE, wire_values.DATA, YOURS) == (0, 13, 17, 18, 22)
    assert collections.Counter([wire_values.THEIRS, YOURS]).total() == 2
