"""Measured profiles: what is written is read back, what is wrong is named, the newest match wins."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robotbrain.errors import InputError
from robotbrain.jetson import measured
from robotbrain.jetson.measure import tomlio
from robotbrain.jetson.measured import MeasuredProfile, Power, Timing

SHA = "ab" * 32


def a_profile(**changes: Any) -> MeasuredProfile:
    made = MeasuredProfile(
        module="orin-nano-8gb",
        mode="15W",
        model="segmentation",
        sha256=SHA,
        precision="fp16",
        latency=Timing(median=2.0, mean=2.1, min=1.9, max=3.0, p90=2.2, p99=2.9),
        source="trtexec on a desk",
        date=datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC),
        shapes={"image": (1, 3, 64, 64)},
    )
    return replace(made, **changes)


# Letters of every script, control characters and quotes: whatever a path or a name can hold (but no lone surrogates).
texts = st.text(st.characters(exclude_categories=["Cs"]), min_size=1).filter(lambda text: text.strip() != "")
positive = st.floats(1e-3, 1e5, allow_nan=False)
maybe = st.none() | positive


@st.composite
def timings(draw: st.DrawFn) -> Timing:
    ordered = sorted(draw(st.lists(positive, min_size=6, max_size=6)))
    tail = [draw(st.sampled_from([None, value])) for value in ordered[2:5]]
    mean = min(max(draw(positive), ordered[0]), ordered[5])
    return Timing(ordered[1], mean, ordered[0], ordered[5], *tail)


profiles = st.builds(
    MeasuredProfile,
    module=st.sampled_from(["nano-4gb", "t5000"]),
    mode=texts,
    model=texts,
    sha256=st.text("0123456789abcdef", min_size=64, max_size=64),
    precision=st.sampled_from(["fp32", "fp16", "int8"]),
    latency=timings(),
    source=texts,
    date=st.datetimes(datetime(1990, 1, 1), datetime(2100, 1, 1), timezones=st.just(UTC)),
    harness=st.sampled_from(measured.HARNESSES),
    batch=st.integers(1, 4096),
    cuda_graph=st.booleans(),
    shapes=st.dictionaries(
        st.text(st.characters(exclude_categories=["Cs"])), st.lists(st.integers(0, 9999)).map(tuple)
    ),
    host_latency=st.none() | timings(),
    throughput_qps=maybe,
    memory_mb=maybe,
    system_memory_mb=maybe,
    power=st.none() | st.builds(lambda w, rails: Power(w, 2 * w, 7, tuple(rails), "jtop"), positive, st.lists(texts)),
    temperature_mean_c=st.none() | st.floats(-40, 120),
    clocks_pinned=st.none() | st.booleans(),
    gpu_mhz=maybe,
    jetpack=st.none() | texts,
    command=st.none() | st.text(st.characters(exclude_categories=["Cs"])),
    notes=st.lists(st.text(st.characters(exclude_categories=["Cs"]))).map(tuple),
)


@settings(max_examples=80, deadline=None)
@given(profiles)
def test_what_is_written_is_read_back(tmp_path_factory: pytest.TempPathFactory, profile: MeasuredProfile) -> None:
    path = profile.write(tmp_path_factory.mktemp("measured"))
    assert measured.load(path) == profile
    assert path.parent.name == profile.module
    # A name that every file system takes, whatever the model is called.
    assert set(path.name) <= set("abcdefghijklmnopqrstuvwxyz0123456789._-") and not path.name.startswith(".")


@settings(max_examples=300, deadline=None)
@given(
    st.dictionaries(
        st.text(st.characters(exclude_categories=["Cs"])), st.text(st.characters(exclude_categories=["Cs"]))
    )
)
def test_any_text_survives_toml(texts: dict[str, str]) -> None:
    assert tomllib.loads("\n".join(tomlio.pairs(texts))) == texts


def test_a_lone_surrogate_does_not_break_the_file() -> None:
    assert tomllib.loads("\n".join(tomlio.pairs({"name": "a\ud800b"}))) == {"name": "a?b"}


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_a_spoilt_file_is_refused_by_name(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    text = a_profile(power=Power(7.0, 9.0, 5, ("VDD_IN",), "tegrastats")).to_toml()
    start = data.draw(st.integers(0, len(text)))
    end = data.draw(st.integers(start, min(len(text), start + 40)))
    path = tmp_path_factory.mktemp("spoilt") / "spoilt.toml"
    path.write_text(text[:start] + data.draw(st.text('0123456789.-[]="x\n', max_size=5)) + text[end:], encoding="utf-8")
    try:
        measured.load(path)
    except InputError as error:
        assert "spoilt.toml" in str(error)


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("median = 2.0", "median = -2.0", "[latency_ms] median"),
        ("median = 2.0", "median = nan", "[latency_ms] median"),
        ("median = 2.0", "median = 3.5", "[latency_ms]"),
        ("median = 2.0\n", "", "[latency_ms] median"),
        ("p90 = 2.2", "p90 = 2.95", "[latency_ms]"),
        ("batch = 1", "batch = true", "[model] batch"),
        ("batch = 1", "batch = 0", "batch"),
        ('precision = "fp16"', 'precision = "FP16"', "precision"),
        (f'sha256 = "{SHA}"', 'sha256 = "ab"', "sha256"),
        ('provenance = "measured"', 'provenance = "predicted"', "provenance"),
        ("format = 1", "format = 2", "format"),
        ("date = 2026-01-02T03:04:05Z", "date = 2026-01-02", "date"),
        ("date = 2026-01-02T03:04:05Z", "date = 2026-01-02T03:04:05", "date"),
        ("image = [1, 3, 64, 64]", "image = [1, 3.5]", "[model.shapes]"),
        ("[power_w]\nmean = 7.0", "[power_w]\nmean = 70.0", "[power_w]"),
        ("[power_w]\nmean = 7.0\n", "[power_w]\n", "[power_w]"),
    ],
)
def test_a_wrong_value_is_named(tmp_path: Path, old: str, new: str, key: str) -> None:
    text = a_profile(power=Power(7.0, 9.0, 5, ("VDD_IN",), "tegrastats")).to_toml()
    assert text.count(old) == 1
    path = tmp_path / "wrong.toml"
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(InputError) as caught:
        measured.load(path)
    assert "wrong.toml" in str(caught.value) and key in str(caught.value)


def test_missing_power_stays_missing(tmp_path: Path) -> None:
    path = a_profile().write(tmp_path)
    assert "power" not in path.read_text(encoding="utf-8").replace("power_mode", "")
    loaded = measured.load(path)
    assert loaded.power is None and loaded.energy_mj is None and loaded.memory_mb is None


def test_energy_counts_the_pauses_between_queries() -> None:
    power = Power(10.0, 12.0, 5, ("VDD_IN",), "tegrastats")
    # 10 W at 400 queries a second is 25 mJ each, though each keeps the GPU busy for 2.1 of the 2.5 ms only.
    assert a_profile(power=power, throughput_qps=400.0).energy_mj == pytest.approx(25.0)
    assert a_profile(power=power).energy_mj == pytest.approx(21.0)


def test_dates_are_kept_in_utc() -> None:
    local = datetime(2026, 1, 2, 5, 4, 5, 999, tzinfo=timezone(timedelta(hours=2)))
    profile = a_profile(date=local)
    assert profile.date == datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)
    assert "date = 2026-01-02T03:04:05Z\n" in profile.to_toml()


def found(tmp_path: Path, **changes: Any) -> MeasuredProfile | None:
    key = {"sha256": SHA, "slug": "orin-nano-8gb", "mode": "15W", "precision": "fp16", **changes}
    return measured.find(**key, among=[tmp_path])


def test_find_matches_everything(tmp_path: Path) -> None:
    profile = a_profile()
    profile.write(tmp_path)
    assert found(tmp_path) == profile
    for wrong in (
        {"sha256": "cd" * 32},
        {"sha256": ""},
        {"slug": "orin-nano-4gb"},
        {"mode": "7W"},
        {"precision": "int8"},
        {"harness": "mlperf"},
        {"batch": 2},
        {"cuda_graph": True},
    ):
        assert found(tmp_path, **wrong) is None, wrong


def test_find_knows_the_mode_by_its_other_names(tmp_path: Path) -> None:
    a_profile().write(tmp_path)
    for mode in ("15w", "MODE_15W"):
        assert found(tmp_path, mode=mode) is not None, mode


def test_a_mode_of_the_owners_own_can_be_found(tmp_path: Path) -> None:
    a_profile(mode="QUIET_NIGHT").write(tmp_path)
    assert found(tmp_path, mode="quiet_night") is not None
    assert found(tmp_path) is None


def test_the_newest_match_wins_wherever_it_lies(tmp_path: Path) -> None:
    first, second = tmp_path / "a", tmp_path / "b"
    new = a_profile(date=datetime(2027, 1, 1, tzinfo=UTC), source="later")
    new.write(first)
    a_profile().write(second)
    for among in ([first, second], [second, first]):
        got = measured.find(SHA, "orin-nano-8gb", "15W", "fp16", among=among)
        assert got == new


def test_two_networks_of_one_name_do_not_overwrite_each_other(tmp_path: Path) -> None:
    one, other = a_profile(), a_profile(sha256="cd" * 32)
    paths = {one.write(tmp_path), other.write(tmp_path), one.write(tmp_path)}
    assert len(paths) == 2
    assert found(tmp_path) == one and found(tmp_path, sha256="cd" * 32) == other


def test_measuring_again_replaces(tmp_path: Path) -> None:
    a_profile().write(tmp_path)
    a_profile(source="again").write(tmp_path)
    assert len(list(tmp_path.rglob("*.toml"))) == 1
    again = found(tmp_path)
    assert again is not None and again.source == "again"


def test_a_spoilt_file_among_the_measured_is_not_passed_over(tmp_path: Path) -> None:
    path = a_profile().write(tmp_path)
    path.write_text("format = ", encoding="utf-8")
    with pytest.raises(InputError, match=path.name):
        found(tmp_path)


def test_a_file_in_another_modules_folder_is_named(tmp_path: Path) -> None:
    path = a_profile().write(tmp_path)
    (tmp_path / "nano-4gb").mkdir()
    path.rename(tmp_path / "nano-4gb" / path.name)
    with pytest.raises(InputError, match="nano-4gb"):
        found(tmp_path, slug="nano-4gb")


def test_directories_come_from_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(measured.DIRECTORIES_VARIABLE, raising=False)
    before = measured.directories()
    assert [path.name for path in before] == ["measured"]
    monkeypatch.setenv(measured.DIRECTORIES_VARIABLE, str(tmp_path))
    assert measured.directories() == [*before, tmp_path]


@pytest.mark.parametrize(
    "values",
    [
        {"median": float("inf")},
        {"min": -1.0},
        {"max": 1.0},
        {"p99": 1.0},
        {"mean": 10.0},
        {"p90": 2.9, "p99": 2.2},
    ],
)
def test_times_that_contradict_each_other_are_refused(values: dict[str, float]) -> None:
    with pytest.raises(InputError):
        Timing(**{"median": 2.0, "mean": 2.1, "min": 1.5, "max": 3.0, **values})
