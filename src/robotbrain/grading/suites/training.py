"""What labs that train networks share."""

from __future__ import annotations

import copy

import torch
from torch import nn


def first_steps() -> None:
    """Train a tiny network a step with each optimiser: the first step of a process costs much more than the next.

    Random generators are left as they were.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = nn.Sequential(nn.Conv2d(3, 4, 3), nn.BatchNorm2d(4), nn.ReLU(), nn.Flatten(), nn.Linear(16, 2))
        network.load_state_dict(copy.deepcopy(network).state_dict())
        images = torch.randn(2, 3, 4, 4)
        for optimiser in (torch.optim.SGD(network.parameters(), lr=0.1), torch.optim.Adam(network.parameters())):
            answer = network(images)
            loss = nn.functional.cross_entropy(answer, answer.argmax(dim=1)) + nn.functional.mse_loss(
                answer.tanh(), torch.zeros_like(answer)
            )
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()
        with torch.no_grad():
            network.eval()(images).clamp(-1, 1).numpy()
