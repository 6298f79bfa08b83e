"""Runs attacks where nothing protects: tests and student's code in one process, as in stock nbgrader.

An attack that gains nothing here is no attack, and that it gains nothing elsewhere shows nothing. Run as a program
with the names of attacks on standard input (JSON); it answers with the points that each got, and with its output.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import select
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tests.grading.attacks.vault import POINTS, Vault

PATIENCE_S = 4.0


def run_unprotected(vault: Vault, submissions: Mapping[str, Sequence[str]]) -> dict[str, dict[str, Any]]:
    """Run the code cells of each submission; return ``{"points": {exercise: points}, "text": output}`` by name."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.grading.attacks.unprotected"],
        input=json.dumps({"cells": dict(submissions), "points": POINTS}),
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).resolve().parents[3],
        env={
            **os.environ,
            "ROBOTBRAIN_AUTOGRADER": str(vault.autograder),
            "ROBOTBRAIN_SUITES": str(vault.root / "suites"),
            "NBGRADER_EXECUTION": "validate",  # else the notebook leaves testing to the tester
        },
    )
    return json.loads(done.stdout.splitlines()[-1])  # type: ignore[no-any-return]


def _run(cells: Sequence[str], points: Mapping[str, float]) -> dict[str, Any]:
    from IPython.core.interactiveshell import InteractiveShell

    shell = InteractiveShell.instance()
    earned: dict[str, float] = {}
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text):
        for cell in cells:
            result = shell.run_cell(cell)
            exercise = next((n for n in points if f'lab.score("{n}", hidden=True)' in cell), "")
            if exercise:
                with contextlib.suppress(BaseException):
                    earned[exercise] = float(result.result)
    return {"points": earned, "text": text.getvalue()}


def main() -> None:
    """Run what standard input names, each in a forked process of its own."""
    job = json.load(sys.stdin)
    import IPython.core.interactiveshell
    import numpy as np

    import robotbrain.grading.lab

    del IPython, np, robotbrain
    answers = {}
    for name, cells in job["cells"].items():
        ours, theirs = os.pipe()
        pid = os.fork()
        if pid == 0:
            try:
                os.write(theirs, json.dumps(_run(cells, job["points"])).encode()[:60_000])
            finally:
                os._exit(0)
        os.close(theirs)
        with open(ours, "rb") as pipe:  # noqa: PTH123 - a descriptor
            ended = select.select([pipe], [], [], PATIENCE_S)[0]
            os.kill(pid, signal.SIGKILL) if not ended else None
            answer = pipe.read()
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        try:
            answers[name] = json.loads(answer)
        except ValueError:
            answers[name] = {"points": {}, "text": ""}
    print(json.dumps(answers))


if __name__ == "__main__":
    main()
