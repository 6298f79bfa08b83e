"""Makes the book: ``python book/build.py``. Notebooks that have not changed are not run again.

What ran before an interruption is kept: the same command goes on after it.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import nbformat
from staging import HERE, REPOSITORY, stage

_CODE = {".py", ".toml", ".json", ".onnx", ".pt", ".npz", ".csv"}


def library_digest() -> str:
    """Changes when the library does: outputs made with another one must not be taken from the cache."""
    digest = hashlib.sha256(sys.version.encode())
    for root in (REPOSITORY / "src", REPOSITORY / "autograder" / "profiles"):
        for path in sorted(p for p in root.rglob("*") if p.suffix in _CODE and "__pycache__" not in p.parts):
            digest.update(path.relative_to(REPOSITORY).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def failures(executed: Path) -> Iterator[str]:
    """Name each cell that raised an error it does not announce (by the tag ``raises-exception``)."""
    for path in sorted(executed.rglob("*.ipynb")):
        for cell in nbformat.read(path, 4).cells:
            if "raises-exception" in cell.metadata.get("tags", ()):
                continue
            for output in cell.get("outputs", ()):
                if output.output_type == "error":
                    where = path.relative_to(executed).as_posix()
                    yield f"{where}, cell `{cell.id}`: {output.ename}: {output.evalue}"


def build(source: Path, out: Path, cache: Path | None) -> int:
    """Run Sphinx over ``source``; without a cache, notebooks are shown as they are and not run.

    Warnings are errors. Returns Sphinx's exit code, or 1 if a cell failed.
    """
    mode = "cache" if cache else "off"
    environment = os.environ | {"ROBOTBRAIN_BOOK_EXECUTION": mode, "ROBOTBRAIN_BOOK_CACHE": str(cache or "")}
    environment |= {
        "OMP_NUM_THREADS": "1",
        "ROBOTBRAIN_NO_PROGRESS": "1",
        "MPLBACKEND": "module://matplotlib_inline.backend_inline",
    }
    shutil.rmtree(out, ignore_errors=True)  # no page stays whose source is gone
    executed = out.parent / "jupyter_execute"
    shutil.rmtree(executed, ignore_errors=True)
    command = [sys.executable, "-m", "sphinx", "--builder", "html", "--fail-on-warning", "--keep-going", "--fresh-env"]
    command += ["--doctree-dir", str(out.parent / "doctrees"), "--conf-dir", str(HERE), str(source), str(out)]
    code = subprocess.run(command, env=environment, check=False).returncode
    failed = list(failures(executed))
    for line in failed:
        print(f"FAILED  {line}", file=sys.stderr)
    return code or bool(failed)


def main() -> int:
    """Build the book; returns an exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--work", type=Path, default=HERE / "_build", help="folder of the book (html/) and its cache")
    parser.add_argument("--no-execution", action="store_true", help="leave the outputs out: quick, to check the text")
    options = parser.parse_args()
    work: Path = options.work.resolve()
    stage(work / "source")
    cache = work / "cache" / library_digest()
    for old in (work / "cache").glob("*"):
        if old != cache:
            shutil.rmtree(old)
    code = build(work / "source", work / "html", None if options.no_execution else cache)
    if code == 0:
        print(f"\nOpen {work / 'html' / 'index.html'} in a browser.")
    return code


if __name__ == "__main__":
    sys.exit(main())
