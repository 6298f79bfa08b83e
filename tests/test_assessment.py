"""The assessment: a good bank, fair papers, right marks, and a key that stays at home."""

from __future__ import annotations

import functools
import itertools
import json
import math
import os
import random
import re
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import nbformat
import numpy as np
import pytest

from robotbrain.assessment import units
from robotbrain.assessment.bank import FOLDER, Bank, load_bank, parse_bank, practice_bank
from robotbrain.assessment.dice import Dice
from robotbrain.assessment.draw import GRADED, PRACTICE, Blueprint, Draw, Drawn, arrange, draw
from robotbrain.assessment.formulas import evaluate
from robotbrain.assessment.marking import advice, mark, reasons, right_answer, same
from robotbrain.assessment.paper import KINDS, TOPICS, Paper
from robotbrain.assessment.questions import DIFFICULTIES, OBJECTIVES, Question, check_values
from robotbrain.assessment.records import draw_class, open_paper, practice_draw, read_students, recorded_draw
from robotbrain.assessment.show import make_form, review, show
from robotbrain.cli import main
from robotbrain.errors import InputError
from robotbrain.grading import Lab, load_hidden_suite
from robotbrain.grading.suites.assessment import NAMES
from tests import classes

REPO = Path(__file__).resolve().parents[1]
GRADED_BANK = load_bank(REPO / "autograder" / FOLDER)
PRACTICE_BANK = practice_bank()
ALL = (*GRADED_BANK.questions, *PRACTICE_BANK.questions)


def of_kind(kind: str) -> list[Question]:
    return [q for q in ALL if q.kind == kind]


def by_id(questions: list[Question]) -> Any:
    return pytest.mark.parametrize("question", questions, ids=lambda q: q.id)


def drawn(question: Question, seed: str = "s") -> Drawn:
    return arrange([question], seed).questions[0]


def callable_of(source: str) -> Callable[..., Any]:
    names: dict[str, Any] = {"math": math}
    exec(source, names)
    return names["answer"]


def answers_of(made: Draw) -> dict[str, Any]:
    """Right answers as a student's variables."""
    found: dict[str, Any] = {}
    for d in made.questions:
        if d.question.kind == "code":
            found[d.item.name] = callable_of(d.question.reference)
        else:
            found[d.item.name] = right_answer(d)
    return found


# ---------------------------------------------------------------- the bank


def test_the_bank_is_large_and_covers_everything() -> None:
    questions = GRADED_BANK.questions
    assert len(questions) >= 70
    topics = Counter(q.topic for q in questions)
    assert set(topics) == set(TOPICS) and min(topics.values()) >= 7
    for seen, wanted, least in (
        (Counter(q.objective for q in questions), OBJECTIVES, 8),
        (Counter(q.kind for q in questions), KINDS, 8),
        (Counter(q.difficulty for q in questions), DIFFICULTIES, 10),
    ):
        assert set(seen) == set(wanted) and min(seen.values()) >= least, seen


def test_no_practice_question_is_graded() -> None:
    graded = GRADED_BANK.questions
    assert not {q.id for q in graded} & {q.id for q in PRACTICE_BANK.questions}
    assert len({q.text for q in ALL}) == len(ALL) == len({q.id for q in ALL})
    assert Counter(q.topic for q in PRACTICE_BANK.questions) == dict.fromkeys(TOPICS, PRACTICE.per_topic)


def words(text: str) -> list[str]:
    return re.findall(r"[a-z0-9]+", text.lower())


@functools.cache
def headings(topic: str) -> list[list[str]]:
    number = list(TOPICS).index(topic) + 1
    notebook = nbformat.read(next((REPO / "course").glob(f"{number:02d}_*.ipynb")), as_version=4)
    text = "\n".join(c.source for c in notebook.cells if c.cell_type == "markdown")
    return [words(line.lstrip("#")) for line in text.splitlines() if line.startswith("#")]


@by_id(list(ALL))
def test_where_to_reread_is_there(question: Question) -> None:
    """The words of the reference are, but for a few, those of one heading of the lesson."""
    wanted = set(words(question.reread))
    best = max(len(wanted & set(heading)) / len(wanted) for heading in headings(question.topic))
    assert best >= 0.5, question.reread


@by_id(list(ALL))
def test_every_mistake_has_a_reason_of_its_own(question: Question) -> None:
    found = reasons(question)
    own = [why for key, why in found.items() if not key.endswith(("prefix", "sign", "raised", "other"))]
    assert len(set(own)) == len(own) and all(len(why) > 12 for why in own)
    for key in found:
        assert question.explain in advice(question, key) and "Reread lesson" in advice(question, key)


@by_id([q for q in ALL if q.options])
def test_every_option_is_marked_with_its_own_reason(question: Question) -> None:
    for seed in ("one", "two"):
        d = drawn(question, seed)
        for index, option in enumerate(question.options):
            (letter,) = d.letters_of([index])
            assert dict(d.item.options)[letter] == option.text
            if question.kind == "single":
                marked = mark(d, letter)
                assert marked.right is option.right
                assert option.right or (marked.key == f"{question.id}-option-{index}" and marked.reason == option.why)
            else:
                flipped = set(right_answer(d)) ^ {letter}
                marked = mark(d, flipped)
                assert not marked.right and marked.key == f"{question.id}-option-{index}"
        assert mark(d, right_answer(d)).right


@by_id(of_kind("order"))
def test_every_exchange_of_neighbours_is_marked_with_its_reason(question: Question) -> None:
    d = drawn(question)
    right = right_answer(d)
    assert mark(d, right).right and [t for _, t in d.item.options] != list(question.steps)
    for place in range(len(right) - 1):
        turned = [*right[:place], right[place + 1], right[place], *right[place + 2 :]]
        assert mark(d, turned).key == f"{question.id}-step-{place}"


@by_id(of_kind("code"))
def test_functions_and_their_mistakes(question: Question) -> None:
    d = drawn(question)
    assert mark(d, callable_of(question.reference)).right
    for index, slip in enumerate(question.slips):
        marked = mark(d, callable_of(slip.wrong))
        assert marked.credit == 0 and marked.key == f"{question.id}-slip-{index}"
    for lazy in (lambda *_: None, lambda *_: 0.0, lambda *_: True, lambda *_: [], lambda *a: a[0]):
        assert not mark(d, lazy).right
    assert mark(d, lambda *_: 1 / 0).key == f"{question.id}-raised"


# ---------------------------------------------------------------- numbers


def _turned(values: dict[str, Any]) -> float:
    difference = np.deg2rad(values["estimated"] - values["true"])
    return float(np.rad2deg(np.arctan2(np.sin(difference), np.cos(difference))))


def _stopped(values: dict[str, Any]) -> float:
    way, speed, step = values["v"] * values["t"] / 1000, values["v"], 1e-4
    while speed > 0:
        way, speed = way + speed * step, speed - values["a"] * step
    return float(way)


def _oldest(values: dict[str, Any]) -> float:
    """The largest age on a fine grid of time, over several results."""
    arrivals = [k * values["period"] + values["latency"] for k in range(6)]
    times = np.arange(arrivals[0], arrivals[-1], 0.1)
    newest = (np.searchsorted(arrivals, times, side="right") - 1) * values["period"]
    return float((times - newest).max())


def _bound(values: dict[str, Any]) -> float:
    from robotbrain.pipeline.patterns.budgets import Task
    from robotbrain.pipeline.patterns.chains import reaction_bound_ns

    tasks = [Task.of(n, values[n], r) for n, r in (("t1", 5), ("t2", 20), ("t3", 2))]
    return reaction_bound_ns(tasks, "timers") / 1e6


def _peak(values: dict[str, Any]) -> float:
    from robotbrain.jetson.catalogue import load_module

    return load_module(values["slug"]).peak_flops("fp32", values["mode"]) / 1e9


def _target(values: dict[str, Any]) -> float:
    import torch

    from robotbrain.rl.ddpg import td_target

    r, q = torch.tensor([values["r"]], dtype=torch.float64), torch.tensor([values["q"]], dtype=torch.float64)
    return float(td_target(r, torch.zeros(1, dtype=torch.float64), q, values["gamma"])[0])


def _scale(values: dict[str, Any], **how: Any) -> float:
    from robotbrain.optimisation import choose_qparams

    return float(choose_qparams(values["low"], values["high"], **how).scale)


def _iou(values: dict[str, Any]) -> float:
    from robotbrain.monitoring.accuracy import class_iou, confusion

    both, extra, missed = values["both"], values["extra"], values["missed"]
    predicted = np.array([1] * (both + extra) + [0] * (missed + 50))
    truth = np.array([1] * both + [0] * extra + [1] * missed + [0] * 50)
    return 100 * float(class_iou(confusion(predicted, truth, 2))[1])


def _interval(values: dict[str, Any]) -> float:
    from scipy import stats

    n = values["n"]
    sample = np.arange(n, dtype=float)
    sample *= values["s"] / sample.std(ddof=1)
    low, _ = stats.t.interval(0.95, n - 1, loc=sample.mean(), scale=stats.sem(sample))
    return float(sample.mean() - low)


ORACLES: dict[str, Callable[[dict[str, Any]], float]] = {
    "arch-traffic": lambda v: np.zeros((v["height"], v["width"], 3), np.uint8).nbytes * v["hz"] * 1e-6,
    "jetson-peak": _peak,
    "jetson-sparse": lambda v: (v["total"] - (v["total"] - v["gpu"])) * 0.5,
    "jetson-roofline": lambda v: 1e6 * max(v["mflop"] * 1e6 / (v["tflops"] * 1e12), v["mb"] * 1e6 / (v["gbs"] * 1e9)),
    "jetson-weights": lambda v: (
        v["billions"] * 1e9 * np.dtype({1: "i1", 2: "f2", 4: "f4"}[v["bytes"]]).itemsize / 1024**3
    ),
    "trt-scale": lambda v: _scale(v, symmetric=True),
    "task-step-reward": lambda v: float(np.dot([v["track"], v["torque"]], [v["w_track"], v["w_torque"]])) * 0.02,
    "task-experience": lambda v: v["robots"] * (v["steps"] * 0.02) / 3600,
    "ddpg-target": _target,
    "ddpg-horizon": lambda v: sum(v["gamma"] ** k for k in range(5000)) / v["hz"],
    "s2r-interval": _interval,
    "s2r-late-angle": lambda v: float(np.rad2deg(v["speed"] * v["delay"] * 1e-3)),
    "pc-rate": lambda v: min(1000 / step for step in (33, v["perception"], 8, v["planning"], 2)),
    "pc-latency": lambda v: sum((v["perception"], 8, v["planning"], 2)),
    "pc-peak-age": _oldest,
    "pc-stopping": _stopped,
    "pc-timers": _bound,
    "opt-asymmetric": lambda v: _scale(v, signed=False),
    "opt-list": lambda v: (1_000_000 - 10_000 * v["zeros"]) * (4 + v["index"]) / 1e6,
    "opt-channels": lambda v: 100 * np.ones((100 - v["cut"], 100 - v["cut"])).size / 100**2,
    "mon-little": lambda v: v["depth"] / (v["rate"] / 1000),
    "mon-amdahl": lambda v: v["total"] / (1 / (1 - v["part"] / v["total"] * (1 - 1 / v["factor"]))),
    "mon-hundredth": lambda v: 1 / (v["hz"] * 0.01),
    "mon-iou": _iou,
    "ts-radio": lambda v: 100 * (v["kb"] * 8e3 * v["hz"]) / (v["mbit"] * 1e6),
    "ts-yaw": _turned,
    "ts-period": lambda v: 1000 * (12 * v["busy"] + 4 * v["period"] - 4 * v["busy"]) / 1000,
    "practice-peak": lambda v: v["cores"] * v["mhz"] * 1e6 * 2 / 1e9,
    "practice-int8-step": lambda v: v["q"] * v["scale"],
    "practice-kernel": lambda v: float(np.exp(-(v["error"] ** 2) / v["sigma"] ** 2)),
    "practice-pipeline": lambda v: 1 / ((v["one"] + v["two"]) * 1e-3),
    "practice-response": lambda v: (v["ready"] + v["wait"] + v["work"]) - v["ready"],
    "practice-growing": lambda v: v["free"] / (v["arrival"] * v["mb"] - v["service"] * v["mb"]),
}


@by_id(of_kind("numeric"))
def test_numbers_agree_with_an_independent_oracle(question: Question) -> None:
    for values in question.combinations():
        check_values(question, values)
        # An angle in the text, a t with two digits: to a part of the tolerance.
        oracle = ORACLES[question.id](values)
        assert evaluate(question.answer, values) == pytest.approx(oracle, rel=question.tolerance / 4), values


@by_id(of_kind("numeric"))
def test_likely_wrong_numbers_get_their_reason(question: Question) -> None:
    for seed in range(6):
        d = drawn(question, f"{seed}")
        wanted = evaluate(question.answer, d.values)
        for form in (
            wanted,
            f"{wanted!r} {question.unit}".strip(),
            right_answer(d),
            wanted * (1 + 0.9 * question.tolerance),
        ):
            assert mark(d, form).right, form
        assert not mark(d, wanted * (1 + 1.2 * question.tolerance)).right
        for index, slip in enumerate(question.slips):
            value = evaluate(slip.wrong, d.values)
            first = next(i for i, s in enumerate(question.slips) if same(evaluate(s.wrong, d.values), value))
            assert mark(d, value).key.startswith(f"{question.id}-slip-"), (index, d.values)
            assert first < index or mark(d, value).key == f"{question.id}-slip-{index}", d.values


def test_the_numbers_of_a_question_differ_between_students() -> None:
    for question in of_kind("numeric"):
        assert len({drawn(question, str(seed)).item.text for seed in range(40)}) >= 3, question.id


# ---------------------------------------------------------------- no cues


def test_the_right_option_is_not_told_by_its_length() -> None:
    single = [q for q in GRADED_BANK.questions if q.kind == "single"]
    ranks = Counter(sorted(-len(o.text) for o in q.options).index(-len(q.options[0].text)) for q in single)
    assert all(q.options[0].right and len(q.options) == 4 for q in single)
    chi2 = sum((ranks[rank] - len(single) / 4) ** 2 / (len(single) / 4) for rank in range(4))
    assert chi2 < 7.8, ranks  # 95 % of fair banks
    multiple = [q for q in GRADED_BANK.questions if q.kind == "multiple"]
    longer = [
        np.mean([len(o.text) for o in q.options if o.right]) > np.mean([len(o.text) for o in q.options if not o.right])
        for q in multiple
    ]
    assert 3 <= sum(longer) <= len(longer) - 3


def test_positions_are_uniform_and_so_are_numbers_of_right_options() -> None:
    question = next(q for q in GRADED_BANK.questions if q.kind == "single")
    places = Counter(right_answer(drawn(question, str(seed))) for seed in range(2000))
    assert all(440 < places[letter] < 560 for letter in "abcd"), places
    rights = Counter(sum(o.right for o in q.options) for q in GRADED_BANK.questions if q.kind == "multiple")
    assert len(rights) >= 2  # "always three" would be a cue


# ---------------------------------------------------------------- draws


@pytest.fixture(scope="module")
def thousand() -> list[Draw]:
    return [draw(GRADED_BANK, f"seed {k}") for k in range(1000)]


def test_every_paper_keeps_the_blueprint(thousand: list[Draw]) -> None:
    for made in thousand:
        questions = [d.question for d in made.questions]
        assert len(set(made.ids)) == 2 * len(TOPICS)
        assert [q.topic for q in questions] == [t for t in TOPICS for _ in range(2)]
        kinds, levels = Counter(q.kind for q in questions), Counter(q.difficulty for q in questions)
        goals = Counter(q.objective for q in questions)
        for count, limits in ((kinds, GRADED.kinds), (levels, GRADED.difficulties), (goals, GRADED.objectives)):
            for key, (low, high) in limits.items():  # type: ignore[attr-defined]
                assert low <= count[key] <= high, (key, count)


def test_every_question_is_drawn_and_papers_differ(thousand: list[Draw]) -> None:
    seen = Counter(name for made in thousand for name in made.ids)
    assert set(seen) == {q.id for q in GRADED_BANK.questions}
    assert max(seen.values()) < 0.6 * len(thousand) and min(seen.values()) > 0.03 * len(thousand)
    assert len({made.paper.code for made in thousand}) == 1000
    shared = [len(set(a.ids) & set(b.ids)) for a, b in itertools.pairwise(thousand)]
    assert np.mean(shared) < 8


def test_the_same_seed_gives_the_same_paper_on_every_machine() -> None:
    dice = Dice("a", 1)
    assert [dice.below(1000) for _ in range(5)] == PINNED_NUMBERS
    assert "".join(Dice("x").shuffled("abcdefgh")) == PINNED_ORDER
    code = (
        "from robotbrain.assessment.bank import load_bank\nfrom robotbrain.assessment.draw import draw\n"
        f"print(draw(load_bank({str(REPO / 'autograder' / FOLDER)!r}), 'term 1/ada').paper.code)"
    )
    codes = set()
    for hashing in ("0", "4711"):
        environment = os.environ | {"PYTHONHASHSEED": hashing}
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
        codes.add(done.stdout.strip())
    assert codes == {draw(GRADED_BANK, "term 1/ada").paper.code} != {draw(GRADED_BANK, "term 1/alan").paper.code}


PINNED_NUMBERS = [406, 904, 184, 109, 626]
PINNED_ORDER = "dheagcbf"


def test_dice_are_fair() -> None:
    counts = Counter(Dice("fair").below(1) for _ in range(3))
    assert counts == {0: 3}
    dice = Dice("fair")
    counts = Counter(dice.below(6) for _ in range(6000))
    assert set(counts) == set(range(6)) and all(880 < n < 1120 for n in counts.values())
    orders = Counter("".join(dice.shuffled("abc")) for _ in range(3000))
    assert len(orders) == 6 and all(420 < n < 580 for n in orders.values())


def test_a_blueprint_that_cannot_be_kept_is_refused() -> None:
    with pytest.raises(InputError, match="no choice"):
        draw(PRACTICE_BANK, "s", Blueprint(per_topic=2, kinds={"order": (15, 20)}))
    with pytest.raises(InputError, match="at least 3"):
        draw(PRACTICE_BANK, "s", Blueprint(per_topic=3))


# ---------------------------------------------------------------- marks


def test_multiple_choice_rewards_knowledge_and_not_guessing() -> None:
    for question in of_kind("multiple"):
        d = drawn(question)
        letters, right = d.item.letters, set(right_answer(d))
        credits_ = {}
        for size in range(1, len(letters) + 1):
            for chosen in itertools.combinations(letters, size):
                credit = mark(d, list(chosen)).credit
                assert credit == mark(d, list(reversed(chosen))).credit == mark(d, set(chosen)).credit
                credits_[frozenset(chosen)] = credit
        assert credits_[frozenset(letters)] == 0 and credits_[frozenset(right)] == 1
        assert sum(credit == 1 for credit in credits_.values()) == 1
        for chosen, credit in credits_.items():
            for letter in set(letters) - chosen:  # one more right letter never costs, one more wrong one never pays
                more = credits_[chosen | {letter}]
                assert more >= credit if letter in right else more <= credit
        # Before the floor at zero, tossing a coin for each letter is worth nothing; the floor leaves a little.
        raw = [
            len(c & right) / len(right) - len(c - right) / (len(letters) - len(right))
            for c in map(frozenset, itertools.chain.from_iterable(
                itertools.combinations(letters, n) for n in range(len(letters) + 1)))
        ]  # fmt: skip
        assert np.mean(raw) == pytest.approx(0) and np.mean(list(credits_.values())) < 0.25
        for chosen, value in zip(credits_, map(credits_.get, credits_), strict=True):
            expected = len(chosen & right) / len(right) - len(chosen - right) / (len(letters) - len(right))
            assert value == pytest.approx(max(0.0, expected))


def test_an_order_is_worth_the_less_the_more_is_turned() -> None:
    for question in of_kind("order"):
        d = drawn(question)
        right = right_answer(d)
        pairs = math.comb(len(right), 2)
        found = []
        for chosen in itertools.permutations(right):
            turned = sum(right.index(a) > right.index(b) for a, b in itertools.combinations(chosen, 2))
            credit = mark(d, chosen).credit
            assert credit == pytest.approx(max(0.0, 1 - 2 * turned / pairs))
            found.append(credit)
        assert mark(d, right[::-1]).credit == 0 and np.mean(found) < 0.2


def test_guessing_a_paper_earns_little(thousand: list[Draw]) -> None:
    rng = random.Random(0)
    totals = []
    for made in thousand[:200]:
        total = 0.0
        for d in made.questions:
            letters = list(d.item.letters)
            if d.question.kind == "single":
                total += mark(d, rng.choice(letters)).credit
            elif d.question.kind == "multiple":
                total += mark(d, [x for x in letters if rng.random() < 0.5] or letters).credit
            elif d.question.kind == "order":
                total += mark(d, rng.sample(letters, len(letters))).credit
        totals.append(total / len(made.questions))
    assert np.mean(totals) < 0.18


def test_the_key_earns_everything(thousand: list[Draw]) -> None:
    for made in thousand[:60]:
        answers = answers_of(made)
        assert all(mark(d, answers[d.item.name]).right for d in made.questions)


@pytest.mark.parametrize(
    ("kind", "answer", "value"),
    [
        ("single", " B) ", "b"),
        ("single", ["b"], "b"),
        ("multiple", "a, c", ("a", "c")),
        ("multiple", {"c", "a"}, ("a", "c")),
        ("multiple", "CA", ("a", "c")),
        ("multiple", ["a", "a"], ("a",)),
    ],
)
def test_answers_are_read_in_several_forms(kind: str, answer: object, value: object) -> None:
    item = drawn(of_kind(kind)[0]).item
    assert item.read(answer) == value


@pytest.mark.parametrize(
    ("kind", "answer"),
    [
        *itertools.product(KINDS, (..., None, 3 + 2j, {"a": 1}, b"a")),
        *itertools.product(("single", "multiple", "order"), ("z", "durability transient local", ["a", 3], 2, "")),
        *itertools.product(("single", "order"), (["a", "b"], [], "a b a")),
        *itertools.product(
            ("numeric",),
            ("many", "3,5", "1 furlong", math.nan, math.inf, True, "", [3.0], "1e999", "-", 10**400, "1" + 300 * " "),
        ),
        *itertools.product(("code",), ("def f(): pass", 3.0, "len")),
    ],
)
def test_what_cannot_be_read_is_said(kind: str, answer: object) -> None:
    d = drawn(of_kind(kind)[0])
    with pytest.raises(InputError) as caught:
        mark(d, answer)
    assert caught.value.what == "q01" and caught.value.fix


@pytest.mark.parametrize(
    ("answer", "unit", "value"),
    [
        ("3.5 ms", "ms", 3.5),
        ("0.0035 s", "ms", 3.5),
        ("3500 µs", "ms", 3.5),
        ("3500us", "ms", 3.5),
        (3.5, "ms", 3.5),
        (np.float32(0.5), "s", 0.5),
        ("2", "W", 2.0),
        ("−10 °", "deg", -10.0),
        ("3.141592653589793 rad", "deg", 180.0),
        ("36 km/h", "m/s", 10.0),
        ("25 %", "", 0.25),
        ("0.25", "", 0.25),
        (25, "%", 25.0),
        ("1 GiB", "MB", 1073.741824),
        ("8 Mbit/s", "MB/s", 1.0),
        ("1e3 gflops", "TFLOPS", 1.0),
        (".5 h", "min", 30.0),
        ("1.2E-3 J", "mJ", 1.2),
    ],
)
def test_units(answer: object, unit: str, value: float) -> None:
    assert units.parse(answer, unit) == pytest.approx(value, rel=1e-6)


def test_a_unit_of_another_quantity_is_refused() -> None:
    for answer, unit in (("3 ms", "W"), ("3 W", "mJ"), ("3 TOPS", "TFLOPS"), ("3 m", "m/s"), ("3 MB", "MB/s")):
        with pytest.raises(InputError, match="units:"):
            units.parse(answer, unit)
    for quantity, sizes in units.UNITS.items():
        for unit in sizes:
            assert units.quantity_of(unit) == quantity  # no unit means two things


def test_prefix_and_sign_are_named() -> None:
    d = drawn(GRADED_BANK["pc-stopping"])
    wanted = evaluate(d.question.answer, d.values)
    assert mark(d, 1000 * wanted).key == "pc-stopping-prefix"
    assert mark(d, -wanted).key == "pc-stopping-sign"
    assert mark(d, 1.37 * wanted).key == "pc-stopping-other"


# ---------------------------------------------------------------- malformed banks

GOOD = """
topic = "ddpg"
[[question]]
id = "a-b"
kind = "numeric"
objective = "learn"
difficulty = 1
text = "Twice {x}?"
parameters = { x = [1, 2] }
answer = "2 * x"
unit = "s"
slips = [["x", "You forgot to double it."]]
explain = "Two times."
reread = "Six lines"
"""
GOOD_SINGLE = """
[[question]]
topic = "ddpg"
id = "c"
kind = "single"
objective = "learn"
difficulty = 2
text = "Which?"
right = "one"
wrong = [["two", "Because it is two."], ["three", "Because it is three."]]
explain = "It is one."
reread = "Six lines"
"""


@pytest.mark.parametrize(
    ("text", "old", "new", "match"),
    [
        (GOOD, "[[question]]", "[[question]", "TOML"),
        (GOOD, "[[question]]", "[[questions]]", "tables"),
        (GOOD, 'id = "a-b"\n', "", "id"),
        (GOOD, '"a-b"', '"A b"', "hyphens"),
        (GOOD, '"ddpg"', '"cooking"', "topic"),
        (GOOD, '"numeric"', '"essay"', "essay"),
        (GOOD, '"learn"', '"relax"', "objective"),
        (GOOD, "difficulty = 1", "difficulty = 9", "difficulty"),
        (GOOD, "difficulty = 1", 'difficulty = "hard"', "layout"),
        (GOOD, 'explain = "Two times."', "", "explain"),
        (GOOD, '"Two times."', '" "', "explain"),
        (GOOD, "Twice {x}", "Twice {y}", "parameters"),
        (GOOD, "2 * x", "2 * z", "formula"),
        (GOOD, "2 * x", "__import__('os').getpid()", "formula"),
        (GOOD, "2 * x", "x / 0", "formula"),
        (GOOD, "2 * x", "x - x", "no meaning"),
        (GOOD, "2 * x", "9 ** 9 ** 9 ** 9.0 * x", "formula"),
        (GOOD, '["x", ', '["x + x", ', "nearly"),
        (GOOD, '["x", ', '["2.08 * x", ', "nearly"),
        (GOOD, '[["x", "You forgot to double it."]]', "[]", "mistake"),
        (GOOD, '"You forgot to double it."', '""', "reason"),
        (GOOD, 'unit = "s"', 'unit = "parsec"', "unit"),
        (GOOD, 'unit = "s"', 'unit = "s"\ntolerance = 0', "tolerance"),
        (GOOD, 'unit = "s"', 'unit = "s"\nunits = "s"', "units"),
        (GOOD, "{ x = [1, 2] }", "3", "layout"),
        (GOOD_SINGLE, ', ["three", "Because it is three."]', "", "options"),
        (GOOD_SINGLE, '"three", "Because', '"two", "Because', "different"),
        (GOOD_SINGLE, ', "Because it is two."', "", "layout"),
        (GOOD_SINGLE, 'right = "one"\n', "", "right"),
    ],
)
def test_a_malformed_bank_is_refused_in_words(text: str, old: str, new: str, match: str) -> None:
    assert parse_bank(text, "good.toml")
    assert old in text
    with pytest.raises(InputError, match=match):
        parse_bank(text.replace(old, new), "bad.toml")


def test_orders_and_functions_are_checked_too() -> None:
    common = 'topic="ddpg"\nid="x"\nobjective="learn"\ndifficulty=1\ntext="t"\nexplain="e"\nreread="r"\n'
    order = f'[[question]]\nkind="order"\n{common}steps=["a","b","c","d"]\nbecause=["1","2","3"]\n'
    code = (
        f'[[question]]\nkind="code"\n{common}function="def answer(x):"\nreference="def answer(x): return x"\n'
        'cases=[[1],[2],[3]]\nslips=[["def answer(x): return 2*x", "why"]]\n'
    )
    for good, old, new in (
        (order, '"1","2","3"', '"1","2"'),
        (order, '"c","d"', '"c","c"'),
        (code, "def answer(x): return x", "def other(x): return x"),
        (code, "def answer(x): return x", "def answer(x) return x"),
        (code, "[[1],[2],[3]]", "[[1]]"),
        (code, '"def answer(x):"', '"answer(x)"'),
    ):
        assert parse_bank(good, "good")
        with pytest.raises(InputError):
            parse_bank(good.replace(old, new, 1), "bad")


def test_an_id_twice_and_an_empty_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="folder with"):
        load_bank(tmp_path)
    for name in ("a", "b"):
        (tmp_path / f"{name}.toml").write_text(GOOD, encoding="utf-8")
    with pytest.raises(InputError, match="no other question"):
        load_bank(tmp_path)


# ---------------------------------------------------------------- papers and records


def test_a_paper_survives_its_file_and_no_change_to_it(tmp_path: Path) -> None:
    made = draw(GRADED_BANK, "s", student="ada")
    path = made.paper.save(tmp_path / "paper.json")
    assert Paper.load(path) == made.paper == open_paper(path)
    text = path.read_text(encoding="utf-8")
    for broken in (
        text.replace("q07", "q08", 1),
        text[:-40],
        "[]",
        "",
        '{"format": 2}',
        text.replace("single", "singular", 1),
    ):
        path.write_text(broken, encoding="utf-8")
        with pytest.raises(InputError, match=r"paper\.json"):
            Paper.load(path)
    assert open_paper(tmp_path / "none.json").practice


@pytest.fixture
def autograder(tmp_path: Path) -> Path:
    """An autograder folder with bank and hidden tests, in which papers can be drawn."""
    folder = tmp_path / "autograder"
    ignored = shutil.ignore_patterns("draws.json")
    shutil.copytree(REPO / "autograder" / FOLDER, folder / FOLDER, ignore=ignored)
    (folder / "hidden").mkdir()
    shutil.copy(REPO / "autograder" / "hidden" / "assessment.py", folder / "hidden")
    return folder


def test_two_students_get_different_papers_and_keep_them(autograder: Path) -> None:
    first = draw_class(autograder, ["ada", "alan"])
    assert first["ada"].paper.code != first["alan"].paper.code
    again = draw_class(autograder, ["alan", "ada", "mary"], "ignored for those who have one")
    assert all(again[s].paper == first[s].paper for s in first)
    assert recorded_draw(autograder, "ada").paper == first["ada"].paper
    with pytest.raises(InputError, match="paper was drawn"):
        recorded_draw(autograder, "eve")
    seeded = [draw(GRADED_BANK, "term/ada").paper.code, again["mary"].paper.code]
    assert len(set(seeded)) == 2
    # A question more leaves papers as they are, and so does a mended key; another text does not.
    path = autograder / FOLDER / "ddpg.toml"
    text = path.read_text(encoding="utf-8")
    path.write_text(text + GOOD.partition("\n[[")[2].join(("\n[[", "")), encoding="utf-8")
    assert recorded_draw(autograder, "ada").paper == first["ada"].paper
    drawn_id = next(d for d in first["ada"].questions if d.question.topic == "ddpg")
    changed = text.replace(drawn_id.question.text.splitlines()[0][:30], "Now then: " + drawn_id.question.text[:30], 1)
    path.write_text(changed, encoding="utf-8")
    with pytest.raises(InputError, match="changed since"):
        recorded_draw(autograder, "ada")


def test_marks_go_by_the_recorded_draw(autograder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    draws = draw_class(autograder, ["ada", "alan"], "term")
    monkeypatch.setenv("ROBOTBRAIN_AUTOGRADER", str(autograder))
    complete = load_hidden_suite("assessment", autograder)

    def points(student: str, answers: dict[str, Any], paper: Paper) -> float:
        monkeypatch.setenv("NBGRADER_STUDENT", student)
        lab = Lab("assessment", {**answers, "paper": paper}, suite=complete)
        return sum(lab.score(topic, hidden=True).report.earned for topic in TOPICS)

    own = {s: answers_of(d) for s, d in draws.items()}
    ada, practice = draws["ada"].paper, practice_draw()
    assert points("ada", own["ada"], ada) == pytest.approx(100)
    assert points("ada", own["ada"], practice.paper) == pytest.approx(100)  # whatever paper the notebook says it has
    assert points("ada", own["alan"], draws["alan"].paper) < 55
    assert points("ada", answers_of(practice), practice.paper) < 55
    assert points("eve", own["ada"], ada) == 0
    assert points("ada", {}, ada) == 0
    one_wrong = own["ada"] | {"q01": answers_of(draws["alan"])["q01"]}
    single = draws["ada"]["q01"]
    if single.question.kind == "single":
        one_wrong["q01"] = next(x for x in single.item.letters if x != right_answer(single))
        assert points("ada", one_wrong, ada) == pytest.approx(100 - 4.75)


def test_feedback_names_the_misconception(autograder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = draw_class(autograder, ["ada"], "term 2")["ada"]
    monkeypatch.setenv("ROBOTBRAIN_AUTOGRADER", str(autograder))
    monkeypatch.setenv("NBGRADER_STUDENT", "ada")
    d = next(d for d in made.questions if d.question.kind == "single")
    wrong = next(i for i, o in enumerate(d.question.options) if not o.right)
    answers = answers_of(made) | {d.item.name: d.letters_of([wrong])[0], "paper": made.paper}
    complete = load_hidden_suite("assessment", autograder)
    report = Lab("assessment", answers, suite=complete).score(d.question.topic, hidden=True).report
    (failed,) = [r for r in report.results if not r.passed]
    assert failed.hint_key == f"{d.question.id}-option-{wrong}"
    assert failed.hint == advice(d.question, failed.hint_key) and d.question.options[wrong].why in failed.hint


def test_the_visible_check_tells_form_on_a_paper_and_reasons_in_practice() -> None:
    made, practice = draw(GRADED_BANK, "s"), practice_draw()
    d, p = made.questions[0], practice.questions[0]
    wrong = next(x for x in p.item.letters if x != right_answer(p))
    for paper, answers in ((made.paper, dict.fromkeys(made.paper.names, "b")), (practice.paper, answers_of(practice))):
        told = Lab("assessment", {**answers, "q01": wrong, "paper": paper}).check("architecture")
        text = told.results[0].message
        if paper.practice:
            assert not told.full and p.question.explain in text
        else:
            assert all(option.why not in text for option in d.question.options)


def test_lists_of_students(tmp_path: Path) -> None:
    path = tmp_path / "students.csv"
    path.write_text("id,name\nada,Ada L.\nalan,Alan T.\n# left\n\n", encoding="utf-8")
    assert read_students(path) == ["ada", "alan"]
    for bad in ("", "ada\nada\n", "../up\n", "a b\n"):
        path.write_text(bad, encoding="utf-8")
        with pytest.raises(InputError):
            read_students(path)


def test_the_command_draws_checks_and_shows_the_key(
    tmp_path: Path, autograder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("robotbrain.assessment.commands.course_autograder", lambda _: autograder)
    students = tmp_path / "students.txt"
    students.write_text("ada\nalan\n", encoding="utf-8")
    out = tmp_path / "papers"
    assert main(["assessment", "draw", "--students", str(students), "--out", str(out), "--seed", "term"]) == 0
    papers = [Paper.load(out / s / "assessment" / "paper.json") for s in ("ada", "alan")]
    assert papers[0].code != papers[1].code and papers[0].student == "ada"
    record = json.loads((autograder / FOLDER / "draws.json").read_text(encoding="utf-8"))
    assert record["students"]["ada"]["code"] == papers[0].code
    assert main(["assessment", "check"]) == 0
    assert main(["assessment", "key", "ada"]) == 0
    shown = capsys.readouterr().out
    assert papers[0].code in shown and shown.count("**Why:**") == len(papers[0].items)
    keys = tmp_path / "keys"
    assert main(["assessment", "key", "--out", str(keys)]) == 0
    made = recorded_draw(autograder, "alan")
    text = (keys / "alan" / "assessment" / "key.md").read_text(encoding="utf-8")
    assert all(d.question.explain in text and d.item.text.strip() in text for d in made.questions)


# ---------------------------------------------------------------- the notebook


def test_the_form_writes_the_line_to_type() -> None:
    pytest.importorskip("ipywidgets")
    for kind in ("single", "multiple", "numeric", "order"):
        item = drawn(of_kind(kind)[0]).item
        *inputs, line = make_form(item).children
        if kind == "single":
            inputs[0].value = "b"
        elif kind == "multiple":
            inputs[0].value = inputs[2].value = True
        elif kind == "order":
            for field, letter in zip(inputs, reversed(item.letters), strict=True):
                field.value = letter
        else:
            inputs[0].value = "2.5"
        names: dict[str, Any] = {}
        exec(line.value, names)
        item.read(names["q01"])


@pytest.mark.parametrize("grading", [False, True])
def test_a_question_is_shown_as_text_too(grading: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ipywidgets")
    shown: list[Any] = []
    monkeypatch.setattr("IPython.display.display", lambda value, **_: shown.append(value))
    if grading:
        monkeypatch.setenv("NBGRADER_EXECUTION", "autograde")
    paper = practice_draw().paper
    show(paper, "q01")
    assert shown[0] == dict.fromkeys(("text/markdown", "text/plain"), paper["q01"].markdown())
    assert len(shown) == (1 if grading else 2)  # no form while grading
    with pytest.raises(InputError, match="question"):
        show(paper, "q99")


def test_a_review_tells_reasons_in_practice_only() -> None:
    practice = practice_draw()
    rows = review(practice.paper, answers_of(practice)).rows
    assert all(said.startswith("Right.") for *_, said in rows)
    assert "not answered yet" in repr(review(practice.paper, {}))
    made = draw(GRADED_BANK, "s")
    text = review(made.paper, answers_of(made))._repr_markdown_()
    assert text.count("can be read") == len(made.questions)
    assert not any(d.question.explain in text for d in made.questions)


def test_the_notebook_has_the_papers_names_and_the_practice_key(repo: Path) -> None:
    notebook = nbformat.read(repo / "solutions" / "assessment" / "assessment.ipynb", as_version=4)
    names: dict[str, Any] = {"math": math}
    answered = [c for c in notebook.cells if c.metadata.get("nbgrader", {}).get("solution")]
    assert [c.metadata.nbgrader.grade_id for c in answered] == list(practice_draw().paper.names)
    assert [n for topic in TOPICS for n in NAMES[topic]] == list(practice_draw().paper.names)
    for cell in answered:
        exec(cell.source, names)
    assert all(mark(d, names[d.item.name]).right for d in practice_draw().questions)
    points = sum(c.metadata.nbgrader.points for c in notebook.cells if c.metadata.get("nbgrader", {}).get("grade"))
    assert points == 100


@pytest.mark.timeout(300)
def test_a_class_is_graded(repo: Path, tmp_path: Path) -> None:
    if (repo / "autograder" / FOLDER / "draws.json").exists():
        pytest.skip("papers were drawn here: the practice paper does not count")
    kinds = {f"{d.question.id}": d.question.kind for d in practice_draw().questions}
    seen: set[str] = set()

    def keep(entry: dict[str, Any]) -> bool:
        kind = kinds.get(re.sub(r"-(option|slip|step)-\d+$", "", entry["name"]), "")
        first = entry["kind"] == "mutant" and kind not in seen
        seen.add(kind)
        return first or entry["kind"] in ("reference", "style", "stub")

    graded = classes.grade_sample(repo, "assessment", tmp_path / "class", keep)
    classes.check_losses(graded, at_least=8)
    classes.check_pages(graded, "assessment")


# ---------------------------------------------------------------- the key stays at home


def shipped(repo: Path) -> list[Path]:
    folders = ("labs", "src", "course", "solutions", "book")
    suffixes = {".py", ".toml", ".json", ".ipynb", ".md", ".txt", ".html"}
    return [
        p
        for f in folders
        for p in (repo / f).rglob("*")
        if p.suffix in suffixes and p.is_file() and "_build" not in p.parts
    ]


def test_nothing_that_ships_holds_the_key(repo: Path) -> None:
    sentences = {s for q in GRADED_BANK.questions for s in (q.explain, *reasons(q).values()) if len(s) > 25}
    sentences -= {s for q in PRACTICE_BANK.questions for s in (q.explain, *reasons(q).values())}
    sentences |= {json.dumps(s)[1:-1] for s in sentences} | {json.dumps(s, ensure_ascii=False)[1:-1] for s in sentences}
    course = " ".join(p.read_text(encoding="utf-8") for p in (repo / "course").glob("*.ipynb"))
    files = shipped(repo)
    assert len(files) > 100
    for path in files:
        text = path.read_text(encoding="utf-8", errors="replace")
        found = [s for s in sentences if s in text and s not in course]
        assert not found, f"{path}: {found[:2]}"
        assert not re.search(r"autograder[/\\.]assessment[/\\.](?!`|\s)\w+\.toml", text), path
    assert not list((repo / "labs").rglob("draws.json")) and not list((repo / "labs").rglob("paper.json"))
    banks = [p for p in (repo / "src").rglob("*.toml") if "[[question]]" in p.read_text(encoding="utf-8")]
    assert [p.name for p in banks] == ["practice.toml"]


def test_a_paper_holds_questions_only(tmp_path: Path) -> None:
    for seed in range(20):
        made = draw(GRADED_BANK, str(seed))
        content = json.loads(made.paper.save(tmp_path / "paper.json").read_text(encoding="utf-8"))
        assert set(content) == {"format", "code", "student", "practice", "questions"}
        text = json.dumps(content, ensure_ascii=False)
        for entry, d in zip(content["questions"], made.questions, strict=True):
            assert set(entry) == {"name", "topic", "kind", "text", "options", "unit", "function"}
            assert d.question.id not in text and d.question.explain not in text
            assert all(why not in text for why in reasons(d.question).values())


def test_without_the_autograder_the_package_knows_no_key(tmp_path: Path) -> None:
    code = (
        "from robotbrain.assessment.bank import practice_bank\n"
        "from robotbrain.assessment.records import open_paper, recorded_draw\n"
        "from robotbrain.grading import load_suite\nimport sys\n"
        "suite = load_suite('assessment')\n"
        "print(len(practice_bank().questions), open_paper().practice, len(suite.hints), end=' ')\n"
        "print(recorded_draw('.', 'ada').paper.practice)\n"
        "print([m for m in sys.modules if 'autograder' in m or '_hidden_' in m])"
    )
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("ROBOTBRAIN", "NBGRADER"))}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True, env=environment
    )
    assert done.stdout.split("\n")[:2] == ["20 True 1 True", "[]"]


def test_bank_is_a_bank() -> None:
    assert isinstance(GRADED_BANK, Bank) and not GRADED_BANK.practice and PRACTICE_BANK.practice
    with pytest.raises(InputError, match="id of the bank"):
        GRADED_BANK["no-such"]
