"""A real JupyterLab on a copy of the course, and a real browser to look at it."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import psutil

T = TypeVar("T")

TOKEN = "browser-test"
WHOLE = os.environ.get("ROBOTBRAIN_PROOF") == "browser"  # `make proof-browser`: every lesson, every lab, every cell
CHROMIUM_ARGUMENTS = (
    "--no-sandbox",
    "--disable-gpu",
    "--use-angle=swiftshader",  # WebGL without a graphics card: meshcat needs it
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
)


@dataclass(frozen=True)
class LabServer:
    """A running ``robotbrain lab``: its address, the copied course, the user's home and the process."""

    url: str
    course: Path
    home: Path
    process: psutil.Popen

    def address(self, notebook: str = "", workspace: str = "") -> str:
        """The address of a notebook in a workspace of its own, or of the server's front page."""
        path = f"/lab/workspaces/{workspace}/tree/{notebook}" if notebook else "/"
        return f"{self.url}{path}?token={TOKEN}"


def wait_until(
    condition: Callable[[], T | None], timeout_s: float, what: Callable[[], str] | str, every_s: float = 0.2
) -> T:
    """Return the first true value of ``condition()``, or fail saying ``what`` did not happen."""
    end = time.monotonic() + timeout_s
    while not (value := condition()):
        if time.monotonic() > end:
            raise AssertionError(f"not within {timeout_s:g} s: {what if isinstance(what, str) else what()}")
        time.sleep(every_s)
    return value


def copy_course(repo: Path, target: Path) -> Path:
    """Copy the folders that notebooks need, so that nothing a browser does reaches the checkout."""
    ignore = shutil.ignore_patterns(".ipynb_checkpoints", "__pycache__")
    for folder in ("course", "labs", "solutions", "autograder/hidden"):
        shutil.copytree(repo / folder, target / folder, ignore=ignore)
    return target


@contextlib.contextmanager
def serve(course: Path, scratch: Path, *options: str) -> Iterator[LabServer]:
    """Run ``robotbrain lab`` on ``course`` as a user who never used Jupyter; on exit nothing of it is left running."""
    home = _home(scratch)
    port = free_port()
    log = scratch / "jupyterlab.log"
    command = [
        sys.executable,
        "-m",
        "robotbrain.cli",
        "lab",
        "--no-browser",
        "--port",
        str(port),
        "--directory",
        str(course),
        *options,
    ]
    with log.open("wb") as output:
        process = psutil.Popen(
            command, env=user_environment(home), cwd=scratch, stdout=output, stderr=subprocess.STDOUT
        )
    url = f"http://127.0.0.1:{port}"
    try:
        wait_for_server(process, url, log)
        yield LabServer(url, course, home, process)
    finally:
        end_tree(process)


def wait_for_server(process: psutil.Popen, url: str, log: Path) -> None:
    """Wait until a Jupyter server at ``url`` answers; fail with its log if it ends instead."""

    def up() -> bool:
        if process.poll() is not None:
            raise AssertionError(
                f"the server ended with {process.returncode}:\n{log.read_text(encoding='utf-8', errors='replace')}"
            )
        try:
            with urllib.request.urlopen(f"{url}/api/status?token={TOKEN}", timeout=5) as reply:
                return bool(reply.status == 200)
        except (urllib.error.URLError, OSError):
            return False

    wait_until(up, 90, lambda: f"an answer from {url}\n{log.read_text(encoding='utf-8', errors='replace')}")


def end_tree(process: psutil.Popen) -> None:
    """Kill a process and all that it started (kernels too: they have process groups of their own)."""
    try:
        family = [*process.children(recursive=True), process]
    except psutil.NoSuchProcess:
        return
    for member in family:
        with contextlib.suppress(psutil.NoSuchProcess):
            member.kill()
    psutil.wait_procs(family, timeout=20)


def _home(scratch: Path) -> Path:
    home = scratch / "home"
    config = home / "jupyter" / "config"
    config.mkdir(parents=True)
    # A user who lets the world in for other purposes has not asked for that here.
    server = {"ServerApp": {"allow_root": True, "ip": "0.0.0.0", "root_dir": str(home)}}
    (config / "jupyter_server_config.json").write_text(json.dumps(server))
    # Lets a test ask the page about notebook and kernel: cells out of view are not in its document.
    (config / "jupyter_lab_config.json").write_text(json.dumps({"LabApp": {"expose_app_in_browser": True}}))
    return home


def user_environment(home: Path) -> dict[str, str]:
    """Variables for the user whose home is ``home``: nothing of this machine's Jupyter, and a fixed token."""
    kept = {
        k: v for k, v in os.environ.items() if not k.startswith(("JUPYTER", "ROBOTBRAIN", "NBGRADER", "MPLBACKEND"))
    }
    return kept | {
        "HOME": str(home),
        "USERPROFILE": str(home),
        "JUPYTER_CONFIG_DIR": str(home / "jupyter" / "config"),
        "JUPYTER_DATA_DIR": str(home / "jupyter" / "data"),
        "JUPYTER_RUNTIME_DIR": str(home / "jupyter" / "runtime"),
        "IPYTHONDIR": str(home / "ipython"),
        "MPLCONFIGDIR": str(home / "matplotlib"),
        "JUPYTER_TOKEN": TOKEN,
    }


def free_port() -> int:
    """A TCP port that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
