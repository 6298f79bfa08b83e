"""The finished book in figures: pages, links, what axe-core finds, and how soon each page can be used.

Run with ``python benchmarks/book.py`` after ``make book`` (``--book FOLDER`` for another one, ``--repeats N``). Each
page is opened from loopback in a browser that never saw it. It can be used (is *interactive*) when its document is
ready and the main thread has had no task longer than 50 ms for half a second; the time is that of the last such task's
end, or of the document, whichever is later. Frames with replays load when they come into view and count if they do.
"""

from __future__ import annotations

import argparse
import shutil
import statistics
import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY))

from tests.book_browser import DESKTOP, PHONE, axe_script, browser, inspect, reader  # noqa: E402
from tests.book_site import Book, serve  # noqa: E402

if TYPE_CHECKING:
    from playwright.sync_api import Browser

BAR_S = 3.0
_WATCH = """window.tasks = [];
new PerformanceObserver(list => tasks.push(...list.getEntries().map(e => e.startTime + e.duration)))
  .observe({type: 'longtask', buffered: true});"""
_QUIET = """() => { const n = performance.getEntriesByType('navigation')[0];
  return n.loadEventEnd > 0 && performance.now() - Math.max(n.loadEventEnd, ...tasks) > 500; }"""
_TIMES = """() => { const n = performance.getEntriesByType('navigation')[0];
  return [n.domInteractive, n.loadEventEnd, Math.max(n.domContentLoadedEventEnd, ...tasks)]; }"""


def times(opened: Browser, address: str) -> tuple[float, float, float]:
    """Open a page for the first time; return when its text was there, all of it, and when it could be used, in s."""
    with reader(opened, "light") as context:
        page = context.new_page()
        page.add_init_script(_WATCH)
        page.goto(address, wait_until="load")
        page.wait_for_function(_QUIET, timeout=60_000)
        text, loaded, usable = page.evaluate(_TIMES)
        return text / 1000, loaded / 1000, usable / 1000


def impacts(opened: Browser, base: str, paths: list[str]) -> Counter[str]:
    """Count what axe-core finds on all pages, light and dark and on a telephone, by impact."""
    axe, found = axe_script(), Counter[str]()
    for mode, size in (("light", DESKTOP), ("dark", DESKTOP), ("light", PHONE)):
        with reader(opened, mode, size) as context:
            for path in paths:
                found.update(impact for impact, *_ in inspect(context, base, path, mode, axe).violations)
    return found


def main() -> int:
    """Print the table; returns 1 if a page takes longer than the bar, or a link is broken."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--book", type=Path, default=REPOSITORY / "book" / "_build" / "html")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--no-axe", action="store_true", help="times only")
    options = parser.parse_args()
    book = Book(options.book.resolve())
    paths = [page.path for page in book.pages]
    count, broken = book.broken_links()
    print(f"{len(paths)} pages, {len(book.replays)} replays, {len(book.downloads())} notebooks to download")
    print(f"{count} links within the book, {len(broken)} broken; {len(book.external())} addresses elsewhere")
    worst = 0.0
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if chromium is None:
        sys.exit("no Chromium on PATH")
    with browser(chromium) as opened, serve(book.folder) as base:
        if not options.no_axe:
            found = impacts(opened, base, paths)
            print("axe-core, violations by impact:", dict(found) or "none")
        print(
            f"\nmedian of {options.repeats} first visits, s\n{'page':58} {'text':>6} {'loaded':>7} {'interactive':>12}"
        )
        for path in paths:
            runs = [times(opened, base + path) for _ in range(options.repeats)]
            text, loaded, usable = (statistics.median(column) for column in zip(*runs, strict=True))
            worst = max(worst, usable)
            print(f"{path:58} {text:6.2f} {loaded:7.2f} {usable:12.2f}", flush=True)
    print(f"\nslowest page: {worst:.2f} s to interactive (bar: {BAR_S:g} s)")
    return int(worst > BAR_S or bool(broken))


if __name__ == "__main__":
    sys.exit(main())
