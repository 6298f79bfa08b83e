"""Makes the book: ``python book/build.py [--out DIR]``. Notebooks that have not changed are not run again."""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
REPOSITORY = HERE.parent
# A page, and the files that it links to.
FILES = ("src/robotbrain/jetson/engine/TENSORRT_TODAY.md", "src/robotbrain/jetson/engine/*.py")
_CODE = {".py", ".toml", ".json", ".onnx", ".pt", ".npz", ".csv"}


def stage(folder: Path) -> None:
    """Lay out the sources as in the repository, so that links between them hold."""
    shutil.rmtree(folder, ignore_errors=True)
    ignore = shutil.ignore_patterns(".ipynb_checkpoints", "__pycache__")
    for name in ("course", "labs"):
        shutil.copytree(REPOSITORY / name, folder / name, ignore=ignore)
    for path in (p for pattern in FILES for p in REPOSITORY.glob(pattern)):
        target = folder / path.relative_to(REPOSITORY)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(path, target)
    shutil.copy(HERE / "index.md", folder / "index.md")


def library_digest() -> str:
    """Changes when the library does: outputs made with another one must not be taken from the cache."""
    digest = hashlib.sha256(sys.version.encode())
    for root in (REPOSITORY / "src", REPOSITORY / "autograder" / "profiles"):
        for path in sorted(p for p in root.rglob("*") if p.suffix in _CODE and "__pycache__" not in p.parts):
            digest.update(path.relative_to(REPOSITORY).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def main() -> int:
    """Build the book; returns Sphinx's exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=HERE / "_build" / "html", help="folder of the finished pages")
    parser.add_argument("--no-execution", action="store_true", help="leave the outputs out: quick, to check the text")
    options = parser.parse_args()
    source, caches = HERE / "_build" / "source", HERE / "_build" / "cache"
    stage(source)
    cache = caches / library_digest()
    for old in caches.iterdir() if caches.is_dir() else ():
        if old != cache:
            shutil.rmtree(old)
    environment = os.environ | {"ROBOTBRAIN_BOOK_CACHE": str(cache), "OMP_NUM_THREADS": "1"}
    if options.no_execution:
        environment["ROBOTBRAIN_BOOK_EXECUTION"] = "off"
    command = [sys.executable, "-m", "sphinx", "--builder", "html", "--fail-on-warning", "--keep-going", "--fresh-env"]
    command += ["--conf-dir", str(HERE), str(source), str(options.out)]
    code = subprocess.run(command, env=environment).returncode
    if code == 0:
        print(f"\nOpen {options.out / 'index.html'} in a browser.")
    return code


if __name__ == "__main__":
    sys.exit(main())
