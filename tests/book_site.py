"""A built book as files: its pages, what they link to, and what is wrong with them without opening a browser."""

from __future__ import annotations

import contextlib
import functools
import http.server
import re
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

ADDRESSES = {"href", "src", "data", "poster", "action"}
HTTP_ONLY = {"incompleteideas.net"}
"""Hosts that offer no https."""
REPLAYS = "_replays"


@dataclass
class Page:
    """What a page holds.

    Attributes:
        path: from the book's root, with slashes.
        ids: what links can point at.
        links: (tag, address) of all it refers to.
        language: of ``<html lang>``.
        title: in the browser's tab.
        headings: levels, in their order.
        images: (address, alternative text or None).
        frames: (address, title or None).
    """

    path: str
    ids: set[str] = field(default_factory=set)
    repeated: list[str] = field(default_factory=list)
    links: list[tuple[str, str]] = field(default_factory=list)
    language: str = ""
    title: str = ""
    headings: list[int] = field(default_factory=list)
    images: list[tuple[str, str | None]] = field(default_factory=list)
    frames: list[tuple[str, str | None]] = field(default_factory=list)


class _Reader(HTMLParser):
    def __init__(self, page: Page) -> None:
        super().__init__()
        self.page, self._in_title, self._drawing = page, False, 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        page, values = self.page, dict(attrs)
        if name := values.get("id"):
            (page.repeated.append if name in page.ids else page.ids.add)(name)
        page.links += [(tag, value) for key, value in attrs if key in ADDRESSES and value]
        if tag == "html":
            page.language = values.get("lang") or ""
        elif tag == "title" and not self._drawing:
            self._in_title = True
        elif tag == "svg":
            self._drawing += 1
        elif re.fullmatch("h[1-6]", tag):
            page.headings.append(int(tag[1]))
        elif tag == "img":
            page.images.append((values.get("src") or "", values.get("alt")))
        elif tag == "iframe":
            page.frames.append((values.get("src") or "", values.get("title")))

    def handle_endtag(self, tag: str) -> None:
        self._in_title &= tag != "title"
        self._drawing -= tag == "svg"

    def handle_data(self, data: str) -> None:
        if self._in_title:
            self.page.title += data


def read_page(path: str, text: str) -> Page:
    """Return what the HTML of a page holds."""
    page = Page(path)
    reader = _Reader(page)
    reader.feed(text)
    reader.close()
    return page


class Book:
    """A built book.

    Args:
        folder: of its pages (``book/_build/html``).
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @functools.cached_property
    def pages(self) -> list[Page]:
        """All pages that a reader can open, replays not counted."""
        return self._read(lambda path: not path.startswith("_"))

    @functools.cached_property
    def replays(self) -> list[Page]:
        """The pages in the frames."""
        return self._read(lambda path: path.startswith(REPLAYS))

    @property
    def executed(self) -> bool:
        """Whether its notebooks have run."""
        return bool(self.replays)

    def _read(self, wanted: object) -> list[Page]:
        paths = sorted(path.relative_to(self.folder).as_posix() for path in self.folder.rglob("*.html"))
        return [read_page(p, (self.folder / p).read_text(encoding="utf-8")) for p in paths if wanted(p)]  # type: ignore[operator]

    def broken_links(self) -> tuple[int, list[str]]:
        """Follow each link to another file of the book or a place in one; return their number and what is broken."""
        ids = {page.path: page.ids for page in [*self.pages, *self.replays]}
        count, broken = 0, []
        for page in [*self.pages, *self.replays]:
            for _, address in page.links:
                parts = urlsplit(address)
                if parts.scheme or parts.netloc:
                    continue
                count += 1
                base = (self.folder / page.path).parent
                target = (base / unquote(parts.path)).resolve() if parts.path else self.folder / page.path
                if not target.is_file() or not target.is_relative_to(self.folder.resolve()):
                    broken.append(f"{page.path}: {address} (no such file)")
                elif parts.fragment and target.suffix == ".html":
                    name = target.relative_to(self.folder.resolve()).as_posix()
                    if unquote(parts.fragment) not in ids.get(name, set()):
                        broken.append(f"{page.path}: {address} (no such place)")
        return count, broken

    def external(self) -> dict[str, list[str]]:
        """Addresses elsewhere, each with the pages that name it."""
        found: dict[str, list[str]] = {}
        for page in self.pages:
            for _, address in page.links:
                if urlsplit(address).scheme not in ("", "data", "javascript"):
                    found.setdefault(address, []).append(page.path)
        return found

    def downloads(self) -> list[Path]:
        """The notebooks offered to readers."""
        return sorted((self.folder / "_sources").rglob("*.ipynb"))


def malformed(address: str) -> str:
    """Say what is wrong with an address elsewhere; nothing if it is well formed and encrypted."""
    try:
        parts = urlsplit(address)
        host = parts.hostname or ""
    except ValueError as error:
        return str(error)
    if parts.scheme == "http" and host not in HTTP_ONLY:
        return "http"
    if parts.scheme not in ("http", "https"):
        return f"scheme {parts.scheme}"
    if not re.fullmatch(r"([a-z0-9-]+\.)+[a-z]{2,}", host) or re.search(r"[\s<>\"]", address):
        return "not an address"
    return ""


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""


@contextlib.contextmanager
def serve(folder: Path) -> Iterator[str]:
    """Serve a folder on loopback; yield its address."""
    handler = functools.partial(_Quiet, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}/"
        finally:
            server.shutdown()
            thread.join()
