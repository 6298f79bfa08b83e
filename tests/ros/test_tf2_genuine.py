"""The kit's buffer core answers as genuine tf2 (C++, built from source) did: values, exceptions and their texts."""

from __future__ import annotations

import gzip
import json
from collections import Counter
from pathlib import Path

import pytest
from tf2_programs import run

from robotbrain.ros.tf2.core import BufferCore

FIXTURE = Path(__file__).parent / "data" / "genuine_tf2.json.gz"
RUNS = json.loads(gzip.decompress(FIXTURE.read_bytes()))["runs"]


def same(mine, genuine):
    if not isinstance(genuine, dict) or "error" in genuine:
        return mine == genuine
    if mine["stamp"] != genuine["stamp"] or mine["frames"] != genuine["frames"]:
        return False
    if mine["translation"] != pytest.approx(genuine["translation"], abs=1e-7):
        return False
    # Where the sign is decided by a tie (a half turn, a trace of exactly zero), rounding decides it.
    flipped = [-value for value in genuine["rotation"]]
    return any(mine["rotation"] == pytest.approx(wanted, abs=1e-7) for wanted in (genuine["rotation"], flipped))


@pytest.mark.parametrize("index", range(len(RUNS)))
def test_the_same_answers(context, index):
    program, genuine = RUNS[index]["program"], RUNS[index]["answers"]
    answers = run(BufferCore(), program)
    different = [
        (number, operation, mine, theirs)
        for number, (operation, mine, theirs) in enumerate(zip(program, answers, genuine, strict=True))
        if not same(mine, theirs)
    ]
    assert not different, different[0]


def test_the_fixture_covers_what_matters():
    answers = [answer for one in RUNS for answer in one["answers"]]
    errors = Counter(answer["error"] for answer in answers if isinstance(answer, dict) and "error" in answer)
    assert {"LookupException", "ConnectivityException", "ExtrapolationException", "InvalidArgumentException"} <= set(
        errors
    )
    assert min(errors.values()) >= 5
    texts = " ".join(answer["text"] for answer in answers if isinstance(answer, dict) and "error" in answer)
    for part in ("into the future", "into the past", "but only time", "contains a loop", "unconnected trees"):
        assert part in texts
    assert sum(isinstance(answer, dict) and "rotation" in answer for answer in answers) > 300


def test_signs_are_those_of_genuine_tf2(context):
    """Away from ties the quaternion has the very sign that tf2 reports."""
    checked = 0
    for one in RUNS:
        for mine, genuine in zip(run(BufferCore(), one["program"]), one["answers"], strict=True):
            if isinstance(genuine, dict) and "rotation" in genuine:
                x, y, z, w = genuine["rotation"]
                if abs(4 * w * w - 1) > 1e-6 and max(abs(x), abs(y), abs(z), abs(w)) < 1 - 1e-6:
                    checked += 1
                    assert mine["rotation"] == pytest.approx(genuine["rotation"], abs=1e-7)
    assert checked > 200
