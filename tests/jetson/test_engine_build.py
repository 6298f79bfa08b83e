"""Plans are built as each version wants it, kept, found again, and refused where they do not belong."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

import onnx
import pytest
from tests.jetson.engine_models import images, write

from robotbrain.errors import InputError
from robotbrain.jetson.engine import TensorRTEngine, plan
from robotbrain.jetson.engine.build import BuildOptions, build_plan
from robotbrain.jetson.engine.runtime import TensorRTRuntime
from robotbrain.jetson.engine.simulated import VERSIONS, simulated_runtime
from robotbrain.jetson.engine.tensorrt_engine import find_or_build


def header(built: bytes) -> Any:
    return json.loads(built.split(b"\n")[1])


def build(path: Path, version: str, precision: str | None = None, **more: Any) -> Any:
    return header(build_plan(path, BuildOptions(precision), simulated_runtime(version), **more)[0])


@pytest.mark.parametrize("version", VERSIONS)
def test_precision_flags_where_they_exist_and_strong_types_where_not(tmp_path: Path, version: str) -> None:
    plain, half = write(tmp_path / "plain.onnx"), write(tmp_path / "half.onnx", half=True)
    quantised = write(tmp_path / "q.onnx", quantised=True)
    both = write(tmp_path / "both.onnx", quantised=True, half=True)
    new = version.startswith("11")
    expected: dict[tuple[Path, str | None], tuple[list[str], bool]] = {
        (plain, "fp32"): ([], new),
        (half, "fp16"): ([] if new else ["FP16"], new),
        (quantised, "int8"): ([] if new else ["FP16", "INT8"], new),
    }
    typed = not version.startswith("8")
    for path, flags in ((plain, []), (half, ["FP16"]), (quantised, ["INT8"]), (both, ["FP16", "INT8"])):
        expected[path, None] = ([] if typed else flags, typed)
    for (path, precision), (flags, strong) in expected.items():
        found = build(path, version, precision)
        assert (found["flags"], found["strongly_typed"]) == (flags, strong), (path.name, precision)
    if not new:
        assert build(plain, version, "fp16")["flags"] == ["FP16"]


@pytest.mark.parametrize(
    ("made", "precision", "versions", "words"),
    [
        ({}, "int8", VERSIONS, "no Q/DQ.*calibrators"),
        ({"quantised": True}, "fp16", VERSIONS, "Ask for int8"),
        ({"quantised": True}, "fp32", VERSIONS, "Ask for int8"),
        ({"half": True}, "fp32", VERSIONS, "Ask for fp16"),
        ({}, "fp16", ["11.0"], "autocast"),
        ({"quantised": True, "zero_point": 3}, None, VERSIONS, "zero points other than 0"),
        ({"operator": "Strange"}, None, VERSIONS, "nobody.knows:Strange"),
    ],
)
def test_files_that_do_not_carry_the_precision_are_explained(
    tmp_path: Path, made: dict[str, Any], precision: str | None, versions: list[str], words: str
) -> None:
    path = write(tmp_path / "m.onnx", **made)
    for version in versions:
        with pytest.raises(InputError, match=rf"(?s){words}"):
            build(path, version, precision)


def test_parser_errors_name_the_node(tmp_path: Path) -> None:
    path = write(tmp_path / "m.onnx", operator="Strange")
    for version, words in (("8.6", "node 2: "), ("10.3", r"node 2 strange \(Strange\): ")):
        with pytest.raises(InputError, match=words):
            build(path, version)
    bad = tmp_path / "bad.onnx"
    bad.write_bytes(b"this is no network")
    with pytest.raises(InputError, match="could not be read"):
        build(bad, "10.3")


def test_the_profile_covers_the_batches(tmp_path: Path) -> None:
    path = write(tmp_path / "m.onnx")
    options = BuildOptions(max_batch=16, best_batch=2)
    shapes = header(build_plan(path, options, simulated_runtime("10.3"))[0])["profile"]["image"]
    assert [shape[0] for shape in shapes] == [1, 2, 16] and {tuple(shape[1:]) for shape in shapes} == {(3, 6, 6)}
    fixed = write(tmp_path / "fixed.onnx", batch=3)
    assert header(build_plan(fixed, options, simulated_runtime("10.3"))[0])["profile"] == {}


@pytest.mark.parametrize("wrong", [{"max_batch": 0}, {"best_batch": 9}, {"workspace_bytes": 1}, {"precision": "fp8"}])
def test_impossible_options_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        BuildOptions(**wrong)


def test_progress_is_told_where_tensorrt_tells_it_and_can_cancel(tmp_path: Path) -> None:
    path = write(tmp_path / "m.onnx")
    for version in VERSIONS:
        told: list[tuple[str, int, int]] = []
        build(path, version, progress=lambda *step, told=told: told.append(step))
        steps = [done for _, done, _ in told]
        assert (steps == sorted(steps) and told[-1][1] == told[-1][2] > 0) if told else version.startswith("8")
    with pytest.raises(InputError, match="cancelled"):
        build(path, "10.3", progress=lambda *_: False)


def test_the_timing_cache_is_used_again_and_renewed_after_an_update(tmp_path: Path) -> None:
    path = write(tmp_path / "m.onnx")
    runtime = simulated_runtime("10.3")
    _, cache = build_plan(path, BuildOptions(), runtime)
    assert build_plan(path, BuildOptions(), runtime, timing_cache=cache)[1] == cache
    newer = build_plan(path, BuildOptions(), simulated_runtime("10.13"), timing_cache=cache)[1]
    assert newer and newer != cache


# ---------------------------------------------------------------- the cache of plans


class Counting:
    """Counts builds."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.builds = 0

        def counted(*arguments: Any, **more: Any) -> Any:
            self.builds += 1
            return build_plan(*arguments, **more)

        monkeypatch.setattr("robotbrain.jetson.engine.tensorrt_engine.build_plan", counted)


def test_a_plan_is_built_once_for_everything_that_it_depends_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counting, folder = Counting(monkeypatch), tmp_path / "plans"
    path, options, runtime = write(tmp_path / "m.onnx"), BuildOptions(), simulated_runtime("10.3")

    def get(path: Path = path, options: BuildOptions = options, runtime: TensorRTRuntime = runtime) -> Path:
        return find_or_build(path, options, folder, runtime)

    first = get()
    assert get() == first and counting.builds == 1
    others = [
        get(options=dataclasses.replace(options, max_batch=2)),
        get(options=dataclasses.replace(options, precision="fp16")),
        get(options=dataclasses.replace(options, workspace_bytes=1 << 27)),
        get(runtime=simulated_runtime("10.13")),
        get(runtime=simulated_runtime("10.3", device="simulated other GPU")),
    ]
    write(path, seed=5)
    others.append(get())
    assert len({first, *others}) == 7 and counting.builds == 7
    assert len({get(), others[-1]}) == 1 and counting.builds == 7


def test_a_folder_that_cannot_be_written_to_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way", encoding="utf-8")
    with pytest.raises(InputError, match=r"folder for plans.*cache="):
        find_or_build(write(tmp_path / "m.onnx"), BuildOptions(), tmp_path / "file", simulated_runtime("10.3"))


@pytest.mark.parametrize("damage", ["truncated", "sidecar gone", "sidecar damaged", "sidecar of another"])
def test_a_damaged_plan_is_built_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, damage: str) -> None:
    counting, path, runtime = Counting(monkeypatch), write(tmp_path / "m.onnx"), simulated_runtime("10.3")
    found = find_or_build(path, BuildOptions(), tmp_path, runtime)
    sidecar = found.with_name(found.name + ".json")
    if damage == "truncated":
        found.write_bytes(found.read_bytes()[:-1])
    elif damage == "sidecar gone":
        sidecar.unlink()
    else:
        text = sidecar.read_text(encoding="utf-8")
        sidecar.write_text("{" if damage == "sidecar damaged" else text.replace("10.3.0", "10.4.0"), encoding="utf-8")
    assert find_or_build(path, BuildOptions(), tmp_path, runtime) == found and counting.builds == 2
    with TensorRTEngine(found, runtime=runtime) as engine:
        assert engine.infer(images(1)).shape == (1, 4)


def test_a_kept_plan_that_no_longer_loads_is_built_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An update of CUDA or the driver leaves TensorRT's version, and so the plan's name, as it was."""
    counting, path, runtime = Counting(monkeypatch), write(tmp_path / "m.onnx"), simulated_runtime("10.3")
    with TensorRTEngine(path, cache=tmp_path, runtime=runtime) as engine:
        right, found = engine.infer(images(2)), engine.plan_path
    info, _ = plan.read_sidecar(found)
    plan.put(tmp_path, "m", info, b"of another driver")
    with TensorRTEngine(path, cache=tmp_path, runtime=runtime) as engine:
        assert (engine.infer(images(2)) == right).all() and engine.plan_path == found
    assert counting.builds == 2
    with TensorRTEngine(path, cache=tmp_path, runtime=runtime) as engine:
        assert counting.builds == 2


def test_weights_in_another_file_are_part_of_what_a_plan_is_of(tmp_path: Path) -> None:
    runtime, path = simulated_runtime("10.3"), tmp_path / "m.onnx"
    answers = []
    for seed in (0, 1):
        model = onnx.load(write(tmp_path / "whole.onnx", seed=seed))
        (tmp_path / "any name.bin").unlink(missing_ok=True)
        onnx.save(model, path, save_as_external_data=True, location="any name.bin", size_threshold=0)
        with TensorRTEngine(path, cache=tmp_path, runtime=runtime) as engine:
            answers.append(engine.infer(images(1)))
    assert not (answers[0] == answers[1]).all()
    whole = tmp_path / "whole.onnx"
    assert plan.onnx_digest(whole) == hashlib.sha256(whole.read_bytes()).hexdigest()  # as a manifest has it


def test_a_plan_from_elsewhere_is_refused_with_the_reason(tmp_path: Path) -> None:
    runtime = simulated_runtime("10.3")
    found = find_or_build(write(tmp_path / "m.onnx"), BuildOptions(), tmp_path, runtime)
    newer, other = simulated_runtime("10.13"), simulated_runtime("10.3", device="simulated other GPU")
    for elsewhere, words in ((newer, "TensorRT 10.3.0"), (other, "another GPU")):
        with pytest.raises(InputError, match=words):
            TensorRTEngine(found, runtime=elsewhere)
    bare = tmp_path / "bare.engine"  # without a sidecar TensorRT itself has to say it
    bare.write_bytes(found.read_bytes())
    with TensorRTEngine(bare, runtime=runtime) as engine:
        assert engine.infer(images(8)).shape == (8, 4)
    for elsewhere, words in ((newer, "version 10.3.0"), (other, "simulated GPU")):
        with pytest.raises(InputError, match=rf"{words}.*Plans do not travel"):
            TensorRTEngine(bare, runtime=elsewhere)
    found.write_bytes(found.read_bytes() + b"x")
    with pytest.raises(InputError, match="checksum"):
        TensorRTEngine(found, runtime=runtime)


def test_a_simulated_plan_never_passes_for_a_genuine_one(tmp_path: Path) -> None:
    found = find_or_build(write(tmp_path / "m.onnx"), BuildOptions(), tmp_path, simulated_runtime("10.3"))
    info, _ = plan.read_sidecar(found)
    assert info.simulated and b"simulated" in found.read_bytes()[:20]
    with pytest.raises(InputError, match="simulated runtime"):
        plan.check_fits(found, info.tensorrt, info.device, simulated=False)
    assert plan.find(tmp_path, "m", dataclasses.replace(info, simulated=False)) is None
