"""Where a course keeps its things, and how nbgrader is run on them without a shell."""

from __future__ import annotations

import importlib.util
import logging
import os
import shutil
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from traitlets.config import Config, PyFileConfigLoader

from robotbrain.errors import InputError, MissingDependencyError, RobotBrainError
from robotbrain.grading.suite import AUTOGRADER_VARIABLE

CONFIG_NAME = "nbgrader_config.py"
_LONGEST_LOCK_S = 3600


@dataclass(frozen=True)
class Course:
    """Folders of a course. The names of nbgrader's steps are relative to ``root``, as nbgrader wants them.

    Attributes:
        home: the repository: it holds ``solutions/``, ``labs/`` and ``autograder/``.
        root: nbgrader's course folder; ``home`` itself, or the folder of an isolated grading run.
        db_url: SQLAlchemy address of the gradebook; ``""``: the SQLite file ``database``.
    """

    home: Path
    root: Path
    source: str = "solutions"
    release: str = "labs"
    submitted: str = "autograder/submitted"
    autograded: str = "autograder/autograded"
    feedback: str = "autograder/feedback"
    database: str = "autograder/gradebook.db"
    db_url: str = ""

    @property
    def autograder(self) -> Path:
        """The folder with the configuration, hidden tests and mutants."""
        return self.home / "autograder"

    @property
    def results(self) -> Path:
        """The folder for result tables and caches."""
        return self.autograder if self.root == self.home else self.root

    @property
    def gradebook_url(self) -> str:
        """SQLAlchemy address of the gradebook."""
        return self.db_url or f"sqlite:///{(self.root / self.database).as_posix()}"

    def with_gradebook(self, db_url: str | None = None) -> Course:
        """This course with the gradebook at ``db_url``; default: the one its own ``nbgrader_config.py`` names."""
        if db_url is None and self.root == self.home:
            configured = _instructors_config(self).CourseDirectory.get("db_url", "")
            db_url = configured if isinstance(configured, str) else ""
        return replace(self, db_url=driver_url(db_url)) if db_url else self

    def labs(self) -> list[str]:
        """Names of the labs that have a source."""
        folder = self.home / "solutions"
        return sorted(p.name for p in folder.iterdir() if any(p.glob("*.ipynb"))) if folder.is_dir() else []

    def sources(self, lab: str) -> list[Path]:
        """The instructor's notebooks of ``lab``; raises :class:`InputError` if there is none."""
        found = sorted((self.home / "solutions" / lab).glob("*.ipynb"))
        if not found:
            raise InputError(
                "lab", given=lab, expected=f"one of {', '.join(self.labs()) or '(none)'}", fix="Check the name."
            )
        return found

    def isolated(self, out: Path, lab: str) -> Course:
        """A course folder of its own below ``out``, with nbgrader's usual names and a fresh copy of the source."""
        out = out.resolve()
        target = out / "source" / lab
        shutil.rmtree(target, ignore_errors=True)
        ignore = shutil.ignore_patterns(".ipynb_checkpoints", "__pycache__")
        shutil.copytree(self.sources(lab)[0].parent, target, ignore=ignore)
        return Course(self.home, out, "source", "release", "submitted", "autograded", "feedback", "gradebook.db")


def find_course(start: str | Path | None = None) -> Course:
    """The course whose folder is ``start`` (default: the working directory) or a parent of it."""
    here = Path(start or Path.cwd()).resolve()
    for folder in (here, *here.parents):
        if (folder / "autograder" / CONFIG_NAME).is_file():
            return Course(folder, folder)
    raise InputError(
        "course folder",
        given=str(here),
        expected=f"a folder with autograder/{CONFIG_NAME} in it or above it",
        fix="Run this inside the repository, or name it with --course.",
    )


def driver_url(url: str) -> str:
    """``url`` with a PostgreSQL driver that is installed.

    SQLAlchemy 2.1 takes ``postgresql://`` for psycopg 3; before, it was psycopg2, which is what most courses have.
    """
    scheme, separator, rest = url.partition("://")
    if scheme not in ("postgres", "postgresql") or importlib.util.find_spec("psycopg"):
        return url.replace("postgres://", "postgresql://", 1)
    if importlib.util.find_spec("psycopg2") is None:
        raise MissingDependencyError(
            "psycopg2", needed_for="a gradebook in PostgreSQL", install="pip install psycopg2-binary"
        )
    return f"postgresql+psycopg2{separator}{rest}"


def patient_url(url: str) -> str:
    """``url`` such that nbgrader's own steps wait for a locked SQLite gradebook; they give up after 5 s by default."""
    if not url.startswith("sqlite") or "timeout=" in url:
        return url
    return f"{url}{'&' if '?' in url else '?'}timeout={_LONGEST_LOCK_S}"


def _instructors_config(course: Course) -> Config:
    os.environ[AUTOGRADER_VARIABLE] = str(course.autograder)
    return PyFileConfigLoader(CONFIG_NAME, path=str(course.autograder)).load_config()


def nbgrader_config(course: Course) -> Config:
    """The instructor's own nbgrader configuration, with the folders of ``course``."""
    config = _instructors_config(course)
    directory = config.CourseDirectory
    directory.root = str(course.root)
    directory.source_directory, directory.release_directory = course.source, course.release
    directory.submitted_directory = course.submitted
    directory.autograded_directory = course.autograded
    directory.feedback_directory = course.feedback
    directory.db_url = patient_url(course.gradebook_url)
    return config


def run_nbgrader(course: Course, step: str, lab: str, *, log: Path | None = None, **settings: Any) -> str:
    """Run one nbgrader step over a lab, replacing what an earlier run left.

    Args:
        step: ``"GenerateAssignment"``, ``"Autograde"`` or ``"GenerateFeedback"``.
        log: file to append nbgrader's messages to.
        settings: ``Class__trait=value`` settings on top of the configuration.

    Returns:
        What went wrong, or ``""``.
    """
    from nbgrader import converters
    from nbgrader.converters.base import NbGraderException
    from nbgrader.coursedir import CourseDirectory

    config = nbgrader_config(course)
    for name, value in settings.items():
        section, _, trait = name.partition("__")
        config[section][trait] = value
    logger, handler = nbgrader_logger(log)
    (course.root / course.database).parent.mkdir(parents=True, exist_ok=True)
    try:
        directory = CourseDirectory(config=config, log=logger)
        directory.assignment_id = lab
        converter = getattr(converters, step)(coursedir=directory, config=config, log=logger)
        converter.force = True
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # nbgrader's own, about its database sessions
            converter.start()
        return ""
    except (NbGraderException, SystemExit) as error:
        return str(error) or "nbgrader stopped"
    except RuntimeError as error:
        raise RobotBrainError(f"nbgrader {step} of {lab}: {error}") from error
    finally:
        logger.removeHandler(handler)
        handler.close()


def nbgrader_logger(log: Path | None) -> tuple[logging.Logger, logging.Handler]:
    """A logger for nbgrader's messages and the handler that writes them to ``log``; remove and close that later."""
    logger = logging.getLogger("robotbrain.nbgrader")
    logger.setLevel(logging.INFO)
    logger.propagate = False
    if log is None:
        handler: logging.Handler = logging.NullHandler()
    else:
        log.parent.mkdir(parents=True, exist_ok=True)
        handler = logging.FileHandler(log, encoding="utf-8")
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    logger.addHandler(handler)
    return logger, handler


def generate(course: Course, lab: str, *, log: Path | None = None) -> None:
    """Make the release of ``lab`` and enter it in the gradebook; raises :class:`RobotBrainError` on failure."""
    course.sources(lab)
    error = run_nbgrader(course, "GenerateAssignment", lab, log=log)
    if error:
        raise RobotBrainError(
            f"the students' version of {lab} could not be generated: {error}. "
            f"If cells were added or removed after submissions came in, grade into a new folder (--out)."
        )


def release_differences(course: Course, lab: str, scratch: Path) -> list[str]:
    """What differs between ``labs/<lab>`` and what would be generated now, file by file."""
    fresh = course.isolated(scratch, lab)
    generate(fresh, lab)
    made, kept = fresh.root / fresh.release / lab, course.home / "labs" / lab
    names = {p.relative_to(f).as_posix() for f in (made, kept) for p in f.rglob("*") if _counts(p)}
    differences = []
    for name in sorted(names):
        a, b = made / name, kept / name
        if not b.is_file():
            differences.append(f"{name} is missing")
        elif not a.is_file():
            differences.append(f"{name} is not generated from anything")
        elif a.read_bytes() != b.read_bytes():
            differences.append(f"{name} differs")
    return differences


def _counts(path: Path) -> bool:
    return path.is_file() and not {".ipynb_checkpoints", "__pycache__"} & set(path.parts)
