"""The course's files: found, whole, and without one that stands in for a library."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from robotbrain.doctor.finding import (
    Cure,
    Finding,
    Situation,
    everywhere,
    fault,
    note,
    ok,
    posix_or_windows,
    quoted,
    warning,
)
from robotbrain.doctor.probes.libraries import MODULES
from robotbrain.doctor.shipped import State, examine

_FOLDERS = ("course", "labs")
_KIT_MODULES = ("robotbrain", "rclpy", "geometry_msgs", "sensor_msgs", "nav_msgs", "std_msgs", "tf2_ros")
_LARGEST = 50_000_000


def course(situation: Situation) -> list[Finding]:
    """The folder of the course and its notebooks."""
    if situation.course is None:
        return [
            note(
                f"{situation.folder} is no folder of the course",
                everywhere("Change to your copy of the course (cd), or name it: robotbrain doctor --directory FOLDER"),
            )
        ]
    found: list[Finding] = []
    count = 0
    for notebook in _notebooks(situation.course):
        count += 1
        if problem := _damage(notebook):
            found.append(
                fault(
                    f"the notebook {notebook.relative_to(situation.course)} cannot be opened: {problem}",
                    _again(situation.course, notebook),
                )
            )
    return [ok(f"course {situation.course} with {count} notebooks"), *found]


def _notebooks(folder: Path) -> Iterator[Path]:
    yield from sorted((folder / "course").glob("*.ipynb"))
    yield from sorted((folder / "labs").glob("*/*.ipynb"))


def _damage(notebook: Path) -> str:
    try:
        if notebook.stat().st_size > _LARGEST:
            return f"it has {notebook.stat().st_size / 1e6:.0f} MB (clear its outputs)"
        cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    except OSError as error:
        return error.strerror or str(error)
    except UnicodeDecodeError:
        return "it is not UTF-8"
    except (ValueError, KeyError, TypeError):
        head = notebook.read_text(encoding="utf-8", errors="replace")[:200_000]
        return "it holds git's conflict marks (<<<<<<<)" if "<<<<<<< " in head else "it is no notebook (cut short?)"
    return "" if isinstance(cells, list) else "it has no list of cells"


def _again(root: Path, path: Path) -> Cure:
    name = path.relative_to(root).as_posix() if path.is_relative_to(root) else str(path)
    if (root / ".git").exists():
        return everywhere(
            f"Keep a copy if you worked in it; then: git -C {quoted(root)} checkout -- {quoted(Path(name))}"
        )
    return everywhere(f"Keep a copy if you worked in it; then take {name} out of the course's zip file again.")


def shadowing(situation: Situation) -> list[Finding]:
    """Files that Python imports instead of a library, because they are named like it and stand in front of it."""
    names = {module.partition(".")[0] for module in MODULES.values()} | set(_KIT_MODULES)
    standard = set(getattr(sys, "stdlib_module_names", ())) - {"this", "antigravity"}
    found = []
    for folder, why in _folders_in_front(situation):
        for path in _modules_in(folder):
            if path.stem not in names | standard:
                continue
            if _holds_kit(path):
                continue
            found.append(
                fault(
                    f"{path} stands in for the {'standard library' if path.stem in standard else 'package'} module "
                    f"{path.stem}: {why}",
                    _rename(path, why),
                )
            )
    return found or [ok("no file stands in for a library")]


_BESIDE = "notebooks in this folder import it"
_ON_PATH = "PYTHONPATH puts it in front of the environment"


def _folders_in_front(situation: Situation) -> Iterator[tuple[Path, str]]:
    seen: set[Path] = set()
    places: list[tuple[Path, str]] = []
    if situation.course is not None:
        places += [(situation.course, _BESIDE), (situation.course / "course", _BESIDE)]
        places += [(p, _BESIDE) for p in sorted((situation.course / "labs").glob("*")) if p.is_dir()]
    if situation.folder != Path.home():
        places.append((situation.folder, _BESIDE))
    places += [(Path(p or "."), _ON_PATH) for p in os.environ.get("PYTHONPATH", "").split(os.pathsep) if p]
    for folder, why in places:
        place = folder.resolve()
        if place not in seen and place.is_dir():
            seen.add(place)
            yield place, why


def _modules_in(folder: Path) -> list[Path]:
    """Modules and packages in ``folder`` that ``import`` would find there."""
    try:
        entries = sorted(folder.iterdir())
    except OSError:
        return []
    return [p for p in entries if p.suffix == ".py" or (p.is_dir() and (p / "__init__.py").is_file())]


def _holds_kit(path: Path) -> bool:
    """Whether this is the kit itself, put on PYTHONPATH from a checkout, or a genuine ROS (another probe's matter)."""
    import robotbrain

    here = Path(robotbrain.__file__).resolve().parent
    return path.resolve() == here or path.stem in _KIT_MODULES[1:]


def _rename(path: Path, why: str) -> Cure:
    if why == _ON_PATH:
        return posix_or_windows(
            f"unset PYTHONPATH (or take {path.parent} out of it; look into ~/.bashrc and ~/.profile)",
            f"Remove-Item Env:PYTHONPATH (or take {path.parent} out of it)",
        )
    new = path.with_name(f"my_{path.name}")
    return posix_or_windows(
        f"mv {quoted(path)} {quoted(new)}, then restart the kernel",
        f'Move-Item "{path}" "{new}", then restart the kernel',
    )


def shipped_files(_: Situation) -> list[Finding]:
    """The shipped networks and profiles are there, byte for byte."""
    found: list[Finding] = []
    fine = 0
    for file in examine():
        again = _restore(file.path)
        if file.state is State.SAME:
            fine += 1
        elif file.state is State.MISSING:
            found.append(fault(f"the shipped file {file.name} is missing", again))
        elif file.state is State.POINTER:
            found.append(
                fault(
                    f"{file.name} is a pointer of Git LFS, not the file itself",
                    Cure("git lfs pull", "git lfs pull", "git lfs pull"),
                )
            )
        elif file.state is State.SHORT:
            found.append(fault(f"the shipped file {file.name} is cut short: {file.detail}", again))
        elif file.path.suffix in (".onnx", ".pt"):
            found.append(
                warning(f"the network {file.name} is not the shipped one (trained again?): results will differ", again)
            )
        else:
            found.append(note(f"{file.name} is not as shipped; if you did not mean to change it", again))
    return [ok(f"{fine} shipped networks and profiles are whole"), *found]


def _restore(path: Path) -> Cure:
    from robotbrain.doctor.finding import reinstall
    from robotbrain.doctor.probes.packages import checkout

    root = checkout()
    return reinstall("robotbrain") if root is None else _again(root, path)
