"""What the kit puts in place of nbgrader's own classes; the configuration in ``autograder/`` names them.

``ResilientExecute`` replaces ``Execute``; ``HealingExporter`` reads submissions that nbgrader could not;
``GuardedCollect`` takes from the exchange what belongs to the student that it names, and follows no links. Everything
else (overwriting of locked cells, the gradebook, formgrader, feedback) stays stock.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from nbconvert.exporters import NotebookExporter
from nbformat.notebooknode import NotebookNode
from nbgrader.exchange.default import ExchangeCollect
from nbgrader.preprocessors import NbGraderPreprocessor
from nbgrader.utils import parse_utc
from traitlets import Bool, Float, Integer

from robotbrain.grading import intake
from robotbrain.grading.bench import shared_bench
from robotbrain.grading.collecting import entries, take
from robotbrain.grading.execute import Limits
from robotbrain.grading.sandbox.layers import warning_of
from robotbrain.grading.suite import AUTOGRADER_VARIABLE
from robotbrain.notebooks import canonicalise


class ResilientExecute(NbGraderPreprocessor):  # type: ignore[misc]
    """Runs a notebook so that every graded cell ends with a score and a reason."""

    timeout = Float(Limits.cell_s, help="Seconds an ordinary cell may run.").tag(config=True)
    graded_timeout = Float(Limits.graded_s, help="Seconds a graded cell may run.").tag(config=True)
    grace = Float(Limits.grace_s, help="Seconds between interrupt and kill.").tag(config=True)
    wall = Float(Limits.wall_s, help="Seconds the whole notebook may take.").tag(config=True)
    output_bytes = Integer(Limits.output_bytes, help="Bytes of output kept of one cell.").tag(config=True)
    require_sandbox = Bool(False, help="Refuse to run where the host cannot shut student code in.").tag(config=True)

    def limits(self) -> Limits:
        """The configured limits."""
        return Limits(self.timeout, self.graded_timeout, self.grace, self.wall, self.output_bytes)

    def preprocess(self, nb: NotebookNode, resources: dict[str, Any]) -> tuple[NotebookNode, dict[str, Any]]:
        """Execute ``nb`` on the bench that this process keeps for all submissions."""
        names = resources.get("nbgrader", {})
        student, lab = names.get("student", ""), names.get("assignment", "")
        folder = Path(resources.get("metadata", {}).get("path") or Path.cwd())
        autograder = Path(os.environ.get(AUTOGRADER_VARIABLE) or Path.cwd())
        bench = shared_bench(autograder, self.limits(), require_sandbox=self.require_sandbox, lab=lab)
        run = bench.execute(nb, lab=lab, student=student, files=intake.receive(folder).further())
        for incident in run.incidents:
            self.log.warning("%s: %s", student, incident)
        warning = warning_of(run.layers)
        if warning:
            self.log.warning("%s: %s", student, warning)
        return nb, resources


class CanonicalForm(NbGraderPreprocessor):  # type: ignore[misc]
    """Brings a released notebook into the form in which the repository keeps notebooks."""

    def preprocess(self, nb: NotebookNode, resources: dict[str, Any]) -> tuple[NotebookNode, dict[str, Any]]:
        """Return ``nb`` in canonical form."""
        return canonicalise(nb), resources


class HealingExporter(NotebookExporter):  # type: ignore[misc]
    """Reads a submission through :mod:`robotbrain.grading.intake`, so that a damaged file still gets a grade."""

    def from_filename(
        self, filename: str, resources: dict[str, Any] | None = None, **kw: Any
    ) -> tuple[Any, dict[str, Any]]:
        """Heal a submitted notebook against the instructor's source; leave other files alone."""
        source = self._source_of(filename, resources or {})
        if source is None:
            return super().from_filename(filename, resources=resources, **kw)  # type: ignore[no-any-return]
        healed = intake.heal(Path(filename), intake.master_of(source))
        for repair in healed.repairs:
            self.log.warning("%s: %s", filename, repair)
        resources = dict(resources or {})
        resources["metadata"] = {"name": Path(filename).stem, "path": str(Path(filename).parent)}
        return self.from_notebook_node(healed.notebook, resources=resources, **kw)  # type: ignore[no-any-return]

    def _source_of(self, filename: str, resources: dict[str, Any]) -> Path | None:
        converter = self.parent
        names = resources.get("nbgrader")
        if names is None or not getattr(converter, "_sanitizing", False):
            return None
        course = converter.coursedir
        folder = Path(course.format_path(course.source_directory, ".", names["assignment"]))
        path = folder / f"{names['notebook']}.ipynb"
        return path if path.is_file() else None


class GuardedCollect(ExchangeCollect):  # type: ignore[misc]
    """Collects as nbgrader does, also by formgrader's button, but trusts nothing that lies in the exchange."""

    def copy_files(self) -> None:
        """Copy each student's newest submission (the newest in time, if ``before_duedate``), unless it is here."""
        lab, chosen = self.coursedir.assignment_id, self.coursedir.student_id
        newest = {}
        for entry in entries(Path(self.inbound_path), lab):
            late = self.before_duedate and self.duedate and parse_utc(entry.stamp) > self.duedate
            if self.check_owner and not entry.own:
                self.log.warning("%s is left: it belongs to %s", entry.path.name, entry.owner)
            elif chosen in ("", "*", entry.student) and not (late and entry.student in newest):
                newest[entry.student] = entry
        for student, entry in newest.items():
            target = Path(self.coursedir.format_path(self.coursedir.submitted_directory, student, lab))
            here = self.coursedir.get_existing_timestamp(str(target)) if target.is_dir() else None
            if target.is_dir() and not (self.update and (here is None or parse_utc(entry.stamp) > here)):
                continue
            try:
                for sentence in take(entry, target):
                    self.log.warning("%s: left out: %s", student, sentence)
            except OSError as error:
                self.log.error("%s cannot be read: %s", entry.path.name, error.strerror)
