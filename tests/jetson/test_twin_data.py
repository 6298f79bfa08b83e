"""The calibration data: what each row must say, what damaged files lead to, and profiles of one's own."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from robotbrain.errors import InputError
from robotbrain.jetson.catalogue import load_module
from robotbrain.jetson.figures import SOURCE_FORMS
from robotbrain.jetson.paths import find_part
from robotbrain.jetson.twin import predict
from robotbrain.jetson.twin.data import (
    USES,
    LatencyRow,
    PowerRow,
    data_digest,
    fastest_mode,
    load_kernel_lists,
    load_latency_rows,
    load_power_rows,
)

FOLDER = find_part("calibration/latency.csv").parent
PROFILES = FOLDER.parent


@pytest.fixture
def profiles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the profiles that the twin reads instead of the kit's."""
    copy = tmp_path / "profiles"
    shutil.copytree(PROFILES, copy)
    monkeypatch.setenv("ROBOTBRAIN_PROFILES", str(copy))
    return copy


# -- what is there


ROWS: list[LatencyRow | PowerRow] = [*load_latency_rows(uses=USES), *load_power_rows(uses=USES)]


def test_every_row_has_a_source_and_every_row_left_out_a_reason() -> None:
    assert len(ROWS) > 200
    for row in ROWS:
        assert row.source.startswith(SOURCE_FORMS) and len(row.source) > 20
        assert row.use != "out" or len(row.note) > 10, row
        assert row.use in USES


def test_no_row_is_there_twice() -> None:
    # Two rounds of one benchmark may agree to the digit; then their sources differ.
    keys = [(type(r), r.source, r.module, str(r.mode), r.network, r.kernels, r.precision) for r in ROWS]
    assert len(set(keys)) == len(keys)


def test_uses_divide_the_rows() -> None:
    whole = load_latency_rows(uses=USES)
    parts = {use: load_latency_rows(uses=(use,)) for use in USES}
    assert sum(map(len, parts.values())) == len(whole)
    assert load_latency_rows() == parts["fit"]
    assert {row.harness for row in parts["check"]}.isdisjoint({row.harness for row in parts["fit"]})


def test_clocks_of_a_row_override_those_of_its_mode() -> None:
    with (FOLDER / "latency.csv").open(encoding="utf-8", newline="") as file:
        table = list(csv.DictReader(file))
    for cells, row in zip(table, load_latency_rows(uses=USES), strict=True):
        module = load_module(row.module)
        mode = module.mode(cells["mode"]) if cells["mode"] else fastest_mode(module)
        assert row.where.gpu_ghz == pytest.approx(float(cells["gpu_mhz"] or mode.gpu_mhz) / 1e3, rel=2e-3)
        share = float(cells["emc_mhz"] or mode.emc_mhz) / module.emc_max_mhz
        assert row.where.bandwidth == pytest.approx(min(1, share) * module.bandwidth_gbs * 1e9)


def test_the_fastest_mode_is_beaten_by_none() -> None:
    for row in load_latency_rows():
        module = load_module(row.module)
        best = fastest_mode(module)
        assert all(mode.gpu_mhz * mode.sms_on <= best.gpu_mhz * best.sms_on for mode in module.modes.values())


def test_networks_with_a_kernel_list_have_their_operations_from_it() -> None:
    lists = load_kernel_lists()
    for row in load_power_rows(uses=USES):
        if row.kernels:
            assert row.gflop == pytest.approx(2e-9 * lists[row.kernels].macs)


# -- damage


def spoil(path: Path, change: Callable[[list[str], list[list[str]]], None]) -> None:
    with path.open(encoding="utf-8", newline="") as file:
        head, *rows = csv.reader(file)
    change(head, rows)
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([head, *rows])


def cell(column: str, value: str, row: int = 3) -> Callable[[list[str], list[list[str]]], None]:
    def change(head: list[str], rows: list[list[str]]) -> None:
        rows[row][head.index(column)] = value

    return change


LOADERS = {"latency.csv": load_latency_rows, "power.csv": load_power_rows}
BAD_CELLS = [
    ("module", "raspberry-pi"),
    ("module", ""),
    ("gpu_mhz", "fast"),
    ("gpu_mhz", "-5"),
    ("emc_mhz", "nan"),
    ("kernels", "no-such-network"),
    ("precision", "fp8"),
    ("precision", ""),
    ("latency_ms", "inf"),
    ("latency_ms", "1,5"),
    ("use", "maybe"),
    ("use", ""),
    ("source", ""),
    ("source", "somebody said so"),
]
ONLY = {
    "latency.csv": [("latency_ms", "0"), ("latency_ms", ""), ("mode", "MODE_99W"), ("harness", "stopwatch")],
    "power.csv": [("wall_power_w", "0"), ("wall_power_w", ""), ("cpu_mhz", "x"), ("cpu_cores", "-1")],
}


@pytest.mark.parametrize(
    ("file", "column", "value"), [(file, *bad) for file in LOADERS for bad in [*BAD_CELLS, *ONLY[file]]]
)
def test_a_damaged_cell_is_named_by_file_line_and_column(profiles: Path, file: str, column: str, value: str) -> None:
    spoil(profiles / "calibration" / file, cell(column, value))
    with pytest.raises(InputError, match=rf"{file}, line 5: {column}"):
        LOADERS[file]()


@pytest.mark.parametrize("file", LOADERS)
def test_a_row_left_out_without_a_reason_is_refused(profiles: Path, file: str) -> None:
    def change(head: list[str], rows: list[list[str]]) -> None:
        rows[3][head.index("use")], rows[3][head.index("note")] = "out", " "

    spoil(profiles / "calibration" / file, change)
    with pytest.raises(InputError, match=rf"{file}, line 5: note"):
        LOADERS[file]()


@pytest.mark.parametrize("file", LOADERS)
@pytest.mark.parametrize(("more", "said"), [(["x"], "more"), (None, "fewer")])
def test_a_row_of_another_length_is_refused(profiles: Path, file: str, more: list[str] | None, said: str) -> None:
    def change(head: list[str], rows: list[list[str]]) -> None:
        rows[3] = rows[3] + more if more else rows[3][:-2]

    spoil(profiles / "calibration" / file, change)
    with pytest.raises(InputError, match=rf"{file}, line 5.*{said} cells"):
        LOADERS[file]()


@pytest.mark.parametrize("file", LOADERS)
@pytest.mark.parametrize("column", ["module", "kernels", "precision", "use", "note", "source", "latency_ms"])
def test_a_missing_column_is_named(profiles: Path, file: str, column: str) -> None:
    def change(head: list[str], rows: list[list[str]]) -> None:
        index = head.index(column)
        for row in (head, *rows):
            del row[index]

    spoil(profiles / "calibration" / file, change)
    with pytest.raises(InputError, match=f"no column {column}"):
        LOADERS[file]()


@pytest.mark.parametrize("file", LOADERS)
@pytest.mark.parametrize("content", [b"", b"\n", b"module\n", b"\xff\xfe\x00", b'module,use\n"open'])
def test_a_table_that_is_none_is_refused(profiles: Path, file: str, content: bytes) -> None:
    (profiles / "calibration" / file).write_bytes(content)
    with pytest.raises(InputError, match=file):
        LOADERS[file]()


@pytest.mark.parametrize("text", ["", "[]", "3", '{"resnet50": 3}', '{"resnet50": []}', '{"a": [{}]}', "[" * 10**5])
def test_kernel_lists_that_are_none_are_refused(profiles: Path, text: str) -> None:
    (profiles / "calibration" / "kernels.json").write_text(text, encoding="utf-8")
    with pytest.raises(InputError):
        load_kernel_lists()


def test_a_damaged_calibration_stops_a_prediction(profiles: Path) -> None:
    (profiles / "calibration" / "fit.json").write_bytes(b"\xff")
    with pytest.raises(InputError, match=r"fit\.json"):
        predict(load_kernel_lists()["resnet50"], "nano-4gb")


# -- digest


def test_the_digest_sees_every_file_and_no_line_ends(profiles: Path) -> None:
    before = data_digest()
    for name in ("kernels.json", "latency.csv", "power.csv"):
        path = profiles / "calibration" / name
        original = path.read_bytes()
        path.write_bytes(original.replace(b"\n", b"\r\n"))
        assert data_digest() == before
        path.write_bytes(original + b" ")
        assert data_digest() != before
        path.write_bytes(original)


# -- profiles of one's own


def rewrite(path: Path, old: str, new: str) -> None:
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")


def test_another_clock_in_a_profile_changes_the_prediction(profiles: Path) -> None:
    network = load_kernel_lists()["resnet50"]
    before = predict(network, "nano-4gb", mode="5W")
    rewrite(profiles / "modules" / "nano-4gb.toml", "gpu_mhz = 640", "gpu_mhz = 320")
    after = predict(network, "nano-4gb", mode="5W")
    assert 1.5 * before.latency_ms < after.latency_ms < 2.5 * before.latency_ms
    assert after.power_w < before.power_w
    # The other mode's caps are as they were.
    assert predict(network, "nano-4gb", mode="MAXN").latency_ms < before.latency_ms


def test_another_memory_size_changes_the_verdict(profiles: Path) -> None:
    network = load_kernel_lists()["resnet50"]
    assert predict(network, "nano-4gb").fits
    rewrite(profiles / "modules" / "nano-4gb.toml", "size_gb = { value = 4,", "size_gb = { value = 1,")
    assert not predict(network, "nano-4gb").fits


def test_a_directory_with_one_module_only_is_filled_up_from_the_kit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    network = load_kernel_lists()["resnet50"]
    before = predict(network, "xavier-nx").latency_ms
    shutil.copytree(PROFILES / "modules", tmp_path / "modules")
    monkeypatch.setenv("ROBOTBRAIN_PROFILES", str(tmp_path))
    assert predict(network, "xavier-nx").latency_ms == before


def test_a_table_of_ones_own_goes_with_the_kits_kernel_lists(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "calibration").mkdir()
    shutil.copytree(PROFILES / "modules", tmp_path / "modules")
    lines = (FOLDER / "latency.csv").read_text(encoding="utf-8").splitlines(keepends=True)
    (tmp_path / "calibration" / "latency.csv").write_text("".join(lines[:9]), encoding="utf-8")
    monkeypatch.setenv("ROBOTBRAIN_PROFILES", str(tmp_path))
    assert len(load_latency_rows(uses=USES)) == 8
    assert json.loads((FOLDER / "kernels.json").read_text(encoding="utf-8")).keys() == load_kernel_lists().keys()
