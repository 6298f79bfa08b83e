"""Versions of the packages, against the bounds that the kit declares, and the versions known to be bad."""

from __future__ import annotations

import importlib.metadata as metadata
import re
import sys
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from robotbrain.doctor.finding import (
    Cure,
    Finding,
    Situation,
    everywhere,
    fault,
    note,
    ok,
    pip_install,
    python,
    warning,
)

KIT = "robotbrain"

FEW = 3
"""So many missing packages are named one by one; more of them mean that the installation did not come to its end."""

COMPANIONS = ("torchvision", "torchaudio", "triton", "mujoco-mjx", "jupyterlab-widgets", "numba")
"""Packages the kit does not need, which break what it needs when their versions do not fit one another."""


def packages(_: Situation) -> list[Finding]:
    """Every requirement of the kit is installed within its bounds, once, and with nothing that spoils it."""
    try:
        from packaging.requirements import Requirement
    except ImportError:
        Requirement = None  # type: ignore[assignment,misc]
    texts, stale = requirements()
    found: list[Finding] = []
    if stale:
        found.append(
            warning(
                "the checkout asks for other packages than when it was installed: " + ", ".join(stale),
                _install_kit(),
            )
        )
    if Requirement is None:
        found.append(
            warning(
                "the package `packaging` is missing, so bounds of versions are not compared (only what is missing)",
                pip_install("packaging"),
            )
        )
    if not texts:
        what = "the kit is not installed in this environment, so what it requires is not known"
        return [warning(what, _install_kit()), *found]
    missing = [text for text in texts if _applies(text, Requirement) and version_of(_name(text)) is None]
    wrong = [finding for text in texts if text not in missing and (finding := _check(text, Requirement))]
    if len(missing) > FEW:
        names = ", ".join(map(_name, missing))
        found.append(fault(f"{len(missing)} required packages are missing: {names}", _install_kit()))
    else:
        found += [fault(f"{_name(text)} is missing", pip_install(_bare(text))) for text in missing]
    found += wrong
    fine = len(texts) - len(missing) - len(wrong)
    found += _known_bad() + _doubled()
    if Requirement is not None:
        found += _companions(Requirement)
    return [ok(f"{fine} of {len(texts)} required packages are there, within their bounds"), *found]


def checkout() -> Path | None:
    """Return the folder of the checkout that runs this, if it is one."""
    folder = Path(__file__).resolve().parents[4]
    return folder if (folder / "pyproject.toml").is_file() else None


def requirements() -> tuple[list[str], list[str]]:
    """Return what the kit requires, and what of it the installed metadata does not know (an old editable install)."""
    try:
        installed = [r for r in metadata.requires(KIT) or () if "extra ==" not in r]
    except metadata.PackageNotFoundError:
        installed = None
    root = checkout()
    if root is None or sys.version_info < (3, 11):
        return installed or [], []
    import tomllib

    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    declared = list(project["dependencies"])
    missing = [] if installed is None else [r for r in declared if _key(r) not in {_key(i) for i in installed}]
    return declared, [r for r in missing if version_of(_name(r)) is None]


def version_of(distribution: str) -> str | None:
    """Return the installed version of a distribution, or None."""
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None


def _name(requirement: str) -> str:
    return re.split(r"[\s<>=!~;\[(@]", requirement.strip(), maxsplit=1)[0]


def _key(requirement: str) -> str:
    return re.sub(r"[-_.]+", "-", _name(requirement)).lower()


def _install_kit() -> Cure:
    root = checkout()
    return pip_install(KIT) if root is None else pip_install("--editable", str(root))


def _applies(text: str, requirement_class: Any) -> bool:
    """Whether a requirement is one on this system; without ``packaging`` its condition cannot be told."""
    if requirement_class is None:
        return ";" not in text
    marker = requirement_class(text).marker
    return marker is None or bool(marker.evaluate())


def _bare(text: str) -> str:
    """A requirement without its condition."""
    return text.partition(";")[0].strip()


def _check(text: str, requirement_class: Any) -> Finding | None:
    """Return what is wrong with the version of an installed requirement."""
    if requirement_class is None or not _applies(text, requirement_class):
        return None
    name, bare = _name(text), _bare(text)
    version = version_of(name)
    if version is None or requirement_class(bare).specifier.contains(version, prereleases=True):
        return None
    why = ""
    if name == "numpy" and version.startswith("1."):
        why = "packages compiled for NumPy 2 stop with an ABI error under NumPy 1"
    return fault(f"{name} {version} is installed; the kit needs {bare}", pip_install("--upgrade", bare), why)


def _known_bad() -> list[Finding]:
    found = []
    core = version_of("mujoco-core")
    if core == "4.0.0":
        found.append(
            fault(
                "mujoco-core 4.0.0 computes wrong contact forces (its sparse Newton factor is wrong)",
                pip_install("mujoco-core>=4.0.1"),
            )
        )
    if core and (full := version_of("mujoco")):
        found.append(
            warning(
                f"mujoco {full} and mujoco-core {core} put their files into the same folder and overwrite each other",
                everywhere(
                    f"{python('-m', 'pip', 'uninstall', '--yes', 'mujoco', 'mujoco-core')}, then "
                    f"{python('-m', 'pip', 'install', 'mujoco-core>=4.0.1')}"
                ),
            )
        )
    return found


def _companions(requirement_class: Any) -> list[Finding]:
    """Neighbours whose own demands are not met: a torchvision made for another torch stops when it is imported."""
    found = []
    for name in COMPANIONS:
        version = version_of(name)
        for text in (metadata.requires(name) or ()) if version else ():
            requirement = requirement_class(text)
            if "extra ==" in text or (requirement.marker is not None and not requirement.marker.evaluate()):
                continue
            there = version_of(requirement.name)
            if there and not requirement.specifier.contains(there.partition("+")[0], prereleases=True):
                found.append(
                    fault(
                        f"{name} {version} is made for {requirement.name}{requirement.specifier}, and {there} is "
                        "installed",
                        everywhere(
                            f"{python('-m', 'pip', 'install', '--upgrade', name)} (the kit does not need it: "
                            f"{python('-m', 'pip', 'uninstall', name)} helps as well)"
                        ),
                    )
                )
    return found


def _doubled() -> list[Finding]:
    """Packages with two records of their version, and what an interrupted pip left behind."""
    found = []
    for folder in map(Path, filter(None, sys.path)):
        try:
            entries = [p.name for p in folder.iterdir()]
        except OSError:
            continue
        left = sorted(name for name in entries if name.startswith("~"))
        if left:
            found.append(
                note(
                    f"an interrupted pip left {', '.join(left)} in {folder}",
                    everywhere(f"Delete these entries of {folder}; nothing uses them."),
                )
            )
        twice = _twice(n for n in entries if n.endswith((".dist-info", ".egg-info")) and n not in left)
        found += [
            warning(
                f"{name} has two records of its version in {folder}: an interrupted installation",
                everywhere(
                    f"{python('-m', 'pip', 'uninstall', '--yes', name)} (until nothing is left of it), then "
                    f"{python('-m', 'pip', 'install', name)}"
                ),
            )
            for name in twice
        ]
    return found


def _twice(names: Iterable[str]) -> list[str]:
    counts = Counter(re.sub(r"[-_.]+", "-", name.partition("-")[0]).lower() for name in names)
    return sorted(name for name, count in counts.items() if count > 1)
