"""Widgets as the last thing they showed: a page without a kernel and without a network cannot bring them to life."""

from __future__ import annotations

import json
import re
from typing import Any

from docutils import nodes
from myst_nb.sphinx_ import NbMetadataCollector
from sphinx.application import Sphinx

_VIEW = re.compile(
    r'<script type="application/vnd\.jupyter\.widget-view\+json">\s*(?P<view>\{.*?\})\s*</script>', re.DOTALL
)


def still(markup: str, state: dict[str, Any]) -> str:
    """Return HTML with what HTML widgets held in the end in the place of the widgets; others leave nothing.

    Args:
        markup: of a cell's output.
        state: of the widgets of its notebook, by their ids.
    """

    def held(match: re.Match[str]) -> str:
        model = state.get(json.loads(match["view"])["model_id"], {})
        return str(model["state"]["value"]) if model.get("model_name") == "HTMLModel" else ""

    return _VIEW.sub(held, markup)


def show_still(app: Sphinx, doctree: nodes.document, docname: str) -> None:
    """Replace the widgets of one page, and leave their state out of it."""
    files = NbMetadataCollector.get_js_files(app.env, docname)
    _, saved = files.pop("ipywidgets_state", (None, {}))
    state = json.loads(saved.get("body", "{}")).get("state", {})
    views = [node for node in doctree.findall(nodes.raw) if "jupyter.widget-view+json" in node.astext()]
    done: set[str] = set()  # a widget that came back after a clear_output has left several views
    for node in views:
        text = still(node.astext(), state)
        node.children = [nodes.Text("" if text in done else text)]
        done.add(text)


def setup(app: Sphinx) -> dict[str, Any]:
    """Register with Sphinx."""
    app.connect("doctree-resolved", show_still)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
