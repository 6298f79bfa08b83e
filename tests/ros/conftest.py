from __future__ import annotations

import pytest

import robotbrain.ros  # makes rclpy and the interface packages importable
from robotbrain.ros import SimContext


@pytest.fixture
def context():
    """A fresh simulation that is the default context."""
    assert robotbrain.ros.BACKEND == "kit", "these tests are about the kit, not about genuine rclpy"
    simulation = SimContext()
    simulation.log_lines = []
    simulation.log_sink = simulation.log_lines.append
    with simulation.as_default():
        yield simulation
