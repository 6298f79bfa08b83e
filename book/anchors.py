"""A place for each cell of a notebook, so that other pages can point at it.

The map of the outline names cells by their ids: on the page such a name becomes a link to the cell. So does what a
check says about where to reread, which links to a cell as JupyterLab does.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import nbformat
from docutils import nodes
from sphinx.application import Sphinx

_NOTEBOOK_LINK = re.compile(r'href="(?P<notebook>[^":]+)\.ipynb(?:#cell-id=(?P<cell>[\w-]+))?"')
_LINES_OF_A_CELL = 10_000  # MyST-NB counts line k of cell n (from 0) as (n + 1) * 10000 + k


def name_cells(app: Sphinx, doctree: nodes.document) -> None:
    """Give the first element of each cell the id ``cell-ID``."""
    path = Path(app.env.doc2path(app.env.docname))
    if path.suffix != ".ipynb":
        return
    ids = [cell.id for cell in nbformat.read(path, 4).cells]
    named: set[int] = set()
    for node in doctree.findall(lambda n: isinstance(n, nodes.Element) and not isinstance(n, nodes.document)):
        index = _cell_of(node)
        if index is not None and index < len(ids) and index not in named:
            named.add(index)
            node["ids"].append(f"cell-{ids[index]}")


def _cell_of(node: nodes.Element) -> int | None:
    if "nb_element" in node and node["nb_element"] == "cell_code":
        return int(node["cell_index"])
    return node.line // _LINES_OF_A_CELL - 1 if node.line and node.line >= _LINES_OF_A_CELL else None


def link_cells(app: Sphinx, doctree: nodes.document, docname: str) -> None:
    """Turn names of cells that follow a link to a notebook into links: ``[Lesson 3](…): Streams (`stream`)``."""
    if docname not in app.config.robotbrain_cell_links:
        return
    for place in [*doctree.findall(nodes.entry), *doctree.findall(nodes.paragraph)]:
        target = ""
        for node in list(place.findall(lambda n: isinstance(n, (nodes.reference, nodes.literal)))):
            if isinstance(node, nodes.reference):
                address = node.get("refuri", "")
                target = address if node.get("internal") and ".html" in address and "#" not in address else ""
            elif target and not isinstance(node.parent, nodes.reference):
                link = nodes.reference("", "", internal=True, refuri=f"{target}#cell-{node.astext()}")
                node.replace_self(link)
                link += node


def mend_outputs(app: Sphinx, doctree: nodes.document, docname: str) -> None:
    """Turn links to notebooks in outputs of cells, which Sphinx leaves as they are, into links to pages."""
    for node in doctree.findall(nodes.raw):
        if ".ipynb" in node.astext():
            node.children = [nodes.Text(to_pages(node.astext()))]


def to_pages(markup: str) -> str:
    """Return HTML whose links to notebooks, and to cells in them, lead to the pages made of them."""

    def page(match: re.Match[str]) -> str:
        place = f"#cell-{match['cell']}" if match["cell"] else ""
        return f'href="{match["notebook"]}.html{place}"'

    return _NOTEBOOK_LINK.sub(page, markup)


def setup(app: Sphinx) -> dict[str, Any]:
    """Register with Sphinx."""
    app.add_config_value("robotbrain_cell_links", (), "html", frozenset({tuple, list}))
    app.connect("doctree-read", name_cells)
    app.connect("doctree-resolved", link_cells)
    app.connect("doctree-resolved", mend_outputs)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
