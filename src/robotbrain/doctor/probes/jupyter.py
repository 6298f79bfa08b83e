"""JupyterLab: what it is, which kernels it offers, and whether nbgrader's buttons are in it."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from robotbrain.doctor.finding import (
    Cure,
    Finding,
    Situation,
    everywhere,
    fault,
    ok,
    pip_install,
    posix_or_windows,
    python,
    quoted,
    reinstall,
    warning,
)
from robotbrain.doctor.probes.packages import version_of

KERNEL = "python3"
"""The kernel that the notebooks of the course ask for."""

SERVER_EXTENSIONS = {
    "nbgrader.server_extensions.validate_assignment": "the Validate button",
    "nbgrader.server_extensions.assignment_list": "the list of assignments",
    "nbgrader.server_extensions.formgrader": "formgrader (for instructors)",
}
FOR_INSTRUCTORS = ("nbgrader.server_extensions.formgrader",)
"""Turned off for students by the kit itself; `robotbrain lab --instructor` turns them on."""

LAB_EXTENSION = "@jupyter/nbgrader"
LAB_PLUGINS = {
    f"{LAB_EXTENSION}:validate-assignment": "the Validate button",
    f"{LAB_EXTENSION}:assignment-list": "the list of assignments",
}
_NATIVE = ("python", f"python{sys.version_info[0]}", f"python{sys.version_info[0]}.{sys.version_info[1]}")


def jupyter(_: Situation) -> list[Finding]:
    """JupyterLab and the command that starts it."""
    version = version_of("jupyterlab")
    if version is None:
        return [fault("JupyterLab is missing", pip_install("jupyterlab>=4.4"))]
    if version_of("jupyter-core") is None:
        return [fault("jupyter-core, which every part of Jupyter needs, is missing", pip_install("jupyter-core"))]
    old = version_of("notebook")
    found = []
    if old and old.split(".")[0] in ("5", "6"):
        found.append(
            warning(
                f"notebook {old} is installed beside JupyterLab {version}; nbgrader's extensions are for notebook 7",
                pip_install("--upgrade", "notebook>=7"),
            )
        )
    import jupyter_core.paths as paths

    broken = [path for folder in paths.jupyter_config_path() for path in Path(folder).glob("**/*.json") if _bad(path)]
    found += [
        fault(
            f"Jupyter's settings {path} are no JSON: the server stops, or forgets what stands there",
            posix_or_windows(f"mv {quoted(path)} {quoted(path)}.broken", f'Move-Item "{path}" "{path}.broken"'),
            detail=_bad(path),
        )
        for path in broken
    ]
    return [ok(f"JupyterLab {version}"), *found]


def kernels(situation: Situation) -> list[Finding]:
    """The kernel of the notebooks runs this environment's Python; no kernel leads to a Python that is gone."""
    if version_of("jupyter-client") is None or version_of("ipykernel") is None:
        return [fault("ipykernel, which runs the cells of notebooks, is missing", pip_install("ipykernel"))]
    found: list[Finding] = []
    specs = _kernel_specs()
    if KERNEL not in specs:
        specs[KERNEL] = None  # Jupyter then makes one for the Python it runs in itself
    for name, folder in sorted(specs.items()):
        found += _kernel(name, folder, situation)
    return found or [ok(f"the kernel {KERNEL} runs {sys.executable}")]


def _kernel_specs() -> dict[str, Path | None]:
    """Kernels by name; as in Jupyter the first folder of its path that has one wins."""
    from jupyter_core.paths import jupyter_path

    specs: dict[str, Path | None] = {}
    for folder in map(Path, jupyter_path("kernels")):
        for file in sorted(folder.glob("*/kernel.json")):
            specs.setdefault(file.parent.name.lower(), file.parent)
    return specs


def _kernel(name: str, folder: Path | None, situation: Situation) -> list[Finding]:
    install = python("-m", "ipykernel", "install", "--sys-prefix", "--name", KERNEL)
    if folder is None:
        return []
    file = folder / "kernel.json"
    spec = _read(file)
    needed = name == KERNEL
    say = fault if needed else warning
    remove = posix_or_windows(f"rm -r {quoted(folder)}", f'Remove-Item -Recurse "{folder}"').here()
    cure = everywhere(f"{remove}; then {install}" if needed else remove)
    words = spec.get("argv") if isinstance(spec, dict) else None
    if not isinstance(words, list) or not words or not all(isinstance(word, str) for word in words):
        return [say(f"the kernel {name} cannot be read: {file}", cure)]
    if not needed and spec.get("language") != "python":
        return []
    program = words[0]
    if program in _NATIVE:
        return []  # Jupyter puts in the Python it runs in itself
    found = shutil.which(program)
    if found is None:
        return [say(f"the kernel {name} ({folder}) starts {program}, which does not exist", cure)]
    if not needed or _same(Path(found), Path(sys.executable)):
        return []
    prefix, why = _prefix_of(found, min(20.0, situation.limit_s))
    if prefix is None:
        what = f"the kernel {name} ({folder}) starts {found}, which cannot import robotbrain"
        return [fault(what, everywhere(f"{remove}; then {install}"), why)]
    if not _same(prefix, Path(sys.prefix)):
        return [
            warning(
                f"the kernel {name} ({folder}) starts the Python of another environment, {prefix}: what is installed "
                f"here ({sys.prefix}) is not seen in notebooks",
                everywhere(install),
            )
        ]
    return []


def _prefix_of(interpreter: str, limit_s: float) -> tuple[Path | None, str]:
    """Ask another Python for its environment; None, and why, if it cannot import the kit."""
    try:
        done = subprocess.run(
            [interpreter, "-c", "import sys, robotbrain; print(sys.prefix)"],
            capture_output=True,
            text=True,
            encoding="utf-8",
            errors="replace",
            timeout=limit_s,
            check=False,
            stdin=subprocess.DEVNULL,
        )
    except (OSError, subprocess.SubprocessError) as error:
        return None, str(error)
    if done.returncode:
        lines = done.stderr.strip().splitlines()
        return None, lines[-1] if lines else f"exit code {done.returncode}"
    return Path(done.stdout.strip().splitlines()[-1]), ""


def _same(one: Path, other: Path) -> bool:
    # Not resolved: the interpreters of two environments are links to the same file.
    return Path(one).absolute() == Path(other).absolute()


def extensions(_: Situation) -> list[Finding]:
    """Nbgrader's parts for the server and for JupyterLab are installed and not turned off."""
    if version_of("nbgrader") is None:
        return [fault("nbgrader is missing", pip_install("nbgrader>=0.9.6"))]
    from jupyter_core.paths import jupyter_config_path, jupyter_path

    found: list[Finding] = []
    configs = [Path(folder) for folder in jupyter_config_path()]
    found += _server_parts(configs)
    folder = next((p for f in jupyter_path("labextensions") if (p := Path(f, LAB_EXTENSION)).is_dir()), None)
    if folder is None:
        found.append(
            fault(
                "nbgrader's JupyterLab extension is not in this environment: no Validate button, no assignment list",
                reinstall("nbgrader"),
            )
        )
    else:
        state = _read(folder / "package.json")
        version = state.get("version") if isinstance(state, dict) else None
        if version != version_of("nbgrader"):
            found.append(
                warning(
                    f"nbgrader's JupyterLab extension in {folder} is version {version}; nbgrader is "
                    f"{version_of('nbgrader')}",
                    reinstall("nbgrader"),
                )
            )
    disabled = _disabled(configs)
    for plugin, purpose in LAB_PLUGINS.items():
        if origin := disabled.get(plugin) or disabled.get(LAB_EXTENSION):
            found.append(
                fault(
                    f"nbgrader's JupyterLab extension for {purpose} is turned off in {origin}",
                    everywhere(f'In {origin} take "{plugin}" out of "disabledExtensions", then reload JupyterLab'),
                )
            )
    return found or [ok("nbgrader's extensions of server and JupyterLab are installed and turned on")]


def _server_parts(configs: Sequence[Path]) -> list[Finding]:
    """Server extensions that are missing or turned off, for `robotbrain lab` or for a plain `jupyter lab` only."""
    from robotbrain.jupyter import CONFIG

    found = []
    plain, origins = server_extensions(configs)
    in_lab, _ = server_extensions([CONFIG, *configs])
    for name, purpose in SERVER_EXTENSIONS.items():
        if name not in plain:
            found.append(fault(f"nbgrader's server extension for {purpose} is not registered", reinstall("nbgrader")))
        elif not plain[name] and not in_lab[name] and name not in FOR_INSTRUCTORS:
            found.append(fault(_turned_off(purpose, origins[name]), _turn_on(name, origins[name])))
        elif not plain[name]:
            what = f"{_turned_off(purpose, origins[name])} (`robotbrain lab` turns it on again)"
            found.append(warning(what, _turn_on(name, origins[name])))
    return found


def _turned_off(purpose: str, file: Path) -> str:
    return f"nbgrader's server extension for {purpose} is turned off in {file}"


def _turn_on(name: str, file: Path) -> Cure:
    # `jupyter server extension enable` writes elsewhere, to a file that this one overrides.
    return everywhere(f'In {file} change "{name}": false to "{name}": true, then start JupyterLab again')


def server_extensions(configs: Sequence[Path]) -> tuple[dict[str, bool], dict[str, Path]]:
    """Return whether each server extension is turned on, and the file that decides.

    Args:
        configs: folders of Jupyter's settings, the most important one first. As for the server itself, what stands in
            a folder's ``jupyter_server_config.json`` precedes all of the ``.d`` folders, where packages put theirs.
    """
    files = [f for c in reversed(configs) for f in sorted((c / "jupyter_server_config.d").glob("*.json"))]
    files += [c / "jupyter_server_config.json" for c in reversed(configs)]
    enabled: dict[str, bool] = {}
    origins: dict[str, Path] = {}
    for file in files:
        section = _read(file)
        for key in ("ServerApp", "jpserver_extensions"):
            section = section.get(key) if isinstance(section, dict) else None
        for name, state in section.items() if isinstance(section, dict) else ():
            enabled[name], origins[name] = bool(state), file
    return enabled, origins


def _disabled(configs: Iterable[Path]) -> dict[str, Path]:
    """JupyterLab plugins that are turned off, with the file that says so."""
    disabled: dict[str, Path] = {}
    share = Path(sys.prefix, "share", "jupyter", "lab", "settings")
    for folder in (share, *(c / "labconfig" for c in reversed(list(configs)))):
        file = folder / "page_config.json"
        page = _read(file)
        section = page.get("disabledExtensions") if isinstance(page, dict) else None
        states = dict.fromkeys(section, True) if isinstance(section, list) else section
        for name, off in states.items() if isinstance(states, dict) else ():
            if off:
                disabled[name] = file
            else:
                disabled.pop(name, None)
    return disabled


def _read(file: Path) -> Any:
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def _bad(file: Path) -> str:
    try:
        json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        return str(error)
    except OSError:
        pass
    return ""
