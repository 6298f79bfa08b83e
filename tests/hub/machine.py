"""Turns the namespaces that it is started in into a small machine with three users, and runs the scenario there.

Mounts made here are seen by nobody else. Homes, ``/srv``, ``/tmp`` and ``/run`` are empty and in memory; the list of
users has three more; folders that only root may enter, and the checkout (students must not find the key in it), are
covered, except for what Python and the proxy need of them.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import socket
import struct
import subprocess
import sys
import tempfile
from pathlib import Path

from robotbrain.bundle.contents import collect
from robotbrain.grading.course import find_course

REPO = Path(__file__).resolve().parents[2]
USERS = {"instructor": 3001, "alice": 3002, "bob": 3003}
STUDENT_COURSE, PROOF = Path("/srv/robotbrain/course"), Path("/srv/proof")
_UP = 0x1  # IFF_UP


def main() -> None:
    """Make the machine; then become the scenario."""
    proxy = Path(sys.argv[1])
    with tempfile.TemporaryDirectory() as kept:
        staged = stage(Path(kept))
        needed = [Path(sys.prefix), Path(sys.base_prefix), proxy.parents[2]]
        cover([REPO, *closed(needed)], needed)
        for folder, mode in (("/home", "755"), ("/srv", "755"), ("/run", "755"), ("/var/tmp", "1777")):
            mount("-t", "tmpfs", "-o", f"mode={mode}", "none", folder)
        users()
        shutil.copytree(staged / "student", STUDENT_COURSE)
        shutil.copytree(staged / "proof", PROOF)
        PROOF.chmod(0o700)
        home = Path("/home") / "instructor"
        shutil.copytree(staged / "repository", home / "robotbrain")
        subprocess.run(["chown", "-R", "instructor:instructor", str(home)], check=True)
    mount("-t", "tmpfs", "-o", "mode=1777", "none", "/tmp")
    loopback()
    os.chdir("/")
    path = os.pathsep.join([str(Path(sys.executable).parent), "/usr/local/bin:/usr/bin:/bin"])
    environment = {"PATH": path, "HOME": str(PROOF), "LANG": "C.UTF-8", "OMP_NUM_THREADS": "1", "PROXY": str(proxy)}
    environment["PYTHONPATH"] = str(STUDENT_COURSE / "src")
    os.execve(sys.executable, [sys.executable, str(PROOF / "scenario.py")], environment)


def stage(folder: Path) -> Path:
    """Copy what the machine is to hold: the student bundle, the instructor's repository, this test."""
    for item in collect(find_course(REPO)):
        path = folder / "student" / item.name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(item.data)
    left = shutil.ignore_patterns("__pycache__", "gradebook.db*", "submitted", "autograded", "feedback", "results")
    for name in ("course", "labs", "solutions", "autograder"):
        shutil.copytree(REPO / name, folder / "repository" / name, ignore=left)
    shutil.copytree(Path(__file__).parent, folder / "proof", ignore=left)
    return folder


def mount(*arguments: str) -> None:
    """Run ``mount``."""
    subprocess.run(["mount", *arguments], check=True)


def closed(paths: list[Path]) -> list[Path]:
    """The outermost folders above ``paths`` that ordinary users may not enter."""
    found = [p for path in paths for p in reversed(path.parents) if not p.stat().st_mode & 0o001]
    return [p for p in dict.fromkeys(found) if not any(p != o and p.is_relative_to(o) for o in found)]


def cover(folders: list[Path], except_for: list[Path]) -> None:
    """Put an empty folder over each of ``folders``, with those parts of it that are needed."""
    handles = {p: os.open(p, os.O_PATH) for p in except_for if any(p.is_relative_to(f) for f in folders)}
    for folder in dict.fromkeys(folders):
        mount("-t", "tmpfs", "-o", "mode=755", "none", str(folder))
    for path, handle in handles.items():
        path.mkdir(parents=True, exist_ok=True)
        subprocess.run(
            ["mount", "--no-canonicalize", "--bind", f"/proc/self/fd/{handle}", str(path)],
            check=True,
            pass_fds=[handle],
        )
        os.close(handle)


def users() -> None:
    """Add the users to this machine's lists, and make their homes."""
    for name, line in (("passwd", "{n}:x:{u}:{u}::/home/{n}:/bin/bash\n"), ("group", "{n}:x:{u}:\n")):
        text = Path("/etc", name).read_text(encoding="utf-8")
        private = Path("/run", name)
        private.write_text(text + "".join(line.format(n=n, u=u) for n, u in USERS.items()), encoding="utf-8")
        mount("--bind", str(private), f"/etc/{name}")
    for name, number in USERS.items():
        home = Path("/home", name)
        home.mkdir()
        os.chown(home, number, number)
        home.chmod(0o700)


def loopback() -> None:
    """Switch the loopback interface of this network on; there is no other."""
    with socket.socket() as any_socket:
        request = struct.pack("16sh", b"lo", _UP)
        fcntl.ioctl(any_socket, 0x8914, request)  # SIOCSIFFLAGS


if __name__ == "__main__":
    main()
