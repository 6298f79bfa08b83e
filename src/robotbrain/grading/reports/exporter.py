"""The feedback page for nbgrader's own commands: ``c.GenerateFeedback.exporter_class = FeedbackExporter``."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

from nbconvert.exporters.exporter import Exporter
from nbformat.notebooknode import NotebookNode

from robotbrain.errors import InputError
from robotbrain.grading.marks import Marks, marks_of
from robotbrain.grading.reports.feedback import feedback_page
from robotbrain.grading.reports.grades import graded_notebook, open_gradebook
from robotbrain.grading.reports.model import read_results

TAGS = sorted(
    {"a", "b", "blockquote", "br", "caption", "code", "dd", "div", "dl", "dt", "em", "h1", "h2", "h3", "h4", "h5", "h6"}
    | {"hr", "i", "li", "ol", "p", "pre", "span", "strong", "sub", "sup", "table", "tbody", "td", "th", "thead"}
    | {"tr", "ul"}
)
"""What a student's HTML may hold where formgrader shows it to a teacher."""
ATTRIBUTES = {"a": ["href", "title"], "th": ["scope"], "td": ["colspan"], "div": ["class"]}


def harmless_html(html: str) -> str:
    """``html`` with nothing in it that acts or fetches: links to pages stay, ``javascript:`` goes."""
    import bleach

    return str(bleach.clean(html, tags=set(TAGS), attributes=ATTRIBUTES, protocols={"http", "https"}, strip=True))


class FeedbackExporter(Exporter):  # type: ignore[misc]
    """Makes the kit's feedback page where nbgrader makes its own (formgrader, ``nbgrader generate_feedback``)."""

    file_extension = ".html"
    output_mimetype = "text/html"

    def from_notebook_node(
        self, nb: NotebookNode, resources: dict[str, Any] | None = None, **kw: Any
    ) -> tuple[str, dict[str, Any]]:
        """Return the page of an autograded notebook."""
        notebook, found = super().from_notebook_node(nb, resources, **kw)
        names = found.get("nbgrader", {})
        lab, student = names.get("assignment", ""), names.get("student", "")
        with open_gradebook(names["db_url"]) as gradebook:
            graded = graded_notebook(gradebook, lab, student, names.get("notebook", ""))
        row = self._stored(found, lab, student)
        row.marks = marks_of(notebook)  # what was autograded last, also by stock nbgrader
        return feedback_page(row, notebook, lab=lab, graded=graded), found

    def _stored(self, resources: dict[str, Any], lab: str, student: str) -> Marks:
        """What ``robotbrain grade-class`` wrote down about the run: repairs, layers of the sandbox."""
        here = Path(resources.get("metadata", {}).get("path") or ".").resolve()  # <base>/autograded/<student>/<lab>
        with contextlib.suppress(InputError, IndexError, StopIteration):
            stored = read_results(here.parents[2] / "results" / lab / "results.json")
            return next(row for row in stored.rows if row.student == student)
        return Marks(student, [])
