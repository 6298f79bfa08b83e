"""A paper in a notebook: questions as Markdown, a form beside them where ipywidgets can be had, and a review.

An answer lives in a cell, as a plain Python value, because that is what nbgrader keeps. The form is an aid: it writes
the line to type. Everything can be done with the keyboard, and without the form.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from typing import Any

from robotbrain.assessment.paper import TOPICS, Item, Paper
from robotbrain.errors import InputError


def show(paper: Paper, name: str) -> None:
    """Display the question ``name``; with a form where that is possible and nobody is grading."""
    from IPython.display import display

    item = paper[name]
    text = item.markdown()
    display({"text/markdown": text, "text/plain": text}, raw=True)  # feedback pages show a student's outputs as text
    if os.environ.get("NBGRADER_EXECUTION") is None and item.kind != "code":
        form = make_form(item)
        if form is not None:
            display(form)


def make_form(item: Item) -> Any:
    """A form for one question that shows the line to type; None without ipywidgets."""
    try:
        import ipywidgets as widgets
    except ImportError:
        return None
    line = widgets.Text(description="to type:", value=f"{item.name} = ...", layout={"width": "95%"})

    def write(value: object) -> None:
        line.value = f"{item.name} = {value!r}"

    inputs = _inputs(item, widgets, write)
    return widgets.VBox([*inputs, line])


def _inputs(item: Item, widgets: Any, write: Callable[[object], None]) -> list[Any]:
    if item.kind == "single":
        radio = widgets.RadioButtons(options=list(item.letters), value=None, description="choose:")
        radio.observe(lambda change: write(change["new"]), "value")
        return [radio]
    if item.kind == "multiple":
        boxes = [widgets.Checkbox(description=letter, indent=False) for letter in item.letters]
        for box in boxes:
            box.observe(lambda _: write([b.description for b in boxes if b.value]), "value")
        return boxes
    if item.kind == "order":
        steps = [
            widgets.Dropdown(options=["", *item.letters], description=f"{k + 1}.") for k in range(len(item.letters))
        ]
        for step in steps:
            step.observe(lambda _: write([s.value for s in steps]), "value")
        return steps
    number = widgets.Text(description=f"in {item.unit}:" if item.unit else "number:")
    number.observe(lambda change: write(f"{change['new']} {item.unit}".strip()), "value")
    return [number]


class Review:
    """What was answered, question by question; of a practice paper also whether it is right, and why."""

    def __init__(self, rows: list[tuple[str, str, str, str]]) -> None:
        self.rows = rows

    def __repr__(self) -> str:
        return "\n".join(f"{name} ({topic}): {given} - {said}" for name, topic, given, said in self.rows)

    def _repr_markdown_(self) -> str:
        body = [" | ".join(_cell(text) for text in row) for row in self.rows]
        return "\n".join(
            ["| question | topic | your answer | |", "| --- | --- | --- | --- |", *(f"| {b} |" for b in body)]
        )


def _cell(text: str) -> str:
    return " ".join(text.replace("|", "\\|").split())


def review(paper: Paper, namespace: Mapping[str, object]) -> Review:
    """Go through all answers: are they there, can they be read; of a practice paper also marked, with reasons.

    Args:
        namespace: the notebook's variables, ``globals()``.
    """
    return Review([_reviewed(paper, item, namespace.get(item.name, ...)) for item in paper.items])


def _reviewed(paper: Paper, item: Item, answer: object) -> tuple[str, str, str, str]:
    topic = TOPICS[item.topic]
    if answer is ...:
        return item.name, topic, "", "not answered yet"
    given = getattr(answer, "__name__", None) if item.kind == "code" else repr(answer)
    try:
        item.read(answer)
        said = told(paper, item.name, answer) if paper.practice else "can be read"
    except (InputError, NotImplementedError) as error:
        said = str(error) or "not written yet"
    return item.name, topic, str(given)[:60], said


def told(paper: Paper, name: str, answer: object) -> str:
    """What marking says of an answer on a practice paper, whose key is public."""
    from robotbrain.assessment.marking import advice, mark
    from robotbrain.assessment.records import practice_draw

    draw = practice_draw()
    if draw.paper.code != paper.code:
        raise InputError("paper", given=paper.code, expected=draw.paper.code, fix="Open the practice paper again.")
    marked = mark(draw[name], answer)
    if marked.right:
        return f"Right. {marked.reason}"
    return f"{marked.credit:.0%}. {advice(draw[name].question, marked.key)}"
