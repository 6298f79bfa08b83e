"""Where a program can run: on the kit in this Python, or on genuine rclpy in a virtual environment of its own.

Genuine wheels install a ``.pth`` that re-executes every Python start, so they never go into the kit's environment.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import venv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
PROGRAMS = HERE / "programs"
EXPECTED = HERE / "expected"
DISTROS = ("kilted", "jazzy")
CACHE_VARIABLE = "ROBOTBRAIN_CONFORMANCE_CACHE"
DEFAULT_CACHE = HERE.parents[1] / "build" / "conformance"
PACKAGES = ("rclpy", "rmw-fastrtps-cpp", "common-interfaces", "test-msgs")
"""``test-msgs`` has the action of the programs: of all packages on PyPI with actions it is the only standard one."""

ENVIRONMENT: dict[str, dict[str, str]] = {"messages_unchecked": {"ROS_PYTHON_CHECK_FIELDS": "0"}}
"""Environment variables of single programs."""

Line = dict[str, Any]
"""One line of a decision log: ``event`` and its fields."""

_ON_THE_KIT = (
    "import runpy, sys; import robotbrain.ros; "
    "sys.argv = sys.argv[1:]; sys.path.insert(0, sys.argv.pop(0)); runpy.run_path(sys.argv[0], run_name='__main__')"
)


class ProgramError(RuntimeError):
    """A program ended with an error or took too long; the message holds what it printed."""


@dataclass(frozen=True)
class Backend:
    """One rclpy to run programs on.

    Attributes:
        name: ``kit`` or a ROS 2 distribution.
        python: interpreter whose environment has it.
    """

    name: str
    python: Path

    def command(self, program: Path, *arguments: str) -> list[str]:
        """Return the command that runs a program file as a student would."""
        if self.name == "kit":
            return [str(self.python), "-c", _ON_THE_KIT, str(program.parent), str(program), *arguments]
        return [str(self.python), str(program), *arguments]

    def environment(self, domain: int) -> dict[str, str]:
        """Return environment variables: nothing leaves this machine, and no two runs see each other."""
        inherited = {
            key: value for key, value in os.environ.items() if not key.startswith(("ROS_", "RMW_", "RCUTILS_"))
        }
        chosen = {
            "ROS_DOMAIN_ID": str(domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
            # Without it genuine messages take any value, and the process dies when such a one is published.
            "ROS_PYTHON_CHECK_FIELDS": "1",
            "ROBOTBRAIN_ROS_BACKEND": "kit" if self.name == "kit" else "",
        }
        return {**inherited, **chosen}

    def run(self, program: Path, *, domain: int, timeout_s: float = 120.0) -> list[Line]:
        """Run a program and return its decision log.

        Raises:
            ProgramError: it failed or took longer than ``timeout_s`` (wall-clock seconds).
        """
        with tempfile.TemporaryDirectory(prefix="conformance-") as folder:
            target = Path(folder) / "log.jsonl"
            environment = {**self.environment(domain), **ENVIRONMENT.get(program.stem, {})}
            environment |= {"CONFORMANCE_LOG": str(target), "ROS_LOG_DIR": folder}
            try:
                done = subprocess.run(
                    self.command(program), env=environment, cwd=folder, timeout=timeout_s, capture_output=True,
                    text=True, encoding="utf-8", errors="replace", check=False,
                )  # fmt: skip
            except subprocess.TimeoutExpired as error:
                raise ProgramError(f"{program.stem} on {self.name} took longer than {timeout_s:g} s") from error
            lines = read_log(target) if target.exists() else []
            if done.returncode != 0:
                tail = "\n".join((done.stdout + done.stderr).strip().splitlines()[-25:])
                raise ProgramError(f"{program.stem} on {self.name}: exit code {done.returncode}\n{tail}")
            return lines


def read_log(path: Path) -> list[Line]:
    """Read a decision log."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def write_log(path: Path, lines: Sequence[Line]) -> None:
    """Write a decision log."""
    path.parent.mkdir(parents=True, exist_ok=True)
    text = "".join(json.dumps(line, sort_keys=True) + "\n" for line in lines)
    path.write_text(text, encoding="utf-8", newline="\n")


def programs(names: Sequence[str] = ()) -> list[Path]:
    """Return the program files in order of name; only those of ``names`` unless that is empty."""
    found = [path for path in sorted(PROGRAMS.glob("*.py")) if path.stem != "conformance"]
    unknown = set(names) - {path.stem for path in found}
    if unknown:
        raise SystemExit(
            f"no such program: {', '.join(sorted(unknown))}; there are: {', '.join(p.stem for p in found)}"
        )
    return [path for path in found if not names or path.stem in names]


def cache_folder(option: Path | None = None) -> Path:
    """Return where the environments are kept: the option, the environment variable, or ``build/conformance``."""
    return (option or Path(os.environ.get(CACHE_VARIABLE) or DEFAULT_CACHE)).resolve()


def kit() -> Backend:
    """Return the kit in the Python that runs this."""
    return Backend("kit", Path(sys.executable))


def genuine(distro: str, cache: Path, also: Sequence[str] = ()) -> Backend:
    """Return genuine rclpy of a distribution; its environment is made and filled when first used.

    Args:
        distro: name of the distribution.
        cache: folder of the environments.
        also: further packages; an environment with such is another one.
    """
    if not (sys.platform == "linux" and os.uname().machine == "x86_64"):
        raise SystemExit("Genuine rclpy comes from PyPI for Linux on x86-64 only; elsewhere use --only kit.")
    folder = cache / (f"{distro}-drive" if also else distro)
    python = folder / "bin" / "python"
    done = folder / ".complete"
    wanted = [f"ros-{distro}-{package}" for package in PACKAGES] + list(also)
    if not done.exists() or done.read_text(encoding="utf-8").split() != wanted:
        print(f"making {folder} ({', '.join(wanted)}) ...", flush=True)
        venv.create(folder, with_pip=True)
        subprocess.run([str(python), "-m", "pip", "install", "--quiet", *wanted], check=True)
        done.write_text("\n".join(wanted) + "\n", encoding="utf-8")
    return Backend(distro, python)


def versions(backend: Backend) -> dict[str, str]:
    """Return the versions of rclpy, its middleware and the interfaces in an environment."""
    if backend.name == "kit":
        from importlib.metadata import version

        return {"robotbrain": version("robotbrain")}
    shown = [f"ros-{backend.name}-{package}" for package in PACKAGES]
    code = "import sys, json, importlib.metadata as m; print(json.dumps({n: m.version(n) for n in sys.argv[1:]}))"
    done = subprocess.run([str(backend.python), "-c", code, *shown], check=True, capture_output=True, text=True)
    answer: dict[str, str] = json.loads(done.stdout)
    return answer
