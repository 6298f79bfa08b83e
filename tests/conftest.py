"""Shared by all tests: headless plotting, and optional programs that CI must not skip."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

os.environ.setdefault("MPLBACKEND", "Agg")

REPO = Path(__file__).resolve().parents[1]


def need(condition: object, reason: str) -> None:
    """Skip with the reason where an optional component is missing; fail instead where CI promised it."""
    if condition:
        return
    if os.environ.get("ROBOTBRAIN_NO_SKIP"):
        pytest.fail(f"CI promised not to skip, but: {reason}")
    pytest.skip(reason)


SLOW_FILES = (
    "test_hw1_rl.py",
    "test_hw2_optimisation.py",
    "test_lab_integration.py",
    "test_hw3_performance.py",
    "test_capstone.py",
    "test_labs_remote_a.py",
    "test_attacks.py",
    "test_book.py",
)
"""Files that take minutes: with two workers (pytest-xdist) they must not be left for the end."""


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run the slow files first; the order within a file stays."""
    items.sort(key=lambda item: item.path.name not in SLOW_FILES)


def graders() -> int:
    """Return how many submissions a test may grade at a time: two, unless the tests themselves run side by side."""
    return 1 if os.environ.get("PYTEST_XDIST_WORKER") else 2


@pytest.fixture(scope="session")
def repo() -> Path:
    """Return the root of the checkout."""
    return REPO


@pytest.fixture(scope="session")
def chromium() -> str:
    """Return the path of a Chromium browser."""
    path = next((p for name in ("chromium", "chromium-browser", "google-chrome") if (p := shutil.which(name))), None)
    need(path, "no Chromium on PATH (install the package `chromium`)")
    assert path is not None
    return path
