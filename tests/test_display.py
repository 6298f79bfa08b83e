"""Races, figures and tables in a notebook: readable by everybody, and safe with any text."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import pytest

from robotbrain.display import show, table
from robotbrain.errors import InputError
from robotbrain.figures import new_figure
from robotbrain.jetson.race import Race
from robotbrain.jetson.twin import Prediction, predict
from robotbrain.jetson.twin.data import load_kernel_lists


@pytest.fixture(scope="module")
def predictions() -> list[Prediction]:
    network = load_kernel_lists()["resnet18"]
    return [predict(network, slug, mode="MAXN") for slug in ("nano-4gb", "orin-nano-8gb", "agx-orin-64gb")]


def test_a_race_is_as_fast_as_the_predictions(predictions: list[Prediction]) -> None:
    page = Race(predictions, slow_motion=100)._repr_html_()
    durations = [float(s) for s in re.findall(r"animation-duration:([\d.]+)s", page)]
    assert durations == pytest.approx([p.latency_ms / 10 for p in predictions], abs=6e-4)
    bars = [float(w) for w in re.findall(r'width="([\d.]+)" height="6" fill="#(?!e6e6e6)', page)]
    assert max(bars) == bars[-1] == 420  # the fastest fills its track
    assert bars[0] / bars[-1] == pytest.approx(predictions[-1].latency_ms / predictions[0].latency_ms, abs=1e-3)


def test_a_race_can_be_read_paused_and_repeated(predictions: list[Prediction]) -> None:
    race = Race(predictions)
    page = race._repr_html_()
    root = ElementTree.fromstring(page)
    svg = next(node for node in root.iter() if node.tag == "svg")
    assert svg.get("role") == "img" and svg.get("aria-label") == race.describe()
    box, label = root.find("input"), root.find("label")
    assert box is not None and label is not None and box.get("id") == label.get("for")
    assert "prefers-reduced-motion" in page and "paused" in page and "<script" not in page
    assert page == Race(list(predictions))._repr_html_()


def test_a_race_escapes_what_it_is_given(predictions: list[Prediction]) -> None:
    odd = replace(predictions[0], model='<b>"x"</b>', mode="<i>")
    page = Race([odd])._repr_html_()
    assert "<b>" not in page and "<i>" not in page


@pytest.mark.parametrize("slow_motion", [0, -1, float("nan"), float("inf")])
def test_a_race_refuses_what_it_cannot_show(predictions: list[Prediction], slow_motion: float) -> None:
    with pytest.raises(InputError, match="slow_motion"):
        Race(predictions, slow_motion)
    with pytest.raises(InputError, match="race"):
        Race([])


def test_a_table_names_its_rows_and_escapes_its_cells() -> None:
    made = table("A & B", ["name", "x (<s>)"], [["a<b", 1], ["c", 2.5]])
    root = ElementTree.fromstring(made._repr_html_())
    assert root.findtext("caption") == "A & B"
    assert [th.text for th in root.iter("th") if th.get("scope") == "col"] == ["name", "x (<s>)"]
    assert [th.text for th in root.iter("th") if th.get("scope") == "row"] == ["a<b", "c"]
    assert [td.text for td in root.iter("td")] == ["1", "2.5"]
    assert "<table" not in repr(made) and "A & B" in repr(made) and "2.5" in repr(made)


def test_a_table_refuses_ragged_rows() -> None:
    with pytest.raises(InputError, match="table"):
        table("t", ["a", "b"], [[1, 2], [3]])


def test_a_figure_needs_alt_text_and_gets_it() -> None:
    figure = new_figure(2, 1)
    with pytest.raises(InputError, match="alt text"):
        show(figure)
    figure.set_label('says "hello"')
    assert 'alt="says &quot;hello&quot;"' in show(figure)._repr_html_()
    assert repr(show(figure)) == 'says "hello"'
