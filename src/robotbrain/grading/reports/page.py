"""The frame of every report page, and the one way by which foreign text gets into it.

Templates are rendered with autoescape, every string is cleaned of control characters on its way in, and the page's
own security policy allows one style sheet (by its digest), PNG pictures in the page, and nothing else: no script, no
form, no connection. https://www.w3.org/TR/CSP3/
"""

from __future__ import annotations

import base64
import functools
import hashlib
import re
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

_FOLDER = Path(__file__).parent / "templates"
_ANSI = re.compile(r"\x1b(?:\[[0-?]*[ -/]*[@-~]|\][^\x07\x1b]*(?:\x07|\x1b\\)?|[@-Z\\-_])")
# C0 and C1 controls, what turns the reading direction (a name could pass for another), lone surrogates (not UTF-8).
_UNSAFE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff\ufffe\uffff]")
_STACKED = re.compile("([\u0300-\u036f\u0483-\u0489\u1ab0-\u1aff\u1dc0-\u1dff\u20d0-\u20ff\ufe20-\ufe2f]{3})"
                      "[\u0300-\u036f\u0483-\u0489\u1ab0-\u1aff\u1dc0-\u1dff\u20d0-\u20ff\ufe20-\ufe2f]+")  # fmt: skip
_CODE = re.compile(r"`([^`\n]+)`")


def clean(text: str, limit: int = 20_000) -> str:
    """``text`` without terminal colours and characters that act instead of showing, cut after ``limit`` characters."""
    cut = len(text) - limit
    text = text[: limit + 2000]
    text = _STACKED.sub(r"\1", _UNSAFE.sub("\N{REPLACEMENT CHARACTER}", _ANSI.sub("", text.replace("\r\n", "\n"))))
    return text if cut <= 0 else f"{text[:limit]}\n… ({cut} more characters)"


def points(value: float | None) -> str:
    """Points with at most one decimal; a dash where there are none yet."""
    return "–" if value is None else f"{value:.1f}".removesuffix(".0")


def sentences(text: str) -> Markup:
    """Escaped ``text`` in which `code` is marked as such."""
    return Markup(_CODE.sub(r"<code>\1</code>", str(Markup.escape(clean(text)))))


def _final(value: Any) -> Any:
    """What a template's ``{{ }}`` gives: cleaned, if it is text that is not markup of our own."""
    return clean(value) if isinstance(value, str) and not isinstance(value, Markup) else value


@functools.cache
def environment() -> jinja2.Environment:
    """The templates, with autoescape on for all of them."""
    made = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_FOLDER),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=_final,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    style = (_FOLDER / "style.css").read_text(encoding="utf-8")
    digest = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
    made.globals["style"] = Markup(style)
    made.globals["policy"] = (
        f"default-src 'none'; style-src 'sha256-{digest}'; img-src data:; base-uri 'none'; form-action 'none'"
    )
    made.filters |= {"points": points, "sentences": sentences, "clean": clean}
    return made


def render(template: str, **values: Any) -> str:
    """The page that ``template`` (a file in ``templates/``) makes of ``values``."""
    return environment().get_template(template).render(**values)
