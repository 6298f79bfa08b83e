"""The catalogue agrees with closed forms and with itself, finds the mode that is meant, and refuses damaged files."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import pytest

from robotbrain.errors import InputError
from robotbrain.jetson.catalogue import list_modules, load_cpu_hosts, load_module
from robotbrain.jetson.figures import PROVENANCES, SOURCE_FORMS, Figure
from robotbrain.jetson.modes import PowerMode, resolve_mode
from robotbrain.jetson.paths import module_directory, profile_directory

SLUGS = (
    *("nano-4gb", "tx2", "xavier-nx", "agx-xavier-32gb", "orin-nano-4gb", "orin-nano-8gb", "orin-nano-4gb-super"),
    *("orin-nano-8gb-super", "orin-nx-8gb", "orin-nx-16gb", "orin-nx-8gb-super", "orin-nx-16gb-super"),
    *("agx-orin-32gb", "agx-orin-64gb", "t4000", "t5000"),
)

# Multiply-accumulates per SM and clock, from the architecture white papers: CUDA cores in FP32, tensor cores dense.
FP32_MACS = {"maxwell": 128, "pascal": 128, "volta": 64, "ampere": 128, "blackwell": 128}
FP16_MACS = {"maxwell": 256, "pascal": 256, "volta": 512, "ampere": 1024, "blackwell": 4096}


def test_all_sixteen_modules_are_there() -> None:
    assert sorted(list_modules()) == sorted(SLUGS)


@pytest.mark.parametrize("slug", SLUGS)
def test_figures_are_sourced_and_agree_with_closed_forms(slug: str) -> None:
    module = load_module(slug)
    clock = module.gpu_max_mhz * 1e6
    assert module.fp32_tflops * 1e12 == pytest.approx(2 * module.cuda_cores * clock, rel=1e-3)
    assert module.fp16_tflops * 1e12 == pytest.approx(2 * module.sm_count * FP16_MACS[module.family] * clock, rel=1e-3)
    assert module.cuda_cores == module.sm_count * FP32_MACS[module.family]
    if module.family in ("maxwell", "pascal"):
        assert module.int8_tops is None and module.tensor_cores == 0 and module.tf32_tflops is None
    else:
        assert module.int8_tops == pytest.approx(2 * module.fp16_tflops, rel=1e-3)
        assert module.tensor_cores > 0
    assert module.bandwidth_gbs == pytest.approx(2e-3 * module.emc_max_mhz * module.memory_bus_bits / 8, rel=0.01)
    assert module.gpu_throttle_c < module.shutdown_c
    assert module.idle_power_w < module.power_budget_w <= module.max_power_w or module.default_mode.watts is None

    for figure in module.figures.values():
        assert math.isfinite(figure.value) and figure.unit
        assert figure.provenance in PROVENANCES and figure.source.startswith(SOURCE_FORMS)
    for statement in module.statements.values():
        assert statement.text and statement.provenance in PROVENANCES and statement.source.startswith(SOURCE_FORMS)


@pytest.mark.parametrize("slug", SLUGS)
def test_modes_stay_within_the_module_and_scale_what_they_cap(slug: str) -> None:
    module = load_module(slug)
    assert [mode.default for mode in module.modes.values()].count(True) == 1
    assert module.mode() is module.default_mode is module.mode(None)
    for name, mode in module.modes.items():
        assert mode.name == name and mode.source.startswith(SOURCE_FORMS) and mode.provenance in PROVENANCES
        assert 0 < mode.gpu_mhz <= module.gpu_max_mhz and 0 < mode.emc_mhz <= module.emc_max_mhz
        assert 0 < mode.cpu_mhz <= module.cpu_max_mhz
        assert 1 <= mode.cpu_online <= module.cpu_cores and 1 <= mode.sms_on <= module.sm_count
        assert mode.dla_mhz is None or mode.dla_mhz <= (module.dla_max_mhz or 0)
        assert (mode.dla_mhz is None) == (module.dla_count == 0)
        assert mode.watts is None or mode.watts <= module.max_power_w
        fp32 = 2 * mode.sms_on * FP32_MACS[module.family] * mode.gpu_mhz * 1e6
        assert module.peak_flops("fp32", name) == pytest.approx(fp32, rel=1e-3)
        assert module.peak_flops("fp16", mode) == pytest.approx(
            fp32 * FP16_MACS[module.family] / FP32_MACS[module.family], rel=1e-3
        )
        bus = 2e6 * mode.emc_mhz * module.memory_bus_bits / 8
        assert module.bandwidth(name) == pytest.approx(bus, rel=0.01)
        assert module.cpu_score(name) / mode.cpu_mhz == pytest.approx(module.cpu_score() / module.mode().cpu_mhz)


@pytest.mark.parametrize(
    ("slug", "precision", "tera"),
    [  # as NVIDIA prints them, dense: sparse figures halved, TOPS of the GPU alone
        ("nano-4gb", "fp16", 0.472),
        ("xavier-nx", "fp32", 0.85),
        ("xavier-nx", "fp16", 6.8),
        ("agx-xavier-32gb", "int8", 22.6),
        ("orin-nano-4gb", "int8", 10),
        ("orin-nano-8gb", "int8", 20),
        ("orin-nano-8gb-super", "int8", 33.5),
        ("agx-orin-32gb", "int8", 54),
        ("agx-orin-64gb", "int8", 85),
        ("agx-orin-64gb", "fp32", 5.3),
        ("t5000", "fp16", 258.5),
    ],
)
def test_peaks_agree_with_the_printed_ones(slug: str, precision: str, tera: float) -> None:
    assert load_module(slug).peak_flops(precision, "MAXN") / 1e12 == pytest.approx(tera, rel=0.025)


def test_dla_peaks_agree_with_nvidias_table_by_mode() -> None:
    # NVIDIA/Deep-Learning-Accelerator-SW: 105, 90 and 40 TOPS sparse on the AGX Orin at MAXN, 30 W and 15 W.
    module = load_module("agx-orin-64gb")
    for mode, sparse in (("MAXN", 105), ("30W", 90), ("15W", 40)):
        assert 2 * module.dla_peak_flops(mode) / 1e12 == pytest.approx(sparse, rel=0.02)
    assert load_module("orin-nano-8gb").dla_peak_flops() == 0
    # The module's advertised total is the GPU's and the DLAs' sparse share together.
    for slug, total in (("agx-orin-64gb", 275), ("agx-orin-32gb", 200), ("orin-nx-16gb", 100), ("orin-nx-8gb", 70)):
        module = load_module(slug)
        both = 2 * (module.peak_flops("int8", "MAXN") + module.dla_peak_flops("MAXN")) / 1e12
        assert both == pytest.approx(total, rel=0.02)


def test_precisions_fall_back_where_nothing_speeds_them_up() -> None:
    nano, orin = load_module("nano-4gb"), load_module("agx-orin-64gb")
    assert nano.runs_as("int8") == "fp16" and nano.peak_flops("int8") == nano.peak_flops("fp16")
    assert nano.runs_as("tf32") == "fp32" and orin.runs_as("tf32") == "tf32"
    assert orin.peak_flops("tf32") == pytest.approx(orin.peak_flops("fp16") / 2, rel=1e-3)
    with pytest.raises(InputError, match="fp16"):
        nano.peak_flops("FP16")


@pytest.mark.parametrize(
    ("slug", "mode", "cpu_online", "cpu_mhz", "gpu_mhz", "sms_on", "emc_mhz"),
    [  # independent facts from nvpmodel's files
        ("nano-4gb", "5W", 2, 918, 640, 1, 1600),
        ("tx2", "MAXQ", 4, 1200, 850, 2, 1331.2),
        ("xavier-nx", "MODE_15W_6CORE", 6, 1420, 1109.25, 6, 1600),
        ("agx-xavier-32gb", "MODE_10W", 2, 1200, 520, 4, 1065.6),
        ("orin-nano-8gb", "7W", 4, 960, 408, 4, 2133),
        ("orin-nano-8gb-super", "25W", 6, 1344, 918, 8, 3199),
        ("orin-nx-16gb", "25W", 8, 1497, 408, 8, 3199),
        ("orin-nx-8gb-super", "40W", 6, 1984, 1173, 8, 3199),
        ("agx-orin-64gb", "MODE_30W", 8, 1728, 612, 8, 3199),
        ("agx-orin-64gb", "MODE_50W", 12, 1497, 816, 16, 3199),
    ],
)
def test_modes_as_nvpmodel_has_them(
    slug: str, mode: str, cpu_online: int, cpu_mhz: float, gpu_mhz: float, sms_on: int, emc_mhz: float
) -> None:
    found = load_module(slug).modes[mode]
    stated = (found.cpu_online, found.cpu_mhz, found.gpu_mhz, found.sms_on, found.emc_mhz)
    assert stated == (cpu_online, cpu_mhz, gpu_mhz, sms_on, emc_mhz)


def test_mode_names_are_nvpmodels_in_the_order_of_their_numbers() -> None:
    names = {slug: load_module(slug).mode_names for slug in SLUGS}
    assert names["nano-4gb"] == ("MAXN", "5W")
    assert names["xavier-nx"] == tuple(
        [f"MODE_15W_{n}CORE" for n in (2, 4, 6)]
        + ["MODE_10W_2CORE", "MODE_10W_4CORE", "MODE_10W_DESKTOP"]
        + [f"MODE_20W_{n}CORE" for n in (2, 4, 6)]
    )
    assert names["orin-nano-4gb"] == ("10W", "7W_AI", "7W_CPU")
    assert names["orin-nx-16gb-super"] == ("MAXN_SUPER", "10W", "15W", "25W", "40W")
    assert names["agx-orin-32gb"] == ("MAXN", "MODE_15W", "MODE_30W", "MODE_40W")
    assert names["t5000"] == ("MAXN", "120W", "90W", "70W")
    for slug, listed in names.items():
        assert [load_module(slug).modes[name].id for name in listed] == list(range(len(listed)))
    defaults = {slug: load_module(slug).default_mode.name for slug in SLUGS}
    assert defaults["tx2"] == "MAXP_CORE_ALL" and defaults["agx-orin-64gb"] == "MODE_30W"
    assert defaults["orin-nano-8gb-super"] == "25W" and defaults["xavier-nx"] == "MODE_10W_DESKTOP"


@pytest.mark.parametrize(
    ("slug", "wanted", "expected"),
    [
        ("xavier-nx", "MODE_15W_2CORE", "MODE_15W_2CORE"),
        ("xavier-nx", "mode_15w_2core", "MODE_15W_2CORE"),
        ("xavier-nx", "15W_2core", "MODE_15W_2CORE"),
        ("xavier-nx", "15W 2CORE", "MODE_15W_2CORE"),
        ("xavier-nx", "15w-2core", "MODE_15W_2CORE"),
        ("xavier-nx", "15W", "MODE_15W_6CORE"),  # the default is none of these: most cores
        ("xavier-nx", "15 W", "MODE_15W_6CORE"),
        ("xavier-nx", "MODE_20W", "MODE_20W_6CORE"),
        ("xavier-nx", "10W", "MODE_10W_DESKTOP"),  # the default is among them
        ("xavier-nx", "4", "MODE_10W_4CORE"),
        ("xavier-nx", 0, "MODE_15W_2CORE"),
        ("xavier-nx", "MAXN", "MODE_20W_6CORE"),  # has none: most throughput, memory clock, cores
        ("agx-xavier-32gb", "15W", "MODE_15W"),  # a name of its own goes before the default MODE_15W_DESKTOP
        ("agx-xavier-32gb", "30w", "MODE_30W_ALL"),
        ("agx-orin-64gb", "50W", "MODE_50W"),
        ("agx-orin-64gb", "maxn", "MAXN"),
        ("nano-4gb", "10W", "MAXN"),
        ("nano-4gb", "MAXN (10W)", "MAXN"),
        ("nano-4gb", "Max-N", "MAXN"),
        ("tx2", "Max-Q", "MAXQ"),
        ("tx2", "maxp", "MAXP_CORE_ALL"),
        ("tx2", "15W", "MAXP_CORE_ALL"),  # by budget
        ("tx2", "7.5W", "MAXQ"),
        ("orin-nano-8gb", "MAXN", "15W"),
        ("orin-nano-4gb", "7W", "7W_AI"),
        ("orin-nano-8gb-super", "MAXN", "MAXN_SUPER"),
        ("orin-nano-8gb-super", "maxn super", "MAXN_SUPER"),
    ],
)
def test_aliases(slug: str, wanted: str | int, expected: str) -> None:
    assert load_module(slug).mode(wanted).name == expected


def made_up(name: str, number: int, cores: int, gpu_mhz: float, default: bool = False) -> PowerMode:
    return PowerMode(name, number, 15, default, cores, 1000, gpu_mhz, 1, 1000, None, "assumed", "kit:made up")


def test_an_ambiguous_alias_goes_by_default_then_cores_then_gpu_clock_then_number() -> None:
    few, many = made_up("15W_A", 0, 2, 900), made_up("15W_B", 1, 8, 400)
    fast, faster = made_up("15W_C", 2, 8, 500), made_up("15W_D", 3, 8, 500)
    other = made_up("MAXN", 4, 8, 999, default=True)
    modes = {mode.name: mode for mode in (few, many, fast, faster, other)}
    assert resolve_mode("made up", modes, "15W") is fast
    preferred = made_up("15W_A", 0, 2, 900, default=True)
    assert (
        resolve_mode("made up", {**modes, "15W_A": preferred, "MAXN": made_up("MAXN", 4, 8, 999)}, "15w") is preferred
    )


@pytest.mark.parametrize("wanted", ["40W", "MAXN_SUPER", "9", "", "CORE", "MODE", True, "15W_6CORES", -1, "٣W"])
def test_an_unknown_mode_lists_the_known_ones(wanted: str | int) -> None:
    with pytest.raises(InputError, match=r"MODE_15W_6CORE \(2\)"):
        load_module("xavier-nx").mode(wanted)


def test_errors_suggest_what_is_near() -> None:
    with pytest.raises(InputError, match="Did you mean 'MODE_15W_6CORE'"):
        load_module("xavier-nx").mode("15W_6CORES")
    with pytest.raises(InputError, match="Did you mean 'agx-orin-64gb'"):
        load_module("agx-orin-64")
    assert load_module("AGX-Orin-64GB").slug == "agx-orin-64gb"
    foreign = load_module("agx-orin-64gb").mode("MAXN")
    with pytest.raises(InputError, match="Orin NX"):
        load_module("orin-nx-8gb").mode(foreign)


def test_faster_modules_score_higher_in_the_cpu_benchmark() -> None:
    score = {slug: load_module(slug).cpu_score("MAXN") for slug in SLUGS}
    order = ("nano-4gb", "orin-nano-8gb", "orin-nano-8gb-super", "agx-orin-64gb", "t5000")
    assert sorted(order, key=score.__getitem__) == list(order)
    # One benchmark family throughout: per clock, no core is far from another.
    for slug in SLUGS:
        module = load_module(slug)
        assert 0.9 < module.cpu_score() / module.mode().cpu_mhz < 1.8
    hosts = load_cpu_hosts()
    assert len(hosts) >= 5
    assert {host.single_thread.unit for host in hosts.values()} == {load_module("tx2").cpu_single_thread.unit}
    assert all(host.single_thread.value > score["nano-4gb"] for host in hosts.values())


# ---------------------------------------------------------------- damaged files


@pytest.fixture
def module_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "modules").mkdir()
    path = tmp_path / "modules" / "xavier-nx.toml"
    shutil.copy(module_directory() / "xavier-nx.toml", path)
    monkeypatch.setenv("ROBOTBRAIN_PROFILES", str(tmp_path))
    return path


def line(path: Path, start: str) -> str:
    """Return the one line of the file that starts so."""
    found = [text for text in path.read_text(encoding="utf-8").splitlines() if text.startswith(start)]
    assert len(found) == 1, found
    return found[0]


@pytest.mark.parametrize(
    ("start", "old", "new", "words"),
    [
        ("sm_count", None, "", ("[gpu]", "sm_count")),
        ("[thermal]", "[thermal]", "[warmth]", ("warmth",)),
        ("[memory]", "[memory]", "[[memory]]", ("memory",)),
        ("size_gb", "value = 8", "value = nan", ("[memory.size_gb]", "value")),
        ("size_gb", "value = 8", "value = inf", ("[memory.size_gb]", "value")),
        ("size_gb", "value = 8", 'value = "8"', ("[memory.size_gb]", "value")),
        ("size_gb", "value = 8", "value = true", ("[memory.size_gb]", "value")),
        ("size_gb", "value = 8", "value = -8", ("[memory.size_gb]", "value")),
        ("size_gb", "value = 8, ", "", ("[memory.size_gb]", "value")),
        ("size_gb", None, "size_gb = 8", ("[memory]", "size_gb")),
        ("size_gb", '"GB"', '"MB"', ("[memory.size_gb]", "unit", "'GB'")),
        ("size_gb", '"published"', '"rumoured"', ("[memory.size_gb]", "provenance", "datasheet")),
        ("size_gb", '"ultralytics"', '"ultralitics"', ("[memory.size_gb]", "source")),
        ("size_gb", '"ultralytics"', '"kit:we think so"', ("[memory.size_gb]", "provenance")),
        ("size_gb", " }", ', notes = "" }', ("[memory.size_gb]", "notes", "'note'")),
        ("cuda_cores", "384", "383.5", ("[gpu.cuda_cores]", "whole")),
        ("cuda_cores", "384", "385", ("[gpu]", "cuda_cores", "384")),
        ("fp32_tflops", "0.8519", "0.9519", ("[peak]", "fp32_tflops")),
        ("bandwidth_gbs", "59.7", "51.2", ("[memory]", "bandwidth_gbs")),
        ("int8_tops = { value = 13.63", None, "", ("[peak]", "int8_tops")),
        ("shutdown_c", "98", "92.5", ("[thermal]", "shutdown_c")),
        ('family = "volta"', "volta", "ampere", ("[gpu]", "cuda_cores")),
        ('family = "volta"', "volta", "hopper", ("family", "volta")),
        ("slug", "xavier-nx", "xavier", ("slug", "xavier-nx")),
        ("headline", '"21 TOPS"', '""', ("[headline]", "text")),
        ("ultralytics =", "github:", "see ", ("[sources]", "ultralytics")),
        ("[gpu]", "[gpu]", "[gpu", ("TOML",)),
    ],
)
def test_a_damaged_file_is_refused_with_its_place(
    module_file: Path, start: str, old: str | None, new: str, words: tuple[str, ...]
) -> None:
    assert load_module("xavier-nx").sm_count == 6
    text, victim = module_file.read_text(encoding="utf-8"), line(module_file, start)
    assert old is None or old in victim
    module_file.write_text(text.replace(victim, new if old is None else victim.replace(old, new)), encoding="utf-8")
    with pytest.raises(InputError) as caught:
        load_module("xavier-nx")
    for word in ("xavier-nx.toml", *words):
        assert word in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("gpu_mhz = 510\n", "gpu_mhz = 1110\n", ("modes.MODE_10W_DESKTOP]", "gpu_mhz", "1109.25")),
        ("gpu_mhz = 510\n", "", ("modes.MODE_10W_DESKTOP]", "gpu_mhz")),
        ("gpu_mhz = 510\n", "gpu_mhz = nan\n", ("modes.MODE_10W_DESKTOP]", "gpu_mhz")),
        ("gpu_mhz = 510\n", "gpu_ghz = 0.51\n", ("modes.MODE_10W_DESKTOP]", "gpu_ghz", "'gpu_mhz'")),
        ("default = true\n", "", ("modes", "default")),
        ("default = true\n", 'default = "yes"\n', ("modes.MODE_10W_DESKTOP]", "default")),
        ("id = 0\nwatts = 15\n", "id = 0\nwatts = 15\ndefault = true\n", ("modes", "default")),
        ("id = 1\n", "id = 0\n", ("modes", "id")),
        ("id = 1\n", "id = 1.5\n", ("modes.MODE_15W_4CORE]", "id")),
    ],
)
def test_a_damaged_mode_is_refused_with_its_place(
    module_file: Path, old: str, new: str, words: tuple[str, ...]
) -> None:
    text = module_file.read_text(encoding="utf-8")
    assert text.count(old) == 1
    module_file.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(InputError) as caught:
        load_module("xavier-nx")
    for word in ("xavier-nx.toml", *words):
        assert word in str(caught.value)


@pytest.mark.parametrize(
    "field", ["cpu_online = 2", "sms_on = 6", "emc_mhz = 1866", "dla_mhz = 896", "cpu_mhz = 1907.2"]
)
def test_no_mode_exceeds_the_module(module_file: Path, field: str) -> None:
    key = field.partition(" ")[0]
    text = module_file.read_text(encoding="utf-8")
    module_file.write_text(text.replace(f"\n{field}\n", f"\n{key} = 4242\n"), encoding="utf-8")
    with pytest.raises(InputError, match=rf"xavier-nx.toml: \[modes\.MODE_\w+\] {key}"):
        load_module("xavier-nx")


# ---------------------------------------------------------------- where the files are


def test_an_override_changes_what_is_read_at_once(module_file: Path) -> None:
    assert list_modules() == ["xavier-nx"]
    assert load_module("xavier-nx").peak_flops("fp16") == pytest.approx(3.13e12, rel=0.01)
    text = module_file.read_text(encoding="utf-8")
    module_file.write_text(text.replace("gpu_mhz = 510\n", "gpu_mhz = 255\n"), encoding="utf-8")
    assert load_module("xavier-nx").peak_flops("fp16") == pytest.approx(3.13e12 / 2, rel=0.01)
    # What the override lacks comes from the kit.
    assert profile_directory() == module_file.parents[1]
    assert "epyc-zen4" in load_cpu_hosts()


def test_an_empty_override_is_explained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROBOTBRAIN_PROFILES", str(tmp_path))
    for call in (profile_directory, list_modules, load_cpu_hosts):
        with pytest.raises(InputError, match="ROBOTBRAIN_PROFILES"):
            call()


def test_an_unreadable_file_is_explained(module_file: Path) -> None:
    module_file.write_bytes(b"\xff\xfe slug")
    with pytest.raises(InputError, match=r"xavier-nx\.toml"):
        load_module("xavier-nx")


@pytest.mark.parametrize(
    ("value", "unit", "provenance", "source"),
    [
        (math.nan, "W", "assumed", "kit:x"),
        (True, "W", "assumed", "kit:x"),
        (1.0, "", "assumed", "kit:x"),
        (1.0, "W", "heard", "kit:x"),
        (1.0, "W", "assumed", ""),
        (1.0, "W", "assumed", "kit:"),
        (1.0, "W", "datasheet", "kit:x"),
    ],
)
def test_a_figure_is_finite_and_has_an_origin(value: float, unit: str, provenance: str, source: str) -> None:
    assert str(Figure(1.0, "W", "assumed", "kit:x")) == "1 W (assumed)"
    with pytest.raises(InputError, match="figure"):
        Figure(value, unit, provenance, source)
