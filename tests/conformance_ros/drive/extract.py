"""The planner of the lab as a file: the cells of the notebook as they are, in order, below one import."""

from __future__ import annotations

import json
from pathlib import Path

NOTEBOOK = Path(__file__).parents[3] / "solutions" / "lab_integration" / "lab_integration.ipynb"
EXERCISES = ("inflate", "astar", "smooth", "planner_node")


def planner_source(notebook: Path = NOTEBOOK) -> str:
    """Return the source of ``MyPlanner`` with what it needs: the cells of its exercises and the imports above it."""
    cells = [cell for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"]
    names = [cell["metadata"].get("nbgrader", {}).get("grade_id", "") for cell in cells]
    chosen = [names.index(name) for name in EXERCISES]
    imports = names.index("planner_node") - 1
    if "nav_msgs.srv import GetPlan" not in "".join(cells[imports]["source"]):
        raise LookupError(f"{notebook.name}: the cell before the planner does not import what it needs")
    sources = ["".join(cells[index]["source"]) for index in sorted([*chosen, imports])]
    return "\n\n\n".join(["import numpy as np", *sources]) + "\n"
