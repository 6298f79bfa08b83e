"""The patient."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.doctor.patient import HOST, Patient


@pytest.fixture
def patient(tmp_path: Path) -> Patient:
    """A healthy environment with a home and a small course of its own."""
    environment = {name: os.environ[name] for name in HOST if name in os.environ}
    home = tmp_path / "home"
    home.mkdir()
    environment |= {"HOME": str(home), "USERPROFILE": str(home), "OMP_NUM_THREADS": "1"}
    made = Patient(tmp_path, environment)
    for name in ("course", "labs/lab_one", "autograder"):
        (made.course / name).mkdir(parents=True)
    for name in ("course/00_welcome.ipynb", "labs/lab_one/lab_one.ipynb"):
        (made.course / name).write_text('{"cells": []}', encoding="utf-8")
    exchange = tmp_path / "exchange"
    exchange.mkdir()
    exchange.chmod(0o777)
    environment["ROBOTBRAIN_EXCHANGE"] = str(exchange)  # else nbgrader is asked, which takes its time
    return made
