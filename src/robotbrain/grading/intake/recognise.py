"""Which cell of a submission is which cell of the lab: by label, by cell id, by text, by what it defines, by place."""

from __future__ import annotations

import ast
import difflib
import re
from collections.abc import Iterable, Sequence

from robotbrain.grading.intake.cells import Piece
from robotbrain.grading.intake.master import ANSWER, ESSAY, GIVEN, LOCKED, Slot, defined
from robotbrain.grading.intake.text import conflict_sides

_LONGEST_PARSED = 100_000  # characters of a cell whose syntax is looked at
_DEEPEST_PARSED = 60  # open brackets, as a bound on the work of the parser
_SHORTEST_BLOCK = 12  # characters of a given text that is searched inside merged cells
_MOST_COMPARISONS = 300
_SIMILAR = 0.6
_MAGIC = re.compile(r"^(\s*)[%!?].*$", re.M)


def recognise(pieces: list[Piece], slots: Sequence[Slot], repairs: list[str]) -> list[Piece]:
    """Set ``piece.slot`` of every cell that is one of the lab's, each of these at most once.

    Returns the pieces: those that were cut from merged cells are new, needless copies are gone.
    """
    labels = {s.label: s for s in slots if s.label}
    for piece in pieces:
        if piece.label not in labels:
            piece.label = ""
    pieces = _cut_merged(pieces, slots, repairs)
    pieces = _by_label(pieces, labels, repairs)
    _exchange(pieces, slots, repairs)
    lost = _by_id_and_text(pieces, slots) + _by_content(pieces, slots)
    _note_lost(lost, repairs)
    templates = {_normal(s.shown) for s in slots if s.what in (ANSWER, LOCKED)} - {""}
    given = {(s.id, _normal(s.shown)) for s in slots if s.what == GIVEN}
    return [p for p in pieces if p.slot is not None or not _needless_copy(p, templates, given)]


def compiles(source: str) -> bool:
    """Whether code parses as Python; lines for IPython count as nothing. False for what is too large to look at."""
    if len(source) > _LONGEST_PARSED or not _shallow(source):
        return False
    try:
        ast.parse(_MAGIC.sub(r"\1pass", source))
    except (SyntaxError, ValueError, MemoryError, RecursionError):
        return False
    return True


def _shallow(source: str) -> bool:
    depth = 0
    for match in re.finditer(r"[(\[{]|[)\]}]|[-+~]{50}|(?:not ){50}|(?:lambda:? ?){20}", source):
        text = match.group()
        if len(text) > 1:
            return False
        depth = depth + 1 if text in "([{" else max(0, depth - 1)
        if depth > _DEEPEST_PARSED:
            return False
    return True


def same(a: str, b: str) -> bool:
    """Whether two texts differ in blanks at line ends and empty lines around only."""
    return a == b or _normal(a) == _normal(b)


def _normal(text: str) -> str:
    return "\n".join(line.rstrip() for line in text.strip().splitlines())


def untouched(source: str, slot: Slot) -> bool:
    """Whether an answer is still the template, or nothing at all."""
    return same(source, slot.shown) or not any(
        line.strip() and not line.lstrip().startswith("#") for line in source.splitlines()
    )


def free(pieces: Iterable[Piece]) -> list[Piece]:
    """The student's own cells."""
    return [p for p in pieces if p.slot is None]


def _cut_merged(pieces: list[Piece], slots: Sequence[Slot], repairs: list[str]) -> list[Piece]:
    """Separate cells of the lab that the student merged into one, at the given texts between the answers."""
    answers = frozenset().union(*(s.names for s in slots))
    merged = {p.id for p in pieces if p.names & answers and not p.label}  # an answer in a given cell
    present = {p.label for p in pieces} | {p.id for p in pieces} - merged | {_normal(p.source) for p in pieces}
    absent = [
        s
        for s in slots
        if s.what in (LOCKED, GIVEN)
        and not ({s.label, s.id} - {""}) & present
        and len(s.shown.strip()) >= _SHORTEST_BLOCK
        and _normal(s.shown) not in present
    ]
    if not absent:
        return pieces
    out: list[Piece] = []
    for piece in pieces:
        parts = [piece]
        for slot in list(absent):
            for number, part in enumerate(parts):
                cut = _cut(part, slot) if part.slot is None else None
                if cut is not None:
                    parts[number : number + 1] = cut
                    absent.remove(slot)
                    break
        if len(parts) > 1:
            named = [slots[p.slot].title for p in parts if p.slot is not None]
            repairs.append(f"the cell {named[0]} had been merged with its neighbours and was separated from them")
        out += parts
    return out


def _cut(piece: Piece, slot: Slot) -> list[Piece] | None:
    block = slot.shown.strip()
    start = piece.source.find(block)
    end = start + len(block)
    whole_lines = start >= 0 and piece.source[:start][-1:] in ("", "\n") and piece.source[end : end + 1] in ("", "\n")
    if not whole_lines:
        return None
    before, after = piece.source[:start].strip("\n"), piece.source[end:].strip("\n")
    middle = Piece(slot.kind, slot.shown, slot=slot.number)
    parts = [middle]
    if before:
        parts.insert(0, Piece(piece.kind, before, piece.id, piece.label, piece.tags, piece.attachments))
        if after:
            parts.append(Piece(piece.kind, after, tags=piece.tags))
    elif after:
        parts.append(Piece(piece.kind, after, piece.id, piece.label, piece.tags, piece.attachments))
    return parts


def _by_label(pieces: list[Piece], labels: dict[str, Slot], repairs: list[str]) -> list[Piece]:
    groups: dict[str, list[int]] = {}
    for index, piece in enumerate(pieces):
        if piece.label:
            groups.setdefault(piece.label, []).append(index)
    gone: set[int] = set()
    for label, indices in groups.items():
        slot = labels[label]
        chosen = pieces[indices[-1]]
        if len(indices) > 1:
            chosen, dropped = _choose([pieces[i] for i in indices], indices, slot, repairs)
            gone |= dropped
        chosen.slot = slot.number
    return [p for i, p in enumerate(pieces) if i not in gone]


def _choose(copies: list[Piece], indices: list[int], slot: Slot, repairs: list[str]) -> tuple[Piece, set[int]]:
    """Which of the cells with one label stands for it, and the indices of those that go."""
    texts = {_normal(c.source): (i, c) for i, c in zip(reversed(indices), reversed(copies), strict=True)}
    parts = sorted(texts.values(), key=lambda part: part[0])  # each text once, where it stands first
    if slot.what == ANSWER and indices[-1] - indices[0] == len(indices) - 1 and 1 < len(parts) <= 8:
        joined = "\n".join(c.source for _, c in parts)
        if not all(compiles(c.source) for _, c in parts) and compiles(joined):
            copies[0].source = joined
            repairs.append(f"the cell {slot.title} had been split; its parts were joined")
            return copies[0], set(indices[1:])
    answers = [c for c in copies if not untouched(c.source, slot)] or copies
    sound = [c for c in answers if slot.kind != "code" or compiles(c.source)] or answers
    whole = [c for c in sound if slot.names and slot.names <= c.names] or sound
    chosen = whole[-1] if slot.what in (ANSWER, ESSAY) else copies[-1]
    counts = "the last one" if chosen is copies[-1] else "the one with the answer"
    repairs.append(f"the cell {slot.title} occurred {_times(len(copies))}; {counts} counts")
    gone = set()
    for index, copy in zip(indices, copies, strict=True):
        if copy is not chosen:
            copy.label = copy.id = ""
            if untouched(copy.source, slot) or same(copy.source, chosen.source) or same(copy.source, slot.shown):
                gone.add(index)
    return chosen, gone


def _times(count: int) -> str:
    return "twice" if count == 2 else f"{count} times"


def _exchange(pieces: list[Piece], slots: Sequence[Slot], repairs: list[str]) -> None:
    """Give answers that stand in each other's cells back to their own."""
    wrong = {
        p.slot: p for p in pieces if p.slot is not None and slots[p.slot].names and not slots[p.slot].names & p.names
    }
    moves: dict[int, int] = {}
    for number, piece in wrong.items():
        found = piece.names
        right = [n for n in wrong if n != number and slots[n].names <= found]
        if len(right) == 1 and right[0] not in moves.values():
            moves[number] = right[0]
    for number, piece in wrong.items():
        if number in moves:
            piece.slot = moves[number]
            repairs.append(f"the answer {slots[moves[number]].title} stood in the cell {slots[number].title}")
        elif number in moves.values():
            piece.slot, piece.label, piece.id = None, "", ""


def _by_id_and_text(pieces: list[Piece], slots: Sequence[Slot]) -> list[Slot]:
    """Find cells without a label by their cell id, else by their text; return the labelled ones that were found."""
    found = []
    answers = frozenset().union(*(s.names for s in slots))
    for find in (_same_id, _same_text):
        index = find(pieces)
        taken = {p.slot for p in pieces}
        for slot in slots:
            key = slot.id if find is _same_id else _normal(slot.shown)
            queue = index.get(key, []) if slot.number not in taken and key else []
            order = reversed(queue) if find is _same_id else queue  # of two versions the last counts
            holds_answer = answers - defined(slot.shown) if slot.what == GIVEN else frozenset()
            piece = next((p for p in order if p.slot is None and not p.names & holds_answer), None)
            if piece is not None:
                piece.slot = slot.number
                found.append(slot)
    return [s for s in found if s.label]


def _same_id(pieces: list[Piece]) -> dict[str, list[Piece]]:
    index: dict[str, list[Piece]] = {}
    for piece in pieces:
        if piece.slot is None and not piece.label:
            index.setdefault(piece.id, []).append(piece)
    return index


def _same_text(pieces: list[Piece]) -> dict[str, list[Piece]]:
    index: dict[str, list[Piece]] = {}
    for piece in pieces:
        if piece.slot is None:
            index.setdefault(_normal(piece.source), []).append(piece)
    return index


def _by_content(pieces: list[Piece], slots: Sequence[Slot]) -> list[Slot]:
    """Find what is left by the names it defines, by being alone in its gap, or by similarity."""
    found: list[Slot] = []
    missing = [s for s in slots if s.what != GIVEN and s.number not in {p.slot for p in pieces}]
    for slot in missing:
        if not slot.names:
            continue
        others = frozenset().union(*(s.names for s in missing if s is not slot)) - slot.names
        fits = [p for p in free(pieces) if slot.names <= (names := p.names) and not names & others]
        fits = [p for p in fits if compiles(p.source)] or fits
        if fits:
            fits[-1].slot = slot.number
            found.append(slot)
    budget = _MOST_COMPARISONS
    for slot in [s for s in missing if s not in found]:
        gap = [p for p in _gap(pieces, slot) if p.source.strip()]
        alike = [p for p in gap if p.kind == slot.kind]
        if slot.what == ESSAY and alike:
            max(alike, key=lambda p: len(p.source)).slot = slot.number
            found.append(slot)
            continue
        if slot.what == ANSWER and not slot.names and len(alike) == 1:
            alike[0].slot = slot.number
            found.append(slot)
            continue
        compared = [p for p in free(pieces)[:400] if p.source.strip()][: max(0, budget)]
        budget -= len(compared)
        scores = [(_similarity(p.source, slot.shown), -i) for i, p in enumerate(compared)]
        if scores and max(scores)[0] >= _SIMILAR and slot.what == LOCKED:
            compared[-max(scores)[1]].slot = slot.number
            found.append(slot)
    return found


def _gap(pieces: list[Piece], slot: Slot) -> list[Piece]:
    """The student's own cells between the cells that stand before and after a missing one."""
    before = [i for i, p in enumerate(pieces) if p.slot is not None and p.slot < slot.number]
    start = before[-1] + 1 if before else 0
    end = next((i for i in range(start, len(pieces)) if pieces[i].slot is not None), len(pieces))
    return pieces[start:end]


def _similarity(source: str, shown: str) -> float:
    """The share of lines of the shorter text that occur in the other, in order."""
    a = [line.strip() for line in source[:8000].splitlines() if line.strip()][:100]
    b = [line.strip() for line in shown[:8000].splitlines() if line.strip()][:100]
    if not a or not b:
        return 0.0
    if len(a) == len(b) == 1:
        return difflib.SequenceMatcher(None, a[0][:200], b[0][:200], autojunk=False).ratio()
    if not set(a) & set(b):
        return 0.0
    matched = sum(block.size for block in difflib.SequenceMatcher(None, a, b, autojunk=False).get_matching_blocks())
    return matched / max(len(a), len(b)) if len(b) < 3 else matched / len(b)


def _note_lost(lost: list[Slot], repairs: list[str]) -> None:
    if len(lost) > 4:
        repairs.append(f"{len(lost)} cells had lost their grading labels; they were found by their ids and content")
    else:
        repairs += [f"the cell {slot.title} had lost its grading label" for slot in lost]


def _needless_copy(piece: Piece, templates: set[str], given: set[tuple[str, str]]) -> bool:
    """Whether a cell only repeats a text of the lab; a copied template would undo the answer above it."""
    text = _normal(piece.source)
    return text in templates or (piece.id, text) in given


def sides_that_work(source: str) -> str | None:
    """A cell with git's conflict markers in it, settled for the side that works; None where it has none."""
    sides = conflict_sides(source)
    if len(sides) == 1:
        return None
    return next((s for s in reversed(sides) if compiles(s)), sides[-1])
