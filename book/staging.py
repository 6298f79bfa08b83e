"""Lays the sources of the book out as they lie in the repository, so that links between them hold."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterable
from pathlib import Path

import references

HERE = Path(__file__).resolve().parent
REPOSITORY = HERE.parent
LABS = ("lab_integration", "hw1_rl", "hw2_optimisation", "hw3_performance", "assessment", "capstone")
"""The order of the labs in the book; those that it does not know follow."""
PAGES = (
    "src/robotbrain/jetson/engine/TENSORRT_TODAY.md",
    "src/robotbrain/rl/isaaclab/OUTDATED_NAMES.md",
    "autograder/*.md",
    "autograder/profiles/README.md",
)
LINKED = ("src/robotbrain/jetson/engine/*.py",)
"""Files that pages link to."""
_IMAGES = {".png", ".svg", ".jpg"}
_LINK = re.compile(r"\[(?P<text>[^\]\[]*)\]\((?P<target>[^):#\s]+)\)")
_ANNOUNCED = "The second part is about what is no longer true in it, or never was."


def stage(folder: Path, repository: Path = REPOSITORY) -> None:
    """Replace ``folder`` by the sources of the book."""
    shutil.rmtree(folder, ignore_errors=True)
    ignore = shutil.ignore_patterns(".ipynb_checkpoints", "__pycache__")
    for name in ("course", "labs"):
        shutil.copytree(repository / name, folder / name, ignore=ignore)
    for path in (p for pattern in (*PAGES, *LINKED) for p in sorted(repository.glob(pattern))):
        target = folder / path.relative_to(repository)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(path, target)
        if path.suffix == ".md":
            _keep_links(target, path.parent)
    _split_outline(folder / "course")
    lessons = [f"course/{path.name}" for path in sorted((folder / "course").glob("*.ipynb"))]
    labs = labs_in_order(
        path.parent.name for path in (folder / "labs").glob("*/*.ipynb") if path.stem == path.parent.name
    )
    references_page = references.page(folder, [*lessons, *(f"labs/{lab}/{lab}.ipynb" for lab in labs)])
    (folder / "references.md").write_text(references_page, encoding="utf-8")
    front = (HERE / "index.md").read_text(encoding="utf-8")
    front = front.replace("@LESSONS@", "\n".join(_numbered(folder, lesson) for lesson in lessons))
    front = front.replace("@LABS@", "\n".join(f"labs/{lab}/{lab}" for lab in labs))
    front = front.replace("@GRADING@", "\n".join(_pages(folder, "autograder")))
    (folder / "index.md").write_text(front, encoding="utf-8")


def labs_in_order(names: Iterable[str]) -> list[str]:
    """Return the names of labs in the order of the book."""
    known = {name: place for place, name in enumerate(LABS)}
    return sorted(names, key=lambda name: (known.get(name, len(known)), name))


def _keep_links(page: Path, origin: Path) -> None:
    """Bring the images of a page along; what leads to a folder, which a site does not show, is no link any more."""

    def keep(match: re.Match[str]) -> str:
        linked = origin / match["target"]
        if linked.suffix in _IMAGES and linked.is_file():
            copy = page.parent / match["target"]
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(linked, copy)
        return match["text"] if linked.is_dir() else match[0]

    page.write_text(_LINK.sub(keep, page.read_text(encoding="utf-8")), encoding="utf-8")


def _numbered(folder: Path, lesson: str) -> str:
    """Return a lesson's line in the table of contents: with its number, but for the welcome."""
    number = int(Path(lesson).name[:2])
    title = references.title(folder / lesson)
    return f"{number}. {title} <{lesson.removesuffix('.ipynb')}>" if number else lesson.removesuffix(".ipynb")


def _pages(folder: Path, part: str) -> list[str]:
    """Return the Markdown pages directly in a part of the book, its README first."""
    found = sorted((folder / part).glob("*.md"), key=lambda path: (path.stem != "README", path.name))
    return [path.relative_to(folder).with_suffix("").as_posix() for path in found]


def _split_outline(course: Path) -> None:
    """Make two pages of the map of the outline and the table of what is no longer true in it."""
    taught, found, changes = (
        (course / "OUTLINE.md").read_text(encoding="utf-8").partition("## What is no longer true\n")
    )
    if not found or _ANNOUNCED not in taught:
        raise SystemExit("course/OUTLINE.md no longer has the two parts that book/staging.py makes pages of")
    pointer = "What is no longer true in it, or never was, stands on [a page of its own](CHANGES.md)."
    (course / "OUTLINE.md").write_text(taught.replace(_ANNOUNCED, pointer), encoding="utf-8")
    back = "Of [the outline that this course follows](OUTLINE.md): what it says, what is so today, and who says that.\n"
    changes = f"# What is no longer true\n\n{back}{changes}".replace("\n### ", "\n## ")
    (course / "CHANGES.md").write_text(changes, encoding="utf-8")
