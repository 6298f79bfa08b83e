"""Putting a recognised submission in order: cells of the lab as they must be, answers where they count."""

from __future__ import annotations

import ast
import bisect
import re
from collections.abc import Sequence

from robotbrain.grading.intake.cells import Piece
from robotbrain.grading.intake.master import ANSWER, ESSAY, GIVEN, LOCKED, SKIP_TAG, Slot, defined
from robotbrain.grading.intake.recognise import compiles, same, sides_that_work, untouched

_ELSEWHERE = "# The answer stands in a cell above; the empty template was set aside before grading."
_SCORING = re.compile(r"^\s*\w+\.(?:score|check)\(.*\)\s*;?\s*$", re.M)
_MOST_PARTS = 5  # cells into which a split answer may have fallen


def restore(pieces: list[Piece], slots: Sequence[Slot], repairs: list[str]) -> list[Piece]:
    """Return the cells of the notebook that is graded, in order."""
    pieces = _settle(pieces, slots, repairs)
    pieces = _join_split(pieces, slots, repairs)
    pieces = _in_order(pieces, slots, repairs)
    pieces = _put_back(pieces, slots, repairs)
    pieces = _bring_answers(pieces, slots, repairs)
    return _bring_essays(pieces, slots, repairs)


def _settle(pieces: list[Piece], slots: Sequence[Slot], repairs: list[str]) -> list[Piece]:
    """Give every cell of the lab its type, tags and, where it is locked, its text."""
    out: list[Piece] = []
    for piece in pieces:
        slot = slots[piece.slot] if piece.slot is not None else None
        if slot is None or slot.what == ANSWER:
            settled = sides_that_work(piece.source)
            if settled is not None:
                piece.source = settled
                repairs.append(f"{_called(slot)} held an unsolved git conflict; the side that works was kept")
        if slot is None:
            out.append(piece)
            continue
        if piece.kind != slot.kind:
            if slot.what != GIVEN or slot.kind == "code":
                repairs.append(f"the cell {slot.title} had become a {piece.kind} cell")
            piece.kind = slot.kind
        piece.tags = slot.tags if slot.label else piece.tags
        if slot.what == LOCKED:
            rest = _beside_locked(piece.source, slot)
            if rest is not None:
                repairs.append(f"the {_kind(slot)} cell {slot.title} had been changed and was restored")
            if rest and not any(same(rest, s.shown) for s in slots):
                out.append(Piece("code", rest))
            piece.source = slot.shown
        out.append(piece)
    return out


def _called(slot: Slot | None) -> str:
    return f"the cell {slot.title}" if slot is not None else "a cell"


def _beside_locked(source: str, slot: Slot) -> str | None:
    """What a student wrote into a locked cell; None if it is unchanged, ``""`` if there is nothing to keep."""
    if same(source, slot.shown) or not source.strip():
        return None
    if slot.shown.strip() in source:
        rest = source.replace(slot.shown.strip(), "", 1)
    elif source.strip() in slot.shown:
        return ""
    else:
        rest = source if slot.kind == "code" else ""
    if "### BEGIN HIDDEN TESTS" in rest:  # graded before: the tests, not the student's
        return None
    rest = _SCORING.sub("", rest).strip("\n")
    return rest if any(line.strip() and not line.lstrip().startswith("#") for line in rest.splitlines()) else ""


def _join_split(pieces: list[Piece], slots: Sequence[Slot], repairs: list[str]) -> list[Piece]:
    """Join an answer with the unlabelled cells next to it if only together they are Python."""
    gone: set[int] = set()
    for index, piece in enumerate(pieces):
        slot = slots[piece.slot] if piece.slot is not None else None
        if slot is None or slot.what != ANSWER or untouched(piece.source, slot):
            continue
        near = [i for step in (1, -1) for i in _neighbours(pieces, index, step) if i not in gone]
        broken = {i for i in [index, *near] if not compiles(pieces[i].source)}
        best: tuple[int, int, list[int]] | None = None
        for first in sorted({index, *(i for i in near if i < index)}) if broken else ():
            for last in sorted({index, *(i for i in near if i > index)}):
                parts = [i for i in range(first, last + 1) if i not in gone]
                joined = "\n".join(pieces[i].source for i in parts)
                rank = (len(broken - set(parts)), len(parts), parts)
                if len(parts) > 1 and broken & set(parts) and compiles(joined) and (best is None or rank < best):
                    best = rank
        if best is not None:
            piece.source = "\n".join(pieces[i].source for i in best[2])
            gone |= set(best[2]) - {index}
            repairs.append(f"the cell {slot.title} had been split; its parts were joined")
    return [p for i, p in enumerate(pieces) if i not in gone]


def _neighbours(pieces: list[Piece], index: int, step: int) -> list[int]:
    """Numbers of the student's own cells next to a cell, nearest first."""
    found: list[int] = []
    here = index + step
    while 0 <= here < len(pieces) and len(found) < _MOST_PARTS - 1:
        if pieces[here].slot is not None:
            break
        found.append(here)
        here += step
    return found


def _fixed(piece: Piece, slots: Sequence[Slot]) -> bool:
    """Whether a cell has its place: all of the lab's but texts and cells that are not run."""
    if piece.slot is None:
        return False
    slot = slots[piece.slot]
    return slot.what != GIVEN or (slot.kind == "code" and SKIP_TAG not in slot.tags)


def _in_order(pieces: list[Piece], slots: Sequence[Slot], repairs: list[str]) -> list[Piece]:
    """Move the fewest cells of the lab that bring all of them into the lab's order."""
    places = [(i, p.slot) for i, p in enumerate(pieces) if p.slot is not None and _fixed(p, slots)]
    keep = _longest_rising([slot for _, slot in places])
    moved = [pieces[places[i][0]] for i in range(len(places)) if i not in keep]
    if not moved:
        return pieces
    lab = [slots[p.slot].title for p in moved if p.slot is not None and slots[p.slot].label]
    if lab:
        repairs.append(f"cells stood in another order and were put back in place: {', '.join(lab[:8])}")
    out = [p for p in pieces if p not in moved]
    for piece in sorted(moved, key=lambda p: p.slot or 0):
        _insert(out, piece, slots)
    return out


def _longest_rising(values: list[int]) -> set[int]:
    """Indices of a longest increasing subsequence."""
    tails: list[int] = []  # values
    at: list[int] = []  # their indices
    before: list[int] = []
    for index, value in enumerate(values):
        place = bisect.bisect_left(tails, value)
        before.append(at[place - 1] if place else -1)
        tails[place : place + 1] = [value]
        at[place : place + 1] = [index]
    chain = set()
    here = at[-1] if at else -1
    while here >= 0:
        chain.add(here)
        here = before[here]
    return chain


def _insert(pieces: list[Piece], piece: Piece, slots: Sequence[Slot]) -> None:
    """Put a cell of the lab where it belongs: answers right after what precedes them, tests as late as they may."""
    number = piece.slot or 0
    start = max((i + 1 for i, p in enumerate(pieces) if _fixed(p, slots) and (p.slot or 0) < number), default=0)
    if slots[number].what == LOCKED:
        end = next((i for i in range(start, len(pieces)) if pieces[i].slot is not None), len(pieces))
        own = [i for i in range(start, end) if pieces[i].kind == "code"]
        start = own[-1] + 1 if own else start
    pieces.insert(start, piece)


def _put_back(pieces: list[Piece], slots: Sequence[Slot], repairs: list[str]) -> list[Piece]:
    """Insert the cells of the lab that are not there. Texts and cells that are not run anyway are not missed."""
    out = list(pieces)
    present = {p.slot for p in pieces}
    everything = "\n".join(p.source for p in pieces)
    given = []
    for slot in slots:
        if slot.number in present:
            continue
        if slot.what == GIVEN:
            needed = slot.kind == "code" and SKIP_TAG not in slot.tags and not _only_checks(slot.shown)
            if not needed or slot.shown.strip() in everything:
                continue
            given.append(slot.title)
        else:
            kind = "test" if slot.graded else "given" if slot.what == LOCKED else "answer"
            repairs.append(f"the {kind} cell {slot.title} was missing and has been put back")
        _insert(out, Piece(slot.kind, slot.shown, slot.id, slot.label, slot.tags, slot=slot.number), slots)
    if given:
        repairs.append(f"cells given with the lab were missing and have been put back: {', '.join(given[:8])}")
    return out


def _only_checks(source: str) -> bool:
    return not _SCORING.sub("", source).strip()


def _kind(slot: Slot) -> str:
    return "test" if slot.graded else "given"


def _bring_answers(pieces: list[Piece], slots: Sequence[Slot], repairs: list[str]) -> list[Piece]:
    """Where an answer cell is still empty and its answer stands in another cell, see to it that the answer counts."""
    for slot in slots:
        if slot.what != ANSWER or not slot.names:
            continue
        here = next(i for i, p in enumerate(pieces) if p.slot == slot.number)
        own = pieces[here]
        empty = untouched(own.source, slot)
        if not empty and (slot.names & own.names and compiles(own.source)):
            continue
        test = next(
            (i for i, p in enumerate(pieces) if i > here and p.slot is not None and slots[p.slot].graded), len(pieces)
        )
        holders = [i for i, p in enumerate(pieces) if i != here and _holds(p, slot, slots)]
        if any(here < i < test for i in holders):
            for i in holders:
                pieces[i].kind = "code"
        elif above := [i for i in holders if i < here]:
            pieces[above[-1]].kind = "code"
            if empty:
                own.source = _ELSEWHERE
                repairs.append(
                    f"the answer {slot.title} stood in a cell above its own; the empty template was set aside"
                )
        elif below := [i for i in holders if i > test]:
            if not empty:  # a draft that is no Python stays, and the answer comes after it
                pieces.insert(here, Piece("code", own.source))
                here, below = here + 1, [i + 1 for i in below]
            pieces = _bring_up(pieces, here, below[-1], slot, slots)
            repairs.append(f"the answer {slot.title} stood in a cell below its test and was moved to its place")
    return pieces


def _holds(piece: Piece, slot: Slot, slots: Sequence[Slot]) -> bool:
    """Whether another cell defines what an answer should define, and is Python."""
    if piece.slot is not None and slots[piece.slot].what != ANSWER:
        return False
    if piece.slot is not None and untouched(piece.source, slots[piece.slot]):
        return False
    return slot.names <= piece.names and compiles(piece.source)


def _bring_up(pieces: list[Piece], here: int, there: int, slot: Slot, slots: Sequence[Slot]) -> list[Piece]:
    """Move an answer from a later cell to its own, and with it the student's cells below that it needs."""
    own, other = pieces[here], pieces[there]
    foreign = frozenset().union(*(s.names for s in slots if s is not slot)) - slot.names
    gone: list[Piece] = []
    if other.slot is not None or other.names & foreign:
        own.source, other.source = _extracted(other.source, slot.names)
    else:
        own.source = other.source
        gone.append(other)
    needed = _words(own.source) - own.names
    helpers: list[Piece] = []
    for piece in reversed(pieces[here + 1 :]):
        if piece.slot is None and piece.kind == "code" and piece not in gone and piece.names & needed:
            helpers.insert(0, piece)
            needed |= _words(piece.source)
    rest = [p for p in pieces if p not in gone and p not in helpers]
    place = rest.index(own)
    return [*rest[:place], *helpers, *rest[place:]]


def _words(source: str) -> set[str]:
    return set(re.findall(r"[^\W\d]\w*", source))


def _extracted(source: str, names: frozenset[str]) -> tuple[str, str]:
    """Divide code: the statements that define ``names`` with those just before them that define nothing, the rest."""
    lines = source.split("\n")
    taken: set[int] = set()
    pending: list[range] = []
    try:
        body = ast.parse(source).body
    except (SyntaxError, ValueError, MemoryError, RecursionError):  # lines for IPython: leave it whole, run it twice
        return source, source
    for statement in body:
        first = min([statement.lineno, *(d.lineno for d in getattr(statement, "decorator_list", []))])
        span = range(first - 1, statement.end_lineno or first)
        bound = defined("\n".join(lines[span.start : span.stop]))
        if bound & names:
            taken.update(i for part in [*pending, span] for i in part)
        pending = [*pending, span] if isinstance(statement, (ast.Import, ast.ImportFrom)) else []
    mine = "\n".join(line for i, line in enumerate(lines) if i in taken)
    rest = "\n".join(line for i, line in enumerate(lines) if i not in taken)
    return mine, rest


def _bring_essays(pieces: list[Piece], slots: Sequence[Slot], repairs: list[str]) -> list[Piece]:
    """Move a text into the answer cell above it that was left empty: nbgrader gives an untouched one no points."""
    out: list[Piece] = []
    target: Piece | None = None
    for piece in pieces:
        if piece.slot is not None:
            slot = slots[piece.slot]
            target = piece if slot.what == ESSAY and untouched_text(piece.source, slot) else None
        elif target is not None and piece.kind != "code" and piece.source.strip():
            if target.slot is not None:
                repairs.append(
                    f"the answer {slots[target.slot].title} stood in a cell below its own and was moved there"
                )
            target.source, target.attachments = piece.source, piece.attachments
            target = None
            continue
        out.append(piece)
    return out


def untouched_text(source: str, slot: Slot) -> bool:
    """Whether an essay is still its template, or empty."""
    return same(source, slot.shown) or not source.strip()
