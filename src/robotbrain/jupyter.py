"""``robotbrain lab``: JupyterLab on the course, with nbgrader's Validate button ready to use.

What nbgrader and JupyterLab need to know stands in ``jupyter_config/`` beside this file, which is put first on
Jupyter's search path for this one server. Nothing of the user's own configuration is changed, and their theme and
shortcuts apply. In that folder,

- ``nbgrader_config.json`` gives Validate the same patience as grading, and lets it pass over cells that only show;
- ``jupyter_server_config.d`` turns on nbgrader's extensions for students, whatever the user turned off elsewhere;
- ``labconfig`` hides what is for instructors, and JupyterLab's question about news: a course opens with the course.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping
from pathlib import Path

from robotbrain.errors import InputError

LANDING = "course/00_welcome.ipynb"
CONFIG = Path(__file__).with_name("jupyter_config")


def find_course(start: str | Path | None = None) -> Path:
    """Return the folder that holds ``course/`` and ``labs/``.

    Args:
        start: a folder of the course, at any depth. By default the working directory, and failing that the checkout
            that this package was installed from.

    Raises:
        InputError: there is no course at, above or (by default) behind ``start``.
    """
    here = Path(start or Path.cwd()).resolve()
    places = [here, *here.parents]
    if start is None:
        places += Path(__file__).resolve().parents
    for folder in places:
        if (folder / LANDING).is_file() and (folder / "labs").is_dir():
            return folder
    raise InputError(
        "course folder",
        given=str(here),
        expected=f"a folder with {LANDING} and labs/ in it, or a folder inside one",
        fix="Change to your copy of the course, or name it with --directory.",
    )


def server_arguments(course: Path, *, port: int | None = None, browser: bool = True) -> list[str]:
    """Return JupyterLab's command line for the course in folder ``course``.

    Args:
        port: TCP port on 127.0.0.1, and only this one; by default the first free one from 8888 on.
        browser: whether to open the user's web browser.
    """
    arguments = [
        f"--ServerApp.root_dir={course}",
        "--ServerApp.ip=127.0.0.1",
        "--ServerApp.allow_remote_access=False",
        f"--LabApp.default_url=/lab/tree/{LANDING}",
        # Tabs of the user's other projects would not be found in here, nor these in there.
        f"--LabApp.workspaces_dir={_workspaces()}",
    ]
    if port is not None:
        arguments += [f"--ServerApp.port={port}", "--ServerApp.port_retries=0"]
    if not browser:
        arguments.append("--no-browser")
    return arguments


def server_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """Return what to add to ``environment`` so that Jupyter finds the kit's configuration and this Python's kernel."""
    others = environment.get("JUPYTER_CONFIG_PATH", "")
    return {
        "JUPYTER_CONFIG_PATH": os.pathsep.join(filter(None, (str(CONFIG), others))),
        # A kernel the user once installed for all projects would lack robotbrain.
        "JUPYTER_PREFER_ENV_PATH": environment.get("JUPYTER_PREFER_ENV_PATH", "1"),
    }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``robotbrain lab``."""
    parser.add_argument("--port", type=_port, metavar="N", help="port on 127.0.0.1 (default: the first free from 8888)")
    parser.add_argument("--no-browser", action="store_true", help="print the address instead of opening a browser")
    parser.add_argument(
        "--directory", metavar="D", help="the course (default: where you are, or the installed checkout)"
    )


def main(arguments: argparse.Namespace) -> int:
    """Run ``robotbrain lab`` until the server is stopped."""
    course = find_course(arguments.directory)
    os.environ.update(server_environment(os.environ))
    from jupyterlab.labapp import LabApp  # type: ignore[import-untyped]

    LabApp.launch_instance(server_arguments(course, port=arguments.port, browser=not arguments.no_browser))
    return 0


def _port(text: str) -> int:
    number = int(text)
    if not 1 <= number <= 65535:
        raise argparse.ArgumentTypeError(f"{number} is no port; give a number from 1 to 65535")
    return number


def _workspaces() -> Path:
    from jupyter_core.paths import jupyter_data_dir

    return Path(jupyter_data_dir()) / "robotbrain" / "workspaces"
