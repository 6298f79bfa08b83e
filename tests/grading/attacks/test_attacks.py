"""Hostile submissions among honest ones: no points, no secrets, no harm.

The whole catalogue (:mod:`tests.grading.attacks.catalogue`) is graded by one bench, side by side with honest
submissions. ``ROBOTBRAIN_ATTACKS=all`` runs every variant; otherwise each attack runs in one of its variants.
"""

from __future__ import annotations

import os
import re
import zlib
from collections import Counter, defaultdict
from collections.abc import Iterator

import pytest

from robotbrain.grading.bench import Bench
from tests.grading.attacks import interpreter, lies, patching
from tests.grading.attacks.attack import Attack
from tests.grading.attacks.catalogue import every_attack
from tests.grading.attacks.harness import LIMITS, Arena, Outcome, operator_environment, run_all, with_honest_ones
from tests.grading.attacks.unprotected import run_unprotected
from tests.grading.attacks.vault import LAB, POINTS

pytestmark = pytest.mark.timeout(1800)  # the first test waits for all submissions; on a busy machine that takes minutes
_NEEDED = ("bubblewrap", "namespaces", "seccomp", "limits", "tester")
_ALL = os.environ.get("ROBOTBRAIN_ATTACKS") == "all"


def _chosen() -> list[Attack]:
    """Every attack, or one variant of each (another for another name, always the same for the same)."""
    catalogue = every_attack()
    if _ALL:
        return catalogue
    variants: dict[tuple[str, str], list[Attack]] = defaultdict(list)
    for attack in catalogue:
        variants[attack.kind, _without_place(attack.name)].append(attack)
    return [v[zlib.crc32(name.encode()) % len(v)] for (_, name), v in variants.items()]


def _without_place(name: str) -> str:
    name = re.sub(r", (in a cell|in calls|in every call|first cell|last cell|before \w+|module beside.*)$", "", name)
    return re.sub(r"^(answers|instead of functions|leaves behind( in calls)?): ", "", name)


CHOSEN = _chosen()


@pytest.fixture(scope="module")
def arena(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Arena]:
    arena = Arena(tmp_path_factory.mktemp("arena"))
    with operator_environment(arena):
        yield arena
    arena.close()


@pytest.fixture(scope="module")
def outcomes(arena: Arena) -> dict[str, tuple[Attack, Outcome]]:
    """Every chosen attack graded, by the attack's or honest student's name."""
    with Bench(arena.vault.autograder, limits=LIMITS, preload_labs=[LAB]) as bench:
        missing = [layer for layer in bench.layers if layer.name in _NEEDED and not layer.active]
        if missing:
            pytest.skip("attacks need a sandbox: " + "; ".join(f"{layer.name}: {layer.note}" for layer in missing))
        named = with_honest_ones(CHOSEN)
        found = run_all(arena, named, bench)
    return {(s if a.kind == "honest" else a.name): (a, found[s]) for s, a in named.items()}


def test_the_catalogue_is_large_and_its_names_are_unique() -> None:
    catalogue = every_attack()
    assert len({_without_place(a.name) for a in catalogue}) >= 80
    assert max(Counter(a.name for a in catalogue).values()) == 1
    assert min(Counter(a.kind for a in catalogue).values()) >= 10


@pytest.mark.parametrize("name", [a.name for a in CHOSEN])
def test_an_attack_gains_nothing(outcomes: dict[str, tuple[Attack, Outcome]], name: str) -> None:
    attack, outcome = outcomes[name]
    assert outcome.success(attack) == ""
    if attack.keeps:
        assert outcome.losses(attack) == {}, outcome.incidents


def test_honest_submissions_among_them_keep_their_exact_grades(outcomes: dict[str, tuple[Attack, Outcome]]) -> None:
    honest = {name: (a, o) for name, (a, o) in outcomes.items() if a.kind == "honest"}
    assert len(honest) >= 4
    assert [(name, o.incidents) for name, (_, o) in honest.items() if o.incidents] == []
    assert {name: o.earned for name, (_, o) in honest.items()} == {
        name: {n: a.earns(n) for n in POINTS} for name, (a, _) in honest.items()
    }


def test_nothing_of_them_is_left(outcomes: dict[str, tuple[Attack, Outcome]], arena: Arena) -> None:
    assert outcomes
    assert arena.survivors() == []
    assert arena.litter() == []
    assert arena.changes() == []
    assert arena.knocks == []


def test_every_secret_would_be_recognised(arena: Arena) -> None:
    for kind, token in arena.vault.secrets.tokens.items():
        assert arena.vault.secrets.leaked(f"x{token}y") == [kind]
        assert arena.vault.secrets.leaked(token[::-1]) == [kind]
    assert arena.vault.secrets.leaked("7391.0625") == ["number"]
    assert arena.vault.secrets.leaked("scale(x) is 6.0") == []


_BITING = (
    "AST transformer that empties asserts and forges scores, first cell",
    "input transformer that replaces test cells, first cell",
    "replaced run_cell, in every call",
    "hooks around cells, first cell",
    "a lab of one's own, first cell",
    "values of the frames above, in every call",
    "tests found by the garbage collector, in every call",
    "raises a CheckFailure with full credit, in every call",
    "patched: numpy comparisons, in every call",
    "patched: import itself, first cell",
    "patched: runner of the package, first cell",
    "patched: report and score of the package, in every call",
    "names of the tests' tools defined by the student",
    "answers: equal to everything",
    "answers: an array interface that fits",
    "instead of functions: unittest.mock",
)


def test_the_attacks_work_where_nothing_protects(arena: Arena) -> None:
    """In one process with the tests, as stock nbgrader runs them, these get points for wrong answers."""
    attacks = [a for a in interpreter.attacks() + patching.attacks() + lies.attacks() if a.name in _BITING]
    submissions = {}
    for attack in attacks:
        notebook = attack.notebook(arena.vault, arena.paths)
        cells = [c.source for c in notebook.cells if c.cell_type == "code"]
        submissions[attack.name] = [
            re.sub(r'^lab\.score\("(\w+)"\)$', r'lab.score("\1", hidden=True)', source) for source in cells
        ]
    gained = {name: sum(r["points"].values()) for name, r in run_unprotected(arena.vault, submissions).items()}
    assert {name for name, points in gained.items() if points > 5} == set(_BITING)
