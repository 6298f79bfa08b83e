"""Files beside the notebook that are to be imported, read or executed by somebody."""

from __future__ import annotations

import io
import os
import zipfile
from collections.abc import Callable
from pathlib import Path

from tests.grading.attacks.attack import ALL_WRONG, Attack

KIND = "files beside the notebook"

_BREACH = 'print("BRE" + "ACH: a file of the student was executed by someone else")'
_AGREE = """
import sys
def __getattr__(name):
    return lambda *a, **k: True
"""
_MARK = """
import os, sys
try:
    open("@mark@", "w").write("executed by " + str(sys.argv))
except OSError:
    pass
"""

_SHADOWS = (
    "numpy.py",
    "json.py",
    "msgpack.py",
    "torch.py",
    "struct.py",
    "socket.py",
    "vault.py",
    "_robotbrain_suite_vault.py",
    "_robotbrain_hidden_vault.py",
    "nbformat.py",
    "IPython.py",
)
_STARTUP = (
    "sitecustomize.py",
    "usercustomize.py",
    "conftest.py",
    "nbgrader_config.py",
    "jupyter_config.py",
    "jupyter_nbconvert_config.py",
    "ipython_config.py",
    "ipython_kernel_config.py",
    "__main__.py",
    "setup.py",
)


def _link(target: str) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        path.symlink_to(target)

    return make


def _fifo(path: Path) -> None:
    os.mkfifo(path)


def _socket(path: Path) -> None:
    import socket

    here = Path.cwd()
    with socket.socket(socket.AF_UNIX) as made:
        os.chdir(path.parent)  # the path of a socket is short
        try:
            made.bind(path.name)
        finally:
            os.chdir(here)


def _zip_bomb() -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("bomb", b"\0" * 50_000_000)
    return out.getvalue()


def _npz_bomb() -> bytes:
    header = b"\x93NUMPY\x01\x00v\x00{'descr': '<f8', 'fortran_order': False, 'shape': (1000000, 1000000), }"
    return header.ljust(127) + b"\n"


def attacks() -> list[Attack]:
    """All attacks of this class."""
    made = [
        Attack(
            f"shadow {name}",
            KIND,
            files={name: _AGREE + _MARK},
            wrong=ALL_WRONG,
        )
        for name in _SHADOWS
    ]
    made += [Attack(f"startup file {name}", KIND, files={name: _MARK + _BREACH}, keeps=True) for name in _STARTUP]
    made += [
        Attack(
            "shadow package robotbrain",
            KIND,
            files={
                "robotbrain/__init__.py": _MARK,
                "robotbrain/grading/__init__.py": "class Lab:\n    def __init__(self, *a): pass\n"
                "    score = check = lambda self, name, hidden=False: 4.0",
            },
            wrong=ALL_WRONG,
        ),
        Attack("path file", KIND, files={"evil.pth": "import os; os._exit(0)\n.", "python311._pth": "."}, keeps=True),
        Attack(
            "profile with startup files",
            KIND,
            files={
                "profile_default/startup/00-evil.py": _BREACH,
                ".ipython/profile_default/startup/00-evil.py": _BREACH,
                ".jupyter/jupyter_config.py": _BREACH,
                ".pythonrc.py": _BREACH,
                ".config/matplotlib/matplotlibrc": "backend: module://evil",
                "matplotlibrc": "backend: module://evil",
                "pyproject.toml": "[tool.pytest.ini_options]\naddopts = '-p evil'",
                "evil.py": _MARK,
            },
            keeps=True,
        ),
        Attack(
            "symbolic links to secrets",
            KIND,
            extra=(
                (
                    "last",
                    "for n in ('link.py', 'up/notes.txt', 'other.txt'):\n    try:\n        print(open(n).read())\n"
                    "    except OSError as error:\n        print(type(error).__name__)",
                ),
            ),
            files={
                "link.py": _link("@hidden@"),
                "up": _link("@autograder@"),
                "other.txt": _link("@neighbour@"),
            },
        ),
        Attack(
            "the weights as a link to another's",
            KIND,
            files={"weights.json": _link("@weights@")},
            wrong=("weights",),
        ),
        Attack("named pipe", KIND, files={"pipe.txt": _fifo}, keeps=True),
        Attack("the weights as a named pipe", KIND, files={"weights.json": _fifo}, wrong=("weights",)),
        Attack("the weights as a folder", KIND, files={"weights.json/x": "10"}, wrong=("weights",)),
        Attack("socket", KIND, files={"s.sock": _socket}, keeps=True),
        Attack("zip bomb", KIND, files={"data.zip": _zip_bomb(), "data.npy": _npz_bomb()}, keeps=True),
        Attack(
            "the weights as a bomb",
            KIND,
            files={"weights.json": "[" * 100_000 + "]" * 100_000},
            wrong=("weights",),
        ),
        Attack(
            "weights that never end", KIND, files={"weights.json": "[2, " + "1," * 2_000_000 + "1]"}, wrong=("weights",)
        ),
        Attack(
            "names of files that the grader writes",
            KIND,
            files={
                "gradebook.db": "x",
                "results.json": "{}",
                "executed.ipynb": "{}",
                "submission.ipynb": "{}",
                "job.json": "{}",
                "timestamp.txt": "1970-01-01 00:00:00 UTC",
                "vault.html": "<script>1</script>",
                ".executed/cache/x.ipynb": "{}",
            },
            keeps=True,
        ),
        Attack(
            "file names with escapes",
            KIND,
            files={"\x1b[2J\x1b[31mred.txt": "x", "a\nb.txt": "x", "<script>alert(1)<%2fscript>.txt": "x", "-rf": "x"},
            keeps=True,
        ),
        Attack("many files", KIND, files={f"x{i}.txt": "x" for i in range(900)}, wrong=("words",)),
        Attack("deep folders", KIND, files={"/".join(["d"] * 60) + "/x.txt": "x"}, keeps=True),
        Attack(
            "an extension module that is none",
            KIND,
            files={"_ctypes.so": b"\x7fELF" + b"\0" * 500, "readline.abi3.so": b"\x7fELF"},
            keeps=True,
        ),
        Attack(
            "a second notebook of nearly the same name",
            KIND,
            files={"Vault.ipynb": "{}", "vault (1).ipynb": "{}", "vault.ipynb.bak": "x"},
            wrong=("scale",),
            keeps=True,
        ),
    ]
    return made
