"""Memory of observation terms: the last samples, and samples that arrive late."""

from __future__ import annotations

import torch


class HistoryBuffer:
    """The last ``length`` samples of each environment, oldest first; the first sample after a reset fills it all.

    Args:
        length: number of samples.
        num_envs: number of environments.
        shape: of one sample.
    """

    def __init__(self, length: int, num_envs: int, shape: tuple[int, ...]) -> None:
        self.samples = torch.zeros(num_envs, length, *shape)
        self._filled = torch.zeros(num_envs, dtype=torch.bool)

    def reset(self, env_ids: torch.Tensor | None = None) -> None:
        """Empty the memory of these environments."""
        self._filled[slice(None) if env_ids is None else env_ids] = False

    def compute(self, sample: torch.Tensor, record: bool) -> torch.Tensor:
        """The samples, (num_envs, length, ...), a copy; with ``record`` the new one is added first."""
        filled = self._filled.view(-1, *[1] * sample.ndim)
        newest = sample.unsqueeze(1)
        if record:
            rolled = torch.cat((self.samples[:, 1:], newest), 1)
            self.samples.copy_(torch.where(filled, rolled, newest.expand_as(rolled)))
            self._filled.fill_(True)
            return self.samples.clone()
        return torch.where(filled, self.samples, newest.expand_as(self.samples))


class DelayBuffer:
    """Samples that arrive ``lag`` control steps late, with a lag per environment drawn from ``min_lag .. max_lag``.

    A lag is drawn at each reset, and again at each recorded sample with probability ``1 - hold_prob``. Where the
    episode is younger than the lag, its oldest sample is returned.

    Args:
        min_lag, max_lag: bounds of the lag in control steps, both included.
        hold_prob: probability to keep a lag at a step.
        num_envs: number of environments.
        shape: of one sample.
        generator: source of the draws.
    """

    def __init__(
        self,
        min_lag: int,
        max_lag: int,
        hold_prob: float,
        num_envs: int,
        shape: tuple[int, ...],
        generator: torch.Generator,
    ) -> None:
        self._bounds, self._hold_prob, self._generator = (min_lag, max_lag + 1), hold_prob, generator
        self._ring = torch.zeros(max_lag + 1, num_envs, *shape)
        self._head = 0
        self._recorded = torch.zeros(num_envs, dtype=torch.long)
        self._rows = torch.arange(num_envs)
        self.lags = torch.zeros(num_envs, dtype=torch.long)
        self.reset()

    def reset(self, env_ids: torch.Tensor | None = None) -> None:
        """Forget the samples of these environments and draw their lags."""
        index = self._rows if env_ids is None else env_ids
        self._recorded[index] = 0
        self.lags[index] = torch.randint(*self._bounds, (len(index),), generator=self._generator)

    def compute(self, sample: torch.Tensor, record: bool) -> torch.Tensor:
        """The late sample, (num_envs, ...), a copy; with ``record`` the new one is taken in first."""
        size = len(self._ring)
        if record:
            if self._hold_prob < 1.0:
                draws = torch.rand(len(self._rows), generator=self._generator)
                fresh = torch.randint(*self._bounds, (len(self._rows),), generator=self._generator)
                self.lags = torch.where(draws < self._hold_prob, self.lags, fresh)
            self._head = (self._head + 1) % size
            self._ring[self._head] = sample
            self._recorded += 1
        age = torch.minimum(self.lags, (self._recorded - 1).clamp(min=0))
        late = self._ring[(self._head - age) % size, self._rows]
        never = (self._recorded == 0).view(-1, *[1] * (sample.ndim - 1))
        return torch.where(never, sample, late)
