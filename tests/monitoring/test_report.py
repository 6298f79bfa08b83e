"""The report stands alone, says what the figures say, and can be read by everybody."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from robotbrain.errors import InputError
from robotbrain.figures import alt_text
from robotbrain.monitoring import plots
from robotbrain.monitoring.metrics import measure
from robotbrain.monitoring.report import report_html, write_report
from tests.monitoring.sample_runs import trace_of, watched_run


class Page(HTMLParser):
    """Collects what the tests ask about."""

    VOID = frozenset(("meta", "img", "br", "hr", "link", "input"))

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.alts: list[str] = []
        self.ids: set[str] = set()
        self.links: list[str] = []
        self.fetched: list[str] = []
        self.headings: list[str] = []
        self.rows = 0
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        if tag not in self.VOID:
            self.open.append(tag)
        if tag == "img":
            self.alts.append(found.get("alt") or "")
        if found.get("id"):
            self.ids.add(str(found["id"]))
        if tag == "a":
            self.links.append(str(found.get("href")))
        self.fetched += [str(found[name]) for name in ("src", "srcset", "data") if found.get(name)]
        if tag in ("script", "link", "iframe"):
            self.fetched.append(tag)
        self.rows += tag == "tr"

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open[-1] == tag, (tag, self.open)
        self.open.pop()

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "h2":
            self.headings.append(data)


@pytest.fixture(params=[False, True], ids=["quick", "overloaded"])
def text(request: pytest.FixtureRequest) -> str:
    return _report(request.param)


_cache: dict[bool, str] = {}


def _report(overloaded: bool) -> str:
    if overloaded not in _cache:
        _cache[overloaded] = report_html(trace_of(overloaded))
    return _cache[overloaded]


def test_the_page_needs_nothing_else_and_is_well_formed(text: str) -> None:
    page = Page(text)
    assert page.open == []
    assert all(source.startswith("data:image/") for source in page.fetched)
    assert "url(" not in text and "@import" not in text
    assert all(link.startswith("#") and link[1:] in page.ids for link in page.links)
    assert "nan" not in re.sub(r"<img[^>]*>|nano", "", text).lower().split()


def test_every_figure_has_words(text: str) -> None:
    page = Page(text)
    assert len(page.alts) == 6 and all(len(alt) > 40 for alt in page.alts)


def test_the_sections_are_there(text: str) -> None:
    headings = Page(text).headings
    for wanted in ("What happened when", "Sensor to command", "How long callbacks take", "Rates and jitter", "Queues"):
        assert wanted in headings


def test_the_figures_at_a_glance_are_those_of_the_summary() -> None:
    summary, text = measure(trace_of(True)), _report(True)
    values = re.findall(r'class="value">([^<]+)<', text)
    assert values[0] == f"{summary.end_to_end.p50:.0f} ms" and values[1] == f"{summary.end_to_end.p99:.0f} ms"
    assert f"{summary.misses:,}" in values
    assert f"{sum(q.dropped for q in summary.queues):,}" in values
    assert text.count("class=bad") == 2 and _report(False).count("class=bad") == 0


def test_names_from_outside_cannot_break_the_page() -> None:
    from dataclasses import replace

    evil = "<script>alert(1)</script>"
    trace = trace_of(False)
    odd = replace(trace, title=evil, callbacks=tuple(replace(c, name=evil) for c in trace.callbacks[:300]))
    text = report_html(odd)
    assert "<script" not in text and "&lt;script&gt;" in text


def test_a_monitors_summary_has_a_report_too(tmp_path: Path) -> None:
    monitor = watched_run(True)[1]
    path = write_report(monitor.summary(), tmp_path / "report.html", snapshots=list(monitor.snapshots), title="A & B")
    text = path.read_text()
    page = Page(text)
    assert "Over time" in page.headings and "Alarms and notes" in page.headings and "<title>A &amp; B</title>" in text
    assert len(page.alts) == 3


def test_a_window_can_be_chosen_within_the_run(tmp_path: Path) -> None:
    assert "from 1.000 s on" in report_html(trace_of(False), window_s=(1.0, 1.2))
    with pytest.raises(InputError, match="window_s"):
        report_html(trace_of(False), window_s=(5.0, 99.0))
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="written to"):
        write_report(measure(trace_of(False)), tmp_path / "file" / "report.html")


# ---- figures ----


def test_the_usual_window_holds_the_worst_command() -> None:
    run = watched_run(True)[0]
    trace = trace_of(True)
    begin, end = plots.worst_window(trace, longest_s=2.0)
    assert trace.start_ns <= begin < end <= trace.end_ns
    assert (end - begin) * 1e-6 >= run.e2e_ms.max()
    assert plots.worst_window(trace, longest_s=0.1)[1] - plots.worst_window(trace, longest_s=0.1)[0] == 100_000_000


@pytest.mark.parametrize("overloaded", [False, True])
@pytest.mark.parametrize("bin_s", [0.05, 0.37])
def test_use_in_bins_adds_up_to_use_in_all(overloaded: bool, bin_s: float) -> None:
    trace = trace_of(overloaded)
    times, shares = plots.busy_over_time(trace, bin_s)
    edges = np.minimum(np.arange(len(times) + 1) * bin_s, trace.seconds)
    for name, total in measure(trace).utilisation.items():
        assert np.all(shares[name] >= -1e-9) and np.all(shares[name] <= 1 + 1e-9)
        assert shares[name] @ np.diff(edges) / trace.seconds == pytest.approx(total, rel=1e-6)


@pytest.mark.parametrize("overloaded", [False, True])
def test_figures_say_what_they_show(overloaded: bool) -> None:
    trace = trace_of(overloaded)
    summary = measure(trace)
    drawn = [plots.plot_timeline(trace), plots.plot_end_to_end(trace), plots.plot_latencies(summary),
             plots.plot_rhythm(summary), plots.plot_queues(trace), plots.plot_resources(trace)]  # fmt: skip
    assert len({alt_text(figure) for figure in drawn}) == 6
    assert "/controller" in str([t.get_text() for t in drawn[0].axes[0].get_yticklabels()])
    labels = [t.get_text() for t in drawn[2].axes[0].get_yticklabels()]
    slowest = max(summary.callbacks, key=lambda c: c.response.p99)
    assert labels[-1] == slowest.label


def test_nodes_have_colours_that_the_colour_blind_can_tell_apart() -> None:
    colours = plots.node_colours(trace_of(False))
    inside = [colour for colour in colours.values() if colour != plots.GREY]
    assert len(set(inside)) == len(inside) == 6 and colours["/robot"] == plots.GREY
    assert set(inside) <= set(plots.PALETTE) and next(iter(colours)) == "/robot"
