"""Runs submissions on the workers of a Dask cluster, which may be many hosts.

A task carries the submission itself and comes back as plain data. Every worker process keeps one
:class:`~robotbrain.grading.bench.Bench` and must have the course: in the folder where it is here, or in the one that
``ROBOTBRAIN_COURSE`` names. A worker whose tests differ from these is refused. The gradebook is written here only.

A worker that is lost costs nothing: Dask runs its tasks elsewhere. Who reaches a Dask scheduler may run code on its
workers, so keep it in a network of its own or use TLS (``tls://``).
"""

from __future__ import annotations

import atexit
import dataclasses
import os
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import nbformat
from nbformat.notebooknode import NotebookNode

from robotbrain.errors import InputError, MissingDependencyError, RobotBrainError
from robotbrain.grading.course import Course
from robotbrain.grading.execute import Execution, Limits
from robotbrain.grading.jobs import tests_digest
from robotbrain.grading.suite import AUTOGRADER_VARIABLE

COURSE_VARIABLE = "ROBOTBRAIN_COURSE"
_CONNECT_S = 30.0
_TRIES = 3  # each of which outlives as many lost workers as Dask allows (3)

_benches: dict[str, Any] = {}  # in a worker: setup -> its Bench
_lock = threading.Lock()


class ClusterBench:
    """A Bench whose notebooks run on the workers of the Dask scheduler at ``address``.

    Raises:
        MissingDependencyError: Dask is not installed.
        InputError: there is no scheduler, or a worker has other tests or, with ``require_sandbox``, no sandbox.
    """

    def __init__(
        self, address: str, course: Course, lab: str, *, limits: Limits | None = None, require_sandbox: bool = False
    ) -> None:
        try:
            from distributed import Client
        except ImportError:
            raise MissingDependencyError(
                "distributed", needed_for="--cluster", install="pip install distributed"
            ) from None
        self._setup = {
            "autograder": str(course.autograder),
            "tests": tests_digest(_tests(course.autograder)),
            "lab": lab,
            "limits": dataclasses.asdict(limits or Limits()),
            "require_sandbox": require_sandbox,
        }
        try:
            self._client: Any = Client(address, timeout=_CONNECT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError(
                "cluster",
                given=address,
                expected="the address of a running Dask scheduler, e.g. tcp://host:8786",
                fix=f"Start one with `dask scheduler` and workers with `dask worker ADDRESS` ({error}).",
            ) from error
        try:
            self._client.wait_for_workers(1, timeout=_CONNECT_S)
            layers = list(self._client.run(_layers, self._setup).values())
        except TimeoutError as error:
            self.close()
            raise InputError(
                "cluster", given=address, expected="at least one worker", fix=f"Start: dask worker {address}"
            ) from error
        except BaseException:
            self.close()
            raise
        self.layers = [layer for layer in layers[0] if all(layer in others for others in layers)]

    def __enter__(self) -> ClusterBench:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def slots(self) -> int:
        """How many submissions the cluster runs at the same time."""
        return int(sum(self._client.nthreads().values()))

    def close(self) -> None:
        """Withdraw what is not done and disconnect; the workers stay."""
        self._client.close()

    def execute(self, notebook: NotebookNode, *, lab: str, student: str, files: Mapping[str, bytes]) -> Execution:
        """Run a healed notebook on some worker.

        Raises:
            RobotBrainError: the scheduler went away, so that going on makes no sense.
        """
        from distributed import KilledWorker

        task = {"notebook": nbformat.writes(notebook), "lab": lab, "student": student, "files": dict(files)}
        for attempt in range(_TRIES):
            try:
                done = self._client.submit(_execute, self._setup, task, pure=False).result()
                return Execution(nbformat.reads(done.pop("notebook"), as_version=4), **done)
            except KilledWorker:
                if attempt == _TRIES - 1:
                    raise
            except Exception as error:
                if self._client.status != "running":
                    raise RobotBrainError("the connection to the cluster was lost; what is done is kept") from error
                raise
        raise AssertionError("not reached")


# What follows runs in the workers.


def _tests(autograder: Path) -> list[Path]:
    return [autograder / "hidden", autograder / "profiles"]


def _autograder(setup: Mapping[str, Any]) -> Path:
    """The worker's own folder with the hidden tests."""
    candidates = [Path(setup["autograder"])]
    if own := os.environ.get(COURSE_VARIABLE):
        candidates.insert(0, Path(own) / "autograder")
    found = next((p for p in candidates if p.is_dir()), None)
    if found is None:
        raise InputError(
            "course on a worker",
            given=str(candidates[0]),
            expected="a copy of the course there",
            fix=f"Set {COURSE_VARIABLE} to its folder before starting the worker.",
        )
    if tests_digest(_tests(found)) != setup["tests"]:
        raise InputError(
            "course on a worker",
            given=str(found),
            expected="the same tests and the same robotbrain as here",
            fix="Bring the worker's copy up to date.",
        )
    return found


def _bench(setup: Mapping[str, Any]) -> Any:
    from robotbrain.grading.bench import Bench

    with _lock:
        key = repr(sorted(setup.items()))
        if key not in _benches:
            autograder = _autograder(setup)
            os.environ[AUTOGRADER_VARIABLE] = str(autograder)
            bench = Bench(
                autograder,
                require_sandbox=setup["require_sandbox"],
                limits=Limits(**setup["limits"]),
                preload_labs=[setup["lab"]],
            )
            atexit.register(bench.close)
            _benches[key] = bench
        return _benches[key]


def _layers(setup: Mapping[str, Any]) -> list[Any]:
    return list(_bench(setup).layers)


def _execute(setup: Mapping[str, Any], task: Mapping[str, Any]) -> dict[str, Any]:
    notebook = nbformat.reads(task["notebook"], as_version=4)
    done = _bench(setup).execute(notebook, lab=task["lab"], student=task["student"], files=task["files"])
    return {
        "notebook": nbformat.writes(done.notebook),
        "incidents": list(done.incidents),
        "seconds": done.seconds,
        "layers": list(done.layers),
        "sound": done.sound,
    }
