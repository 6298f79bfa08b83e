"""The calibration's report: a valid page that needs nothing else, and says what the run says."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from twin_builders import quick_run

from robotbrain.errors import InputError
from robotbrain.figures import alt_text
from robotbrain.jetson import report
from robotbrain.jetson.report import architecture, report_html, transfer_baseline, write_report
from robotbrain.jetson.report_figures import coverage, plot_groups, plot_power, plot_scatter
from robotbrain.jetson.twin.calibrate import CalibrationRun
from robotbrain.jetson.twin.data import load_kernel_lists, load_latency_rows, load_power_rows
from robotbrain.jetson.twin.validate import covered, group_of, interval_scale

VOID = {"meta", "img", "br", "link", "hr"}


class Page(HTMLParser):
    """Checks that elements are closed in order, and collects what the tests look at."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.tables: dict[str, list[list[str]]] = {}
        self._words = ""
        self._rows: list[list[str]] = []
        self._caption = ""
        self.feed(text)
        self.close()
        assert not self.open, f"not closed: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        assert len(dict(attrs)) == len(attrs), f"an attribute twice in {tag}"
        if tag not in VOID:
            self.open.append(tag)
        if tag in ("caption", "td", "th"):
            self._words = ""
        if tag == "tr":
            self._rows.append([])
        if tag == "table":
            self._rows = []

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open.pop() == tag, f"</{tag}> where <{self.open[-1:]}> is open"
        if tag == "caption":
            self._caption = self._words
        if tag in ("td", "th"):
            self._rows[-1].append(self._words)
        if tag == "table":
            self.tables[self._caption] = self._rows

    def handle_data(self, data: str) -> None:
        self._words += data


@pytest.fixture(scope="module")
def run() -> CalibrationRun:
    return quick_run()


@pytest.fixture(scope="module")
def text(run: CalibrationRun) -> str:
    return report_html(run)


@pytest.fixture(scope="module")
def page(text: str) -> Page:
    return Page(text)


def test_the_page_is_whole(text: str, page: Page) -> None:
    assert text.lower().startswith("<!doctype html>")
    names = [name for name, _ in page.tags]
    assert names.count("h1") == names.count("main") == names.count("title") == 1
    assert dict(page.tags)["html"]["lang"] == "en"
    targets = {attributes["id"] for _, attributes in page.tags if "id" in attributes}
    links = {str(attributes["href"]) for name, attributes in page.tags if name == "a"}
    assert links == {f"#{target}" for target in targets}
    for rows in page.tables.values():
        assert {len(row) for row in rows} == {len(rows[0])}


def test_it_loads_nothing_and_describes_its_figures(page: Page) -> None:
    assert not {"script", "link", "iframe", "object"} & {name for name, _ in page.tags}
    images = [attributes for name, attributes in page.tags if name == "img"]
    assert len(images) == 4
    assert all(str(image["src"]).startswith("data:image/png;base64,") for image in images)
    assert all(len(str(image["alt"])) > 60 for image in images)


def test_every_row_is_accounted_for(page: Page) -> None:
    def counts(start: str) -> tuple[str, Counter[str]]:
        (caption,) = [name for name in page.tables if name.startswith(start)]
        return caption, Counter({row[0]: int(row[1]) for row in page.tables[caption][1:]})

    caption, shown = counts("Published rows of latency that are not used")
    assert shown == Counter(row.note for row in load_latency_rows(uses=("out",)))
    assert caption.endswith(f": {shown.total()}; used: {len(load_latency_rows())}")
    caption, shown = counts("Published rows of wall power that are not used")
    assert shown == Counter(row.note for row in load_power_rows(uses=("out",)))
    assert caption.endswith(f": {shown.total()}; used: {len(load_power_rows())}")
    _, shown = counts("Rows of latency that only check")
    assert shown == Counter(row.note for row in load_latency_rows(uses=("check",)))
    assert len(page.tables["Rows for checking"]) == 1 + shown.total()


def test_errors_by_kind_cover_all_rows(run: CalibrationRun, page: Page) -> None:
    for kind in ("family", "module", "harness", "precision", "architecture", "module, precision and harness"):
        rows = page.tables[f"By {kind}"]
        assert sum(int(row[1]) for row in rows[1:]) == len(run.left_out)
    nano = [abs(item.error) for item in run.left_out if item.row.module == "nano-4gb"]
    (row,) = [row for row in page.tables["By module"] if row[0] == "nano-4gb"]
    assert row[1:3] == [str(len(nano)), f"{100 * np.median(nano):.1f} %"]


def test_targets_are_met_or_not_as_the_run_says(run: CalibrationRun) -> None:
    def verdicts(changed: CalibrationRun) -> dict[str, str]:
        return {re.sub(r" \(.*", "", row[0]): row[-1] for row in Page(report._targets(changed)).tables["Targets"][1:]}

    exact = replace(run, left_out=[replace(i, predicted_ms=1.001 * i.row.latency_ms) for i in run.left_out])
    assert verdicts(exact)["median error, mixed architectures"] == "yes"
    wrong = replace(
        run,
        left_out=[replace(i, predicted_ms=3 * i.row.latency_ms) for i in run.left_out],
        power=[(row, 0.4) for row, _ in run.power],
    )
    found = verdicts(wrong)
    assert found["median error, mixed architectures"] == found["share of them within 20 %"] == "NO"
    assert found["median error of wall power"] == "NO"


def test_limits_that_must_be_said_are_said(text: str) -> None:
    for words in ("Transformers", "trtexec", "Thor", "torch2trt", "assumed"):
        assert words in text


def test_coverage_at_80_percent_is_the_cross_validated_one(run: CalibrationRun) -> None:
    assert coverage(run.left_out, [0.8]) == [pytest.approx(covered(run.left_out))]
    shares = coverage(run.left_out, [0.1, 0.5, 0.9, 0.999999])
    assert shares == sorted(shares)
    # By hand for one group: its intervals are scaled by what the others need.
    group = group_of(run.left_out[0].row)
    inside = [item for item in run.left_out if group_of(item.row) == group]
    scale = interval_scale(item for item in run.left_out if group_of(item.row) != group)
    far = [replace(item, predicted_ms=item.row.latency_ms * np.exp(10 * scale * item.log_sd)) for item in inside]
    others = [item for item in run.left_out if group_of(item.row) != group]
    assert coverage([*others, *far], [0.8])[0] <= len(others) / (len(others) + len(far))


def test_baseline_of_a_module_left_out_knows_only_other_modules(run: CalibrationRun) -> None:
    rows = [item.row for item in run.left_out]
    items = run.transfer["orin-nx-16gb"]
    before = transfer_baseline(items, rows)
    assert before > 0
    faster = [replace(row, latency_ms=row.latency_ms / 7) if row.module == "orin-nx-16gb" else row for row in rows]
    assert transfer_baseline(items, faster) == before
    assert np.isnan(transfer_baseline(items, [row for row in rows if row.module == "orin-nx-16gb"]))


def test_architecture_is_the_part_before_the_size() -> None:
    found = {architecture(name) for name in load_kernel_lists()}
    assert {"resnet", "yolo11", "yolov8", "inception_resnet", "vgg", "efficientvit"} <= found
    assert not any(re.search(r"_\d|_bn|x\d", name) for name in found)


def test_scatter_and_groups_show_every_row(run: CalibrationRun) -> None:
    axes = plot_scatter(run.left_out).axes[0]
    points = [
        tuple(xy) for c in axes.collections for xy in np.asarray(c.get_offsets()) if c.get_label() != "within 20 %"
    ]
    assert sorted(points) == sorted((i.row.latency_ms, i.predicted_ms) for i in run.left_out)
    groups = {group_of(item.row) for item in run.left_out}
    assert len(plot_groups(run.left_out).axes[0].get_yticks()) == len(groups)
    assert str(len(run.power)) in alt_text(plot_power(run.power))


def test_a_place_that_cannot_be_written_to_is_refused(
    run: CalibrationRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(report, "report_html", lambda _: "page")
    assert write_report(run, tmp_path / "report.html").read_text() == "page"
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="written to"):
        write_report(run, tmp_path / "file" / "report.html")
