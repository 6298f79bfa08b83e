"""Reference profiles: stored numbers must be what the kit computes, and a changed profile must change a grade."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from robotbrain.cli import main
from robotbrain.errors import InputError
from robotbrain.grading import load_hidden_suite
from robotbrain.jetson.catalogue import list_modules, load_module
from robotbrain.jetson.profiles import load_profile
from robotbrain.jetson.reference import (
    NETWORKS,
    PRECISIONS,
    drifted,
    load_reference,
    make_reference,
    read_reference,
    to_toml,
)


@pytest.fixture
def copy(repo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a copy of the profiles that the kit reads instead of its own."""
    copied = shutil.copytree(repo / "autograder" / "profiles", tmp_path / "profiles")
    monkeypatch.setenv("ROBOTBRAIN_PROFILES", str(copied))
    return copied


@pytest.mark.parametrize("slug", list_modules())
def test_nothing_stored_is_out_of_date(slug: str) -> None:
    assert drifted(slug) == []


@pytest.mark.parametrize("slug", ["nano-4gb", "agx-orin-64gb"])
def test_every_network_mode_and_precision_has_its_figures(slug: str) -> None:
    reference, module = load_reference(slug), load_module(slug)
    wanted = {(n, m, p) for n in NETWORKS for m in module.modes for p in PRECISIONS}
    assert {(i.network, i.mode, i.precision) for i in reference.networks} == wanted
    for item in reference.networks:
        assert 0 < item.latency_low_ms <= item.latency_ms <= item.latency_high_ms
        assert item.energy_mj == pytest.approx(item.power_w * item.latency_ms, rel=1e-3)
    for mode in module.modes:
        profile = load_profile(slug, mode)
        assert reference.network("segmentation", mode).latency_ms == pytest.approx(profile.segmentation_ms, rel=1e-4)
        assert reference.callback_ms("mapper", mode) == pytest.approx(profile.callback_ms["mapper"], rel=1e-4)


def test_what_is_written_reads_back(tmp_path: Path) -> None:
    made = make_reference("xavier-nx")
    path = tmp_path / "xavier-nx.toml"
    path.write_text(to_toml(made), encoding="utf-8")
    assert read_reference(path) == made


def test_tolerance_is_relative_and_nan_never_agrees() -> None:
    reference = load_reference("nano-4gb")
    assert reference.agrees(100 * (1 + 0.99 * reference.tolerance), 100)
    assert not reference.agrees(100 * (1 + 1.01 * reference.tolerance), 100)
    assert not reference.agrees(float("nan"), 100)


def test_what_is_not_there_is_named() -> None:
    reference = load_reference("nano-4gb")
    with pytest.raises(InputError, match="segmentation"):
        reference.network("classifier")
    with pytest.raises(InputError, match="mapper"):
        reference.callback_ms("maper")
    with pytest.raises(InputError, match="nano-4gb"):
        load_reference("nano")


@pytest.mark.parametrize(
    ("pattern", "replacement", "named"),
    [
        (r"^slug = .*$", 'slug = "tx2"', "slug"),
        (r"^tolerance = .*$", "tolerance = nan", "tolerance"),
        (r"^latency_ms = .*$", 'latency_ms = "fast"', "latency_ms"),
        (r"^power_w = .*$", "power = 3", "power"),
        (r'^provenance = "predicted"$', 'provenance = "guessed"', "provenance"),
        (r"^perception_ms = .*$", "perception_ms = -1", "perception_ms"),
    ],
)
def test_damage_is_named_by_file_and_key(copy: Path, pattern: str, replacement: str, named: str) -> None:
    path = copy / "reference" / "nano-4gb.toml"
    text, count = re.subn(pattern, replacement, path.read_text(encoding="utf-8"), count=1, flags=re.MULTILINE)
    assert count == 1
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=rf"nano-4gb\.toml.*{named}"):
        load_reference("nano-4gb")


def _slower_cpu(copy: Path, slug: str, times: float) -> None:
    path = copy / "modules" / f"{slug}.toml"
    text = path.read_text(encoding="utf-8")
    found = re.search(r"single_thread = \{ value = (\d+)", text)
    assert found is not None
    slow = text.replace(found.group(0), f"single_thread = {{ value = {float(found.group(1)) / times:.1f}")
    path.write_text(slow, encoding="utf-8")


def test_a_changed_module_is_drift_until_the_references_are_written_again(
    copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _slower_cpu(copy, "nano-4gb", 2.0)
    remarks = drifted("nano-4gb")
    assert any("perception_ms" in remark for remark in remarks)
    assert not any("segmentation" in remark for remark in remarks)  # the GPU is as it was
    assert main(["jetson", "reference"]) == 0
    assert drifted("nano-4gb") == []
    assert str(copy) in capsys.readouterr().out


def _earned(repo: Path, exercise: str, test: str, **answers: object) -> bool:
    """Return whether one hidden test of the lab is passed by these answers."""
    from robotbrain.grading.expect import CheckFailure
    from robotbrain.grading.student import Student
    from robotbrain.grading.suites import lab_integration_tools as tools

    tools.reference_profile.cache_clear()  # a grader starts anew where the profiles change
    suite = load_hidden_suite("lab_integration", repo / "autograder")
    chosen = next(t for t in suite.tests if (t.exercise, t.name) == (exercise, test))
    try:
        chosen.function(Student(dict(answers), "lab_integration", frozenset()))
    except CheckFailure:
        return False
    return True


def test_changing_a_reference_changes_what_counts_as_right(repo: Path, copy: Path) -> None:
    def memorised(profile: object, rate_hz: float) -> float:
        """Right for today's references only: an answer looked up instead of computed."""
        return answers[rate_hz]

    answers = {}
    for slug, mode, rate_hz in (("nano-4gb", "5W", 30.0), ("xavier-nx", "15W", 60.0), ("agx-orin-64gb", "MAXN", 90.0)):
        reference = load_reference(slug)
        busy = reference.network("segmentation", mode).latency_ms + reference.callback_ms("perception", mode)
        answers[rate_hz] = 1000 / rate_hz - busy
    test = ("deadline", "the reference profiles of real modules")
    assert _earned(repo, *test, deadline_slack_ms=memorised)
    _slower_cpu(copy, "nano-4gb", 2.0)
    assert main(["jetson", "reference"]) == 0
    assert not _earned(repo, *test, deadline_slack_ms=memorised)
