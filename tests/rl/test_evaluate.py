"""Evaluation: the right episodes are counted, and intervals and tests keep what they promise."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats

from robotbrain.errors import InputError
from robotbrain.rl.evaluate import bootstrap, clopper_pearson, compare, run_episodes
from robotbrain.rl.ppo_env import Step
from tests.rl.ppo_toys import PointEnv


class HalfFails(PointEnv):
    """Each episode is decided at its beginning: it fails after 2 steps, or succeeds after 10; reward 1 each step."""

    def __init__(self, num_envs: int) -> None:
        super().__init__(num_envs, limit=10)
        self.fails = torch.zeros(num_envs, dtype=torch.bool)

    def _reset(self, rows: torch.Tensor) -> None:
        super()._reset(rows)
        self.fails = getattr(self, "fails", torch.zeros(self.num_envs, dtype=torch.bool))
        self.fails[rows] = torch.rand(len(rows), generator=self.generator) < 0.5

    def _obs(self) -> dict[str, torch.Tensor]:
        clock = self.episode_length_buf.float()
        return {"policy": torch.stack([clock, self.fails.float()], dim=1)}

    def step(self, action: torch.Tensor) -> tuple[Any, ...]:
        self.episode_length_buf += 1
        terminated = self.fails & (self.episode_length_buf == 2)
        time_outs = (self.episode_length_buf >= 10) & ~terminated
        extras: dict[str, Any] = {}
        if (done := terminated | time_outs).any():
            extras = {"final_obs": self._obs(), "log": {}}
            self._reset(done.nonzero().squeeze(1))
        return self._obs(), torch.ones(self.num_envs), terminated, time_outs, extras


def nothing(obs: np.ndarray) -> np.ndarray:
    return np.zeros((len(obs), 1))


def clock(env: Any, step: Step) -> dict[str, torch.Tensor]:
    return {"clock": step.last_obs["policy"][:, 0]}


def test_quick_failures_do_not_crowd_out_slow_successes() -> None:
    table = run_episodes(HalfFails(50), nothing, 2000, success=lambda t: ~t.terminated)
    assert len(table) == 2000
    assert np.array_equal(np.bincount(table.env), np.full(50, 40))
    # The first 2000 to end would have had five failures to a success: a rate of 1/6.
    rate = table.success_rate()
    assert rate.low < 0.5 < rate.high and rate.high - rate.low < 0.05
    assert np.array_equal(table.lengths, np.where(table.terminated, 2, 10))
    assert np.array_equal(table.returns, table.lengths)


def test_exactly_so_many_episodes_and_the_same_again() -> None:
    for episodes in (1, 7, 10, 13):
        table = run_episodes(HalfFails(5), nothing, episodes, seed=3)
        assert len(table) == episodes and np.bincount(table.env, minlength=5).max() <= math.ceil(episodes / 5)
    again = run_episodes(HalfFails(5), nothing, 13, seed=3)
    other = run_episodes(HalfFails(5), nothing, 13, seed=4)
    assert np.array_equal(table.lengths, again.lengths) and not np.array_equal(table.lengths, other.lengths)


def test_an_episode_without_an_end_is_told() -> None:
    class Endless(PointEnv):
        def step(self, action: torch.Tensor) -> tuple[Any, ...]:
            none = torch.zeros(self.num_envs, dtype=torch.bool)
            return self._obs(), torch.ones(self.num_envs), none, none, {}

    with pytest.raises(InputError, match=r"31 control steps without an end(.|\n)*within 3 steps"):
        run_episodes(Endless(2, limit=3), nothing, 2)


def test_measures_are_of_the_episode_that_ended() -> None:
    table = run_episodes(HalfFails(6), nothing, 30, measure=clock, tail=3)
    long = ~table.terminated
    np.testing.assert_allclose(table.mean["clock"][long], 5.5)  # of 1 to 10
    np.testing.assert_allclose(table.mean["clock"][~long], 1.5)
    assert (table.tail["clock"][long] == [8, 9, 10]).all()
    np.testing.assert_array_equal(table.tail["clock"][~long], np.tile([math.nan, 1, 2], (int((~long).sum()), 1)))

    def gaps(env: Any, step: Step) -> dict[str, torch.Tensor]:
        return {"x": torch.ones(6).masked_fill(step.done, math.nan)}

    assert (run_episodes(HalfFails(6), nothing, 12, measure=gaps).mean["x"] == 1).all()
    assert "clock 4" in str(table) or "clock 3" in str(table)


def test_policies_may_be_modules_and_are_checked() -> None:
    by_array = run_episodes(PointEnv(4), lambda obs: 2 * obs[:, :1], 8)
    module = torch.nn.Linear(2, 1, bias=False)
    with torch.no_grad():
        module.weight.copy_(torch.tensor([[2.0, 0.0]]))
    by_module = run_episodes(PointEnv(4), module, 8)
    np.testing.assert_allclose(by_module.returns, by_array.returns, rtol=1e-6)
    assert by_array.returns.mean() > run_episodes(PointEnv(4), nothing, 8).returns.mean()
    for bad in (lambda obs: np.zeros((4, 2)), lambda obs: np.full((4, 1), np.nan)):
        with pytest.raises(InputError, match="actions"):
            run_episodes(PointEnv(4), bad, 8)
    with pytest.raises(InputError, match="episodes"):
        run_episodes(PointEnv(4), nothing, 0)
    with pytest.raises(InputError, match="success"):
        by_array.success_rate()


# ------------------------------------------------------------ conclusions


@pytest.mark.parametrize(("successes", "trials"), [(0, 10), (10, 10), (3, 10), (475, 500)])
def test_clopper_pearson_is_that_of_scipy(successes: int, trials: int) -> None:
    ours = clopper_pearson(successes, trials)
    theirs = stats.binomtest(successes, trials).proportion_ci(0.95, "exact")
    assert (ours.low, ours.high) == pytest.approx((theirs.low, theirs.high), abs=1e-9)
    lower = clopper_pearson(successes, trials, side="lower")
    theirs = stats.binomtest(successes, trials, alternative="greater").proportion_ci(0.95, "exact")
    assert (lower.low, lower.high) == pytest.approx((theirs.low, 1.0), abs=1e-9)
    upper = clopper_pearson(successes, trials, side="upper")
    assert upper.low == 0 and upper.high == pytest.approx(
        1 - clopper_pearson(trials - successes, trials, side="lower").low
    )


def test_a_lower_bound_lies_above_the_truth_at_most_so_often() -> None:
    # All outcomes of 30 trials, weighted by their probability: coverage without chance.
    for share in (0.3, 0.7, 0.95):
        outcomes = np.arange(31)
        bounds = np.array([clopper_pearson(int(k), 30, 0.9, "lower").low for k in outcomes])
        assert stats.binom.pmf(outcomes, 30, share)[bounds > share].sum() <= 0.1


def test_bootstrap_interval_covers_as_often_as_it_says() -> None:
    rng = np.random.default_rng(0)
    hits = 0
    for seed in range(200):
        found = bootstrap(rng.exponential(2.0, 60), resamples=300, seed=seed)
        hits += found.low <= 2.0 <= found.high
    assert 0.88 <= hits / 200 <= 0.98  # it is known to be a little short for skewed values
    assert bootstrap([1.0, 2.0, 9.0], of=lambda x: float(np.median(x))).value == 2.0
    assert bootstrap([1.0, 2.0, 9.0]) == bootstrap([1.0, 2.0, 9.0])


def test_seeds_that_differ_widen_the_interval() -> None:
    rng = np.random.default_rng(1)
    groups = [rng.normal(centre, 0.1, 100) for centre in (0.0, 1.0, 2.0)]
    apart, together = bootstrap(groups), bootstrap(np.concatenate(groups))
    assert apart.value == pytest.approx(together.value)
    assert apart.high - apart.low > 3 * (together.high - together.low)


@pytest.mark.parametrize("paired", [False, True])
@pytest.mark.parametrize("size", [4, 40])
def test_permutation_test_is_that_of_scipy(paired: bool, size: int) -> None:
    rng = np.random.default_rng(size)
    a, b = rng.normal(0.5, 1, size), rng.normal(0, 1, size)
    found = compare(a, b, paired=paired)
    theirs = stats.permutation_test(
        (a, b),
        lambda x, y, axis: x.mean(axis=axis) - y.mean(axis=axis),
        permutation_type="samples" if paired else "independent",
        alternative="greater",
        vectorized=True,
    )
    assert found.p_value == pytest.approx(theirs.pvalue, abs=1e-9 if size == 4 else 0.01)
    assert found.difference.value == pytest.approx(a.mean() - b.mean())


def test_few_seeds_cannot_show_much_and_that_is_said() -> None:
    three = compare([5, 6, 7], [1, 2, 3])
    assert three.p_value == three.smallest_p == pytest.approx(1 / 20)
    assert "cannot show less" in str(three)
    five = compare([5, 6, 7, 8, 9], [0, 1, 2, 3, 4])
    assert five.p_value == pytest.approx(1 / 252) and "cannot" not in str(five)
    assert compare([1, 2, 3], [5, 6, 7]).p_value == 1.0
    assert compare([1.1, 1.1, 1.1], [1.1, 1.1, 1.1]).p_value == 1.0


def test_welch_is_that_of_scipy() -> None:
    a, b = np.array([1.0, 2, 3, 4]), np.array([0.0, 1, 1, 1, 0])
    found = compare(a, b, test="welch")
    assert found.p_value == pytest.approx(stats.ttest_ind(a, b, equal_var=False, alternative="greater").pvalue)
    assert found.difference.low < found.difference.value < found.difference.high
    assert (
        compare(a, a - [0.1, 0.2, 0.1, 0.2], test="welch", paired=True).p_value
        < 0.01
        < compare(a, a, test="welch").p_value
    )


@pytest.mark.parametrize(
    "call",
    [
        lambda: compare([1], [1, 2]),
        lambda: compare([1, math.nan], [1, 2]),
        lambda: compare([1, 2, 3], [1, 2], paired=True),
        lambda: compare([1, 2, 3], [1, 2], test="t"),  # type: ignore[arg-type]
        lambda: bootstrap([]),
        lambda: bootstrap([1.0, math.inf]),
        lambda: bootstrap([1.0], level=95),
        lambda: clopper_pearson(3, 2),
        lambda: clopper_pearson(0, 0),
        lambda: clopper_pearson(1, 2, side="left"),  # type: ignore[arg-type]
    ],
)
def test_what_makes_no_sense_is_refused(call: Any) -> None:
    with pytest.raises(InputError):
        call()
