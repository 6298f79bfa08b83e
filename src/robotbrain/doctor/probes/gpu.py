"""NVIDIA GPUs and Jetson boards. Neither is needed; where there is one, driver and packages must fit."""

from __future__ import annotations

import ast
import importlib.machinery
import re
import shutil
import subprocess
import sys
from pathlib import Path

from robotbrain.doctor.finding import Cure, Finding, Situation, everywhere, note, ok, python, warning

# The oldest driver that runs a CUDA release (NVIDIA's release notes, "CUDA Driver minor version compatibility").
_LEAST_DRIVER = {"11": (450, 80), "12": (525, 60), "13": (580, 0)}


def gpu(situation: Situation) -> list[Finding]:
    """Whether there is a GPU or a Jetson, and whether torch can use it."""
    return _jetson(situation) or _desktop(situation)


def torch_build() -> tuple[str, str | None] | None:
    """Return torch's version and the CUDA release it was built for (None: processor only), without importing it."""
    spec = importlib.machinery.PathFinder.find_spec("torch", sys.path)
    if spec is None or not spec.origin:
        return None
    try:
        tree = ast.parse(Path(spec.origin).with_name("version.py").read_text(encoding="utf-8"))
    except (OSError, SyntaxError):
        return None
    values: dict[str, object] = {}
    for line in tree.body:
        if not isinstance(line, (ast.Assign, ast.AnnAssign)) or not isinstance(line.value, ast.Constant):
            continue
        for target in line.targets if isinstance(line, ast.Assign) else [line.target]:
            if isinstance(target, ast.Name):
                values[target.id] = line.value.value
    cuda = values.get("cuda")
    return str(values.get("__version__", "")), cuda if isinstance(cuda, str) else None


def _desktop(situation: Situation) -> list[Finding]:
    program = shutil.which("nvidia-smi")
    build = torch_build()
    if program is None:
        extra = ""
        if build is not None and build[1]:
            extra = f"; torch {build[0]} carries CUDA {build[1]} (2 GB that nothing uses)"
        return [ok(f"no NVIDIA GPU; none is needed{extra}")]
    said, why = _run([program, "--query-gpu=name,driver_version", "--format=csv,noheader"], situation)
    if why:
        return [
            warning(
                "nvidia-smi is installed, but it does not reach a GPU",
                Cure(
                    "Restart after a driver update; then `sudo ubuntu-drivers install` (in a container: start it with "
                    "--gpus all). The kit runs without a GPU.",
                    "The kit runs without a GPU: remove nvidia-smi from PATH.",
                    "Install the driver again from https://www.nvidia.com/drivers. The kit runs without a GPU.",
                ),
                why,
            )
        ]
    name, _, driver = (part.strip() for part in said.splitlines()[0].rpartition(","))
    numbers = tuple(int(part) for part in re.findall(r"\d+", driver)[:2])
    if build is None:
        return [ok(f"{name}, driver {driver}")]
    version, cuda = build
    if cuda is None:
        return [
            note(
                f"{name}, driver {driver}; torch {version} is the build without CUDA and does not use it",
                everywhere(
                    f"{python('-m', 'pip', 'install', '--force-reinstall', 'torch')} --index-url "
                    f"https://download.pytorch.org/whl/{_wheel(numbers)} (the course does not need it)"
                ),
            )
        ]
    least = _LEAST_DRIVER.get(cuda.partition(".")[0], (0, 0))
    if numbers < least:
        return [
            warning(
                f"driver {driver} of {name} is too old for torch {version} (CUDA {cuda} needs {least[0]}.{least[1]} or "
                "newer): torch falls back to the processor",
                Cure(
                    f"sudo ubuntu-drivers install (driver {least[0]} or newer), then restart; or a torch for this "
                    f"driver: {python('-m', 'pip', 'install', '--force-reinstall', 'torch')} --index-url "
                    f"https://download.pytorch.org/whl/{_wheel(numbers)}",
                    "The kit runs without a GPU.",
                    f"Install driver {least[0]} or newer from https://www.nvidia.com/drivers, then restart",
                ),
            )
        ]
    return [ok(f"{name}, driver {driver}, torch for CUDA {cuda}")]


def _wheel(driver: tuple[int, ...]) -> str:
    """The folder of torch's newest builds that a driver runs."""
    return "cu130" if driver >= (580, 0) else "cu126" if driver >= (525, 60) else "cpu"


def _jetson(situation: Situation) -> list[Finding]:
    from robotbrain.jetson.measure.board import read_board

    board = read_board()
    if not board.is_jetson:
        return []
    linux = f"Jetson Linux {board.jetson_linux}" if board.jetson_linux else "an unknown Jetson Linux"
    found = [ok(f"{board.model or board.slug or 'a Jetson'}, {linux}, JetPack {board.jetpack or '(no package)'}")]
    if board.jetson_linux is None:
        found.append(
            warning(
                "the board does not say which Jetson Linux it runs (/etc/nv_tegra_release)",
                Cure(
                    "sudo apt install --reinstall nvidia-l4t-core; in a container: --volume /etc/nv_tegra_release:"
                    "/etc/nv_tegra_release:ro"
                ),
            )
        )
    if board.jetpack is None:
        found.append(
            warning(
                "the package nvidia-jetpack is not installed: no TensorRT, no CUDA",
                Cure("sudo apt update && sudo apt install nvidia-jetpack"),
            )
        )
    build = torch_build()
    if build is not None and build[1] is None:
        found.append(
            warning(
                f"torch {build[0]} is the build without CUDA; it does not use the Jetson's GPU",
                Cure(
                    "Install the build for this JetPack that NVIDIA names: "
                    "https://docs.nvidia.com/deeplearning/frameworks/install-pytorch-jetson-platform/"
                ),
            )
        )
    mode, why = _run(["nvpmodel", "-q"], situation)
    if why:
        found.append(
            note("the power mode cannot be read: latencies depend on it", Cure("sudo nvpmodel -q", "", ""), detail=why)
        )
    else:
        found.append(
            note(
                f"power mode: {' '.join(mode.split()).replace('NV Power Mode: ', '')}; figures hold for one mode",
                Cure("sudo nvpmodel -m 0 (`nvpmodel -p --verbose` lists them); sudo jetson_clocks keeps clocks steady"),
            )
        )
    return found


def _run(command: list[str], situation: Situation) -> tuple[str, str]:
    """Return what a program says, or why it does not."""
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            encoding="utf-8",
            errors="replace",
            check=False,
            timeout=min(15.0, situation.limit_s),
            stdin=subprocess.DEVNULL,
        )
    except (OSError, subprocess.SubprocessError) as error:
        return "", str(error)
    if done.returncode or not done.stdout.strip():
        lines = (done.stderr or done.stdout).strip().splitlines()
        return "", lines[-1] if lines else f"exit code {done.returncode}"
    return done.stdout, ""
