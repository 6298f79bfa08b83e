"""``robotbrain lab``: JupyterLab on the course, with nbgrader's Validate button and assignment list ready to use.

What nbgrader and JupyterLab need to know stands in ``jupyter_config/`` beside this file, which is put first on
Jupyter's search path for this one server. Nothing of the user's own configuration is changed, and their theme and
shortcuts apply. In that folder,

- ``nbgrader_config.json`` gives Validate the same patience as grading, and lets it pass over cells that only show;
- ``nbgrader_config.py`` tells the assignment list where the exchange is, and that labs are fetched into ``labs/``;
- ``jupyter_server_config.d`` turns on nbgrader's extensions for students, whatever the user turned off elsewhere;
- ``labconfig`` hides what is for instructors, and JupyterLab's question about news: a course opens with the course;
- ``windows`` hides the assignment list, which nbgrader does not have there;
- ``instructor`` goes before all this for ``--instructor``, followed by the course's own ``autograder``: formgrader
  and the course list are there then, and the gradebook is the course's.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping
from pathlib import Path

from robotbrain.errors import InputError
from robotbrain.exchange import EXCHANGE_VARIABLE, find_exchange

LANDING = "course/00_welcome.ipynb"
CONFIG = Path(__file__).with_name("jupyter_config")
INSTRUCTOR = CONFIG / "instructor"
LABS_VARIABLE = "ROBOTBRAIN_LABS"  # read by nbgrader_config.py


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


def server_arguments(
    course: Path, *, port: int | None = None, browser: bool = True, instructor: bool = False
) -> list[str]:
    """Return JupyterLab's command line for the course in folder ``course``.

    Args:
        port: TCP port on 127.0.0.1, and only this one; by default the first free one from 8888 on.
        browser: whether to open the user's web browser.
        instructor: open formgrader, not the landing notebook.
    """
    page = "/lab?formgrader=true" if instructor else f"/lab/tree/{LANDING}"
    arguments = [
        f"--ServerApp.root_dir={course}",
        "--ServerApp.ip=127.0.0.1",
        "--ServerApp.allow_remote_access=False",
        f"--LabApp.default_url={page}",
        # Tabs of the user's other projects would not be found in here, nor these in there.
        f"--LabApp.workspaces_dir={_workspaces()}",
    ]
    if port is not None:
        arguments += [f"--ServerApp.port={port}", "--ServerApp.port_retries=0"]
    if not browser:
        arguments.append("--no-browser")
    return arguments


def server_environment(
    environment: Mapping[str, str], course: Path, exchange: str = "", *, instructor: bool = False
) -> dict[str, str]:
    """Return what to add to ``environment`` so that Jupyter finds the kit's configuration and this Python's kernel.

    Args:
        exchange: the folder that labs are fetched from and handed in to.
        instructor: with formgrader, on the gradebook of ``course``.
    """
    ours = [INSTRUCTOR, course / "autograder", CONFIG] if instructor else [CONFIG]
    if sys.platform == "win32":  # nbgrader has no exchange there
        ours.insert(0, CONFIG / "windows")
    others = environment.get("JUPYTER_CONFIG_PATH", "")
    return {
        "JUPYTER_CONFIG_PATH": os.pathsep.join(filter(None, (*map(str, ours), others))),
        LABS_VARIABLE: str(course / "labs"),
        **({EXCHANGE_VARIABLE: exchange} if exchange else {}),
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
    parser.add_argument("--instructor", action="store_true", help="open formgrader on the course's gradebook")
    parser.add_argument(
        "--exchange", metavar="D", help="where labs are fetched and handed in (default: see `robotbrain exchange`)"
    )


def main(arguments: argparse.Namespace) -> int:
    """Run ``robotbrain lab`` until the server is stopped."""
    course, instructor = find_course(arguments.directory), arguments.instructor
    if instructor and not (course / "autograder" / "nbgrader_config.py").is_file():
        raise InputError(
            "course folder",
            given=str(course),
            expected="an instructor's copy, with autograder/nbgrader_config.py in it",
            fix="Name your copy with --directory, or leave out --instructor.",
        )
    exchange = _exchange(arguments.exchange)
    os.environ.update(server_environment(os.environ, course, exchange, instructor=instructor))
    from jupyterlab.labapp import LabApp  # type: ignore[import-untyped]

    options = {"port": arguments.port, "browser": not arguments.no_browser, "instructor": instructor}
    LabApp.launch_instance(server_arguments(course, **options))
    return 0


def _exchange(named: str | None) -> str:
    """The exchange, ready to be used; without one everything but handing in works, so that is no reason to stop."""
    place = find_exchange({EXCHANGE_VARIABLE: named} if named else None)
    try:
        return str(place.usable())
    except InputError as error:
        if named:
            raise
        print(f"robotbrain lab: Nbgrader > Assignment List will not work. {error}", file=sys.stderr)
        return ""


def _port(text: str) -> int:
    number = int(text)
    if not 1 <= number <= 65535:
        raise argparse.ArgumentTypeError(f"{number} is no port; give a number from 1 to 65535")
    return number


def _workspaces() -> Path:
    from jupyter_core.paths import jupyter_data_dir

    return Path(jupyter_data_dir()) / "robotbrain" / "workspaces"
