"""Verifying bundles: any altered byte, truncation, swap or mixture is refused, and so are hostile archives."""

from __future__ import annotations

import gzip
import io
import json
import os
import sys
import tarfile
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from deploy_builders import Files, bundle, files_of, network, put, quantised, reseal
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from robotbrain.errors import InputError
from robotbrain.jetson.deploy import contents, verify_bundle
from robotbrain.jetson.deploy import manifest as manifests
from robotbrain.optimisation import calibrate

FEW = settings(max_examples=30, deadline=None, suppress_health_check=list(HealthCheck))
TOP = "net-orin-nano-8gb-fp16"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Bundles of one network in each form, one of another network and one with a calibration."""
    import numpy as np

    folder = tmp_path_factory.mktemp("bundles")
    model, other = network(folder), network(folder, seed=1, name="other")
    table = calibrate(model, np.random.default_rng(0).normal(size=(4, 3, 16, 16)).astype(np.float32))
    return {
        "folder": bundle(folder, "a", model),
        "tar.gz": bundle(folder, "a.tar.gz", model),
        "zip": bundle(folder, "a.zip", model),
        "other": bundle(folder, "other", other, precision="fp32", mode="7W", seed=5),
        "calibrated": bundle(folder, "c", model, precision="int8", calibration=table),
        "quantised": bundle(folder, "q", quantised(folder), precision="int8"),
    }


@pytest.fixture
def files(made: dict[str, Path]) -> Files:
    return files_of(made["folder"])


def refused(path: Path, word: str = "got") -> str:
    with pytest.raises(InputError, match=word) as caught:
        verify_bundle(path)
    assert caught.value.expected and caught.value.fix
    return str(caught.value)


def test_what_is_right_passes(made: dict[str, Path], tmp_path: Path, files: Files) -> None:
    reports = {name: verify_bundle(path) for name, path in made.items()}
    assert {reports[form].form for form in ("folder", "tar.gz", "zip")} == {"folder", "tar.gz", "zip"}
    assert len({reports[form].sha256 for form in ("folder", "tar.gz", "zip")}) == 1
    assert "TensorRT 10.3" in str(reports["zip"]) and "not a measurement" in str(reports["zip"])
    verify_bundle(put(tmp_path / "copy", reseal(files)))  # so that what is refused below is refused for its edit


@given(st.data())
@FEW
def test_any_flipped_bit_of_a_file_is_refused(made: dict[str, Path], data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(sorted(files_of(made["folder"]))))
    path = made["folder"] / name
    content = path.read_bytes()
    position = data.draw(st.integers(0, 8 * len(content) - 1))
    altered = bytearray(content)
    altered[position // 8] ^= 1 << position % 8
    try:
        path.write_bytes(altered)
        text = refused(made["folder"])
        assert name in text or name == "manifest.sha256"
    finally:
        path.write_bytes(content)


@given(st.data())
@FEW
def test_any_truncation_or_growth_of_a_file_is_refused(made: dict[str, Path], data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(sorted(files_of(made["folder"]))))
    path = made["folder"] / name
    content = path.read_bytes()
    length = data.draw(st.integers(0, len(content) - 1))
    tail = data.draw(st.sampled_from([b"", b"\0" * (len(content) - length), b"\n" + content[length:]]))
    if content[:length] + tail == content:
        return
    try:
        path.write_bytes(content[:length] + tail)
        refused(made["folder"])
    finally:
        path.write_bytes(content)


@pytest.mark.parametrize("form", ["tar.gz", "zip"])
@given(data=st.data())
@FEW
def test_any_altered_archive_is_refused(
    made: dict[str, Path], tmp_path_factory: pytest.TempPathFactory, form: str, data: st.DataObject
) -> None:
    raw = made[form].read_bytes()
    kind = data.draw(st.sampled_from(["flip", "cut", "add"]))
    position = data.draw(st.integers(0, len(raw) - 1))
    altered = {
        "flip": raw[:position] + bytes([raw[position] ^ 1 << position % 8]) + raw[position + 1 :],
        "cut": raw[:position],
        "add": raw + bytes(1 + position % 7),
    }[kind]
    path = tmp_path_factory.mktemp("altered") / "b"
    path.write_bytes(altered)
    refused(path)


def test_every_byte_of_the_archives_heads_and_tails_counts(made: dict[str, Path], tmp_path: Path) -> None:
    for form in ("tar.gz", "zip"):
        raw = made[form].read_bytes()
        for position in (*range(300), *range(len(raw) - 300, len(raw))):
            altered = bytearray(raw)
            altered[position] ^= 0xFF
            (tmp_path / "b").write_bytes(altered)
            refused(tmp_path / "b")


def test_any_file_of_another_bundle_is_refused(made: dict[str, Path], tmp_path: Path, files: Files) -> None:
    other = files_of(made["other"])
    differing = sorted(name for name in files if other[name] != files[name])
    assert {"model.onnx", "manifest.json", "manifest.sha256", "vectors/0_in0.f32"} <= set(differing)
    for name in differing:
        refused(put(tmp_path / name.replace("/", "_"), {**files, name: other[name]}))


def test_files_missing_and_extra(tmp_path: Path, files: Files) -> None:
    for at, name in enumerate(files):
        refused(put(tmp_path / f"without{at}", {n: c for n, c in files.items() if n != name}), "no such file|manifest")
    for at, name in enumerate(["extra", "program/extra.py", "vectors/3_in0.f32"]):
        assert "only files that the manifest names" in refused(put(tmp_path / f"with{at}", {**files, name: b""}))
    for at, name in enumerate([".hidden", "a/b/c.py", "con.txt", "name with space", "Model.onnx", "program/é.py"]):
        refused(put(tmp_path / f"odd{at}", {**files, name: b""}))
    folder = put(tmp_path / "empty", files)
    (folder / "void").mkdir()
    refused(folder, "folder")


EDITS: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "jetpack": (lambda d: d["target"].update(jetpack="6.1"), "target: jetpack"),
    "tensorrt": (lambda d: d["target"].update(tensorrt="8.5"), "target: tensorrt"),
    "jetpack of another module": (lambda d: d["parameters"].update(jetpack="4.6.1"), "JetPack"),
    "module": (lambda d: d["parameters"].update(module="t5000"), "power mode"),
    "module in the target": (lambda d: d["target"].update(module="orin-nx-8gb"), "target: module"),
    "parts": (lambda d: d["target"].update(parts=["3448-0000"]), "target: parts"),
    "mode": (lambda d: d["target"].update(mode="7W"), "target: mode"),
    "opset": (lambda d: d["network"].update(opset=17), "network: opset"),
    "opset range": (lambda d: d["target"].update(newest_opset=99), "newest_opset"),
    "precision": (lambda d: d["parameters"].update(precision="int8"), "precision"),
    "no such precision": (lambda d: d["parameters"].update(precision="int4"), "precision"),
    "shape": (lambda d: d["network"]["inputs"][0].update(shape=[1, 3, 8, 8]), "network: inputs"),
    "batch": (lambda d: d["parameters"].update(batch=0), "batch"),
    "tolerance": (lambda d: d["numerics"].update(rms=1.0), "numerics: rms"),
    "no vectors": (lambda d: d["numerics"].update(vectors=[]), "test vectors"),
    "output renamed": (lambda d: d["numerics"]["vectors"][0].update(outputs={}), "test vectors"),
    "vector elsewhere": (
        lambda d: d["numerics"]["vectors"][0]["inputs"].update(image="../../etc/passwd"), "passwd"),
    "expected of another vector": (
        lambda d: d["numerics"]["vectors"][0]["outputs"]["logits"].update(file="vectors/1_out0.f32"), "error"),
    "label": (lambda d: d["prediction"].update(label="measured"), "prediction"),
    "interval": (lambda d: d["prediction"].update(latency_high_ms=1e-9), "prediction"),
    "deviation": (lambda d: d["preprocessing"].update(std=[0.0, 1.0, 1.0]), "preprocessing"),
    "calibration": (lambda d: d.update(
        calibration={"file": "model.onnx", "method": "m", "network_sha256": "0" * 64, "tensors": 1}), "calibration"),
    "lint": (lambda d: d.update(
        lint={"findings": [{"code": "x", "severity": "warning", "node": "", "message": ""}]}), "lint"),
    "version": (lambda d: d.update(version=2), "version"),
    "schema": (lambda d: d.update(schema="other"), "version"),
    "extra key": (lambda d: d.update(date="now"), "exactly its keys"),
    "missing key": (lambda d: d.pop("lint"), "exactly its keys"),
    "number as text": (lambda d: d["network"].update(opset="13"), "int"),
    "truth as number": (lambda d: d["network"].update(opset=True), "int"),
    "list as object": (lambda d: d.update(files=[]), "object"),
    "digest": (lambda d: d["network"].update(sha256="0"), "form"),
    "shape below nothing": (
        lambda d: d["numerics"]["vectors"][0]["outputs"]["logits"].update(shape=[-1, -4, 16, 16]), "output logits"),
    "shape beyond integers": (
        lambda d: d["numerics"]["vectors"][0]["outputs"]["logits"].update(shape=[2**70]), "shape"),
    "number beyond floats": (
        lambda d: d["prediction"].update(latency_ms=10**400, latency_high_ms=10**400), "latency"),
    "kit that steers the terminal": (lambda d: d.update(kit="\x1b[31m"), "kit"),
    "provenance that steers the terminal": (lambda d: d["prediction"].update(provenance="\x1b[31m"), "provenance"),
}  # fmt: skip


@pytest.mark.parametrize("edit", EDITS)
def test_a_resealed_bundle_whose_parts_do_not_fit_is_refused(tmp_path: Path, files: Files, edit: str) -> None:
    change, word = EDITS[edit]
    refused(put(tmp_path / "b", reseal(files, change)), word)


def test_resealed_parts_of_other_bundles_are_refused(made: dict[str, Path], tmp_path: Path, files: Files) -> None:
    other = files_of(made["other"])

    def adopt(data: dict[str, Any]) -> None:
        data["network"] = json.loads(other["manifest.json"])["network"]

    mixed = {**files, "model.onnx": other["model.onnx"]}
    refused(put(tmp_path / "network", reseal(mixed)), "network: sha256")
    refused(put(tmp_path / "adopted", reseal(mixed, adopt)), "error")
    vectors = {name: content for name, content in other.items() if name.startswith("vectors/0_out")}
    refused(put(tmp_path / "vectors", reseal({**files, **vectors})), "error")
    program = {**files, "program/main.py": files["program/main.py"] + b"\n"}
    refused(put(tmp_path / "program", reseal(program)), "another program")
    refused(put(tmp_path / "extra", reseal({**files, "program/backdoor.py": b""})), "program/backdoor.py")
    # Naming another kit is no way around it; a bundle of another kit with this very program is fine.
    older = reseal(program, lambda d: d.update(kit="0.0.1"))
    assert "Verify with robotbrain 0.0.1" in refused(put(tmp_path / "altered", older), "program/main.py")
    same = reseal(files, lambda d: d.update(kit="0.0.1"))
    assert "made by robotbrain 0.0.1" in verify_bundle(put(tmp_path / "older", same)).notes[0]


def test_a_calibration_of_another_network_is_refused(made: dict[str, Path], tmp_path: Path) -> None:
    files = files_of(made["calibrated"])
    name = "calibration.cache"
    for at, (old, new, word) in enumerate(
        [(b"conv", b"conv", ""), (b"image: ", b"other: ", "calibration"), (b"TRT-", b"XYZ-", "calibration")]
    ):
        folder = put(tmp_path / str(at), reseal({**files, name: files[name].replace(old, new)}))
        if word:
            refused(folder, word)
    shorter = b"\n".join(files[name].splitlines()[:-1]) + b"\n"
    refused(put(tmp_path / "shorter", reseal({**files, name: shorter})), "tensors")


def test_a_precision_that_the_module_lacks_is_refused(made: dict[str, Path], tmp_path: Path) -> None:
    from robotbrain.jetson.deploy.target import target_of

    def move(data: dict[str, Any]) -> None:
        data["parameters"].update(module="nano-4gb", mode="MAXN", jetpack="4.6.1")
        data["target"] = target_of("nano-4gb", "MAXN", "4.6.1")

    refused(put(tmp_path / "b", reseal(files_of(made["calibrated"]), move)), "no INT8")


# ---- hostile ----


@pytest.mark.parametrize(
    "raw",
    [b"", b"{}", b"[" * 100_000 + b"]" * 100_000, b'{"a":' * 50_000, b"1" * 10_000, b"NaN", b"\xff\xfe", b"null",
     b'{"schema": 1, "schema": 2}', b" " * 2_000_000],
)  # fmt: skip
def test_a_manifest_that_is_none(tmp_path: Path, files: Files, raw: bytes) -> None:
    refused(put(tmp_path / "b", {**files, "manifest.json": raw, "manifest.sha256": manifests.digest_line(raw)}))


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.text(), lambda x: st.lists(x) | st.dictionaries(st.text(), x)
    )
)
@FEW
def test_any_other_json_is_refused(tmp_path_factory: pytest.TempPathFactory, value: Any) -> None:
    raw = manifests.to_bytes(value)
    files = {"manifest.json": raw, "manifest.sha256": manifests.digest_line(raw)}
    refused(put(tmp_path_factory.mktemp("json") / "b", files))


def test_a_manifest_in_another_spelling_is_refused(tmp_path: Path, files: Files) -> None:
    raw = files["manifest.json"]
    twice = raw.replace(b'"kit":', b'"kit": "0.0.0",\n "kit":')
    for at, other in enumerate([json.dumps(json.loads(raw)).encode(), raw + b"\n", twice]):
        assert json.loads(other) == json.loads(raw)
        sealed = {**files, "manifest.json": other, "manifest.sha256": manifests.digest_line(other)}
        refused(put(tmp_path / str(at), sealed), "another spelling")


@pytest.mark.skipif(sys.platform == "win32", reason="links and pipes need POSIX here")
def test_links_and_pipes_in_a_folder_are_refused(tmp_path: Path, files: Files) -> None:
    for at, name in enumerate(["model.onnx", "extra"]):
        folder = put(tmp_path / f"link{at}", files)
        (folder / name).unlink(missing_ok=True)
        (folder / name).symlink_to(tmp_path / "elsewhere")
        (tmp_path / "elsewhere").write_bytes(files["model.onnx"])
        refused(folder, "link")
    folder = put(tmp_path / "dir", {n: c for n, c in files.items() if not n.startswith("vectors/")})
    put(tmp_path / "outside", {"x": b""})
    (folder / "vectors").symlink_to(tmp_path / "outside")
    refused(folder, "link")
    folder = put(tmp_path / "pipe", files)
    os.mkfifo(folder / "pipe")
    refused(folder, "link or device")  # and it does not wait for a writer


def tar_of(members: list[tuple[tarfile.TarInfo, bytes]]) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for member, content in members:
            member.size = len(content)
            tar.addfile(member, io.BytesIO(content))
    return gzip.compress(buffer.getvalue(), 0, mtime=0)


def member(name: str, kind: bytes = tarfile.REGTYPE, link: str = "") -> tarfile.TarInfo:
    info = tarfile.TarInfo(name)
    info.type, info.linkname = kind, link
    return info


@pytest.mark.parametrize(
    "name", ["../x", "/etc/x", "b/../../x", "b/./x", "b//x", "C:/x", "b/x\\y", "x", "b/.x", "b/a/b/c"]
)
def test_names_that_leave_the_folder_are_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "t.tar.gz").write_bytes(tar_of([(member(name), b"x")]))
    refused(tmp_path / "t.tar.gz")
    with zipfile.ZipFile(tmp_path / "z.zip", "w") as archive:
        entry = zipfile.ZipInfo(name)
        entry.external_attr = 0o100644 << 16
        archive.writestr(entry, b"x")
    refused(tmp_path / "z.zip")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["t.tar.gz", "z.zip"]


@pytest.mark.parametrize(
    "kind",
    [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.FIFOTYPE, tarfile.DIRTYPE, tarfile.GNUTYPE_SPARSE],
)
def test_members_that_are_no_files_are_refused(tmp_path: Path, kind: bytes) -> None:
    (tmp_path / "t.tar.gz").write_bytes(tar_of([(member("b/x", kind, "/etc/passwd"), b"")]))
    refused(tmp_path / "t.tar.gz")


def test_links_in_a_zip_and_names_given_twice_are_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "z.zip", "w") as archive:
        entry = zipfile.ZipInfo("b/x")
        entry.external_attr = 0o120777 << 16
        archive.writestr(entry, b"/etc/passwd")
    refused(tmp_path / "z.zip", "links")
    (tmp_path / "t.tar.gz").write_bytes(tar_of([(member("b/x"), b"1"), (member("b/x"), b"2")]))
    refused(tmp_path / "t.tar.gz", "once")
    (tmp_path / "u.tar.gz").write_bytes(tar_of([(member("b/x"), b"1"), (member("c/y"), b"2")]))
    refused(tmp_path / "u.tar.gz", "one folder")
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.GNU_FORMAT) as tar:  # which has names of any length
        tar.addfile(member("b" * 300 + "/x"))
    (tmp_path / "long.tar.gz").write_bytes(gzip.compress(buffer.getvalue(), 0, mtime=0))
    refused(tmp_path / "long.tar.gz", "plain names")
    (tmp_path / "v.tar.gz").write_bytes(tar_of([(member(f"b/{at}"), b"") for at in range(65)]))
    refused(tmp_path / "v.tar.gz", "64")


def test_archives_that_unpack_to_more_than_themselves_are_refused(tmp_path: Path) -> None:
    zeros = bytes(1 << 20)
    packer = zlib.compressobj(9, wbits=31)
    with (tmp_path / "bomb.tar.gz").open("wb") as file:
        for _ in range(40):
            file.write(packer.compress(zeros))
        file.write(packer.flush())
    refused(tmp_path / "bomb.tar.gz", "more than its size")
    with (
        zipfile.ZipFile(tmp_path / "bomb.zip", "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("b/model.onnx", "w") as entry,
    ):
        for _ in range(40):
            entry.write(zeros)
    refused(tmp_path / "bomb.zip", "own size")


def test_a_tar_that_claims_a_huge_member_is_refused(tmp_path: Path) -> None:
    info = member("b/model.onnx")
    info.size = 8 * 1024**3 - 1
    raw = gzip.compress(info.tobuf(tarfile.USTAR_FORMAT) + bytes(10240), 0, mtime=0)
    (tmp_path / "t.tar.gz").write_bytes(raw)
    refused(tmp_path / "t.tar.gz")


def test_a_bundle_packed_by_another_program_says_what_to_do(tmp_path: Path, files: Files) -> None:
    with zipfile.ZipFile(tmp_path / "z.zip", "w") as archive:
        for name, content in files.items():
            entry = zipfile.ZipInfo(f"{TOP}/{name}", (2026, 1, 1, 0, 0, 0))
            entry.external_attr = 0o100644 << 16
            archive.writestr(entry, content)
    assert "unpack it yourself and give the folder" in refused(tmp_path / "z.zip")


@pytest.mark.parametrize("content", [b"", b"PK", b"PK\x03\x04" + bytes(50), b"\x1f\x8b", b"text", bytes(2000)])
def test_files_that_are_no_archive(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "b").write_bytes(content)
    refused(tmp_path / "b")
    refused(tmp_path / "missing", "path")


@given(
    st.dictionaries(
        st.from_regex(r"[a-z]{1,8}(/[a-z]{1,8})?", fullmatch=True), st.binary(max_size=300), min_size=1, max_size=8
    )
)
@FEW
def test_what_is_packed_is_what_is_read(tmp_path_factory: pytest.TempPathFactory, files: Files) -> None:
    names = set(files)
    if any(name.partition("/")[0] in names and "/" in name for name in names) or any(
        contents._DEVICES.match(name) for name in names
    ):
        return
    folder = tmp_path_factory.mktemp("packed")
    for out in ("a.tar.gz", "a.zip", "a"):
        path = contents.write(folder / out, files, "top")
        assert contents.read(path).files == files


def test_the_gzip_writer_against_the_standard_library() -> None:
    for size in (0, 1, 65535, 65536, 200_000):
        data = os.urandom(size)
        assert gzip.decompress(contents._gzip(data)) == data
