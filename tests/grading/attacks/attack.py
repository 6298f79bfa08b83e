"""What an attack is, and the ways to put one and the same payload into a notebook.

A *payload* is text that would make wrong answers pass, or fetch a secret, if it worked. :func:`spread` makes attacks of
it: at every place in the notebook (the first cell, inside the answers while they are tested, a module beside the
notebook) and in several spellings, so that what stops it is no matter of where it stands or how it is written.
"""

from __future__ import annotations

import base64
import enum
import re
import textwrap
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from nbformat.notebooknode import NotebookNode

from tests.grading.attacks.vault import GOOD_WEIGHTS, POINTS, WEIGHTS, WRONG, Vault, submission

ALL_WRONG = tuple(POINTS)


class Place(enum.StrEnum):
    """Where a payload stands."""

    FIRST_CELL = "first cell"
    IN_CALLS = "in every call"
    LAST_CELL = "last cell"
    MODULE = "module beside the notebook"


@dataclass(frozen=True)
class Attack:
    """A hostile submission.

    Attributes:
        kind: the class of attacks it belongs to.
        answers: exercise -> source, in place of the right answer.
        extra: further cells as (place, source), see :func:`~tests.grading.attacks.vault.submission`.
        files: files beside the notebook by name; a function is called with the path it is to fill.
        edit: changes to the finished notebook.
        wrong: exercises answered wrongly. The submission honestly earns the points of all others ...
        honest: ... unless said otherwise here (exercise -> points).
        keeps: whether the honest points must really be there: the attack is not to hurt its own author either.
        dangerous: only run inside a sandbox with namespaces of its own; it would harm the machine.
    """

    name: str
    kind: str
    answers: Mapping[str, str] = field(default_factory=dict)
    extra: tuple[tuple[str, str], ...] = ()
    files: Mapping[str, str | bytes | Callable[[Path], None]] = field(default_factory=dict)
    edit: Callable[[NotebookNode], NotebookNode] | None = None
    wrong: tuple[str, ...] = ()
    honest: Mapping[str, float] = field(default_factory=dict)
    keeps: bool = False
    dangerous: bool = False

    def earns(self, exercise: str) -> float:
        """What an honest grader gives for ``exercise``."""
        return self.honest.get(exercise, 0.0 if exercise in self.wrong else float(POINTS[exercise]))

    def notebook(self, vault: Vault, paths: Mapping[str, str]) -> NotebookNode:
        """The submission, with real paths filled in: the attacker is assumed to know them."""

        def known(source: str) -> str:
            for name, value in paths.items():
                source = source.replace(f"@{name}@", value)
            return source

        wrong = {name: WRONG[name] for name in self.wrong}
        answers = {name: known(source) for name, source in {**wrong, **self.answers}.items()}
        return submission(answers, [(place, known(source)) for place, source in self.extra], self.edit)

    def write_files(self, folder: Path, paths: Mapping[str, str]) -> None:
        """Put the further files into the submission's folder."""
        if "weights" not in self.wrong and WEIGHTS not in self.files:
            (folder / WEIGHTS).write_text(GOOD_WEIGHTS)
        for name, content in self.files.items():
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            if callable(content):
                content(target)
            elif isinstance(content, bytes):
                target.write_bytes(content)
            else:
                for key, value in paths.items():
                    content = content.replace(f"@{key}@", value)
                target.write_text(content)


PRELUDE = """
def breach(what):
    import sys
    sys.__stdout__ and None
    print("BRE" + "ACH: " + str(what)[:300])
"""
"""``breach(what)`` reports that something worked which must not; the harness looks for its text in all outputs."""


def _plain(payload: str) -> str:
    return payload


def _encoded(payload: str) -> str:
    # Places like @hidden@ are filled in later: they stay readable.
    pieces = re.split(r"(@\w+@)", payload)
    parts = [repr(p) if i % 2 else f"_d({base64.b64encode(p.encode())!r}).decode()" for i, p in enumerate(pieces)]
    return f"from base64 import b64decode as _d\nexec({' + '.join(parts)}, globals())"


def _in_thread(payload: str) -> str:
    return (
        f"import threading as _t\n_p = _t.Thread(target=exec, args=({payload!r}, globals()), daemon=True)\n"
        "_p.start()\n_p.join(2)"
    )


def _in_cell(payload: str) -> str:
    return f"from IPython import get_ipython as _g\n(_g().run_cell if _g() else exec)({payload!r})"


def _in_decorator(payload: str) -> str:
    head = "class _M(type):\n    def __init__(cls, *a):\n        "
    return f"{head}exec({payload!r}, globals())\nclass _C(metaclass=_M): pass"


def _in_deleter(payload: str) -> str:
    return f"class _D:\n    def __del__(self):\n        exec({payload!r}, globals())\n_d = _D()\ndel _d"


SPELLINGS: tuple[Callable[[str], str], ...] = (_plain, _encoded, _in_thread, _in_cell, _in_decorator, _in_deleter)


def in_calls(payload: str, answers: Mapping[str, str] = WRONG) -> dict[str, str]:
    """``answers`` with ``payload`` run each time one of their functions or methods is called."""
    found = {}
    for name, source in answers.items():
        lines = []
        for line in source.splitlines():
            lines.append(line)
            if line.lstrip().startswith("def "):
                indent = " " * (len(line) - len(line.lstrip()) + 4)
                lines.append(f"{indent}exec(_PAYLOAD, globals(), {{'_arguments': dict(locals())}})")
        found[name] = f"_PAYLOAD = {payload!r}\n" + "\n".join(lines)
    return found


def spread(
    name: str,
    kind: str,
    payload: str,
    *,
    places: tuple[Place, ...] = (Place.FIRST_CELL, Place.IN_CALLS),
    dangerous: bool = False,
    spelling: int = 0,
) -> list[Attack]:
    """Attacks with wrong answers everywhere and ``payload`` at each of ``places``; each is worth nothing.

    Every place has another spelling than the one before, beginning with number ``spelling``.
    """
    made = []
    body = PRELUDE + textwrap.dedent(payload)
    for number, place in enumerate(places):
        text = SPELLINGS[(spelling + number) % len(SPELLINGS)](body)
        answers = in_calls(text) if place is Place.IN_CALLS else {}
        extra = {
            Place.FIRST_CELL: (("first", text),),
            Place.LAST_CELL: (("last", text),),
            Place.MODULE: (("first", "import helper_of_mine"),),
            Place.IN_CALLS: (),
        }[place]
        files = {"helper_of_mine.py": text} if place is Place.MODULE else {}
        made.append(Attack(f"{name}, {place}", kind, answers, extra, files, wrong=ALL_WRONG, dangerous=dangerous))
    return made
