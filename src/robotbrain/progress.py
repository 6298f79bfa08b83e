"""A progress bar for a person who waits at a notebook, and for nobody else."""

from __future__ import annotations

import os
import sys
from typing import Any

SILENT_VARIABLE = "ROBOTBRAIN_NO_PROGRESS"
_AFTER_S = 1.0  # what is done sooner shows no bar


def at_a_notebook() -> bool:
    """Whether a person may be looking on: in a Jupyter kernel, not while grading, and not told to be silent."""
    if os.environ.get("NBGRADER_EXECUTION") or os.environ.get(SILENT_VARIABLE):
        return False
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    return getattr(shell, "kernel", None) is not None


def bar(title: str, total: float, unit: str) -> Any:
    """Return a tqdm bar that appears after a second and vanishes at the end; one that does nothing elsewhere.

    Args:
        title: what goes on.
        total: of ``unit``, when all is done.
        unit: of ``total`` and of what ``update`` is given.
    """
    if not at_a_notebook():
        from tqdm import tqdm

        return tqdm(disable=True)
    from tqdm.auto import tqdm as notebook_tqdm

    shown = "{desc}: {bar} {n:.0f} of {total:.0f} " + unit
    return notebook_tqdm(desc=title, total=total, bar_format=shown, delay=_AFTER_S, leave=False)
