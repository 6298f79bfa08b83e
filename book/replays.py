"""3D replays as files of their own, so that a page with five of them opens as quickly as one with none.

In a notebook a replay is a whole page inside an attribute (``<iframe srcdoc=…>``), with the viewer's script in each.
Here the script is written once, each replay to a file that refers to it, and the frame loads it when it comes into
view. Nothing else changes, and files opened without a server work as well.
"""

from __future__ import annotations

import hashlib
import html
import re
import shutil
from pathlib import Path
from typing import Any

import meshcat
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.osutil import relative_uri

FOLDER, VIEWER = "_replays", "meshcat.min.js"
_FRAME = re.compile(r'<iframe srcdoc="(?P<page>[^"]*)"(?P<rest>[^>]*)>')


def viewer_script() -> Path:
    """The script that draws the scene, as meshcat ships it."""
    return Path(meshcat.viewer_assets_path()) / "dist" / "main.min.js"


def externalise(markup: str, folder: Path, prefix: str, script: str) -> str:
    """Write the replays in ``markup`` to ``folder``; return the markup with frames that load them.

    Args:
        markup: HTML of a cell's output.
        folder: of the replays, where a copy of the viewer's script lies.
        prefix: address of that folder, as seen from the page.
        script: text of the viewer's script.
    """

    def replace(match: re.Match[str]) -> str:
        inline = f"<script>{script}</script>"
        page = html.unescape(match["page"])
        if inline not in page:
            return match[0]
        page = page.replace(inline, f'<script src="{VIEWER}"></script>')
        name = hashlib.sha256(page.encode()).hexdigest()[:16] + ".html"
        (folder / name).write_text(page, encoding="utf-8")
        return f'<iframe class="replay" src="{prefix}{name}" loading="lazy"{match["rest"]}>'

    return _FRAME.sub(replace, markup)


def write_replays(app: Sphinx, doctree: nodes.document, docname: str) -> None:
    """Move the replays of one page out of it."""
    raw = [node for node in doctree.findall(nodes.raw) if "<iframe srcdoc" in node.astext()]
    if not raw or app.builder.format != "html":
        return
    folder = Path(app.outdir) / FOLDER
    folder.mkdir(exist_ok=True)
    shutil.copy(viewer_script(), folder / VIEWER)
    prefix = relative_uri(app.builder.get_target_uri(docname), FOLDER + "/")
    script = viewer_script().read_text(encoding="utf-8")
    for node in raw:
        node.children = [nodes.Text(externalise(node.astext(), folder, prefix, script))]


def setup(app: Sphinx) -> dict[str, Any]:
    """Register with Sphinx."""
    app.connect("doctree-resolved", write_replays)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
