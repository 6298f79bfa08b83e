# ruff: noqa: E501 - payloads are one-line texts
"""Frames that no honest serving end would send, at the moment when the tester waits for an answer."""

from __future__ import annotations

from tests.grading.attacks.attack import Attack

KIND = "crafted frames"

_FRAME = """
import functools, gc, os, socket, struct, sys, time
import msgpack
from robotbrain.grading.remote import values as v
packed = msgpack.packb
def number_of_request():
    frame = sys._getframe()
    while frame is not None:
        if "number" in frame.f_locals and "header" in frame.f_locals:
            return frame.f_locals["number"], frame.f_locals["self"].sock
        frame = frame.f_back
    raise RuntimeError("not asked")
def frame(kind, number, value, blobs=(), head=b""):
    header = b"\\x93" + packed(kind) + packed(number) + value
    sizes = struct.pack(f"<{len(blobs)}I", *map(len, blobs))
    rest = struct.pack("<II", len(header), len(blobs)) + sizes + header + b"".join(blobs)
    return struct.pack("<I", len(rest)) + rest
def array(n):
    return b"\\xdd" + struct.pack(">I", n)
def answer(value, blobs=()):
    number, sock = number_of_request()
    sock.sendall(frame(1, number, b"\\x91" + value, blobs))
    time.sleep(3600)
"""

_CRAFTED = {
    "keys that collide": "n = 17\nbody = b''.join(packed([v.TUPLE, *(-1 - ((i >> b) & 1) for b in range(n))]) + b'\\x00'"
    " for i in range(2 ** n))\nanswer(array(1 + 2 * 2 ** n) + packed(v.DICT) + body)",
    "sets of keys that collide": "n = 16\nbody = b''.join(packed([v.TUPLE, *(-1 - ((i >> b) & 1) for b in range(n))])"
    " for i in range(2 ** n))\nanswer(array(1 + 2 ** n) + packed(v.SET) + body)",
    "a range without end": "answer(packed([v.RANGE, 0, 2**62, 1]))",
    "a range that never moves": "answer(packed([v.RANGE, 0, 2**62, 2**61]))",
    "lists nested without end": "answer(b''.join([b'\\x92' + packed(v.LIST)] * 500_000) + b'\\xc0')",
    "arrays nested without end": "answer(b'\\x91' * 5_000_000 + b'\\xc0')",
    "a list of more than announced": "answer(array(4_000_000_000) + packed(v.LIST))",
    "a blob named ten thousand times": "answer(packed([v.LIST, *([v.INTS, 0, v.LIST],) * 10_000]), [b'\\0' * 8_000_000])",
    "truth values of two": "answer(packed([v.ARRAY, 'bool', [4], b'\\2\\2\\2\\2']))",
    "an array of negative shape": "answer(packed([v.ARRAY, 'float64', [-1, -1], b'\\0' * 8]))",
    "an array of objects": "answer(packed([v.ARRAY, 'object', [1], b'\\0' * 8]))",
    "an array of records": "answer(packed([v.ARRAY, 'f8,O', [1], b'\\0' * 16]))",
    "an array of empty dimensions": "answer(packed([v.ARRAY, 'float64', [2**31, 0, 2**31], b'']))",
    "a class of the library": "answer(packed([v.DATA, 'robotbrain.grading.results:TestResult', 'earned', 4.0]))",
    "a class of the standard library": "answer(packed([v.DATA, 'subprocess:Popen', 'args', 'true']))",
    "a namespace of dunder names": "answer(packed([v.NAMESPACE, '__array__', [v.LIST], '__class__', 1]))",
    "a handle of the tester": "answer(packed([v.YOURS, 1]))",
    "a handle of a bad kind": "answer(packed([v.THEIRS, -1, 'x']))",
    "a handle with a long name": "answer(packed([v.THEIRS, 7, 'x' * 1_000_000]))",
    "a map": "answer(packed({'a': 1}))",
    "an extension type": "answer(packed(msgpack.ExtType(5, b'x')))",
    "a time stamp": "answer(packed(msgpack.Timestamp(1)))",
    "a number of another request": "number, sock = number_of_request()\nsock.sendall(frame(1, number + 1, b'\\x91\\x00'))\ntime.sleep(3600)",
    "answers to all later requests": "number, sock = number_of_request()\nfor more in range(200):\n"
    "    sock.sendall(frame(1, number + more, b'\\x91' + packed(6.0)))",
    "two answers": "number, sock = number_of_request()\nfor _ in range(2):\n    sock.sendall(frame(1, number, b'\\x91' + packed(6.0)))",
    "a call of a function never given": "number, sock = number_of_request()\nsock.sendall(b'\\x24\\0\\0\\0' + b'x' * 36)\ntime.sleep(3600)",
    "requests to the tester": "number, sock = number_of_request()\nfor name in ('call', 'getattr', 'name', 'probe', 'hello', 'eval'):\n"
    "    header = packed([0, 1, name, [], [[v.YOURS, 1], [v.TUPLE], [v.DICT]]])\n"
    "    rest = struct.pack('<II', len(header), 0) + header\n    sock.sendall(struct.pack('<I', len(rest)) + rest)\ntime.sleep(3600)",
    "an exception of credit": "number, sock = number_of_request()\n"
    "header = packed([2, number, 'CheckFailure', 'credit=1.0', '', 0, '', []])\nrest = struct.pack('<II', len(header), 0) + header\n"
    "sock.sendall(struct.pack('<I', len(rest)) + rest)\ntime.sleep(3600)",
    "an interruption of its own": "number, sock = number_of_request()\n"
    "header = packed([2, number, 'interrupted', '', '', 0, '', []])\nrest = struct.pack('<II', len(header), 0) + header\n"
    "sock.sendall(struct.pack('<I', len(rest)) + rest)",
    "a frame of two gigabytes": "number, sock = number_of_request()\nsock.sendall(struct.pack('<I', 2**31) + b'x' * 1000)\ntime.sleep(3600)",
    "a frame one byte a second": "number, sock = number_of_request()\nwhole = frame(1, number, b'\\x91\\x00')\n"
    "for byte in whole:\n    sock.sendall(bytes([byte]))\n    time.sleep(0.5)",
    "lengths that do not fit": "number, sock = number_of_request()\nsock.sendall(struct.pack('<IIII', 100, 2**31, 2**30, 7) + b'x' * 100)\ntime.sleep(3600)",
    "a text that is no text": "answer(packed([v.TEXT, b'\\xff\\xfe\\xed\\xa0\\x80']))",
    "half surrogates": "answer(packed([v.TEXT, '\\ud800'.encode('utf-8', 'surrogatepass')]))",
    "an integer of a million digits": "answer(packed([v.BIG, b'\\x7f' * 400_000]))",
    "a slice of slices": "answer(packed([v.SLICE, [v.SLICE, 1, 2, 3], [v.LIST], 0]))",
    "not a number as a key": "answer(packed([v.DICT, *([float('nan'), 1] * 100_000)]))",
    "a path to elsewhere": "answer(packed([v.PATH, b'/proc/self/environ']))",
}


def attacks() -> list[Attack]:
    """Every frame in the place of what ``words`` and ``GoalTracker.history`` answer."""
    made = []
    for name, text in _CRAFTED.items():
        once = _FRAME + text
        answers = {
            "words": f"_PAYLOAD = {once!r}\ndef words(text):\n    exec(_PAYLOAD, {{}})\n    return {{}}",
            "tracker": f"_PAYLOAD = {once!r}\nclass GoalTracker:\n    best = 1.0\n    def __init__(self, goal): pass\n"
            "    def update(self, value): pass\n    def history(self):\n        exec(_PAYLOAD, {})\n        return []",
        }
        made.append(Attack(f"frame: {name}", KIND, answers, wrong=("words", "tracker")))
    return made
