"""A built book as a browser shows it."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from .browser.server import CHROMIUM_ARGUMENTS

if TYPE_CHECKING:
    from playwright.sync_api import Browser, BrowserContext, Page, Route

DESKTOP, PHONE = (1280, 900), (390, 844)
_SCENE = re.compile(r"for \(const text of (\[.*?\])\) \{", re.DOTALL)


@dataclass
class Visit:
    """What came to light when a page was opened.

    Attributes:
        violations: (impact, rule, place, what is wrong) as axe-core says.
        outside: addresses beyond the book that the page asked for.
        failed: addresses in the book that did not answer, and errors in the console.
        too_wide: by how many pixels the page is wider than the window.
    """

    path: str
    mode: str
    violations: list[tuple[str, str, str, str]] = field(default_factory=list)
    outside: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    too_wide: int = 0


@contextmanager
def browser(chromium: str) -> Iterator[Browser]:
    """A headless Chromium."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=chromium, args=list(CHROMIUM_ARGUMENTS))
        yield opened
        opened.close()


@contextmanager
def reader(opened: Browser, mode: str = "", size: tuple[int, int] = DESKTOP) -> Iterator[BrowserContext]:
    """A reader who never was here, and who has chosen light or dark if ``mode`` says so."""
    context = opened.new_context(viewport={"width": size[0], "height": size[1]})
    if mode:
        context.add_init_script(f"localStorage.setItem('mode', '{mode}'); localStorage.setItem('theme', '{mode}')")
    yield context
    context.close()


def axe_script() -> str:
    """The text of axe-core (Mozilla Public License 2.0), as the package axe-playwright-python ships it."""
    import axe_playwright_python

    return (Path(axe_playwright_python.__file__).parent / "axe.min.js").read_text(encoding="utf-8")


def watch(page: Page, base: str, visit: Visit) -> None:
    """Write down what a page asks for; what lies outside the book is refused."""
    host = urlsplit(base).netloc

    def check(route: Route) -> None:
        parts = urlsplit(route.request.url)
        if parts.netloc == host or parts.scheme in ("data", "blob", "about"):
            route.continue_()
        else:
            visit.outside.append(route.request.url)
            route.abort()

    page.route("**/*", check)
    page.on("response", lambda r: visit.failed.append(f"{r.status} {r.url}") if r.status >= 400 else None)
    page.on("pageerror", lambda error: visit.failed.append(str(error)))
    page.on("console", lambda message: visit.failed.append(message.text) if message.type == "error" else None)


def inspect(context: BrowserContext, base: str, path: str, mode: str, axe: str) -> Visit:
    """Open a page and let axe-core look at it."""
    visit = Visit(path, mode)
    page = context.new_page()
    watch(page, base, visit)
    page.goto(base + path)
    assert not mode or page.evaluate("document.documentElement.dataset.theme") == mode
    page.evaluate(axe)
    found = page.evaluate("axe.run(document, {iframes: false, preload: false, resultTypes: ['violations']})")
    visit.violations = [
        (rule["impact"], rule["id"], " ".join(map(str, node["target"])), node["failureSummary"])
        for rule in found["violations"]
        for node in rule["nodes"]
    ]
    visit.too_wide = page.evaluate("document.documentElement.scrollWidth - window.innerWidth")
    page.close()
    return visit


def is_animated(replay: str) -> bool:
    """Whether the text of a replay's page holds an animation, and not only a scene."""
    match = _SCENE.search(replay)
    assert match, "not a replay"
    return any(b"set_animation" in base64.b64decode(message) for message in json.loads(match[1]))


def drawn(page: Page, frame: Any) -> list[bytes]:
    """Two pictures of a frame, but for its top with caption and controls, half a second apart."""
    box = frame.bounding_box()
    top = box["height"] / 6
    scene = box | {"y": box["y"] + top, "height": box["height"] - top}
    pictures = [page.screenshot(clip=scene)]
    page.wait_for_timeout(500)
    return [*pictures, page.screenshot(clip=scene)]
