"""Turns what a student's process says into outputs of a notebook, checking every field: nothing of it is trusted."""

from __future__ import annotations

from typing import Any

from nbformat.notebooknode import NotebookNode, from_dict

KEPT_MIME = frozenset(
    {
        "text/plain",
        "text/html",
        "text/markdown",
        "text/latex",
        "application/json",
        "image/png",
        "image/jpeg",
        "image/gif",
        "image/svg+xml",
    }
)
"""What a student's cell may show. No scripts, no widgets, and no scores: those come from the tester alone."""

_MOST_OUTPUTS = 10_000


class CellOutputs:
    """The outputs of one cell as they arrive.

    Args:
        limit_bytes: what is kept; the rest is dropped with a note.
    """

    def __init__(self, limit_bytes: int) -> None:
        self._limit, self._size, self._dropped = limit_bytes, 0, False
        self._outputs: list[NotebookNode] = []
        self._named: dict[str, list[NotebookNode]] = {}
        self._clear_next = False

    def take(self, message: dict[str, Any]) -> None:
        """Apply one message of the student's process; one that has no proper form is ignored."""
        operation = message.get("op")
        if operation == "stream":
            name, text = message.get("name"), message.get("text")
            if name in ("stdout", "stderr") and type(text) is str:
                self._add(stream(text, str(name)), len(text))
        elif operation == "output":
            self._take_output(message)
        elif operation == "clear":
            self._clear_next = bool(message.get("wait"))
            if not self._clear_next:
                self._outputs.clear()

    def result(self) -> list[NotebookNode]:
        """The cell's outputs."""
        outputs = merged(self._outputs)
        if self._dropped:
            outputs.append(stream(f"Output beyond {self._limit} bytes was dropped.\n"))
        return outputs

    def _take_output(self, message: dict[str, Any]) -> None:
        given = message.get("output")
        if type(given) is not dict:
            return
        kind = given.get("output_type")
        if kind == "error":
            name, value, lines = given.get("ename"), given.get("evalue"), given.get("traceback")
            if type(name) is str and type(value) is str and type(lines) is list:
                texts = [line for line in lines[:100] if type(line) is str]
                output = from_dict({"output_type": "error", "ename": name, "evalue": value, "traceback": texts})
                # Why a cell failed is kept after a flood, unless it is a flood itself.
                self._add(output, 0 if sum(map(len, texts)) <= self._limit else self._limit + 1)
            return
        if kind not in ("display_data", "execute_result") or type(given.get("data")) is not dict:
            return
        data = {k: v for k, v in given["data"].items() if k in KEPT_MIME and type(v) is str}
        name = message.get("id")
        if message.get("update") is True:
            for output in self._named.get(name, []) if type(name) is str else []:
                if self._fits(data):
                    output.data = from_dict(data)
            return
        fields: dict[str, Any] = {"output_type": kind, "data": data, "metadata": {}}
        if kind == "execute_result":
            fields["execution_count"] = None
        output = from_dict(fields)
        if self._add(output, sum(map(len, data.values()))) and type(name) is str:
            self._named.setdefault(name, []).append(output)

    def _fits(self, data: dict[str, str]) -> bool:
        self._size += sum(map(len, data.values()))
        self._dropped |= self._size > self._limit
        return self._size <= self._limit

    def _add(self, output: NotebookNode, size: int) -> bool:
        if self._clear_next:
            self._outputs.clear()
            self._clear_next = False
        if self._size + size > self._limit or len(self._outputs) >= _MOST_OUTPUTS:
            self._dropped = True
            return False
        self._size += size
        last = self._outputs[-1] if self._outputs else None
        if last is not None and last.output_type == output.output_type == "stream" and last.name == output.name:
            last.text += output.text
        else:
            self._outputs.append(output)
        return True


def merged(outputs: list[NotebookNode]) -> list[NotebookNode]:
    """Join neighbouring pieces of the same stream."""
    joined: list[NotebookNode] = []
    for output in outputs:
        last = joined[-1] if joined else None
        if last is not None and output.output_type == last.output_type == "stream" and output.name == last.name:
            last.text += output.text
        else:
            joined.append(output)
    return joined


def stream(text: str, name: str = "stdout") -> NotebookNode:
    """Printed text as an output."""
    return from_dict({"output_type": "stream", "name": name, "text": text})


def error(name: str, message: str) -> NotebookNode:
    """An exception as an output."""
    return from_dict({"output_type": "error", "ename": name, "evalue": message, "traceback": [f"{name}: {message}"]})
