"""Get the genuine wheel, run the checks beside it in a process of their own, print one table."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import zipfile
from pathlib import Path

from robotbrain.rl.isaaclab.names import ISAACLAB_VERSION

ROOT = Path(__file__).resolve().parents[2]
HOME = ROOT / "build" / "conformance" / "isaaclab"
NEEDS = ("warp-lang==1.17.0", "trimesh", "prettytable", "lazy_loader", "hydra-core", "rich")
"""What the wheel imports besides torch and gymnasium, which the kit has."""


def prepare(home: Path = HOME) -> list[Path]:
    """Download the wheel and what it imports, once; returns the folders for ``PYTHONPATH``.

    The wheel is for Python 3.12 and asks for much that only running it needs. Its Python code imports on 3.11 too, so
    it is unpacked instead of installed.
    """
    wheel, needs, done = home / "wheel", home / "needs", home / f".ready-{ISAACLAB_VERSION}"
    if not done.exists():
        home.mkdir(parents=True, exist_ok=True)
        pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
        only = ["--no-deps", "--python-version", "3.12", "--only-binary=:all:"]
        subprocess.run([*pip, "download", *only, "--dest", str(home), f"isaaclab=={ISAACLAB_VERSION}"], check=True)
        with zipfile.ZipFile(next(home.glob(f"isaaclab-{ISAACLAB_VERSION}-*.whl"))) as archive:
            archive.extractall(wheel)
        subprocess.run([*pip, "install", "--target", str(needs), *NEEDS], check=True)
        done.touch()
    return [wheel, needs]


def main(argv: list[str] | None = None) -> int:
    """Run every check; returns 1 when one fails."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--home", type=Path, default=HOME, help="where the genuine wheel is kept")
    parser.add_argument("--write", action="store_true", help="store the genuine signatures for the tests of CI")
    args = parser.parse_args(argv)
    paths = [*prepare(args.home), ROOT / "src", ROOT]
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(map(str, paths)),
        "GIT_PYTHON_REFRESH": "quiet",
        "PYTORCH_JIT": "0",  # scripted functions hide their signatures
        "WARP_CACHE_PATH": str(args.home / "warp"),
    }
    command = [sys.executable, "-m", "tests.conformance_isaaclab.checks", *(["--write"] if args.write else [])]
    return subprocess.run(command, env=environment, check=False).returncode
