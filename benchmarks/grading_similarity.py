"""How well the similarity report tells copies from honest work, and how long 200 submissions take.

Honest pairs are different right answers to the same exercises: the reference and the labs' `styles`. Copies are the
same answers with other names, comments and layout, functions in another order and cells cut in two.

Run from the repository's top folder: python benchmarks/grading_similarity.py
"""

from __future__ import annotations

import itertools
import random
import sys
import time
from pathlib import Path

import numpy as np

REPO = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPO))

from tests.grading.disguise import disguise  # noqa: E402

from robotbrain.grading import intake, sample  # noqa: E402
from robotbrain.grading.course import find_course  # noqa: E402
from robotbrain.grading.reports.similarity import Pair, compare_class, given_code  # noqa: E402
from robotbrain.grading.reports.tokens import read_code  # noqa: E402
from robotbrain.grading.reports.winnowing import base_of, compare, fingerprint  # noqa: E402

Answers = dict[str, dict[str, str]]  # exercise -> style -> source


def answers_of(lab: str) -> tuple[Answers, list[str]]:
    """The different right answers of a lab, and the code that its release gives."""
    course = find_course(REPO)
    reference = sample.Reference(course, lab)
    found: Answers = {}
    for notebook in reference.notebooks.values():
        for cell in notebook.cells:
            if (name := intake.grade_id(cell)) in reference.answers() and cell.cell_type == "code":
                found[name] = {"reference": cell.source}
    for style in sample.load_mutants(course, lab)[1]:
        for name, source in style.replace.items():
            if name in found and isinstance(source, str):
                found[name][style.name] = source
    return found, [s for nb in reference.stubs.values() for s in given_code(nb.cells)]


def share(a: list[str], b: list[str], given: list[str]) -> tuple[float, bool]:
    """What the report would say of a pair in a class where nothing else is common."""
    base = base_of([read_code("", given)])
    one, two = read_code("a", a), read_code("b", b)
    pair = Pair(one, two, compare(fingerprint(one, base), fingerprint(two, base)))
    return pair.match.share, pair.notable


def main() -> None:
    labs = {lab: answers_of(lab) for lab in find_course(REPO).labs()}
    kinds = ("honest, one exercise", "honest, whole lab", "copy, disguised", "copy of 1 in 3 exercises")
    rows: dict[str, list[tuple[float, bool]]] = {kind: [] for kind in kinds}
    for answers, given in labs.values():
        for styles in answers.values():
            rows["honest, one exercise"] += [
                share([a], [b], given) for a, b in itertools.combinations(styles.values(), 2)
            ]
        for a, b in _apart(answers):
            rows["honest, whole lab"].append(share(a, b, given))
            for seed in range(4):
                rows["copy, disguised"].append(share(a, disguise(a, seed), given))
                taken = [y if i % 3 == seed % 3 else x for i, (x, y) in enumerate(zip(b, a, strict=True))]
                rows["copy of 1 in 3 exercises"].append(share(a, disguise(taken, seed), given))
    print(f"{'pairs':<28}{'n':>5}{'median':>9}{'largest':>9}{'smallest':>10}{'marked':>9}")
    for name, found in rows.items():
        shares = np.array([s for s, _ in found])
        marked = sum(m for _, m in found)
        print(f"{name:<28}{len(found):>5}{np.median(shares):>9.2f}{shares.max():>9.2f}{shares.min():>10.2f}{marked:>9}")
    time_200(*labs["hw1_rl"])


def _apart(answers: Answers) -> list[tuple[list[str], list[str]]]:
    """Pairs of whole labs that answer every exercise differently, as far as there are two answers."""
    several = [list(styles.values()) for styles in answers.values() if len(styles) > 1]
    most = max(map(len, several))
    return [
        ([styles[i % len(styles)] for styles in several], [styles[(i + 1) % len(styles)] for styles in several])
        for i in range(most)
    ]


def time_200(answers: Answers, given: list[str]) -> None:
    """Time a class of 200: random answers, each disguised anew, with 5 pairs of copies in it."""
    rng = random.Random(1)
    students = {
        f"s{i:03}": disguise([rng.choice(list(styles.values())) for styles in answers.values()], i) for i in range(195)
    }
    students |= {f"copy{i}": disguise(students[f"s{i:03}"], 1000 + i) for i in range(5)}
    lines = sum(source.count("\n") + 1 for cells in students.values() for source in cells)
    start = time.perf_counter()
    result = compare_class(students, given=[given])
    print(f"\n{len(students)} submissions of {lines // len(students)} lines: {time.perf_counter() - start:.1f} s")
    print(f"median pair {result.typical:.2f}, 95th percentile {result.high:.2f}; common passages {len(result.common)}")


if __name__ == "__main__":
    main()
