"""One submission, one process: its own copy of the files, bounded in time, killed with everything it started."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import uuid
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import nbformat
from nbformat.notebooknode import NotebookNode

import robotbrain
from robotbrain.files import write_text
from robotbrain.grading import suite as suites
from robotbrain.grading.execute import JOB_VARIABLE, Limits, kernel_env, make_gradable, note_not_run
from robotbrain.grading.intake import Healed
from robotbrain.grading.kernel import kill_marked, kill_tree
from robotbrain.grading.student import STUDENT_VARIABLE
from robotbrain.grading.worker import NOT_STARTED_CODE, partial_path

_NOT_STARTED = "the grader could not start a kernel; this is no fault of the submission, grade it again"
_SLACK_S = 60.0  # beyond the notebook's own wall limit: kernel starts and stops
_LARGEST_FILE = 20_000_000  # bytes of a further file that a submission may bring along


@dataclass(frozen=True)
class Executed:
    """An executed submission.

    Attributes:
        incidents: what went wrong while it ran, one sentence each.
        seconds: wall time it took (s); of the first run, where it comes from the cache.
        sound: False if the process itself failed: such a result is not cached.
    """

    notebook: NotebookNode
    incidents: list[str]
    seconds: float
    cached: bool = False
    sound: bool = True


def fingerprint(healed: Healed, folder: Path | None, limits: Limits, environment: str) -> str:
    """A key that changes when anything does that the outcome may depend on."""
    parts = [nbformat.writes(healed.notebook), json.dumps(dataclasses.asdict(limits)), environment]
    for path in _further_files(folder):
        parts += [path.name, hashlib.sha256(path.read_bytes()).hexdigest()]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


def environment_fingerprint(folders: list[Path]) -> str:
    """A digest of what all submissions of a run share: this package, the tests, the lab's files, Python."""
    digest = hashlib.sha256(f"{sys.version} {robotbrain.__version__}".encode())
    package = Path(robotbrain.__file__).parent
    roots = [package, *folders, *map(Path, os.environ.get(suites.SUITES_VARIABLE, "").split(os.pathsep))]
    for root in roots:
        for path in sorted(root.rglob("*")) if root.is_dir() and root != Path() else []:
            if path.is_file() and path.suffix in {".py", ".ipynb", ".json", ".csv", ".onnx", ".npz"}:
                digest.update(path.relative_to(root).as_posix().encode())
                digest.update(path.read_bytes())
    return digest.hexdigest()


def run_job(healed: Healed, folder: Path | None, limits: Limits, student: str, cache: Path | None) -> Executed:
    """Execute a submission in a process of its own; whatever happens to it, a gradable notebook comes back.

    Args:
        folder: the submission's folder, whose further files are copied beside the notebook.
        cache: file that keeps the outcome, or None.
    """
    if cache is not None and cache.is_file():
        with contextlib.suppress(Exception):  # a damaged cache entry is simply not used
            return _read(cache, cached=True)
    mark = uuid.uuid4().hex
    with tempfile.TemporaryDirectory(prefix="robotbrain-", ignore_cleanup_errors=True) as scratch:
        here = Path(scratch)
        (here / "work").mkdir()
        for path in _further_files(folder):
            shutil.copy(path, here / "work" / path.name)
        out = here / "executed.ipynb"
        (here / "t").mkdir()
        temporary = dict.fromkeys(("TMPDIR", "TEMP", "TMP"), str(here / "t"))  # goes with the job, however it ends
        env = {STUDENT_VARIABLE: student, JOB_VARIABLE: mark, **temporary}
        write_text(here / "submission.ipynb", nbformat.writes(healed.notebook))
        job = {
            "notebook": str(here / "submission.ipynb"),
            "cwd": str(here / "work"),
            "out": str(out),
            "limits": dataclasses.asdict(limits),
            "env": env,
        }
        write_text(here / "job.json", json.dumps(job))
        start = time.monotonic()
        failure = _supervise(here, kernel_env(env), limits.wall_s + _SLACK_S, mark)
        if failure == _NOT_STARTED:  # the machine's fault, not the submission's: a second try costs little
            failure = _supervise(here, kernel_env(env), limits.wall_s + _SLACK_S, mark)
        if not failure and out.is_file():
            executed = _read(out)
        else:
            executed = _salvage(healed, partial_path(out), failure or "the process left no result", start)
    if cache is not None and executed.sound:
        write_text(cache, _dump(executed))
    return executed


def _supervise(here: Path, env: dict[str, str], wall_s: float, mark: str) -> str:
    """Run the worker; return ``""`` or what became of it."""
    command = [sys.executable, "-m", "robotbrain.grading.worker", str(here / "job.json")]
    with (here / "worker.log").open("wb") as log:
        process = subprocess.Popen(
            command, cwd=here, env=env, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True
        )
        try:
            code = process.wait(timeout=wall_s)
            if code == NOT_STARTED_CODE:
                return _NOT_STARTED
            return "" if code == 0 else f"the submission ended the process that ran it (exit code {code})"
        except subprocess.TimeoutExpired:
            return f"the submission did not end within {wall_s:g} s"
        finally:
            kill_tree(process.pid)
            process.wait()
            kill_marked(JOB_VARIABLE, mark)


def _salvage(healed: Healed, partial: Path, why: str, start: float) -> Executed:
    notebook = healed.notebook
    with contextlib.suppress(Exception):  # half-written, or never begun: then nothing ran
        notebook = nbformat.read(partial, as_version=4)
    note_not_run(notebook, 0, why)
    for cell in notebook.cells:
        make_gradable(cell)
    return Executed(notebook, [why], time.monotonic() - start, sound=False)


def _read(path: Path, *, cached: bool = False) -> Executed:
    notebook = nbformat.read(path, as_version=4)
    kept: dict[str, Any] = notebook.metadata["robotbrain"]
    return Executed(notebook, list(kept["incidents"]), float(kept["seconds"]), cached)


def _dump(executed: Executed) -> str:
    return str(nbformat.writes(executed.notebook))


def _further_files(folder: Path | None) -> list[Path]:
    """Plain files beside the notebook, without links, folders and giants."""
    if folder is None or not folder.is_dir():
        return []
    return [
        p
        for p in sorted(folder.iterdir())
        if p.is_file() and not p.is_symlink() and p.suffix != ".ipynb" and p.stat().st_size <= _LARGEST_FILE
    ]
