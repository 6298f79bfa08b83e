"""What the two fork servers are made of: the student's, wrapped in bubblewrap, and the tester's, which is not."""

from __future__ import annotations

import ast
import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import robotbrain
from robotbrain.errors import RobotBrainError
from robotbrain.grading.sandbox import bubblewrap
from robotbrain.grading.sandbox.filter import compile_filter
from robotbrain.grading.sandbox.forkserver import Recipe, can_fork
from robotbrain.grading.student import STUDENT_VARIABLE
from robotbrain.grading.suite import AUTOGRADER_VARIABLE, SUITES_VARIABLE, instructors_code

COMMON = (
    "numpy",
    "torch",
    "matplotlib.pyplot",
    "matplotlib.backends.backend_agg",
    "mujoco",
    "gymnasium",
    "onnx",
    "onnxruntime",
    "scipy.stats",
    "scipy.ndimage",
    "tqdm.auto",
)
_OFTEN = ("torch", "scipy.stats")  # slow to import; who computes with numpy may reach for them, whatever the lab uses
_ALWAYS = ("IPython", "psutil", "robotbrain.grading", "robotbrain.grading.remote.serve")
_STUDENT_ENTRY = "robotbrain.grading.sandbox.child:main"
_STUDENT_ALONE = "robotbrain.grading.sandbox.child:main_alone"
_STUDENT_PREPARE = "robotbrain.grading.sandbox.child:prepare"
_TESTER_ENTRY = "robotbrain.grading.tester.process:main"
_TESTER_PREPARE = "robotbrain.grading.tester.process:prepare"
_PASSED_ON = re.compile(r"TZ|LC_\w+|ROBOTBRAIN_TIME_SCALE|ROBOTBRAIN_PROFILES|ROBOTBRAIN_SUITES")


def student(autograder: Path, labs: Sequence[str], preload: Sequence[str] | None = None) -> Recipe:
    """The recipe of the process that student code is forked from.

    Args:
        labs: what their notebooks and visible tests import is imported once; without labs, all that labs might use.
        preload: these modules instead.
    """
    if preload is None:
        preload = imports_of(autograder, labs) if labs else COMMON
        if "numpy" in preload:
            preload = [*preload, *_OFTEN]
    bwrap = bubblewrap.program()
    wrapper: list[str] = []
    if bwrap is not None:
        wrapper = bubblewrap.command(bwrap, readable=_readable(), hidden=_hidden(autograder))
    scratch = "/tmp/server" if wrapper else str(Path.home())
    return Recipe(
        entry=_STUDENT_ENTRY if can_fork() else _STUDENT_ALONE,
        preload=[*_ALWAYS, *preload] if can_fork() else (),
        prepare=_STUDENT_PREPARE if can_fork() else "",
        arguments={"seccomp": _seccomp()} if can_fork() else {},
        wrapper=wrapper,
        environment=_passed_on() | {"HOME": scratch, "IPYTHONDIR": f"{scratch}/.ipython"},
        uid=bubblewrap.NOBODY if wrapper and os.geteuid() == 0 else None,
    )


def tester(autograder: Path, labs: Sequence[str]) -> Recipe:
    """The recipe of the process that testers are forked from: trusted, with the course's files."""
    return Recipe(
        entry=_TESTER_ENTRY,
        preload=COMMON if can_fork() and not labs else (),  # the labs' tests import what they need
        prepare=_TESTER_PREPARE,
        arguments={"autograder": str(autograder), "labs": list(labs)},
        environment=_passed_on() | {"HOME": str(Path.home()), AUTOGRADER_VARIABLE: str(autograder)},
    )


def wrapped(recipe: Recipe) -> bool:
    """Whether the server runs inside bubblewrap."""
    return bool(recipe.wrapper)


def student_environment(name: str, recipe: Recipe) -> dict[str, str]:
    """All variables that a student's code sees, beside those that follow from its folder."""
    kept = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "PYTHONHASHSEED", "MPLBACKEND")
    from robotbrain.grading.sandbox.forkserver import server_environment

    whole = server_environment(recipe)
    return (
        {k: whole[k] for k in (*kept, "PATH", "LANG") if k in whole}
        | {k: v for k, v in whole.items() if _PASSED_ON.fullmatch(k)}
        | {"NBGRADER_EXECUTION": "autograde", STUDENT_VARIABLE: name, "USER": "student", "LOGNAME": "student"}
    )


def _readable() -> list[Path]:
    """What student code may read beside Python itself: this package, the profiles it uses, suites that are public."""
    folders = [Path(robotbrain.__file__).parent]
    try:
        from robotbrain.jetson.paths import profile_directory

        folders.append(profile_directory())
    except RobotBrainError:  # a lab may do without
        pass
    named = os.environ.get(SUITES_VARIABLE, "")
    return folders + [Path(p).absolute() for p in named.split(os.pathsep) if p and Path(p).is_dir()]


def _passed_on() -> dict[str, str]:
    """The few variables of the grader's own that its servers get."""
    return {k: v for k, v in os.environ.items() if _PASSED_ON.fullmatch(k)}


def _hidden(autograder: Path) -> list[Path]:
    """What must never be visible, wherever it lies."""
    return [autograder, *(autograder.parent / name for name in ("solutions", "submitted", "gradebook"))]


def _seccomp() -> bytes | None:
    try:
        return compile_filter()
    except (ImportError, RuntimeError, OSError):
        return None


def imports_of(autograder: Path, labs: Iterable[str]) -> list[str]:
    """What the labs' notebooks import, for ``names.import_all``, and their visible tests, which every copy needs."""
    modules: list[str] = []
    for lab in labs:
        for source in instructors_code(autograder, lab):
            modules += _imports(source)
        if (Path(robotbrain.__file__).parent / "grading" / "suites" / f"{lab}.py").is_file():
            modules.append(f"robotbrain.grading.suites.{lab}")
    return list(dict.fromkeys(modules))


def _imports(source: str) -> list[str]:
    try:
        tree = ast.parse(source)
    except SyntaxError:  # a magic
        return []
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found += [f"{node.module}:{alias.name}" for alias in node.names if alias.name != "*"]
    return found
