"""After the installation no network is needed: the main paths, in a place that has none, and nothing even asks for it.

Where bubblewrap is installed everything runs in a network namespace with nothing but loopback, subprocesses included.
What the main process asks for is listened to through an audit hook, so that an attempt whose failure is swallowed
(a usage report, a look for news) is found too.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from robotbrain.grading.suite import AUTOGRADER_VARIABLE, SUITES_VARIABLE
from tests.conftest import REPO
from tests.grading import toylab

GUARD = """
import ipaddress, sys

ASKED = []

def _is_here(host):
    if host in (None, "", b"", "localhost", b"localhost"):
        return True
    try:
        return ipaddress.ip_address(host.decode() if isinstance(host, bytes) else host).is_loopback
    except ValueError:
        return False

def _listen(event, arguments):
    if event in ("socket.connect", "socket.sendto", "socket.sendmsg"):
        address = arguments[1]
        if isinstance(address, tuple) and not _is_here(address[0]):
            ASKED.append(f"{event} {address}")
            raise OSError(f"this test has no network: {address}")
    elif event in ("socket.getaddrinfo", "socket.gethostbyname", "socket.gethostbyaddr"):
        if not _is_here(arguments[0]):
            ASKED.append(f"{event} {arguments[0]}")
            raise OSError(f"this test has no network: {arguments[0]}")

sys.addaudithook(_listen)
"""

PROGRAM = (
    GUARD
    + """
import json, sys
from pathlib import Path
from robotbrain import cli

course, notebook, replay = sys.argv[1:]
codes = {}

def run(name, *words):
    codes[name] = cli.main([name, *words])

def check(answer):
    from robotbrain.grading import Lab

    return "FAILED" not in str(Lab("toy", {"__name__": "__main__", "scale": answer}).check("scale")).upper()

run("generate", "toy", "--course", course)
codes["check"] = [check(lambda x: 2 * x), check(lambda x: x)]
run("grade", notebook, "--course", course, "--json")
run("drive", "--seeds", "0:1", "--html", replay)
run("doctor", *(f"--only={name}" for name in OFFLINE_PROBES))
print("ANSWER " + json.dumps({"codes": codes, "asked": ASKED}))
"""
)
PROBES = ("packages", "kernels", "extensions", "gpu", "ros", "proxies", "loopback", "ports", "browsers", "files")


def isolated() -> list[str]:
    """The command that takes the network away, where there is one."""
    bwrap = shutil.which("bwrap")
    return [bwrap, "--dev-bind", "/", "/", "--unshare-net", "--"] if bwrap else []


def test_the_guard_sees_what_is_asked_for() -> None:
    code = GUARD + (
        "import socket\n"
        "server = socket.create_server(('127.0.0.1', 0))\n"
        "socket.create_connection(server.getsockname())\n"
        "for ask in (lambda: socket.create_connection(('192.0.2.1', 80)),\n"
        "            lambda: socket.getaddrinfo('example.org', 443),\n"
        "            lambda: socket.socket(type=socket.SOCK_DGRAM).sendto(b'x', ('192.0.2.1', 53))):\n"
        "    try: ask()\n"
        "    except OSError: pass\n"
        "print(len(ASKED))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.strip() == "3"


def test_the_main_paths_need_no_network(tmp_path: Path) -> None:
    """Making a lab, a check, grading, a drive with its replay, and the doctor."""
    course = toylab.make_course(tmp_path / "course")
    notebook = toylab.submit(tmp_path / "submitted", "ada", toylab.solved()) / f"{toylab.LAB}.ipynb"
    replay = tmp_path / "replay.html"
    environment = dict(os.environ) | {
        SUITES_VARIABLE: str(course / "suites"),
        AUTOGRADER_VARIABLE: str(course / "autograder"),
        "HOME": str(tmp_path),
        "JUPYTER_CONFIG_DIR": str(tmp_path / "jupyter"),
        "OMP_NUM_THREADS": "1",
    }
    program = PROGRAM.replace("OFFLINE_PROBES", repr(PROBES))
    done = subprocess.run(
        [*isolated(), sys.executable, "-c", program, str(course), str(notebook), str(replay)],
        capture_output=True, text=True, encoding="utf-8", env=environment, cwd=tmp_path, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    answer = json.loads(done.stdout.rpartition("ANSWER ")[2])
    assert answer["asked"] == []
    assert answer["codes"] == {"generate": 0, "check": [True, False], "grade": 0, "drive": 0, "doctor": 0}, done.stdout
    assert (course / "labs" / "toy" / "toy.ipynb").is_file()
    page = replay.read_text(encoding="utf-8")
    assert not re.search(r"<(script|link|img)[^>]+(src|href)\\s*=\\s*[\"']?(https?:)?//", page)


@pytest.mark.parametrize("name", ["labconfig/default_setting_overrides.json", "labconfig/page_config.json"])
def test_jupyterlab_is_told_not_to_look_for_news(name: str) -> None:
    settings = json.loads((REPO / "src/robotbrain/jupyter_config" / name).read_text(encoding="utf-8"))
    news = "@jupyterlab/apputils-extension"
    if "disabledExtensions" in settings:
        assert settings["disabledExtensions"][f"{news}:announcements"] is True
    else:
        chosen = settings[f"{news}:notification"]
        assert chosen["fetchNews"] == "false" and chosen["checkForUpdates"] is False
