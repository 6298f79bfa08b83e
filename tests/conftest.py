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
