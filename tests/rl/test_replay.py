"""Replay buffer and exploration noise: statistics with known distributions, rows that stay whole."""

import numpy as np
import pytest
import torch
from scipy import stats

from robotbrain.errors import InputError
from robotbrain.rl.noise import GaussianNoise, OrnsteinUhlenbeckNoise
from robotbrain.rl.replay import ReplayBuffer


def rows(ids):
    """Transitions every number of which tells which one it belongs to."""
    ids = np.asarray(ids, np.float32)
    return ids[:, None] + [0.0, 0.1], ids[:, None] + [0.2], ids + 0.3, ids[:, None] + [0.4, 0.5], ids % 2


def ids_of(batch):
    """The transition that each row of a batch is, after checking that all its parts say the same."""
    ids = batch.obs[:, 0]
    for part, offset in ((batch.obs[:, 1], 0.1), (batch.action[:, 0], 0.2), (batch.reward, 0.3)):
        torch.testing.assert_close(part, ids + offset)
    torch.testing.assert_close(batch.next_obs, ids[:, None] + torch.tensor([0.4, 0.5]))
    torch.testing.assert_close(batch.terminated, ids % 2)
    return ids.long().numpy()


def filled(capacity, counts):
    buffer, start = ReplayBuffer(capacity, 2, 1), 0
    for n in counts:
        buffer.add(*rows(range(start, start + n)))
        start += n
    return buffer


@pytest.mark.parametrize(
    ("capacity", "counts"), [(10, [3]), (10, [4, 4, 4]), (10, [7, 7, 7, 7]), (8, [8, 3]), (5, [5])]
)
def test_holds_the_latest_transitions_and_none_is_mixed(capacity, counts):
    buffer = filled(capacity, counts)
    total = sum(counts)
    found = set(ids_of(buffer.sample(2000, torch.Generator().manual_seed(0))))
    assert found == set(range(max(0, total - capacity), total))
    assert len(buffer) == min(total, capacity)


def test_samples_uniformly_and_independently():
    buffer = filled(50, [30, 30])
    generator = torch.Generator().manual_seed(1)
    ids = np.concatenate([ids_of(buffer.sample(100, generator)) for _ in range(200)]) - 10
    assert stats.chisquare(np.bincount(ids, minlength=50)).pvalue > 1e-3
    pairs = np.bincount(ids[:-1] // 10 * 5 + ids[1:] // 10, minlength=25)
    assert stats.chisquare(pairs).pvalue > 1e-3


def test_a_batch_does_not_change_when_its_rows_are_overwritten():
    buffer = filled(4, [4])
    batch = buffer.sample(50, torch.Generator().manual_seed(0))
    before = ids_of(batch)
    buffer.add(*rows(range(100, 104)))
    np.testing.assert_array_equal(ids_of(batch), before)


def test_saved_and_loaded_it_goes_on_the_same():
    buffer, other = filled(9, [5, 7]), ReplayBuffer(9, 2, 1)
    other.load_state_dict(buffer.state_dict())
    for one in (buffer, other):
        one.add(*rows([50, 51]))
    batches = [one.sample(64, torch.Generator().manual_seed(3)) for one in (buffer, other)]
    for ours, theirs in zip(*batches, strict=True):
        assert torch.equal(ours, theirs)


@pytest.mark.parametrize(
    ("change", "named"),
    [({"reward": np.zeros((3, 1))}, "reward"), ({"obs": np.zeros((3, 3))}, "obs"), ({"action": np.zeros(3)}, "action")],
)
def test_a_wrong_shape_is_named_and_nothing_is_stored(change, named):
    buffer = ReplayBuffer(10, 2, 1)
    columns = dict(zip(("obs", "action", "reward", "next_obs", "terminated"), rows([0, 1, 2]), strict=True)) | change
    with pytest.raises(InputError, match=named):
        buffer.add(**columns)
    assert len(buffer) == 0


def test_refuses_what_it_cannot_do():
    with pytest.raises(InputError, match="empty"):
        ReplayBuffer(10, 2, 1).sample(1, torch.Generator())
    with pytest.raises(InputError, match="capacity"):
        filled(3, [4])
    with pytest.raises(InputError, match="capacity 9"):
        ReplayBuffer(8, 2, 1).load_state_dict(filled(9, [5]).state_dict())


def test_gaussian_noise_has_the_deviation_it_says():
    draws = GaussianNoise(3, 0.2, torch.Generator().manual_seed(0)).sample(4000)
    assert stats.kstest(draws.ravel() / 0.2, "norm").pvalue > 1e-3
    assert abs(np.corrcoef(draws.T)[0, 1]) < 0.05


@pytest.mark.parametrize("dt", [0.04, 1.0])
def test_ornstein_uhlenbeck_noise_has_its_stationary_deviation_and_memory_for_any_step(dt):
    sigma, theta = 0.3, 0.8
    noise = OrnsteinUhlenbeckNoise(2, sigma, theta, dt, torch.Generator().manual_seed(0))
    x = np.stack([noise.sample(1000) for _ in range(round(12 / dt))])
    assert x[0].std() == pytest.approx(sigma * np.sqrt((1 - np.exp(-2 * theta * dt)) / (2 * theta)), rel=0.1)
    assert x[-1].std() == pytest.approx(sigma / np.sqrt(2 * theta), rel=0.1)
    correlation = np.corrcoef(x[-1].ravel(), x[-2].ravel())[0, 1]
    assert correlation == pytest.approx(np.exp(-theta * dt), abs=0.06)


def test_ornstein_uhlenbeck_noise_starts_anew_only_where_an_episode_ended():
    noise = OrnsteinUhlenbeckNoise(1, 0.3, 1e-6, 1.0, torch.Generator().manual_seed(0))
    for _ in range(500):
        x = noise.sample(2)
    twin = OrnsteinUhlenbeckNoise(1, 0.3, 1e-6, 1.0, torch.Generator())
    twin.load_state_dict(noise.state_dict())
    noise.reset(np.array([True, False]))
    after, unreset = noise.sample(2), twin.sample(2)
    np.testing.assert_allclose(unreset[0] - after[0], x[0], rtol=1e-3)  # all that it remembered is gone
    np.testing.assert_array_equal(unreset[1], after[1])
