"""How `hw1_rl` tests a replay buffer and what is put into it.

Every number of transition ``i`` tells that it belongs to ``i``, so that a row put together from two is seen at once.
The tests know nothing of how a buffer draws: they look at what comes out, and bounds on random numbers are such that a
right answer fails with a probability below ``tools.FALSE_ALARM``.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robotbrain.grading import expect, expect_close, fail
from robotbrain.grading.suites import hw1_rl_tools as tools

OBS, ACT = 3, 2
FIELDS = ("obs", "action", "reward", "next_obs", "terminated")


def transitions(first: int, count: int) -> tuple[NDArray[np.float32], ...]:
    """Return transitions ``first`` to ``first + count - 1``: obs, action, reward, next_obs, terminated."""
    i = np.arange(first, first + count)
    columns = 10 * i[:, None] + np.arange(OBS)
    return (
        (columns + 1).astype(np.float32),
        (-columns[:, :ACT] - 1).astype(np.float32),
        (i + 10_000).astype(np.float32),
        (columns + 100_000).astype(np.float32),
        (i % 3 == 0).astype(np.float32),
    )


def fill(buffer: Any, count: int, per_call: int, first: int = 0) -> None:
    """Add transitions ``first`` to ``first + count - 1``, ``per_call`` at a time (fewer in the last call)."""
    for begin in range(first, first + count, per_call):
        buffer.add(*transitions(begin, min(per_call, first + count - begin)))


def rows(batch: Any, size: int, unwritten: str = "not-yet-full") -> NDArray[np.int64]:
    """Check the form of a batch and that each of its rows is one transition; return which.

    Args:
        batch: what ``sample`` returned.
        size: of the batch.
        unwritten: key of the hint for rows of zeros.
    """
    if not all(hasattr(batch, name) for name in FIELDS):
        fail("sample should return a Batch", got=type(batch).__name__, expected=f"Batch({', '.join(FIELDS)})")
    shapes = ((size, OBS), (size, ACT), (size,), (size, OBS), (size,))
    parts = {
        name: tools.as_tensor(getattr(batch, name), f"batch.{name}", shape).detach().numpy()
        for name, shape in zip(FIELDS, shapes, strict=True)
    }
    for name in FIELDS:
        expect(parts[name].dtype == np.float32, f"batch.{name} should be float32, as the networks are",
               got=str(parts[name].dtype), expected="float32", hint="shape-of-a-batch")  # fmt: skip
    owner = {
        "obs": (parts["obs"] - 1 - np.arange(OBS)) / 10,
        "action": (-parts["action"] - 1 - np.arange(ACT)) / 10,
        "reward": (parts["reward"] - 10_000)[:, None],
        "next_obs": (parts["next_obs"] - 100_000 - np.arange(OBS)) / 10,
    }
    if any(np.any(parts[name] == 0) for name in ("obs", "action", "reward", "next_obs")):
        fail("rows came back that were never stored", hint=unwritten, got=parts["obs"][:4])
    found = owner["obs"][:, 0]
    hints = {"action": "rows-stay-together", "reward": "reward-of-this-step", "next_obs": "next-obs-of-this-step"}
    for name, belongs in owner.items():
        strange = np.flatnonzero(np.any(belongs != found[:, None], axis=1))
        if len(strange):
            row = strange[0]
            fail(
                f"in a sampled row, {name} belongs to another transition than obs",
                given="obs, action, reward and next_obs that all carry the number of their transition",
                got=f"obs of transition {found[row]:g} beside {name} of transition {belongs[row, 0]:g}",
                hint=hints.get(name, "rows-stay-together"),
            )
    flags = parts["terminated"]
    truth = (found % 3 == 0).astype(np.float32)
    if np.array_equal(flags, 1 - truth):
        fail("terminated comes back inverted", got=flags[:6], expected=truth[:6], hint="stored-as-it-is")
    expect_close(flags, truth, what="batch.terminated")
    return found.astype(np.int64)


def draws(buffer: Any, size: int, times: int, unwritten: str = "not-yet-full") -> NDArray[np.int64]:
    """Return the numbers of the transitions in ``times`` batches, (times, size)."""
    return np.stack([rows(buffer.sample(size), size, unwritten) for _ in range(times)])


def compare_content(cls: Any, capacity: int, calls: Iterable[int]) -> None:
    """Add ``calls`` transitions each; the buffer must then hold the newest ``capacity`` of them, and no others."""
    sizes = list(calls)
    buffer = cls(capacity, OBS, ACT)
    given = f"capacity {capacity}; calls of add with {', '.join(map(str, sizes))} transitions"
    total = 0
    for size in sizes:
        buffer.add(*transitions(total, size))
        total += size
        expect(len(buffer) == min(total, capacity), "this is not how many transitions it holds", got=len(buffer),
               expected=min(total, capacity), given=given, hint="a-ring-has-a-size")  # fmt: skip
    kept = set(range(max(0, total - capacity), total))
    size = min(8, len(kept))
    # A transition that is there stays unseen with probability (1 - 1/n)^draws < 1e-10.
    times = int(25 * len(kept) / size) + 1
    # Rows of zeros in a buffer that should be full are what a block left at the end that did not fit.
    unwritten = "split-at-the-end" if total >= capacity else "not-yet-full"
    seen = {int(i) for i in draws(buffer, size, times, unwritten).ravel()}
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


def compare_uniform(cls: Any, capacity: int = 200, size: int = 50, times: int = 800) -> None:
    """Every stored transition is equally likely, and the rows of a batch are drawn independently of each other.

    Chi-square over transitions (an upper bound only: drawing without replacement is more even than chance, and as
    good), and the spread of the batches' mean age, which neighbouring rows make larger.
    """
    from scipy import stats

    buffer = cls(capacity, OBS, ACT)
    stored = capacity + capacity // 2 + 3
    fill(buffer, stored, 8)
    found = draws(buffer, size, times) - (stored - capacity)
    counts = np.bincount(found.ravel(), minlength=capacity)[:capacity]
    given = f"{times} batches of {size} from {capacity} transitions"
    if np.all(np.sort(found, axis=1) == np.sort(found[:1], axis=1)):
        fail("every batch is the same", given=given, hint="fresh-draws")
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


def compare_copies(cls: Any) -> None:
    """What was stored and what was drawn are copies: nobody else's writing changes them."""
    buffer = cls(16, OBS, ACT)
    arrays = transitions(0, 8)
    buffer.add(*arrays)
    for array in arrays:
        array[...] = -7  # as an environment does that reuses its arrays
    with_old = [buffer.sample(8) for _ in range(4)]
    if any(np.any(np.asarray(batch.obs) == -7) for batch in with_old):
        fail("what was stored changed when the caller wrote into its own array after add", hint="keep-a-copy",
             given="obs, then overwritten by the environment's next step")  # fmt: skip
    known = [rows(batch, 8) for batch in with_old]
    fill(buffer, 16, 8, first=8)
    buffer.sample(8)
    for batch, before in zip(with_old, known, strict=True):
        now = (np.asarray(batch.obs)[:, 0] - 1) / 10
        expect(np.array_equal(now, before), "a batch drawn earlier changed later on",
               given="16 more transitions, and another batch", hint="batch-is-a-copy")  # fmt: skip
    for _ in range(4):
        batch = buffer.sample(16)
        for name in FIELDS:
            getattr(batch, name).fill_(-7.0)
    later = [np.asarray(buffer.sample(8).obs) for _ in range(8)]
    expect(not any(np.any(obs == -7) for obs in later), "writing into a batch changed what is stored",
           hint="batch-is-a-copy")  # fmt: skip


# ---------------------------------------------------------------- what to store


class Recorder:
    """A buffer that keeps what it is given."""

    def __init__(self) -> None:
        self.calls: list[tuple[NDArray[np.float64], ...]] = []

    def add(self, obs: Any, action: Any, reward: Any, next_obs: Any, terminated: Any) -> None:
        """Keep copies."""
        values = (obs, action, reward, next_obs, terminated)
        self.calls.append(tuple(np.array(value, dtype=float) for value in values))


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


def compare_store(store: Any, step: dict[str, Any], given: str) -> None:
    """Compare what arrives in the buffer with what should."""
    recorder = Recorder()
    arrays = {name: step[name].copy() for name in ("obs", "action", "next_obs", "reward", "terminated", "truncated")}
    store(recorder, *arrays.values(), step["info"])
    expect(len(recorder.calls) == 1, "store_step should call buffer.add once", got=f"{len(recorder.calls)} calls",
           given=given)  # fmt: skip
    obs, action, reward, next_obs, terminated = recorder.calls[0]
    expected = step["next_obs"].astype(float)
    if step["info"]:
        mask = step["info"]["_final_obs"]
        expected = np.where(mask[:, None], step["info"]["final_obs"], expected)
    swapped = np.array_equal(obs, arrays["next_obs"]) or np.array_equal(reward.ravel(), arrays["terminated"].ravel())
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


def compare_untouched(store: Any, step: dict[str, Any]) -> None:
    """The arrays of the training loop are as they were: it acts on ``next_obs`` next."""
    kept = {name: np.copy(step[name]) for name in step if name != "info"}
    store(Recorder(), *(step[name] for name in ("obs", "action", "next_obs", "reward", "terminated", "truncated")),
          step["info"])  # fmt: skip
    for name, before in kept.items():
        expect(np.array_equal(step[name], before), f"{name} was changed in place; the training loop still needs it",
               given="an environment that has just begun a new episode", hint="leave-next-obs")  # fmt: skip
