"""A world small enough for tests of recipes and sweeps: untrained weights, noise for images, one step of training."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from robotbrain.optimisation import networks
from robotbrain.optimisation.data import Scenes
from robotbrain.optimisation.recipe import Budget
from robotbrain.optimisation.workshop import Workshop

BUDGET = Budget(images=16, epochs=1, channel_epochs=1, scratch_epochs=1, calibration_images=4, batch_size=8)


def noise(count: int, seed: int) -> Scenes:
    """Random images and labels."""
    rng = np.random.default_rng(seed)
    images = rng.integers(0, 256, (count, 64, 64, 3), dtype=np.uint8)
    return Scenes(images, rng.integers(0, 4, (count, 64, 64), dtype=np.uint8))


def make_weights(folder: Path) -> Path:
    """Write untrained weights under the shipped names, once; with a seed, so that processes agree."""
    folder.mkdir(parents=True, exist_ok=True)
    for seed, name in enumerate(networks.NAMES):
        torch.manual_seed(seed)
        network = networks.build_teacher() if name == "teacher" else networks.build_student()
        torch.save(network.state_dict(), folder / f"{name}.pt")
    return folder


def workshop(folder: Path) -> Workshop:
    """A workshop that needs neither simulator nor patience."""
    return Workshop(folder, BUDGET, train=noise(16, 1), calibration=noise(4, 2), progress=False)
