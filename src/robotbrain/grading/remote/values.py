"""Python values to and from what a frame holds.

Encoding is liberal: a subclass of ``list`` goes as a list. Decoding is strict: only exact built-in types, numpy arrays
and scalars, tensors and expressly allowed classes come out, so that nothing that arrives can lie about being equal,
about its length or about what it is. What has no value here goes *by handle*: the other side gets a stand-in for it.
"""

from __future__ import annotations

import array
import collections
import dataclasses
import enum
import importlib
import math
import pathlib
import sys
import types
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from robotbrain.grading.expect import CannotCrossError
from robotbrain.grading.remote.wire import MAX_MESSAGE, WireError

MAX_DEPTH = 40
MAX_INT_BYTES = 1_661  # 4,000 decimal digits, what Python itself converts without being asked
MAX_TEXT = 16 << 20
MAX_ELEMENTS = 4_000_000
MAX_COLLISIONS = 64  # different keys with one hash; honest ones hardly ever have two
_INLINE = 256  # bytes; what is longer travels as a blob
_PACKED_FROM = 16  # elements; longer sequences of floats or of integers travel as one blob
_SIZED = ("int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "float16", "float32", "float64")
_DTYPES = frozenset({"bool", *_SIZED, "complex64", "complex128"})
_TENSOR_DTYPES = _DTYPES | {"bfloat16"}
_OWN_PACKAGE = "robotbrain."

(LIST, TUPLE, SET, FROZENSET, DICT, BIG, COMPLEX, RANGE, SLICE, TEXT, BYTES, FLOATS, INTS, ARRAY, SCALAR, TENSOR, PATH,
 NAMESPACE, DATA, RECORD, ENUM, THEIRS, YOURS) = range(23)  # fmt: skip

Exporter = Callable[[object], "list[Any]"]
"""Turns an object that has no value on the wire into ``[THEIRS, handle, type name]`` or ``[YOURS, handle]``."""


def class_name(cls: type) -> str:
    """How a class is named on the wire."""
    return f"{cls.__module__}:{cls.__qualname__}"


class Encoder:
    """Encodes the values of one message.

    Args:
        export: what to do with objects that have no value here.
        by_value: whether instances of a dataclass or enum of this class go by value.
    """

    def __init__(self, export: Exporter, by_value: Callable[[type], bool]) -> None:
        self._export, self._by_value = export, by_value
        self.blobs: list[bytes] = []
        self._elements = 0

    def encode(self, value: Any, depth: int = 0) -> Any:
        """Return what stands for ``value`` in the header; big parts are added to :attr:`blobs`."""
        kind = type(value)
        if value is None or kind is bool or kind is float:
            return value
        if kind is int and -(2**63) <= value < 2**63:
            return value
        if kind is str and len(value) <= _INLINE:
            return value
        if depth > MAX_DEPTH:
            raise CannotCrossError(f"it is nested more than {MAX_DEPTH} levels deep")
        self._count(1)
        return (
            self._scalar(value) or self._container(value, depth) or self._numeric(value) or self._object(value, depth)
        )

    def _scalar(self, value: Any) -> Any:
        if issubclass(type(value), (str, bytes, bytearray)) and not issubclass(type(value), enum.Enum):
            return self._text(value)
        if issubclass(type(value), bool):
            return None
        if issubclass(type(value), int) and not issubclass(type(value), enum.Enum):
            number = int.__int__(value)
            if -(2**63) <= number < 2**63:
                return [INTS, number]
            size = number.bit_length() // 8 + 1
            if size > MAX_INT_BYTES:
                raise CannotCrossError("an integer of more than 4000 digits")
            return [BIG, number.to_bytes(size, "big", signed=True)]
        if issubclass(type(value), float) and not issubclass(type(value), enum.Enum) and not _is_numpy(value):
            return [FLOATS, float.__float__(value)]
        if issubclass(type(value), complex) and not _is_numpy(value):
            number_ = complex.__complex__(value)
            return [COMPLEX, number_.real, number_.imag]
        return None

    def _text(self, value: Any) -> list[Any]:
        if issubclass(type(value), str):
            tag, raw = TEXT, str.encode(value, "utf-8", "surrogatepass")
        else:
            tag, raw = BYTES, bytes(value)
        if len(raw) > MAX_TEXT:
            raise CannotCrossError(f"a text of more than {MAX_TEXT >> 20} MB")
        return [tag, self._raw(raw)]

    def _raw(self, raw: bytes) -> Any:
        """Bytes in the header, or the number of the blob that has them."""
        if len(raw) <= _INLINE:
            return raw
        self.blobs.append(raw)
        return len(self.blobs) - 1

    def _container(self, value: Any, depth: int) -> list[Any] | None:
        if issubclass(type(value), tuple):
            if type(value) is not tuple and hasattr(value, "_fields") and self._by_value(type(value)):
                return [RECORD, class_name(type(value)), *self._all(tuple.__iter__(value), depth)]
            return self._sequence(TUPLE, value, tuple.__iter__(value), depth)
        if issubclass(type(value), list):
            return self._sequence(LIST, value, list.__iter__(value), depth)
        if issubclass(type(value), collections.deque):
            return [LIST, *self._all(collections.deque.__iter__(value), depth)]
        if issubclass(type(value), dict):
            pairs = (part for key in dict.__iter__(value) for part in (key, dict.__getitem__(value, key)))
            return [DICT, *self._all(pairs, depth)]
        if issubclass(type(value), set):
            return [SET, *self._all(set.__iter__(value), depth)]
        if issubclass(type(value), frozenset):
            return [FROZENSET, *self._all(frozenset.__iter__(value), depth)]
        if issubclass(type(value), range):
            if len(value) > MAX_ELEMENTS:
                raise CannotCrossError(f"a range of more than {MAX_ELEMENTS} numbers")
            return [RANGE, *self._all((value.start, value.stop, value.step), depth)]
        if issubclass(type(value), slice):
            return [SLICE, *self._all((value.start, value.stop, value.step), depth)]
        if issubclass(type(value), pathlib.PurePath):
            return [PATH, self._raw(str(value).encode("utf-8", "surrogatepass"))]
        return None

    def _sequence(self, tag: int, value: Any, items: Iterable[Any], depth: int) -> list[Any]:
        if type(value) in (list, tuple) and len(value) >= _PACKED_FROM:
            kinds = set(map(type, value))
            for kind, code, packed in ((float, "d", FLOATS), (int, "q", INTS)):
                if kinds == {kind}:
                    self._count(len(value))
                    try:
                        return [packed, self._raw_blob(array.array(code, value).tobytes()), tag]
                    except OverflowError:  # integers of more than 64 bits
                        break
        return [tag, *self._all(items, depth)]

    def _raw_blob(self, raw: bytes) -> int:
        self.blobs.append(raw)
        return len(self.blobs) - 1

    def _all(self, items: Iterable[Any], depth: int) -> list[Any]:
        encoded = []
        for item in items:
            self._count(1)
            encoded.append(self.encode(item, depth + 1))
        return encoded

    def _count(self, more: int) -> None:
        self._elements += more
        if self._elements > MAX_ELEMENTS:
            raise CannotCrossError(f"it has more than {MAX_ELEMENTS} elements")

    def _numeric(self, value: Any) -> list[Any] | None:
        numpy = sys.modules.get("numpy")
        if numpy is not None and issubclass(type(value), (numpy.ndarray, numpy.generic)):
            plain = numpy.asarray(value)
            if plain.dtype.name in ("float128", "float96", "longdouble"):
                plain = plain.astype(numpy.float64)
            if plain.dtype.name not in _DTYPES:
                return None
            plain = plain.astype(plain.dtype.newbyteorder("<"), copy=False)
            self._fits(plain.nbytes)
            raw = self._raw(plain.tobytes())
            if issubclass(type(value), numpy.generic):
                return [SCALAR, plain.dtype.name, raw]
            return [ARRAY, plain.dtype.name, list(plain.shape), raw]
        torch = sys.modules.get("torch")
        if torch is not None and issubclass(type(value), torch.Tensor):
            name = str(value.dtype).removeprefix("torch.")
            if name not in _TENSOR_DTYPES or value.layout is not torch.strided:
                return None
            self._fits(value.numel() * value.element_size())
            plain = torch.Tensor.detach(value).cpu().contiguous()
            plain = plain.view(torch.int16) if name == "bfloat16" else plain
            return [TENSOR, name, list(value.shape), self._raw(plain.resolve_conj().resolve_neg().numpy().tobytes())]
        return None

    def _fits(self, size: int) -> None:
        if size > MAX_MESSAGE:
            raise CannotCrossError(f"an array of more than {MAX_MESSAGE >> 20} MB")

    def _object(self, value: Any, depth: int) -> list[Any]:
        cls = type(value)
        if cls is types.SimpleNamespace:
            pairs = (part for pair in vars(value).items() for part in pair)
            return [NAMESPACE, *self._all(pairs, depth)]
        if issubclass(type(value), enum.Enum) and self._by_value(cls):
            return [ENUM, class_name(cls), value.name]
        if dataclasses.is_dataclass(cls) and self._by_value(cls):
            pairs = (part for f in dataclasses.fields(cls) for part in (f.name, getattr(value, f.name)))
            return [DATA, class_name(cls), *self._all(pairs, depth)]
        if issubclass(type(value), enum.Enum) and issubclass(type(value), (str, int, float)):
            return self.encode(value.value, depth + 1)  # type: ignore[no-any-return]
        return self._export(value)


def _is_numpy(value: Any) -> bool:
    numpy = sys.modules.get("numpy")
    return numpy is not None and issubclass(type(value), numpy.generic)


class Decoder:
    """Decodes the values of one message; raises :class:`WireError` for whatever is not exactly as it should be.

    Args:
        blobs: those of the frame.
        handle: what stands for ``(tag, arguments)`` of :data:`THEIRS` and :data:`YOURS`.
        find_class: the class of a name, or None where it is not allowed.
    """

    def __init__(
        self,
        blobs: Sequence[memoryview],
        handle: Callable[[int, list[Any]], Any],
        find_class: Callable[[str], type | None],
    ) -> None:
        self._blobs, self._handle, self._find_class = blobs, handle, find_class
        self._elements = 0
        self._taken = 0

    def decode(self, coded: Any) -> Any:
        """The value of a header's part."""
        try:
            return self._decode(coded, 0)
        except WireError:
            raise
        except Exception as error:
            raise WireError(f"a value that cannot be read ({type(error).__name__})") from None

    def _decode(self, coded: Any, depth: int) -> Any:
        kind = type(coded)
        if coded is None or kind is bool or kind is int or kind is float or kind is str:
            return coded
        if kind is not list or not coded or type(coded[0]) is not int:
            raise WireError("a value without a tag")
        if depth > MAX_DEPTH + 2:
            raise WireError("a value nested too deep")
        tag, parts = coded[0], coded[1:]
        self._elements += len(parts)
        if self._elements > MAX_ELEMENTS + 1000:
            raise WireError("a value with too many elements")
        if tag in (THEIRS, YOURS):
            return self._handle(tag, parts)
        read = _READERS.get(tag)
        if read is None:
            raise WireError("a value with an unknown tag")
        return read(self, parts, depth)

    def _all(self, parts: list[Any], depth: int) -> list[Any]:
        return [self._decode(part, depth + 1) for part in parts]

    def _list(self, parts: list[Any], depth: int) -> list[Any]:
        return self._all(parts, depth)

    def _tuple(self, parts: list[Any], depth: int) -> tuple[Any, ...]:
        return tuple(self._all(parts, depth))

    def _set(self, parts: list[Any], depth: int) -> set[Any]:
        return set(self._keys(parts, depth))

    def _frozenset(self, parts: list[Any], depth: int) -> frozenset[Any]:
        return frozenset(self._keys(parts, depth))

    def _dict(self, parts: list[Any], depth: int) -> dict[Any, Any]:
        return dict(zip(self._keys(parts[::2], depth), self._all(parts[1::2], depth), strict=True))

    def _keys(self, parts: list[Any], depth: int) -> list[Any]:
        keys = self._all(parts, depth)
        hashes = collections.Counter(map(hash, keys))
        if any(number > MAX_COLLISIONS for number in hashes.values()):
            raise WireError("keys that were made to collide")  # a table of them takes hours
        return keys

    def _big(self, parts: list[Any], depth: int) -> int:
        (raw,) = parts
        if type(raw) is not bytes or len(raw) > MAX_INT_BYTES:
            raise WireError("an integer that is too long")
        return int.from_bytes(raw, "big", signed=True)

    def _complex(self, parts: list[Any], depth: int) -> complex:
        real, imag = parts
        if type(real) is not float or type(imag) is not float:
            raise WireError("a complex number of something else than floats")
        return complex(real, imag)

    def _range(self, parts: list[Any], depth: int) -> range:
        start, stop, step = (_exact(part, int) for part in self._all(parts, depth))
        if abs(stop - start) > MAX_ELEMENTS * abs(step):
            raise WireError("a range that never ends")
        return range(start, stop, step)

    def _slice(self, parts: list[Any], depth: int) -> slice:
        start, stop, step = self._all(parts, depth)
        return slice(start, stop, step)

    def _text(self, parts: list[Any], depth: int) -> str:
        (raw,) = parts
        return str(self._raw(raw, MAX_TEXT), "utf-8", "surrogatepass")

    def _bytes(self, parts: list[Any], depth: int) -> bytes:
        (raw,) = parts
        return bytes(self._raw(raw, MAX_TEXT))

    def _path(self, parts: list[Any], depth: int) -> pathlib.Path:
        (raw,) = parts
        return pathlib.Path(str(self._raw(raw, 10_000), "utf-8", "surrogatepass"))

    def _floats(self, parts: list[Any], depth: int) -> Any:
        return self._packed(parts, "d", float)

    def _ints(self, parts: list[Any], depth: int) -> Any:
        return self._packed(parts, "q", int)

    def _packed(self, parts: list[Any], code: str, kind: type) -> Any:
        if len(parts) == 1:
            return _exact(parts[0], kind)
        blob, tag = parts
        numbers = array.array(code)
        raw = self._raw(blob, MAX_ELEMENTS * numbers.itemsize)
        self._elements += len(raw) // numbers.itemsize
        numbers.frombytes(raw)
        if tag not in (LIST, TUPLE):
            raise WireError("numbers that are neither list nor tuple")
        return numbers.tolist() if tag == LIST else tuple(numbers)

    def _raw(self, place: Any, longest: int) -> bytes | memoryview:
        raw = place if type(place) is bytes else self._blobs[_natural(place)]
        self._taken += len(raw)  # one blob may be named many times
        if len(raw) > longest or self._taken > MAX_MESSAGE:
            raise WireError("more bytes than a value may have")
        return raw

    def _array(self, parts: list[Any], depth: int) -> Any:
        name, shape, raw = parts
        return self._numbers(name, shape, raw)

    def _scalar(self, parts: list[Any], depth: int) -> Any:
        name, raw = parts
        return self._numbers(name, [], raw)[()]

    def _numbers(self, name: Any, shape: Any, place: Any) -> Any:
        import numpy

        if type(name) is not str or name not in _DTYPES or type(shape) is not list or len(shape) > 32:
            raise WireError("an array of an unknown kind")
        sizes = tuple(_natural(size) for size in shape)
        dtype = numpy.dtype(name).newbyteorder("<")
        raw = self._raw(place, MAX_MESSAGE)
        if math.prod(sizes) * dtype.itemsize != len(raw) or max(sizes, default=0) > 2**31:
            raise WireError("an array whose shape does not fit its bytes")
        if name == "bool":  # a byte of 2 would be a truth value that counts twice
            return (numpy.frombuffer(raw, dtype=numpy.uint8) != 0).reshape(sizes)
        return numpy.frombuffer(raw, dtype=dtype).reshape(sizes).astype(numpy.dtype(name), copy=True)

    def _tensor(self, parts: list[Any], depth: int) -> Any:
        import torch

        name, shape, raw = parts
        if name == "bfloat16":
            return torch.from_numpy(self._numbers("int16", shape, raw)).view(torch.bfloat16)
        return torch.from_numpy(self._numbers(name, shape, raw))

    def _pairs(self, parts: list[Any], depth: int) -> dict[str, Any]:
        names = parts[::2]
        if not all(type(name) is str and name.isidentifier() and not name.startswith("__") for name in names):
            raise WireError("an attribute that is no plain name")  # numpy and others ask instances for dunder names
        return dict(zip(names, self._all(parts[1::2], depth), strict=True))

    def _namespace(self, parts: list[Any], depth: int) -> types.SimpleNamespace:
        return types.SimpleNamespace(**self._pairs(parts, depth))

    def _data(self, parts: list[Any], depth: int) -> Any:
        cls = self._class(parts[0])
        values = self._pairs(parts[1:], depth)
        fields = {field.name: field for field in dataclasses.fields(cls)}
        if values.keys() != fields.keys():
            raise WireError(f"a {cls.__name__} with other fields")
        made = cls(**{name: value for name, value in values.items() if fields[name].init})
        for name, field in fields.items():
            if not field.init:
                object.__setattr__(made, name, values[name])
        return made

    def _record(self, parts: list[Any], depth: int) -> Any:
        return self._class(parts[0])(*self._all(parts[1:], depth))

    def _enum(self, parts: list[Any], depth: int) -> Any:
        cls = self._class(parts[0])
        if not issubclass(cls, enum.Enum):
            raise WireError("a member of what is no enum")
        return cls[_exact(parts[1], str)]

    def _class(self, name: Any) -> Any:
        cls = self._find_class(_exact(name, str))
        if cls is None:
            raise WireError("an instance of a class that does not cross")
        return cls


def _exact(value: Any, kind: type) -> Any:
    if type(value) is not kind:
        raise WireError(f"something else than {kind.__name__}")
    return value


def _natural(value: Any) -> int:
    if type(value) is not int or value < 0:
        raise WireError("something else than a natural number")
    return value


_READERS: dict[int, Callable[[Decoder, list[Any], int], Any]] = {
    LIST: Decoder._list, TUPLE: Decoder._tuple, SET: Decoder._set, FROZENSET: Decoder._frozenset, DICT: Decoder._dict,
    BIG: Decoder._big, COMPLEX: Decoder._complex, RANGE: Decoder._range, SLICE: Decoder._slice, TEXT: Decoder._text,
    BYTES: Decoder._bytes, FLOATS: Decoder._floats, INTS: Decoder._ints, ARRAY: Decoder._array,
    SCALAR: Decoder._scalar, TENSOR: Decoder._tensor, PATH: Decoder._path, NAMESPACE: Decoder._namespace,
    DATA: Decoder._data, RECORD: Decoder._record, ENUM: Decoder._enum,
}  # fmt: skip


def is_own_class(cls: type) -> bool:
    """Whether a class belongs to this package, so that the student's side has it too."""
    return cls.__module__.startswith(_OWN_PACKAGE) and "<locals>" not in cls.__qualname__


def find_own_class(name: str) -> type | None:
    """The class of this package that is named on the wire, for the student's side."""
    module, _, path = name.partition(":")
    if not module.startswith(_OWN_PACKAGE):
        return None
    found: Any = importlib.import_module(module)
    for part in path.split("."):
        found = getattr(found, part)
    return found if isinstance(found, type) else None
