"""How `hw1_rl` tests a replay buffer and what is put into it.

Transitions are random numbers, drawn anew for each student, so that nobody can make them up; each field of a row that
comes back is looked up by itself, so that a row put together from two is seen at once. The tests know nothing of how a
buffer draws: they look at what comes out, and bounds on random numbers are such that a right answer fails with a
probability below ``tools.FALSE_ALARM``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import stats
from torch import Tensor

from robotbrain.grading import expect, expect_close, fail
from robotbrain.grading.suites import hw1_rl_probes as probes
from robotbrain.grading.suites import hw1_rl_tools as tools

OBS, ACT = 3, 2
FIELDS = probes.Batch._fields
UNWRITTEN = -2
"""Number of a row that holds zeros or NaN, as arrays do that nobody has written yet."""
UNKNOWN = -1


class Transitions:
    """Transitions of random numbers, by number; obs, action, reward, next_obs and terminated."""

    def __init__(self, rng: np.random.Generator, count: int) -> None:
        def noise(*shape: int) -> NDArray[np.float32]:
            return (rng.normal(size=(count, *shape)) + 3.0 * rng.choice((-1, 1), (count, *shape))).astype(np.float32)

        self.fields = [noise(OBS), noise(ACT), noise(), noise(OBS), (rng.random(count) < 0.3).astype(np.float32)]
        columns = [field.reshape(count, -1) for field in self.fields[:4]]
        self._columns = columns
        self._order = [np.argsort(column[:, 0], kind="stable") for column in columns]

    def block(self, first: int, count: int) -> list[NDArray[np.float32]]:
        """Return ``count`` transitions from number ``first`` on."""
        return [field[first : first + count] for field in self.fields]

    def blocks(self, sizes: Iterable[int]) -> list[list[NDArray[np.float32]]]:
        """Return blocks of these sizes, one after the other."""
        sizes = list(sizes)
        ends = np.cumsum(sizes)
        return [self.block(int(end) - size, size) for size, end in zip(sizes, ends, strict=True)]

    def numbers(self, field: int, values: NDArray[np.float32]) -> NDArray[np.int64]:
        """Return the numbers of the transitions that rows of a field belong to, or UNKNOWN, or UNWRITTEN."""
        rows, table, order = values.reshape(len(values), -1), self._columns[field], self._order[field]
        place = np.searchsorted(table[order, 0], rows[:, 0])
        found = order[np.minimum(place, len(table) - 1)]
        found = np.where(np.all(table[found] == rows, axis=1), found, UNKNOWN)
        return np.where(np.any((rows == 0) | np.isnan(rows), axis=1), UNWRITTEN, found)


def _check_form(fields: Any, size: int) -> None:
    """Check the form of one batch."""
    if not isinstance(fields, (list, tuple)) or len(fields) != len(FIELDS):
        fail("sample should return a Batch", got=fields, expected=f"Batch({', '.join(FIELDS)})")
    shapes = ((size, OBS), (size, ACT), (size,), (size, OBS), (size,))
    for name, value, shape in zip(FIELDS, fields, shapes, strict=True):
        part = tools.as_tensor(value, f"batch.{name}", shape)
        expect(part.dtype == torch.float32, f"batch.{name} should be float32, as the networks are",
               got=str(part.dtype), expected="float32", hint="shape-of-a-batch")  # fmt: skip


def rows(fields: Any, known: Transitions, size: int, unwritten: str = "not-yet-full") -> NDArray[np.int64]:
    """Check batches and that each of their rows is one transition; return which, (batches, size) or (size,).

    Args:
        fields: a tensor for each field, of one batch or of several stacked.
        known: what may come back.
        size: of a batch.
        unwritten: key of the hint for rows of zeros.
    """
    several = (
        isinstance(fields, (list, tuple))
        and len(fields) == len(FIELDS)
        and all(isinstance(field, Tensor) for field in fields)
        and fields[2].dim() == 2
    )
    _check_form([field[0] if len(field) else field for field in fields] if several else fields, size)
    flat = [field.numpy().reshape(-1, *field.shape[2 if several else 1 :]) for field in fields]
    found = {name: known.numbers(k, flat[k]) for k, name in enumerate(FIELDS[:4])}
    if any(np.any(numbers == UNWRITTEN) for numbers in found.values()):
        fail("rows came back that were never stored", hint=unwritten, got=flat[0][:4], expected="rows that were stored")
    owner = found["obs"]
    hints = {"reward": "reward-of-this-step", "next_obs": "next-obs-of-this-step"}
    for name, numbers in found.items():
        strange = np.flatnonzero((numbers == UNKNOWN) | (numbers != owner))
        if len(strange):
            row = strange[0]
            whose = f"that of transition {numbers[row]}" if numbers[row] >= 0 else "of no transition"
            fail(
                f"in a sampled row, {name} belongs to another transition than obs",
                given="transitions of random numbers",
                got=f"obs of transition {owner[row]}; {name} is {whose}",
                hint=hints.get(name, "rows-stay-together"),
                expected=f"{name} of the same transition, {owner[row]}",
            )
    flags, truth = flat[4], known.fields[4][owner]
    if np.array_equal(flags, 1 - truth):
        fail("terminated comes back inverted", got=flags[:6], expected=truth[:6], hint="stored-as-it-is")
    expect_close(flags, truth, what="batch.terminated")
    return owner.reshape(-1, size) if several else owner


def compare_content(student: Any, rng: np.random.Generator, capacity: int, sizes: Sequence[int]) -> None:
    """Add blocks of these sizes; the buffer must then hold the newest ``capacity`` transitions, and no others."""
    total = sum(sizes)
    known = Transitions(rng, total)
    kept = set(range(max(0, total - capacity), total))
    size = min(8, len(kept))
    # A transition that is there stays unseen with probability (1 - 1/n)^draws < 1e-8.
    times = int(19 * len(kept) / size) + 1
    lengths, fields = student.run(
        probes.drawn, capacity, known.blocks(sizes), size, times, seed=int(rng.integers(2**31))
    )
    given = f"capacity {capacity}; calls of add with {', '.join(map(str, sizes))} transitions"
    for length, stored in zip(lengths, np.cumsum(sizes), strict=True):
        wanted = min(int(stored), capacity)
        expect(isinstance(length, int) and length == wanted, "this is not how many transitions it holds", got=length,
               expected=wanted, given=given, hint="a-ring-has-a-size")  # fmt: skip
    # Rows of zeros in a buffer that should be full are what a block left at the end that did not fit.
    unwritten = "split-at-the-end" if total >= capacity else "not-yet-full"
    seen = {int(i) for i in rows(fields, known, size, unwritten).ravel()}
    if seen == kept:
        return
    hint = "oldest-goes"
    if seen < kept:
        hint = "whole-buffer"
    elif kept & seen and not kept <= seen and total > capacity:
        hint = "split-at-the-end" if max(sizes) > 1 else "oldest-goes"
    if max(kept) not in seen and total > capacity and not seen < kept:
        hint = "oldest-goes"
    fail(
        "the buffer does not hold the newest transitions",
        given=given,
        got=f"transitions {_span(seen)}",
        expected=f"transitions {_span(kept)}",
        hint=hint,
    )


def _span(numbers: set[int]) -> str:
    """Return {1, 2, 3, 7} as '1-3, 7'."""
    runs: list[list[int]] = []
    for number in sorted(numbers):
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    return ", ".join(f"{a}-{b}" if b > a else str(a) for a, b in runs) or "none"


def compare_uniform(
    student: Any, rng: np.random.Generator, capacity: int = 64, size: int = 16, times: int = 240
) -> None:
    """Every stored transition is equally likely, and the rows of a batch are drawn independently of each other.

    Chi-square over transitions (an upper bound only: drawing without replacement is more even than chance, and as
    good), and the spread of the batches' mean age, which neighbouring rows make larger.
    """
    sizes = [8] * ((capacity + capacity // 2) // 8) + [3]
    known = Transitions(rng, sum(sizes))
    _, fields = student.run(probes.drawn, capacity, known.blocks(sizes), size, times, seed=int(rng.integers(2**31)))
    found = rows(fields, known, size) - (sum(sizes) - capacity)
    expect(found.min() >= 0, "the buffer does not hold the newest transitions", hint="oldest-goes",
           got=f"one of {-int(found.min())} transitions before the oldest that should be there",
           expected="the newest, as many as fit")  # fmt: skip
    counts = np.bincount(found.ravel(), minlength=capacity)
    given = f"{times} batches of {size} from {capacity} transitions"
    if np.all(np.sort(found, axis=1) == np.sort(found[:1], axis=1)):
        fail("every batch is the same", given=given, hint="fresh-draws", expected="a new draw each time")
    spread = float(found.mean(axis=1).var() / (found.var() / size))
    limit = 1 + stats.norm.isf(tools.FALSE_ALARM) * np.sqrt(2 / (times - 1))
    expect(spread < limit, "the rows of a batch are not drawn independently", given=given,
           expected="mean ages of batches that scatter as chance has it", got=f"{spread:.1f} times that variance",
           hint="independent-rows")  # fmt: skip
    expected = found.size / capacity
    never = np.flatnonzero(counts == 0)
    if len(never):
        where = "the newest" if never[0] > capacity // 2 else "the oldest" if never[-1] < capacity // 2 else "some"
        fail(f"{len(never)} of {capacity} transitions are never drawn ({where} among them)", given=given,
             expected=f"each about {expected:.0f} times", got=f"between {counts.min()} and {counts.max()} times",
             hint="whole-buffer")  # fmt: skip
    chi2 = float(((counts - expected) ** 2 / expected).sum())
    expect(chi2 < stats.chi2.isf(tools.FALSE_ALARM, capacity - 1), "some transitions are drawn more often than others",
           given=given, expected=f"each about {expected:.0f} times", got=f"{counts.min()} to {counts.max()} times",
           hint="whole-buffer")  # fmt: skip


def compare_copies(student: Any, rng: np.random.Generator) -> None:
    """What was stored and what was drawn are copies: nobody else's writing changes them."""
    known = Transitions(rng, 24)
    found = student.run(probes.overwritten, 16, known.block(0, 8), known.block(8, 16), 8, seed=int(rng.integers(2**31)))
    written, before, after, returned = (list(found[key]) for key in ("written", "before", "after", "returned"))
    sizes = [len(part) for part in (written, before, after, returned)]
    expect(sizes == [4, 4, 4, 8], "batches are missing", got=sizes, expected=[4, 4, 4, 8])
    for batch in written:
        _check_form(batch, 8)
        expect(not any(bool((part == -7).any()) for part in batch),
               "what was stored changed when the caller wrote into its own array after add", hint="keep-a-copy",
               given="obs, then overwritten by the environment's next step",
               expected="what was stored, unchanged")  # fmt: skip
        rows(batch, known, 8)
    for then, now in zip(before, after, strict=True):
        rows(then, known, 8)
        same = all(torch.equal(old, new) for old, new in zip(then, now, strict=True))
        expect(same, "a batch drawn earlier changed later on", given="16 more transitions, and another batch",
               hint="batch-is-a-copy", expected="the batch as it was drawn")  # fmt: skip
    for batch in returned:
        _check_form(batch, 8)
        expect(not any(bool((part == -7).any()) for part in batch), "writing into a batch changed what is stored",
               hint="batch-is-a-copy", expected="what was stored, unchanged")  # fmt: skip


# ---------------------------------------------------------------- what to store


def a_step(rng: np.random.Generator, terminated: Iterable[bool], truncated: Iterable[bool]) -> dict[str, Any]:
    """Return what a vector environment with same-step reset hands over, as the arguments of ``store_step``."""
    ended, late = np.array(list(terminated)), np.array(list(truncated))
    n = len(ended)
    step: dict[str, Any] = {
        "obs": rng.normal(size=(n, OBS)).astype(np.float32),
        "action": rng.uniform(-1, 1, (n, ACT)).astype(np.float32),
        "next_obs": rng.normal(size=(n, OBS)).astype(np.float32),
        "reward": rng.normal(size=n).astype(np.float32),
        "terminated": ended,
        "truncated": late,
        "info": {},
    }
    if np.any(ended | late):
        final = rng.normal(size=(n, OBS)).astype(np.float32)
        mask = ended | late
        final[~mask] = np.nan  # of no meaning there: whoever uses it learns from nonsense
        step["info"] = {"final_obs": final, "_final_obs": mask}
    return step


def compare_store(student: Any, steps: Sequence[dict[str, Any]], given: str) -> None:
    """Compare what arrives in the buffer with what should."""
    for step, found in zip(steps, student.run(probes.stored, steps), strict=True):
        _compare_stored(step, found["calls"], given)


def _compare_stored(step: dict[str, Any], calls: Any, given: str) -> None:
    expect(
        len(calls) == 1,
        "store_step should call buffer.add once",
        got=f"{len(calls)} calls",
        given=given,
        expected="1 call",
    )
    obs, action, reward, next_obs, terminated = calls[0]
    expected = step["next_obs"].astype(float)
    if step["info"]:
        mask = step["info"]["_final_obs"]
        expected = np.where(mask[:, None], step["info"]["final_obs"], expected)
    swapped = np.array_equal(obs, step["next_obs"]) or np.array_equal(reward.ravel(), step["terminated"].ravel())
    expect_close(obs, step["obs"], what="obs", given=given, hint="order-of-add" if swapped else "")
    expect_close(action, step["action"], what="action", given=given)
    expect_close(reward, step["reward"], what="reward", given=given, hint="order-of-add" if swapped else "")
    both = np.array_equal(terminated, step["terminated"] | step["truncated"])
    mistake = "time-is-not-an-end" if both else "stored-as-it-is"
    expect_close(terminated, step["terminated"].astype(float), what="terminated", given=given, hint=mistake)
    lost = np.array_equal(next_obs, step["next_obs"])
    nonsense = bool(np.isnan(next_obs).any())
    hint = "final-obs" if lost else "only-where-it-ended" if nonsense else "final-obs"
    expect_close(next_obs, expected, what="next_obs", given=given, hint=hint)


def compare_untouched(student: Any, step: dict[str, Any]) -> None:
    """The arrays of the training loop are as they were: it acts on ``next_obs`` next."""
    (found,) = student.run(probes.stored, [step])
    for name in probes.STEP:
        expect(np.array_equal(step[name], found["after"][name]),
               f"{name} was changed in place; the training loop still needs it",
               given="an environment that has just begun a new episode", hint="leave-next-obs",
               expected=f"{name} as it was before")  # fmt: skip
