"""Parsers of trtexec, tegrastats, nvpmodel, jetson_clocks and jtop on what real boards printed, and on spoilt logs."""

from __future__ import annotations

import re
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robotbrain.errors import InputError
from robotbrain.jetson.measure import jtop, nvpmodel, tegrastats, trtexec
from robotbrain.jetson.measure.samples import MODULE_RAILS, Sample, summarise, within

LOGS = Path(__file__).resolve().parents[1] / "data" / "jetson_logs"
TRTEXEC = sorted(path.name for path in LOGS.glob("trtexec_*.log"))
TEGRASTATS = sorted(path.name for path in LOGS.glob("tegrastats_*.log"))


def log(name: str) -> str:
    return (LOGS / name).read_text(encoding="utf-8")


# ---- trtexec ----


@pytest.mark.parametrize(
    ("name", "median", "p99", "host", "version", "precision", "batch", "memory"),
    [
        ("trtexec_7_resnet50_int8.log", 55.2111, 57.4766, 55.2737, None, None, None, None),
        ("trtexec_8_2_nano.log", 90.0183, 91.2045, 90.3035, "8.2.1", "fp32", 1, 266.0),
        ("trtexec_8_4_agx_xavier_engine.log", 0.388443, 0.393188, 0.401947, "8.4.0", None, 16, None),
        ("trtexec_8_4_no_transfers_unstable.log", 1.38037, 1.55853, 1.38037, None, None, None, None),
        ("trtexec_8_5_cut_terminal.log", 0.369873, None, 0.385986, None, None, None, None),
        ("trtexec_10_3_orin.log", 7.14139, 12.9485, 7.16092, "10.3.0", "fp16", 1, 114.0),
    ],
)
def test_trtexec_of_each_version(
    name: str, median: float, p99: float | None, host: float, version: str | None, precision: str | None,
    batch: int | None, memory: float | None,
) -> None:  # fmt: skip
    report = trtexec.parse(log(name))
    gpu = report.timings["gpu"]
    assert (gpu.median, gpu.p99, report.timings["host"].median) == (median, p99, host)
    assert (report.version, report.precision, report.memory_mb) == (version, precision, memory)
    if "7_resnet" not in name:
        assert report.batch == batch


@pytest.mark.parametrize("name", [n for n in TRTEXEC if "out_of" not in n and "unknown" not in n])
def test_throughput_and_latency_of_a_log_agree(name: str) -> None:
    """An oracle inside each log: the GPU cannot have been busy for longer than the wall clock ran."""
    report = trtexec.parse(log(name))
    if report.throughput_qps is None:
        return
    busy = report.throughput_qps * report.timings["gpu"].mean / 1000
    if "cut_terminal" in name:  # several streams or an implicit batch, whose command line is cut away
        assert busy > 1
    else:
        assert 0.9 < busy < 1.01


def test_trtexec_details_of_an_orin() -> None:
    report = trtexec.parse(log("trtexec_10_3_orin.log"))
    assert report.passed and report.queries == 391 and report.walltime_s == 3.00082
    assert report.shapes == {"images": (1, 3, 640, 640)}
    assert report.cuda_graph is False and report.data_transfers is True
    assert (report.started, report.ended) == (datetime(2024, 10, 3, 10, 47, 55), datetime(2024, 10, 3, 10, 47, 59))
    assert any("Enqueue Time" in warning for warning in report.warnings)
    assert set(report.timings) == {"host", "enqueue", "host_to_device", "gpu", "device_to_host"}


def test_an_implicit_batch_counts_queries() -> None:
    report = trtexec.parse(log("trtexec_8_4_agx_xavier_engine.log"))
    assert report.batch == 16
    assert report.throughput_qps == pytest.approx(41087.7 / 16)


def test_the_precision_of_a_loaded_engine_is_not_known() -> None:
    assert "Precision: FP32" in log("trtexec_8_0_loads_fp16_engine.log")
    assert trtexec.parse(log("trtexec_8_0_loads_fp16_engine.log")).precision is None


@pytest.mark.parametrize(
    ("name", "word"),
    [("trtexec_10_3_out_of_memory.log", "out of memory"), ("trtexec_10_3_unknown_option.log", "lacks the option")],
)
def test_a_failed_run_says_why(name: str, word: str) -> None:
    with pytest.raises(InputError, match=word):
        trtexec.parse(log(name))


@pytest.mark.parametrize(
    ("number", "version"),
    [(7103, "7.1.3"), (8201, "8.2.1"), (8502, "8.5.2"), (8602, "8.6.2"), (100001, "10.0.1"), (100300, "10.3.0"),
     (101602, "10.16.2"), (110201, "11.2.1")],
)  # fmt: skip
def test_banner_numbers(number: int, version: str) -> None:
    assert trtexec.version_of(number) == version


def test_a_banner_with_dots() -> None:
    text = log("trtexec_10_3_orin.log").replace("v100300]", "v11.1.0.106] [b48]")
    text = "\n".join(line for line in text.splitlines() if "TensorRT version" not in line)
    assert trtexec.parse(text).version == "11.1.0.106"


def test_two_runs_in_one_log_are_refused() -> None:
    with pytest.raises(InputError, match="2 runs"):
        trtexec.parse(2 * log("trtexec_10_3_orin.log"))


def test_numbers_that_contradict_each_other_are_refused() -> None:
    text = log("trtexec_8_2_nano.log").replace("Compute Time: min = 89.0273", "Compute Time: min = 99.0273")
    with pytest.raises(InputError, match="GPU Compute Time"):
        trtexec.parse(text)


def test_windows_line_ends_change_nothing() -> None:
    text = log("trtexec_10_3_orin.log")
    assert trtexec.parse(text.replace("\n", "\r\n")) == trtexec.parse(text)


@pytest.mark.parametrize("name", TRTEXEC)
def test_trtexec_cut_anywhere_is_complete_or_refused(name: str) -> None:
    text = log(name)
    try:
        whole = trtexec.parse(text).timings["gpu"]
    except InputError:
        whole = None
    for end in range(0, len(text), 7):
        try:
            cut = trtexec.parse(text[:end]).timings["gpu"]
        except InputError:
            continue
        # No half number passes for a whole one; of the percentiles, which come last, some may be missing.
        assert whole is not None
        assert (cut.min, cut.max, cut.mean, cut.median) == (whole.min, whole.max, whole.mean, whole.median)
        assert all(getattr(cut, p) in (None, getattr(whole, p)) for p in ("p90", "p95", "p99"))


# ---- tegrastats ----


@pytest.mark.parametrize(
    ("name", "watts", "die", "gpu", "emc", "used", "total"),
    [
        ("tegrastats_nano_jp4.log", 1.022, 36.5, 76, 204, 534, 3964),
        ("tegrastats_tx2_jp4.log", 3.056, 37.5, 624, 1600, 2344, 7852),
        ("tegrastats_xavier_nx_jp4.log", 4.067, 43.5, 306, 1600, 4412, 7772),
        # 18401 + 2301 + 4602 + 0 + 2914 + 4632 mW: the rails lie beside each other
        ("tegrastats_agx_xavier_jp4.log", 32.85, 54.5, 1377, 2133, 10881, 31919),
        ("tegrastats_orin_nx_jp5.log", 5.299, 48.875, 611, 2133, 6334, 15388),
        ("tegrastats_agx_orin_jp5.log", 6.755, 44.562, None, 2133, 4321, 62801),
        ("tegrastats_agx_orin_jp6.log", 8.726, 52.562, None, 2133, 18207, 62841),
        ("tegrastats_agx_orin_jp6_padded.log", 12.377, 53.062, 305, 2133, 29114, 30697),
        ("tegrastats_orin_nano_jp7.log", 3.582, 46.843, 305, 665, 2850, 7486),
        ("tegrastats_thor_jp7.log", 8.291, 34.5, None, 665, 4208, 125773),
    ],
)
def test_tegrastats_of_each_board(
    name: str, watts: float, die: float, gpu: int | None, emc: int, used: int, total: int
) -> None:
    read = tegrastats.parse_log(log(name))
    sample = read.samples[0]
    assert read.skipped == 0
    assert sample.module_w == pytest.approx(watts)
    assert (sample.die_c, sample.gpu_mhz, sample.emc_mhz) == (die, gpu, emc)
    assert (sample.ram_used_mb, sample.ram_total_mb) == (used, total)
    assert (sample.time is None) == ("_jp4" in name or "padded" in name or "nx_jp5" in name)


def test_every_family_has_a_recorded_board() -> None:
    """The table of rails holds nothing that no board was seen to print."""
    seen = {sample.module_rails for name in TEGRASTATS for sample in tegrastats.parse_log(log(name)).samples}
    assert seen == set(MODULE_RAILS)


def test_cores_that_are_off_do_not_count() -> None:
    assert tegrastats.parse_log(log("tegrastats_tx2_jp4.log")).samples[0].cpu_mhz == 345
    assert tegrastats.parse_log(log("tegrastats_orin_nx_jp5.log")).samples[0].cpu_mhz == 729


def test_sensors_without_power_and_rails_without_a_wire_are_left_out() -> None:
    sample = tegrastats.parse_log(log("tegrastats_agx_orin_jp5.log")).samples[0]
    assert "GPU" not in sample.temperatures_c and "CV0" not in sample.temperatures_c
    assert "NC" not in sample.rails_w


def test_the_kits_input_is_not_the_modules_power() -> None:
    sample = tegrastats.parse_log(log("tegrastats_thor_jp7.log")).samples[1]
    assert sample.rails_w["VIN"] == 16.802
    assert sample.module_w == pytest.approx(0 + 5.535 + 5.040)


def test_a_rail_slightly_below_zero_is_read() -> None:
    line = log("tegrastats_thor_jp7.log").splitlines()[0].replace("VDD_GPU 0mW/0mW", "VDD_GPU -392mW/-380mW")
    assert tegrastats.parse_line(line).module_w == pytest.approx(8.291 - 0.392)


@pytest.mark.parametrize("name", TEGRASTATS)
def test_a_cut_line_never_gives_a_wrong_figure(name: str) -> None:
    for line in log(name).splitlines():
        whole = tegrastats.parse_line(line)
        for end in range(len(line)):
            try:
                cut = tegrastats.parse_line(line[:end])
            except InputError:
                continue
            assert all(whole.rails_w.get(rail) == watts for rail, watts in cut.rails_w.items()), line[:end]
            assert all(whole.temperatures_c.get(s) == c for s, c in cut.temperatures_c.items()), line[:end]
            assert cut.ram_used_mb == whole.ram_used_mb and cut.cpu_mhz == whole.cpu_mhz


def test_lines_that_are_no_readings_are_counted() -> None:
    text = "warning: not root\n\n" + log("tegrastats_agx_orin_jp6.log") + "RAM 12/3\n"
    read = tegrastats.parse_log(text)
    assert len(read.samples) == 3 and read.skipped == 2
    with pytest.raises(InputError, match="tegrastats"):
        tegrastats.parse_log("bash: tegrastats: command not found")


# ---- fuzz ----


def _mutate(text: str, rng: np.random.Generator) -> str:
    """Spoil a log as transport does: bytes changed, pieces cut out, doubled or glued."""
    letters = list(text)
    for _ in range(int(rng.integers(1, 12))):
        kind, at = int(rng.integers(4)), int(rng.integers(len(letters)))
        length = int(rng.integers(1, 60))
        if kind == 0:
            letters[at] = str(rng.choice(list("0123456789.-+eE%@[]/x=:,() \nmWinfaMB\x00é")))
        elif kind == 1:
            del letters[at : at + length]
        elif kind == 2:
            letters[at:at] = letters[at : at + length]
        else:
            other = int(rng.integers(len(letters)))
            letters[at:at] = letters[other : other + length]
        if not letters:
            letters = [" "]
    return "".join(letters)


@pytest.mark.parametrize("seed", range(4))
def test_spoilt_logs_never_crash_a_parser(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for _ in range(60):
        for name, parse in [(n, trtexec.parse) for n in TRTEXEC] + [(n, tegrastats.parse_log) for n in TEGRASTATS]:
            try:
                result: Any = parse(_mutate(log(name), rng))
            except InputError:
                continue
            if isinstance(result, tegrastats.TegrastatsLog):
                summarise(result.samples, "tegrastats")
            else:
                assert result.timings["gpu"].median >= 0


@settings(max_examples=200, deadline=None)
@given(st.text(max_size=400))
def test_any_text_never_crashes_a_parser(text: str) -> None:
    for parse in (trtexec.parse, tegrastats.parse_log, tegrastats.parse_line, nvpmodel.parse_mode):
        with pytest.raises(InputError):
            parse(text.replace("NV Power Mode", ""))
    nvpmodel.parse_clocks(text)
    nvpmodel.offered_modes(text)


def test_long_digits_do_not_stall_a_parser() -> None:
    """Python refuses to turn more than 4300 digits into an int: no field may meet that limit."""
    digits = "9" * 5000
    for text in (log("trtexec_10_3_orin.log"), log("trtexec_7_resnet50_int8.log")):
        for number in ("1", "3", "640", "114", "391", "100300", "90", "99", "7", "55", "2024"):
            try:
                trtexec.parse(text.replace(number, digits))
            except InputError:
                continue
    line = log("tegrastats_nano_jp4.log").splitlines()[0]
    for number in sorted(set(re.findall(r"\d+", line))):
        try:
            tegrastats.parse_line(line.replace(number, digits))
        except InputError:
            continue


# ---- summaries ----


def test_the_summary_is_the_mean_and_the_peak() -> None:
    telemetry = summarise(tegrastats.parse_log(log("tegrastats_agx_orin_jp6.log")).samples, "tegrastats")
    watts = [8.726, 8.626, 8.726]
    assert telemetry.power is not None
    assert telemetry.power.mean == pytest.approx(np.mean(watts), abs=1e-3)
    assert (telemetry.power.peak, telemetry.power.samples) == (8.726, 3)
    assert telemetry.temperature_peak_c == 52.562
    assert telemetry.system_memory_mb == 18207


def test_no_rails_means_no_power_not_zero() -> None:
    telemetry = summarise([Sample(ram_used_mb=100.0)], "tegrastats")
    assert telemetry.power is None and telemetry.temperature_mean_c is None and telemetry.gpu_mhz is None
    assert summarise([], "tegrastats").power is None


def test_only_readings_of_the_timed_phase_count() -> None:
    samples = tegrastats.parse_log(log("tegrastats_agx_orin_jp6.log")).samples
    second = datetime(2026, 5, 9, 18, 42, 7)
    assert within(samples, second, second) == [samples[1]]


# ---- nvpmodel, jetson_clocks, jtop ----


@pytest.mark.parametrize(
    ("text", "name", "number"),
    [
        ("NV Power Mode: 25W\n1\n", "25W", 1),
        ("NVPM WARN: fan mode is not set!\nNV Power Mode: MAXN\n0\n", "MAXN", 0),
        ("NV Power Mode: 5W\n1\nNVPM ERROR: Error opening /sys/kernel/nvpmodel_emc_cap/emc_iso_cap: 13\n", "5W", 1),
        ("NVPM VERB: Current mode: NV Power Mode: MODE_15W_6CORE\n2\nNVPM VERB: PARAM\n", "MODE_15W_6CORE", 2),
        ("NV Power Mode: MAXN_SUPER\r\n2\r\n", "MAXN_SUPER", 2),
        ("NV Power Mode: 7W_AI", "7W_AI", None),
    ],
)
def test_nvpmodel(text: str, name: str, number: int | None) -> None:
    assert nvpmodel.parse_mode(text) == nvpmodel.Mode(name, number)


def test_nvpmodel_that_says_nothing_is_refused() -> None:
    with pytest.raises(InputError, match="--mode"):
        nvpmodel.parse_mode("NVPM ERROR: failed to read PARAM")


def test_modes_on_offer() -> None:
    text = "< POWER_MODEL ID=0 NAME=15W >\nCPU_ONLINE CORE_0 1\n< POWER_MODEL ID=2 NAME=MAXN_SUPER >\n"
    assert nvpmodel.offered_modes(text) == {0: "15W", 2: "MAXN_SUPER"}


@pytest.mark.parametrize(
    ("name", "pinned", "gpu_max"),
    [
        ("jetson_clocks_orin_nano.txt", False, 918),
        ("jetson_clocks_orin_nano_pinned.txt", True, 1020),
        # its third core is off and free to scale: that does not matter
        ("jetson_clocks_nano_5w_pinned.txt", True, 614.4),
    ],
)
def test_pinned_clocks(name: str, pinned: bool, gpu_max: float) -> None:
    clocks = nvpmodel.parse_clocks(log(name))
    assert clocks is not None and (clocks.pinned, clocks.gpu_max_mhz) == (pinned, gpu_max)


def test_clocks_without_root_are_not_known() -> None:
    assert nvpmodel.parse_clocks("Error: Run this script(/usr/bin/jetson_clocks) as a root user") is None


def test_jtop_gives_what_tegrastats_gives() -> None:
    """The same AGX Orin through jtop: mW, kHz and KiB."""
    wanted = tegrastats.parse_log(log("tegrastats_agx_orin_jp6_padded.log")).samples[0]
    rails = {name: {"power": round(1000 * watts), "avg": 0, "volt": 1} for name, watts in wanted.rails_w.items()}
    sample = jtop.read(
        power={"rail": rails, "tot": {"power": 12377, "avg": 12377}},
        temperature={
            **{name: {"temp": c, "online": True} for name, c in wanted.temperatures_c.items()},
            "cv0": {"temp": -256, "online": False},
        },
        gpu={"gpu": {"status": {"load": 0.0}, "freq": {"cur": 305000, "max": 1300500}}},
        memory={"RAM": {"used": 29114 * 1024, "tot": 30697 * 1024}, "EMC": {"cur": 2133000}},
    )
    assert sample.module_w == pytest.approx(wanted.module_w) and sample.module_rails == wanted.module_rails
    assert sample.temperatures_c == wanted.temperatures_c
    assert (sample.gpu_mhz, sample.emc_mhz, sample.gpu_load) == (305, 2133, 0)
    assert (sample.ram_used_mb, sample.ram_total_mb) == (wanted.ram_used_mb, wanted.ram_total_mb)


def test_jtop_puts_the_total_rail_back() -> None:
    power = {"rail": {"VDD_SOC": {"power": 1353}}, "tot": {"name": "VDD_IN", "power": 4067}}
    assert jtop.read(power, {}, {}, {}).module_w == pytest.approx(4.067)


@pytest.mark.parametrize("junk", [None, {}, [], "x", {"rail": 3, "tot": None}, {"gpu": {"freq": 1}}, {"RAM": "much"}])
def test_jtop_of_another_version_gives_nothing_instead_of_a_crash(junk: Any) -> None:
    assert jtop.read(junk, junk, junk, junk, junk).module_w is None
