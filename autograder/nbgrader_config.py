"""nbgrader's configuration. Run nbgrader in this folder: ``cd autograder && nbgrader autograde lab_integration``."""

import os
import sys
from pathlib import Path

from nbgrader.converters import GenerateAssignment

from robotbrain.grading.nbgrader_plugins import CanonicalForm, GuardedCollect, HealingExporter, ResilientExecute
from robotbrain.grading.reports.exporter import ATTRIBUTES, TAGS, FeedbackExporter, harmless_html

c = get_config()

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent

# Where things are. The source and the release lie in the repository, all that belongs to students lies in here.
c.CourseDirectory.course_id = "robotbrain"
c.CourseDirectory.root = str(ROOT)
c.CourseDirectory.source_directory = "solutions"
c.CourseDirectory.release_directory = "labs"
c.CourseDirectory.submitted_directory = "autograder/submitted"
c.CourseDirectory.autograded_directory = "autograder/autograded"
c.CourseDirectory.feedback_directory = "autograder/feedback"
c.CourseDirectory.db_url = f"sqlite:///{(HERE / 'gradebook.db').as_posix()}"

# The folder that students fetch from and hand in to; `robotbrain exchange where` says which one it is otherwise.
if exchange := os.environ.get("ROBOTBRAIN_EXCHANGE"):
    c.Exchange.root = exchange
c.ExchangeFactory.collect = GuardedCollect  # nbgrader's own follows links, and takes what others hand in in your name

# Submissions are read so that a damaged file still gets a grade, and run so that one cell cannot spoil the rest.
c.Autograde.exporter_class = HealingExporter
c.ResilientExecute.timeout = 120
c.ResilientExecute.graded_timeout = 300
c.ResilientExecute.wall = 900
c.Autograde.autograde_preprocessors = [
    ResilientExecute,
    "nbgrader.preprocessors.IgnorePattern",
    "nbconvert.preprocessors.ClearMetadataPreprocessor",
    "nbgrader.preprocessors.LimitOutput",
    "nbgrader.preprocessors.SaveAutoGrades",
    "nbgrader.preprocessors.AssignLatePenalties",
    "nbgrader.preprocessors.CheckCellMetadata",
]
c.OverwriteCells.add_missing_cells = True

# What students get, also by formgrader's buttons; and what formgrader shows the teacher runs no script of a student's.
c.GenerateFeedback.exporter_class = FeedbackExporter
c.GenerateFeedback.preprocessors = []  # the page reads the gradebook itself
c.HTMLExporter.preprocessors = ["nbconvert.preprocessors.sanitize.SanitizeHTML"]
c.HTMLExporter.filters = {"strip_files_prefix": harmless_html}  # the last thing its template does to Markdown
c.SanitizeHTML.tags = TAGS
c.SanitizeHTML.attributes = ATTRIBUTES
c.SanitizeHTML.strip = True
c.SanitizeHTML.sanitized_output_types = {"text/html"}  # Markdown outputs become HTML after this: shown as text

# A release is stored like every other notebook of the repository: `labs/` is compared byte by byte.
c.GenerateAssignment.preprocessors = [*GenerateAssignment.preprocessors.default_args[0], CanonicalForm]

# Students see the gaps they are to fill, in words.
c.ClearSolutions.code_stub = {"python": "# YOUR CODE HERE\nraise NotImplementedError()"}
# Validate in a student's JupyterLab and the autograder give a cell the same patience.
c.Execute.timeout = 300
c.Execute.skip_cells_with_tag = "skip-grading"

# The hidden tests are found here, and nbgrader finds the `alembic` command beside this Python.
os.environ.setdefault("ROBOTBRAIN_AUTOGRADER", str(HERE))
os.environ["PATH"] = str(Path(sys.executable).parent) + os.pathsep + os.environ.get("PATH", "")
