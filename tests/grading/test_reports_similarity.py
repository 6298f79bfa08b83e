"""Winnowing keeps its promises, tokens forget what a copier can change, and honest work stays apart."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from robotbrain.grading import intake, sample
from robotbrain.grading.course import find_course
from robotbrain.grading.reports.similarity import compare_class, given_code
from robotbrain.grading.reports.similarity_page import pair_page, similarity_text, write_similarity
from robotbrain.grading.reports.tokens import Code, read_code
from robotbrain.grading.reports.winnowing import base_of, compare, fingerprint, kgrams

from .disguise import disguise
from .reportclass import Page

K, T = 5, 9


def words(source: str) -> list[int]:
    return [int(symbol) for symbol in read_code("x", [source]).symbols]


def code(symbols: list[int]) -> Code:
    return Code("x", "", np.array(symbols, dtype=np.uint64), np.arange(1, len(symbols) + 1))


def shared(a: list[int], b: list[int], base: NDArray[np.uint64] | None = None) -> set[tuple[int, int]]:
    """All pairs of positions that the comparison says are the same."""
    match = compare(fingerprint(code(a), base, K, T), fingerprint(code(b), base, K, T), K)
    for p in match.passages:
        assert p.length >= K
        assert a[p.a : p.a + p.length] == b[p.b : p.b + p.length]
    return {(p.a + i, p.b + i) for p in match.passages for i in range(p.length)}


runs = st.lists(st.integers(1, 60), min_size=T, max_size=2 * T)


@settings(max_examples=150, deadline=None)
@given(run=runs, noise=st.data())
def test_a_shared_run_of_t_tokens_is_always_found(run: list[int], noise: st.DataObject) -> None:
    a, b = (
        noise.draw(st.lists(st.integers(low, low + 999), max_size=40)) for low in (1000, 2000)
    )  # disjoint alphabets: the run is all they share
    cut_a, cut_b = (noise.draw(st.integers(0, len(x))) for x in (a, b))
    found = shared(a[:cut_a] + run + a[cut_a:], b[:cut_b] + run + b[cut_b:])
    assert {i for i, _ in found} == set(range(cut_a, cut_a + len(run)))


@settings(max_examples=100, deadline=None)
@given(a=st.lists(st.integers(1, 4), max_size=60), b=st.lists(st.integers(1, 4), max_size=60))
def test_nothing_shorter_than_k_and_nothing_unequal_is_told(a: list[int], b: list[int]) -> None:
    found = shared(a, b)  # checks every passage
    assert len({i for i, _ in found}) == len({j for _, j in found}) == len(found)


@settings(max_examples=60, deadline=None)
@given(run=st.lists(st.integers(1, 60), min_size=K, max_size=20), own=runs)
def test_given_code_counts_for_nobody_and_hides_nothing_else(run: list[int], own: list[int]) -> None:
    base = base_of([code(run)], K)
    assert shared([1000, *run, 1001], [2000, *run, 2001], base) == set()
    assert fingerprint(code(run), base, K, T).novel.sum() == 0
    fresh = [500 + x for x in own]
    found = shared([1000, *run, *fresh, 1001], [2000, *fresh, *run, 2001], base)
    assert {i for i, _ in found} >= set(range(1 + len(run), 1 + len(run) + len(own)))


def test_of_each_window_the_smallest_hash_is_kept_and_the_rightmost_of_equals() -> None:
    rng = np.random.default_rng(3)
    symbols = rng.integers(1, 4, 200).tolist()
    hashes = kgrams(np.array(symbols, dtype=np.uint64), K)
    window = T - K + 1
    expected = {
        max(j for j in range(i, i + window) if hashes[j] == min(hashes[i : i + window]))
        for i in range(len(hashes) - window + 1)
    }
    assert {p for places in fingerprint(code(symbols), None, K, T).places.values() for p in places} == expected


def test_hashes_are_those_of_the_tokens_alone() -> None:
    symbols = np.array([3, 1, 4, 1, 5, 3, 1, 4, 1, 5, 9], dtype=np.uint64)
    hashes = kgrams(symbols, 5)
    assert hashes[0] == hashes[5] and len(set(hashes.tolist())) == 6
    assert len(kgrams(symbols[:4], 5)) == 0


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("def f(x):\n    return x + 1", "def  g( y ):  # add\n  return y+2"),
        ("def f(x: int = 0, *, y: list[int] | None = 1) -> dict[str, A]:\n    pass", "def f(x=0, *, y=1):\n  pass"),
        ("x: int = (1 +\n  2)", "x = 1 + 2"),
        ("x: int", ""),
        ('def f():\n    """Doc."""\n    return 1', "def f():\n    return 1"),
        ("f(a, b,)\n[1, 2,]", "f(a, b)\n[1, 2]"),
        ("a = 1; b = 2", "a = 1\nb = 2"),
        ("s = f'{a!r:>{b}} and {c}'", "s = 'x'"),
        ("if (a and b):\n    pass", "if a and b:\n  pass"),
        ("%matplotlib inline\nx = 1\n!ls", "x = 1"),
        ("class A:\n    def m(self):\n        self.v = 1", "class B:\n    def n(me):\n        me.w = 1"),
    ],
)  # fmt: skip
def test_tokens_forget_what_a_copier_changes(one: str, other: str) -> None:
    assert words(one) == words(other)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("np.argsort(x)", "np.argmax(x)"),
        ("sum(x)", "max(x)"),
        ("x + y", "x - y"),
        ("f(x)", "f[x]"),
        ("f(x)", "f"),
        ("for x in y:\n    pass", "while x:\n    pass"),
        ("{a: b}", "{a, b}"),
        ("x[a:b]", "x[a]"),
        ("lambda a: b", "lambda a, b: b"),
    ],
)
def test_tokens_keep_what_the_code_does(one: str, other: str) -> None:
    assert words(one) != words(other)


def test_broken_cells_still_give_tokens_and_lines() -> None:
    read = read_code("x", ["def f(:\n    return (1", "y = 'open\nz = g(1)", "w = h(2)"])
    assert len(read) > 10 and read.lines[-1] == 5 and read.text.split("\n")[4] == "w = h(2)"
    assert len(read_code("x", ["\x00\ufeff(", "\\", "'''", "\x0c", "\t\n  x"])) >= 0


LAB = "hw2_optimisation"


@pytest.fixture(scope="module")
def answers(repo: Path) -> tuple[list[list[str]], list[str]]:
    """The different right answers to each exercise of a real lab, and what its release gives."""
    course = find_course(repo)
    reference = sample.Reference(course, LAB)
    cells = [c for nb in reference.notebooks.values() for c in nb.cells if c.cell_type == "code"]
    found = {intake.grade_id(c): [c.source] for c in cells if intake.grade_id(c) in reference.answers()}
    for style in sample.load_mutants(course, LAB)[1]:
        for name, source in style.replace.items():
            if name in found and isinstance(source, str):
                found[name].append(source)
    return [v for v in found.values() if len(v) > 1], [
        s for nb in reference.stubs.values() for s in given_code(nb.cells)
    ]


def test_copies_stand_out_and_honest_work_does_not(answers: tuple[list[list[str]], list[str]]) -> None:
    exercises, given = answers
    students = {f"s{n}": [a[n % len(a)] for a in exercises] for n in range(min(map(len, exercises)))}
    students |= {"copier": disguise(students["s1"], 7), "paster": disguise(students["s0"], 8)}
    reference = {"solution": students.pop("s0")}
    found = compare_class(students, given=[given], references=reference)
    marked = {frozenset((p.a.name, p.b.name)): p.match.share for p in found.pairs if p.notable}
    assert set(marked) == {frozenset(("s1", "copier"))} and min(marked.values()) > 0.9
    assert [(p.a.name, p.match.share > 0.9) for p in found.with_reference if p.notable] == [("paster", True)]
    assert "copier" in similarity_text(found) and "no verdict" in similarity_text(found)


def test_honest_answers_to_the_same_exercise_stay_below_the_mark(answers: tuple[list[list[str]], list[str]]) -> None:
    exercises, given = answers
    for variants in exercises:
        for a, b in itertools.combinations(variants, 2):
            found = compare_class({"a": [a], "b": [b]}, given=[given])
            assert not any(p.notable for p in found.pairs)


def test_what_much_of_the_class_shares_is_told_once_and_marks_nobody() -> None:
    idiom = (
        "def load(path):\n    with open(path) as file:\n        return [float(x) for x in file.read().split() if x]\n"
    )
    mine = ["for i in range({0}):\n" + "    total_{0} = i {1} {0}\n" * n for n in range(3, 11)]
    students = {f"s{n}": [idiom, m.format(n, "+-*/%&|^"[n])] for n, m in enumerate(mine)}
    found = compare_class(students)
    assert not any(p.notable for p in found.pairs)
    assert [c.students for c in found.common] == [8] and "def load" in found.common[0].text


def test_empty_submissions_are_left_out_and_pages_are_written(tmp_path: Path) -> None:
    work = "def f(values):\n    return sorted(v ** 2 for v in values if v > min(values) and v not in (1, 2))[::-1]\n"
    found = compare_class({"a": [work], "b": [work, "x = 1"], "c": [], "d": ["# nothing"]}, references={"r": [work]})
    assert found.skipped == ["c", "d"] and found.students == 2
    (tmp_path / "pair-007.html").write_text("of an earlier run")
    index = write_similarity(tmp_path, "toy", found)
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "index.html",
        "pair-001.html",
        "reference-001.html",
        "reference-002.html",
    ]
    for path in tmp_path.iterdir():
        read = Page(path.read_text())
        assert read.problems == []
        targets = {link for link in read.links if not link.startswith("#")}
        assert all((tmp_path / target).is_file() for target in targets)
        assert all(link[1:] in read.ids for link in read.links if link.startswith("#"))
    assert "no verdict" in index.read_text()
    left, right = (s for s in Page(pair_page("toy", found.pairs[0])).shown if "sorted" in s)
    assert left == right
    assert compare_class({}).pairs == [] and compare_class({"a": []}).skipped == ["a"]
