"""CDR (XCDR1, little endian) encoders and decoders, generated once per message type.

Every primitive is aligned to its own size relative to the end of the 4-byte encapsulation header (OMG
"Common Data Representation", https://www.omg.org/spec/DDSI-RTPS, clause 10). A run of consecutive
fixed-size fields becomes one ``struct`` call; since padding inside a run depends only on the position
modulo 8, a run that follows a variable-length field has eight precompiled variants. Nested messages are
inlined and large primitive arrays are copied as buffers.
"""

from __future__ import annotations

import functools
import struct
import sys
from array import array
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from robotbrain.errors import InputError
from robotbrain.ros.typedefs import PLACEHOLDER, FieldType, Primitive, struct_def

HEADER = b"\x00\x01\x00\x00"
_PAD = tuple(bytes(n) for n in range(8))

# Freeing one large block makes glibc keep freed blocks of up to that size for reuse, instead of giving each back to the
# kernel and faulting in another: images are serialized three times as fast (mallopt(3), M_MMAP_THRESHOLD).
bytes(24 << 20)

Encoder = Callable[[list[Any], int, Any], int]
Decoder = Callable[[Any, int], tuple[Any, int]]


class CdrError(InputError, RuntimeError):
    """Bytes that are not the CDR of a message of the type asked for (genuine rclpy raises a RuntimeError)."""


class Run:
    """A run of fixed-size members: eight ``struct`` variants, one per starting position modulo 8.

    Attributes:
        variants: packers that begin with the padding the phase needs.
        sizes: bytes that each takes, padding included.
    """

    __slots__ = ("sizes", "variants")

    def __init__(self, members: list[tuple[int, str, int]]) -> None:
        """``members`` are ``(alignment, struct code, size in bytes)`` in wire order."""
        self.variants: list[struct.Struct] = []
        for phase in range(8):
            position, codes = phase, []
            for alignment, code, size in members:
                gap = -position % alignment
                codes.append("x" * gap + code)
                position += gap + size
            self.variants.append(struct.Struct("<" + "".join(codes)))
        self.sizes = [variant.size for variant in self.variants]


@dataclass
class _Builder:
    """Source lines and constants of one generated function."""

    lines: list[str] = field(default_factory=list)
    names: dict[str, Any] = field(default_factory=dict)
    members: list[tuple[int, str, int]] = field(default_factory=list)
    values: list[str] = field(default_factory=list)
    after: list[str] = field(default_factory=list)
    counter: int = 0

    def fresh(self, prefix: str) -> str:
        self.counter += 1
        return f"{prefix}{self.counter}"

    def constant(self, prefix: str, value: Any) -> str:
        name = self.fresh(prefix)
        self.names[name] = value
        return name

    def add(self, text: str) -> None:
        self.lines.append("    " + text)

    def compile(self, signature: str, typename: str) -> Any:
        source = "\n".join([f"def {signature}:", *self.lines])
        exec(compile(source, f"<cdr {typename}>", "exec"), self.names)
        return self.names[signature.partition("(")[0]]


def _fixed_member(kind: FieldType) -> tuple[int, str, int] | None:
    """Return ``(alignment, struct code, size)`` when a field can join a run, else None."""
    primitive = kind.primitive
    if primitive is None or kind.shape == "sequence":
        return None
    if kind.shape == "single":
        return primitive.size, primitive.code, primitive.size
    size = primitive.size * kind.length
    return primitive.size, f"{size}s", size


# ---------------------------------------------------------------- encoding


@functools.cache
def encoder(typename: str) -> Encoder:
    """Return ``encode(parts, position, message) -> position`` that appends buffers to ``parts``."""
    build = _Builder()
    _encode_struct(build, typename, "m")
    _flush_encode(build)
    build.add("return pos")
    return build.compile("encode(parts, pos, m)", typename)  # type: ignore[no-any-return]


def _flush_encode(build: _Builder) -> None:
    if not build.members:
        return
    run = Run(build.members)
    variants, sizes = build.constant("V", run.variants), build.constant("Z", run.sizes)
    build.add("phase = pos & 7")
    build.add(f"parts.append({variants}[phase].pack({', '.join(build.values)}))")
    build.add(f"pos += {sizes}[phase]")
    build.members, build.values = [], []


def _encode_struct(build: _Builder, typename: str, expression: str) -> None:
    for name, kind in struct_def(typename).fields:
        if name == PLACEHOLDER:
            build.members.append((1, "B", 1))
            build.values.append("0")
            continue
        value = f"{expression}._{name}"
        member = _fixed_member(kind)
        if member is not None:
            build.members.append(member)
            build.values.append(_fixed_value(kind, value))
        elif kind.kind == "message" and kind.shape == "single":
            local = build.fresh("n")
            build.add(f"{local} = {value}")
            _encode_struct(build, kind.message, local)
        elif kind.kind == "string" and kind.shape == "single":
            # The length joins the run before it, so that a header's stamp and string length are one call.
            text = build.fresh("s")
            build.add(f"{text} = {value}.encode()")
            build.members.append((4, "I", 4))
            build.values.append(f"len({text}) + 1")
            _flush_encode(build)
            build.add(f"parts.append({text})")
            build.add("parts.append(b'\\0')")
            build.add(f"pos += len({text}) + 1")
        else:
            _encode_many(build, kind, value)


def _fixed_value(kind: FieldType, value: str) -> str:
    assert kind.primitive is not None
    if kind.shape == "single":
        return value
    if kind.primitive.typecode:
        return f"{value}.tobytes()"
    return f"b''.join({value})" if kind.primitive.code == "c" else f"bytes({value})"


def _encode_many(build: _Builder, kind: FieldType, value: str) -> None:
    items = build.fresh("a")
    build.add(f"{items} = {value}")
    if kind.shape == "sequence":
        build.members.append((4, "I", 4))
        build.values.append(f"len({items})")
    _flush_encode(build)
    if kind.kind == "primitive":
        primitive = kind.primitive
        assert primitive is not None
        build.add(f"if {items}:")
        if primitive.size > 4:
            build.names["PAD"] = _PAD
            build.add(f"    gap = -pos & {primitive.size - 1}")
            build.add("    if gap:")
            build.add("        parts.append(PAD[gap])")
            build.add("        pos += gap")
        if primitive.typecode:
            build.add(f"    parts.append({items})")
        else:
            build.add(f"    parts.append({_fixed_value(kind, items)})")
        build.add(f"    pos += len({items}) * {primitive.size}")
        return
    build.add(f"for item in {items}:")
    if kind.kind == "string":
        build.names["PAD"] = _PAD
        build.names["pack_length"] = struct.Struct("<I").pack
        build.add("    text = item.encode()")
        build.add("    gap = -pos & 3")
        build.add("    parts += (PAD[gap], pack_length(len(text) + 1), text, b'\\0')")
        build.add("    pos += gap + 5 + len(text)")
    else:
        build.add(f"    pos = {build.constant('E', encoder(kind.message))}(parts, pos, item)")


# ---------------------------------------------------------------- decoding


def make_decoder(typename: str, class_of: Callable[[str], type]) -> Decoder:
    """Return ``decode(buffer, position) -> (message, position)``.

    Args:
        typename: ROS type name.
        class_of: returns the message class of a type name (slots are ``_`` + field name).
    """
    build = _Builder(names={"array": array, "frombuffer": np.frombuffer, "new": object.__new__})
    result = _decode_struct(build, typename, class_of)
    _flush_decode(build)
    build.add(f"return {result}, pos")
    return build.compile("decode(buf, pos)", typename)  # type: ignore[no-any-return]


def _flush_decode(build: _Builder) -> None:
    if build.members:
        run = Run(build.members)
        variants, sizes = build.constant("V", run.variants), build.constant("Z", run.sizes)
        build.add("phase = pos & 7")
        build.add(f"({', '.join(build.values)},) = {variants}[phase].unpack_from(buf, pos)")
        build.add(f"pos += {sizes}[phase]")
    for line in build.after:
        build.add(line)
    build.members, build.values, build.after = [], [], []


def _decode_struct(build: _Builder, typename: str, class_of: Callable[[str], type]) -> str:
    cls = class_of(typename)
    result = build.fresh("m")
    build.add(f"{result} = new({build.constant('C', cls)})")
    for name, kind in struct_def(typename).fields:
        local = build.fresh("v")
        if name == PLACEHOLDER:
            build.members.append((1, "B", 1))
            build.values.append(local)
            continue
        # The slot's own descriptor: skips the checks of __setattr__, which wire data cannot fail.
        setter = build.constant("S", cls.__dict__["_" + name].__set__)
        member = _fixed_member(kind)
        if member is not None:
            build.members.append(member)
            build.values.append(local)
            build.after.append(f"{setter}({result}, {_decoded_fixed(kind, local)})")
        elif kind.kind == "message" and kind.shape == "single":
            inner = _decode_struct(build, kind.message, class_of)
            build.after.append(f"{setter}({result}, {inner})")
        elif kind.kind == "string" and kind.shape == "single":
            build.members.append((4, "I", 4))
            build.values.append(local)
            _flush_decode(build)
            build.add(f"end = pos + {local}")
            build.add(f"{setter}({result}, str(buf[pos:end - 1], 'utf-8'))")
            build.add("pos = end")
        else:
            _decode_many(build, kind, local, class_of)
            build.add(f"{setter}({result}, {local})")
    return result


def _decoded_fixed(kind: FieldType, local: str) -> str:
    primitive = kind.primitive
    assert primitive is not None
    if kind.shape == "single":
        return local
    if primitive.typecode:
        return f"frombuffer({local}, {primitive.dtype!r}).copy()"
    return _decoded_list(primitive, local)


def _decoded_list(primitive: Primitive, local: str) -> str:
    if primitive.code == "c":
        return f"[bytes((b,)) for b in {local}]"
    return f"[b != 0 for b in {local}]"


def _decode_many(build: _Builder, kind: FieldType, local: str, class_of: Callable[[str], type]) -> None:
    count: str | int = kind.length
    if kind.shape == "sequence":
        count = build.fresh("c")
        build.members.append((4, "I", 4))
        build.values.append(count)
    _flush_decode(build)
    if kind.kind == "primitive":
        primitive = kind.primitive
        assert primitive is not None
        if primitive.size > 4:
            build.add(f"if {count}:")
            build.add(f"    pos = (pos + {primitive.size - 1}) & -{primitive.size}")
        build.add(f"end = pos + {count} * {primitive.size}")
        if primitive.typecode:
            build.add(f"{local} = array({primitive.typecode!r})")
            build.add(f"{local}.frombytes(buf[pos:end])")
        else:
            build.add(f"{local} = {_decoded_list(primitive, 'buf[pos:end]')}")
        build.add("pos = end")
        return
    # A corrupt count must not allocate: every element takes at least one byte.
    build.add(f"if {count} > len(buf) - pos:")
    build.add("    raise ValueError('sequence is longer than the data')")
    build.add(f"{local} = []")
    build.add(f"for _ in range({count}):")
    if kind.kind == "string":
        build.names["read_length"] = struct.Struct("<I").unpack_from
        build.add("    pos = (pos + 3) & -4")
        build.add("    end = pos + 4 + read_length(buf, pos)[0]")
        build.add(f"    {local}.append(str(buf[pos + 4:end - 1], 'utf-8'))")
        build.add("    pos = end")
    else:
        build.add(f"    item, pos = {build.constant('D', class_of(kind.message)._cdr_decoder())}(buf, pos)")  # type: ignore[attr-defined]
        build.add(f"    {local}.append(item)")


# ---------------------------------------------------------------- whole messages


def to_cdr(message: Any) -> bytes:
    """Return the CDR bytes of a message of the kit, encapsulation header included."""
    parts: list[Any] = [HEADER]
    message._cdr_encoder()(parts, 0, message)
    return b"".join(parts)


def _little_endian(data: Any, typename: str) -> Any:
    """Return big-endian CDR the other way round; rare enough to leave to rosbags."""
    from robotbrain.ros.typedefs import typestore

    store = typestore()
    try:
        return store.serialize_cdr(store.deserialize_cdr(data, typename), typename)
    except Exception:
        return data


def from_cdr(data: Any, cls: Any) -> Any:
    """Build a message of class ``cls`` from CDR bytes.

    Raises:
        InputError: not little-endian CDR, or truncated, or not of this type.
    """
    view = memoryview(data)
    if len(view) > 4 and view[0] == 0 and view[1] == 0:
        view = memoryview(_little_endian(data, cls.__msgtype__))
    if len(view) < 4 or view[0] != 0 or view[1] != 1:
        raise CdrError(
            f"CDR data of {cls.__msgtype__}",
            given=bytes(view[:8]),
            expected="bytes that begin with 00 01 00 00 (little-endian CDR)",
            fix="Pass the whole message, with its 4-byte header, as serialize_message returns it.",
        )
    body = view[4:]
    try:
        message, end = cls._cdr_decoder()(body, 0)
        # Genuine rclpy may leave bytes behind the last field (it sizes its buffer by an upper estimate).
        problem = "" if end <= len(body) else f"needs {end} bytes after the header, has {len(body)}"
    except (struct.error, ValueError) as error:
        message, problem = None, str(error)
    if problem:
        raise CdrError(
            f"CDR data of {cls.__msgtype__}",
            given=bytes(view[:32]),
            expected="the bytes of one whole message",
            fix=f"Was it cut off, or serialized as another type? ({problem})",
        )
    return message


if sys.byteorder != "little":  # pragma: no cover - every supported platform is little endian
    raise ImportError("robotbrain.ros writes arrays as they lie in memory and needs a little-endian machine")
