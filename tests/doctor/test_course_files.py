"""``robotbrain doctor`` on a course whose files are damaged or in the way."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import sys

from tests.conftest import REPO
from tests.doctor.patient import Patient


def test_files_that_stand_in_for_libraries(patient: Patient) -> None:
    (patient.course / "labs" / "lab_one" / "numpy.py").write_text("", encoding="utf-8")
    (patient.course / "labs" / "lab_one" / "helper.py").write_text("", encoding="utf-8")
    (patient.course / "queue.py").write_text("", encoding="utf-8")
    answer = patient.ask("shadowing")
    assert len(answer.faults()) == 2
    numpy = answer.one("fault", "numpy.py stands in for the package module numpy")
    standard = answer.one("fault", "queue.py stands in for the standard library module queue")
    if sys.platform != "win32":  # the cures are carried out, and cure
        for finding in (numpy, standard):
            subprocess.run(shlex.split(finding["cure"].partition(", then")[0]), check=True)
        assert patient.ask("shadowing").code == 0


def test_a_library_on_pythonpath(patient: Patient) -> None:
    site = patient.path_first("leak")
    (site / "scipy").mkdir()
    (site / "scipy" / "__init__.py").write_text("", encoding="utf-8")
    assert "PYTHONPATH" in patient.ask("shadowing").one("fault", "stands in for the package module scipy")["cure"]


def test_shipped_files_are_cut_short_missing_or_pointers(patient: Patient) -> None:
    """In the layout of an installed wheel."""
    package = patient.path_first("installed") / "robotbrain"
    ignored = shutil.ignore_patterns("__pycache__", "suites", "monitoring", "sim")
    shutil.copytree(REPO / "src" / "robotbrain", package, ignore=ignored)
    shutil.copytree(REPO / "autograder" / "profiles", package / "jetson" / "data")
    whole = patient.ask("files")
    assert whole.code == 0 and len(whole.findings) == 1
    network = package / "pipeline" / "weights" / "segmentation.onnx"
    network.write_bytes(network.read_bytes()[:1000])
    (package / "jetson" / "data" / "jetpack.toml").unlink()
    pointer = package / "rl" / "weights" / "velocity.onnx"
    pointer.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n", encoding="utf-8")
    crlf = package / "jetson" / "data" / "headlines.toml"
    crlf.write_bytes(crlf.read_bytes().replace(b"\n", b"\r\n"))  # as git may leave it on Windows: no fault
    answer = patient.ask("files")
    assert len(answer.findings) == 4  # what is whole, and the three
    cut = answer.one("fault", "pipeline/weights/segmentation.onnx is cut short", "1000 of")
    assert "--force-reinstall --no-cache-dir robotbrain" in cut["cure"]
    assert "robotbrain" in answer.one("fault", "profiles/jetpack.toml is missing")["cure"]
    assert answer.one("fault", "velocity.onnx is a pointer of Git LFS")["cure"] == "git lfs pull"


def test_notebooks_that_cannot_be_opened(patient: Patient) -> None:
    (patient.course / "labs" / "lab_one" / "lab_one.ipynb").write_text(
        '{"cells": [\n<<<<<<< HEAD\n]}', encoding="utf-8"
    )
    (patient.course / "course" / "01_cut.ipynb").write_text('{"cells": [{"cell_ty', encoding="utf-8")
    answer = patient.ask("course")
    assert "lab_one.ipynb" in answer.one("fault", "lab_one.ipynb", "conflict marks")["cure"]
    assert "zip" in answer.one("fault", "01_cut.ipynb", "cut short")["cure"]


def test_a_damaged_gradebook(patient: Patient) -> None:
    file = patient.course / "autograder" / "gradebook.db"
    file.write_bytes(b"this is no database, and was never one" * 100)
    finding = patient.ask("gradebook").one("fault", "gradebook.db is damaged")
    assert "backups" in finding["cure"] and str(file) in finding["cure"]
