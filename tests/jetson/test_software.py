"""JetPack releases fit the modules, opsets are judged with a way out, and the outline's figures are put right."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from robotbrain.errors import InputError
from robotbrain.jetson.catalogue import list_modules, load_module
from robotbrain.jetson.figures import PROVENANCES, SOURCE_FORMS
from robotbrain.jetson.paths import find_part
from robotbrain.jetson.software import compatible, jetpacks_for, load_headlines, load_jetpacks, newest_jetpack


def test_the_table_is_sourced_and_in_order() -> None:
    releases = load_jetpacks()
    versions = [tuple(int(part) for part in release.version.split(".")) for release in releases]
    assert versions == sorted(versions) and len(set(versions)) == len(versions) >= 8
    opsets = [release.onnx_opset.value for release in releases]
    assert opsets == sorted(opsets), "a newer TensorRT never parses less"
    for release in releases:
        facts = [release.l4t, release.cuda, release.tensorrt, release.ubuntu, release.python]
        origins = [(fact.provenance, fact.source) for fact in [*facts, *([release.cudnn] if release.cudnn else [])]]
        origins += [(release.onnx_opset.provenance, release.onnx_opset.source), (release.provenance, release.source)]
        for provenance, source in origins:
            assert provenance in PROVENANCES and source.startswith(SOURCE_FORMS)


def test_every_module_has_software_and_families_stop_where_nvidia_stopped() -> None:
    for slug in list_modules():
        assert jetpacks_for(slug)[-1] == newest_jetpack(slug)
        assert load_module(slug).jetpacks == tuple(release.version for release in jetpacks_for(slug))
    assert newest_jetpack("nano-4gb").version.startswith("4.6") and newest_jetpack("tx2").version.startswith("4.6")
    assert newest_jetpack("xavier-nx").version.startswith("5.1")
    assert all(release.version >= "7" for release in jetpacks_for("t5000"))
    assert not [r for r in jetpacks_for("orin-nano-8gb-super") if r.version < "6.2"], "Super modes came with 6.2"
    assert {r.version for r in jetpacks_for("agx-orin-64gb")} >= {"5.1", "6.0", "6.2"}


@pytest.mark.parametrize(
    ("version", "l4t", "cuda", "tensorrt", "opset"),
    [  # independent facts: NVIDIA's release pages and the parser's tables by TensorRT version
        ("4.6.1", "32.7", "10.2", "8.2", 13),
        ("5.1", "35.", "11.4", "8.5", 17),
        ("6.0", "36.3", "12.2", "8.6", 17),
        ("6.2", "36.4", "12.6", "10.3", 20),
        ("7.0", "38.2", "13.0", "10.13", 20),
    ],
)
def test_known_releases(version: str, l4t: str, cuda: str, tensorrt: str, opset: int) -> None:
    release = {release.version: release for release in load_jetpacks()}[version]
    assert release.l4t.text.startswith(l4t) and release.cuda.text == cuda
    assert release.tensorrt.text == tensorrt and release.onnx_opset.value == opset


def test_an_opset_that_is_too_new_comes_with_a_way_out() -> None:
    fits = compatible(13, "nano-4gb")
    assert fits.ok and fits.max_opset == 13 and fits.jetpack == "4.6.1"
    refused = compatible(17, "nano-4gb")
    # The exporter that torch uses by default starts at opset 18, so an older one needs the other exporter.
    assert not refused.ok and "opset_version=13, dynamo=False" in refused.advice
    assert compatible(17, "xavier-nx").ok and not compatible(18, "xavier-nx").ok
    newer = compatible(20, "orin-nano-8gb")
    assert newer.ok and "JetPack 6.0 and older do not" in newer.advice
    old = compatible(7, "agx-orin-64gb")
    assert not old.ok and "convert_version" in old.advice
    for slug in list_modules():
        top = int(newest_jetpack(slug).onnx_opset.value)
        assert compatible(top, slug).ok and not compatible(top + 1, slug).ok and compatible(9, slug).ok


@pytest.mark.parametrize("opset", [0, -1, 13.0, True, "13"])
def test_an_opset_is_a_whole_number(opset: object) -> None:
    with pytest.raises(InputError, match="opset"):
        compatible(opset, "nano-4gb")  # type: ignore[arg-type]


def test_unknown_modules_are_refused() -> None:
    with pytest.raises(InputError, match="nano-4gb"):
        compatible(13, "nano")


def test_the_three_headlines_stand_beside_comparable_figures() -> None:
    headlines = load_headlines()
    assert [h.outline.text for h in headlines] == ["472 GFLOPS", "1080 GFLOPS", "275 TOPS"]
    assert [h.module.slug for h in headlines] == ["nano-4gb", "xavier-nx", "agx-orin-64gb"]
    like = [h.like_for_like for h in headlines]
    assert [f["fp32"].value for f in like] == pytest.approx([0.24, 0.85, 5.3], rel=0.02)
    assert [f["fp16"].value for f in like] == pytest.approx([0.47, 6.8, 42.6], rel=0.01)
    assert "int8" not in like[0] and like[2]["int8"].value == pytest.approx(85, rel=0.01)
    for headline in headlines:
        assert headline.why and headline.counts and headline.datasheet.source.startswith(SOURCE_FORMS)
    assert "sparse" in headlines[2].counts and "FP16" in headlines[0].counts


@pytest.mark.parametrize(
    ("part", "old", "new", "words"),
    [
        ("jetpack.toml", '[releases."6.2"]', '[releases."six"]', ("six",)),
        ("jetpack.toml", '"t4000", "t5000",\n]', '"t4000", "t50000",\n]', ("modules", "t50000")),
        ("jetpack.toml", 'cuda = { text = "12.2"', 'cuda = { txt = "12.2"', ("releases.6.0.cuda", "'text'")),
        (
            "jetpack.toml",
            "onnx_opset = { value = 24",
            "onnx_opset = { value = 24.5",
            ("releases.7.2.onnx_opset", "whole"),
        ),
        ("jetpack.toml", "onnx_opset = { value = 24", "onnx_opset = { value = nan", ("releases.7.2.onnx_opset",)),
        ("headlines.toml", "[headlines.nano-4gb]", "[headlines.nano]", ("nano-4gb",)),
        ("headlines.toml", 'counts = "FP16', 'count = "FP16', ("headlines.nano-4gb", "'counts'")),
        ("cpu_hosts.toml", 'value = 3673, unit = "7-Zip MIPS"', 'value = 3673, unit = "points"', ("epyc-zen4", "unit")),
    ],
)
def test_damaged_tables_are_refused_with_their_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part: str, old: str, new: str, words: tuple[str, ...]
) -> None:
    from robotbrain.jetson.catalogue import load_cpu_hosts

    path = tmp_path / part
    shutil.copy(find_part(part), path)
    monkeypatch.setenv("ROBOTBRAIN_PROFILES", str(tmp_path))
    load = {"jetpack.toml": load_jetpacks, "headlines.toml": load_headlines, "cpu_hosts.toml": load_cpu_hosts}[part]
    assert load()
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(InputError) as caught:
        load()
    for word in words:
        assert word in str(caught.value)


def test_a_module_without_software_is_explained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = find_part("jetpack.toml").read_text(encoding="utf-8")
    (tmp_path / "jetpack.toml").write_text(text.replace('"t4000", ', ""), encoding="utf-8")
    monkeypatch.setenv("ROBOTBRAIN_PROFILES", str(tmp_path))
    with pytest.raises(InputError, match="T4000"):
        newest_jetpack("t4000")
