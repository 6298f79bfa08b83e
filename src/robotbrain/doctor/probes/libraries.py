"""Whether the packages can be imported, and the native ones compute. Each is tried where it cannot break anything."""

from __future__ import annotations

import importlib.metadata as metadata
import re
from collections.abc import Sequence

from robotbrain.doctor.finding import (
    Cure,
    Finding,
    Situation,
    everywhere,
    fault,
    ok,
    reinstall,
    unset_variable,
)
from robotbrain.doctor.isolated import Outcome, try_out
from robotbrain.doctor.probes.packages import version_of

MODULES = {
    "bleach": "bleach",
    "ddsketch": "ddsketch",
    "gymnasium": "gymnasium",
    "ipython": "IPython",
    "ipywidgets": "ipywidgets",
    "jinja2": "jinja2",
    "jupyter-client": "jupyter_client",
    "jupyterlab": "jupyterlab",
    "markupsafe": "markupsafe",
    "matplotlib": "matplotlib.pyplot",
    "mcap": "mcap",
    "meshcat": "meshcat",
    "msgpack": "msgpack",
    "mujoco-core": "mujoco",
    "nbclient": "nbclient",
    "nbconvert": "nbconvert",
    "nbformat": "nbformat",
    "nbgrader": "nbgrader",
    "numpy": "numpy",
    "onnx": "onnx",
    "onnxruntime": "onnxruntime",
    "psutil": "psutil",
    "pygments": "pygments",
    "pyseccomp": "pyseccomp",
    "pyyaml": "yaml",
    "rosbags": "rosbags",
    "scipy": "scipy.optimize",
    "torch": "torch",
    "torch-pruning": "torch_pruning",
    "torchao": "torchao",
    "tqdm": "tqdm",
    "traitlets": "traitlets",
    "u-msgpack-python": "umsgpack",
}
"""What to import of each distribution that the kit requires."""

_TORCH = ("torch", "torch-pruning", "torchao")
_JUPYTER = (
    "bleach",
    "ipython",
    "ipywidgets",
    "jinja2",
    "jupyter-client",
    "jupyterlab",
    "markupsafe",
    "nbclient",
    "nbconvert",
    "nbformat",
    "nbgrader",
    "pygments",
    "traitlets",
)
_COMPUTES = ("torch", "onnxruntime", "mujoco")


def libraries(situation: Situation) -> list[Finding]:
    """NumPy, SciPy, MuJoCo, ONNX Runtime and the small ones."""
    names = [name for name in MODULES if name not in _TORCH + _JUPYTER]
    # pyseccomp needs libseccomp as well, and only the grading sandbox needs pyseccomp: that probe speaks of it.
    return _probe([name for name in names if name != "pyseccomp"], situation)


def torch(situation: Situation) -> list[Finding]:
    """Torch and what builds on it."""
    return _probe(_TORCH, situation)


def jupyter_libraries(situation: Situation) -> list[Finding]:
    """JupyterLab, nbgrader and what they bring."""
    return _probe(_JUPYTER, situation)


def _probe(distributions: Sequence[str], situation: Situation) -> list[Finding]:
    trials = {}
    for name in distributions:
        if version_of(name) is None:
            continue  # the probe of versions says so
        trials[f"import:{MODULES[name]}"] = name
        if MODULES[name] in _COMPUTES:
            trials[MODULES[name]] = name
    if not trials:
        return []
    outcomes = try_out(list(trials), situation.limit_s)
    found: list[Finding] = []
    broken: set[str] = set()
    for trial, outcome in outcomes.items():
        name = trials[trial]
        if not outcome.fine and name not in broken:
            broken.add(name)
            found.append(_finding(name, trial, outcome))
    fine = sum(name not in broken for name in set(trials.values()))
    return [ok(f"{fine} of {len(set(trials.values()))} packages work"), *found]


def _finding(name: str, trial: str, outcome: Outcome) -> Finding:
    doing = "imported" if trial.startswith("import:") else "used"
    version = version_of(name)
    if outcome.state == "hung":
        what = f"{name} {version} hangs when it is {doing}"
    elif outcome.state == "died":
        what = f"{name} {version} takes Python down when it is {doing}"
    elif outcome.state == "unable":
        what = f"{name} {version} could not be tried"
    else:
        what = f"{name} {version} cannot be {doing}"
    return fault(what, _cure(name, outcome.message), outcome.message)


def _cure(name: str, message: str) -> Cure:
    """What helps against this error, as far as its words tell."""
    if "MUJOCO_GL" in message:
        return unset_variable("MUJOCO_GL")
    if library := re.search(r"(lib[\w+.-]+\.so[.\d]*): cannot open shared object", message):
        return _system_library(name, library.group(1))
    if "DLL load failed" in message or "DLL is missing" in message:
        return everywhere("winget install Microsoft.VCRedist.2015+.x64, then open a new terminal")
    if "SIGILL" in message or "illegal instruction" in message:
        return everywhere(
            f"This processor lacks instructions (AVX) that {name} was built with: use a computer from 2013 or later, "
            "or switch on passing the host's processor through in the settings of the virtual machine."
        )
    if "SIGKILL" in message or "MemoryError" in message:
        return everywhere("Memory ran out: close other programs, or give the virtual machine 4 GB or more.")
    if other := re.search(r"No module named '([\w.]+)'", message):
        missing = other.group(1).partition(".")[0]
        if missing != MODULES[name].partition(".")[0]:
            return reinstall(name, _distribution(missing))
    if "numpy.core.multiarray" in message or "compiled using NumPy 1" in message or "_ARRAY_API" in message:
        return reinstall("numpy>=2.1", name)
    return reinstall(name)


def _distribution(module: str) -> str:
    by_module = {of.partition(".")[0]: name for name, of in MODULES.items()}
    return by_module.get(module) or next(iter(metadata.packages_distributions().get(module, [module])))


_DEBIAN = {
    "libGL.so": "libgl1",
    "libEGL.so": "libegl1",
    "libOSMesa.so": "libosmesa6",
    "libgomp.so": "libgomp1",
    "libstdc++.so": "libstdc++6",
    "libseccomp.so": "libseccomp2",
    "libX11.so": "libx11-6",
}


def _system_library(name: str, library: str) -> Cure:
    stem = library.partition(".so")[0] + ".so"
    package = _DEBIAN.get(stem)
    linux = (
        f"sudo apt install {package} (Fedora: sudo dnf install '*/{library}')"
        if package
        else f"Install the system package that has {library} (Debian, Ubuntu: apt-file search {library}; Fedora: "
        f"sudo dnf install '*/{library}')"
    )
    other = reinstall(name).here()
    return Cure(linux, other, other)
