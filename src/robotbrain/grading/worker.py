"""The process that runs one submission: ``python -m robotbrain.grading.worker JOB.json``.

It knows no gradebook and no other submission. It leaves the executed notebook at the path the job names, and after
each cell an unfinished one beside it, so that the parent has something to grade if it must kill this process.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import robotbrain.grading.quick_import  # noqa: F401

# isort: split
import nbformat
from nbformat.notebooknode import NotebookNode

from robotbrain.files import write_text
from robotbrain.grading.execute import Limits, execute_notebook
from robotbrain.grading.kernel import KernelStartError

NOT_STARTED_CODE = 75  # "temporary failure" of sysexits.h


def partial_path(out: Path) -> Path:
    """Where the unfinished notebook lies while the job for ``out`` runs."""
    return out.with_suffix(".partial")


def main(job_file: str) -> int:
    """Do the job described in ``job_file``."""
    job = json.loads(Path(job_file).read_text(encoding="utf-8"))
    out = Path(job["out"])
    notebook = nbformat.read(job["notebook"], as_version=4)

    def save(unfinished: NotebookNode) -> None:
        write_text(partial_path(out), nbformat.writes(unfinished))

    try:
        run = execute_notebook(
            notebook,
            cwd=Path(job["cwd"]),
            limits=Limits(**job["limits"]),
            extra_env=job["env"],
            on_progress=save,
        )
    except KernelStartError as error:
        print(error, file=sys.stderr)
        return NOT_STARTED_CODE
    run.notebook.metadata["robotbrain"] = {"incidents": run.incidents, "seconds": round(run.seconds, 2)}
    write_text(out, nbformat.writes(run.notebook))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
