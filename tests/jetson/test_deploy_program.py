"""The board's program by its parts: the Pythons of all JetPacks, flags for every TensorRT, what it compares."""

from __future__ import annotations

import ast
import math
import shutil
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from board_stand_ins import StandInBoard
from deploy_builders import bundle
from hypothesis import given, settings
from hypothesis import strategies as st
from test_measure_board import JP5_NANO, plant

from robotbrain.jetson.deploy.bundle import programs
from robotbrain.jetson.deploy.program import engine, jetson, numerics, trtexec
from robotbrain.jetson.deploy.program.problem import Refused
from robotbrain.jetson.deploy.target import target_of
from robotbrain.jetson.measure import board as boards
from robotbrain.jetson.measure.command import Capabilities, Request, build_command
from robotbrain.jetson.measure.trtexec import version_of

PYTHON = {name: text.decode() for name, text in programs().items() if name.endswith(".py")}
NEWER = {
    *("removeprefix", "removesuffix", "is_relative_to", "capture_output", "missing_ok", "monotonic_ns", "readlink"),
    *("dataclasses", "zoneinfo", "tomllib", "cached_property", "nullcontext", "fromisoformat", "dirs_exist_ok"),
    *("TypedDict", "Protocol", "Literal", "Final", "pairwise", "reconfigure", "prod", "with_stem", "isascii"),
}
"""Names of Python's library that came after 3.6 and that one would reach for here."""


def test_it_runs_on_the_oldest_python_of_a_jetpack() -> None:
    assert {"board.py", "program/main.py", "program/__init__.py"} <= PYTHON.keys()
    standard = sys.stdlib_module_names
    for name, text in PYTHON.items():
        tree = ast.parse(text, name, feature_version=(3, 6))
        for node in ast.walk(tree):
            words = {getattr(node, key, None) for key in ("attr", "id", "arg", "name", "module")}
            assert not {word for word in words if isinstance(word, str)} & NEWER, name
            if isinstance(node, ast.ImportFrom):
                assert node.level or (node.module in {*standard, "program.main"} and node.module != "__future__"), name
            if isinstance(node, ast.Import):
                assert {alias.name for alias in node.names} <= standard, name  # neither the kit nor numpy
            # Evaluated when the function is defined: no X | None, no list[int] there before 3.10 and 3.9.
            for annotation in (getattr(node, "annotation", None), getattr(node, "returns", None)):
                assert annotation is None or isinstance(annotation, ast.Constant | ast.Name | ast.Attribute), name


def test_the_scripts_are_plain_shell() -> None:
    scripts = {name: text for name, text in programs().items() if name.endswith(".sh")}
    assert set(scripts) == {"run.sh", "measure.sh"}
    for shell in filter(shutil.which, ("sh", "dash", "bash", "busybox")):
        words = [shell, "sh"] if shell == "busybox" else [shell]
        for text in scripts.values():
            assert text.startswith(b"#!/bin/sh\n") and b"\r" not in text
            subprocess.run([*words, "-n"], input=text, check=True, timeout=30)


def pythons() -> list[str]:
    """Return other Pythons on this machine, by PATH and by pyenv: one of each minor version from 3.6."""
    found: dict[int, str] = {}
    for minor in range(6, 15):
        named = [shutil.which(f"python3.{minor}") or ""]
        named += map(str, sorted(Path.home().glob(f".pyenv/versions/3.{minor}.*/bin/python")))
        for path in filter(None, reversed(named)):
            try:
                subprocess.run([path, "-c", "import argparse"], check=True, capture_output=True, timeout=30)
            except (OSError, subprocess.SubprocessError):
                continue
            found[minor] = path
            break
    return [found[minor] for minor in sorted(found) if minor != sys.version_info[1]]


@pytest.mark.skipif(sys.platform == "win32", reason="the stand-ins are POSIX scripts")
def test_it_runs_under_the_pythons_that_are_here(tmp_path: Path) -> None:
    others = pythons()
    if not others:
        pytest.skip("no Python but the one that runs the tests; the syntax is checked above")
    path = bundle(tmp_path)
    (tmp_path / "board").mkdir()
    board = StandInBoard(tmp_path / "board")
    for at, python in enumerate([others[0], others[-1]] if len(others) > 1 else others):
        words = ("--runs", "1", "--duration", "1", "--work", str(tmp_path / f"work{at}"))
        done = board.run(path, *words, PYTHON=python)
        assert (done.returncode, done.stderr) == (0, ""), python


# ---- flags ----

SETS = {
    "8.0": ("8001", "onnx explicitBatch workspace fp16 int8 calib shapes buildOnly useCudaGraph timingCacheFile"),
    "8.2": ("8201", "onnx explicitBatch workspace fp16 int8 calib shapes buildOnly useCudaGraph timingCacheFile"),
    "8.5": ("8502", "onnx workspace memPoolSize fp16 int8 calib shapes buildOnly useCudaGraph timingCacheFile"),
    "10.3": (
        "100300",
        "onnx memPoolSize fp16 int8 calib shapes skipInference useCudaGraph timingCacheFile stronglyTyped",
    ),
    "11.0": ("110000", "onnx memPoolSize shapes skipInference useCudaGraph timingCacheFile"),
}
ALWAYS = "iterations duration warmUp avgRuns percentile useSpinWait noDataTransfers saveEngine loadEngine"


def of(name: str) -> trtexec.Trtexec:
    number, options = SETS[name]
    version = trtexec._version(f"&&&& RUNNING TensorRT.trtexec [TensorRT v{number}] # trtexec --help")
    assert version == version_of(int(number))
    return trtexec.Trtexec("trtexec", version, frozenset(f"{options} {ALWAYS}".split()), name not in ("8.0", "8.2"))


def manifest(precision: str, *, half: bool = False, quantised: bool = False, dynamic: bool = True) -> dict[str, Any]:
    inputs = [{"name": "image", "dtype": "float32", "shape": [1, 3, 8, 8]}]
    network = {"half": half, "quantised": quantised, "dynamic": dynamic, "inputs": inputs}
    return {"parameters": {"precision": precision}, "network": network, "calibration": None}


@pytest.mark.parametrize("precision", ["fp32", "fp16", "int8"])
@pytest.mark.parametrize("name", ["8.0", "8.2", "8.5", "10.3"])
def test_flags_are_those_that_the_kit_measures_with(name: str, precision: str) -> None:
    program = of(name)
    able = Capabilities(program.version, program.options, program.percentiles)
    request = Request("m.onnx", precision, {"image": (1, 3, 8, 8)}, cuda_graph=True)
    kit = build_command(["trtexec"], able, request)[1:]
    data = manifest(precision, quantised=precision == "int8")
    ours = [*trtexec.build_flags(program, data), *trtexec.time_flags(program, data, 10, True)]
    assert set(ours) == set(kit) - {"--onnx=m.onnx"}
    assert {word.partition("=")[0][2:] for word in ours} <= program.options
    assert ("--workspace=1024" in ours) == (name in ("8.0", "8.2"))


def test_flags_of_strongly_typed_networks() -> None:
    assert "--stronglyTyped" in trtexec.build_flags(of("10.3"), manifest("fp16", half=True))
    assert "--fp16" in trtexec.build_flags(of("8.5"), manifest("fp16", half=True))
    for data in (manifest("fp32"), manifest("fp16", half=True), manifest("int8", quantised=True)):
        assert trtexec.build_flags(of("11.0"), data) == ["--shapes=image:1x3x8x8"]
    for precision in ("fp16", "int8"):
        with pytest.raises(Refused, match="an ONNX that carries it"):
            trtexec.build_flags(of("11.0"), manifest(precision))
    with pytest.raises(Refused, match="useCudaGraph"):
        program = of("10.3")
        trtexec.time_flags(program._replace(options=program.options - {"useCudaGraph"}), manifest("fp32"), 1, True)


def test_shapes_are_given_only_where_the_onnx_leaves_them_open() -> None:
    data = manifest("fp32", dynamic=False)
    assert trtexec.build_flags(of("10.3"), data) == []
    data = manifest("fp32")
    data["network"]["inputs"][0]["name"] = "input:0"
    assert trtexec.shape_flags(data["network"]) == ["--shapes='input:0':1x3x8x8"]


@pytest.mark.parametrize(("name", "line"), [("8.2", "TRT-8201-"), ("10.3", "TRT-100300-")])
def test_a_calibration_cache_gets_the_first_line_of_the_boards_tensorrt(tmp_path: Path, name: str, line: str) -> None:
    (tmp_path / "cache").write_text("TRT-8500-MinMaxCalibration\nimage: 3c000000\n")
    found = engine._calibration(of(name), tmp_path / "cache", tmp_path / "out").read_text()
    assert found == line + "EntropyCalibration2\nimage: 3c000000\n"


def test_everything_that_an_engine_depends_on_is_in_its_key() -> None:
    data = {
        **manifest("fp16"),
        "target": {"module": "orin-nano-8gb", "mode": "15W"},
        "files": {"calibration.cache": {"sha256": "c"}},
    }
    data["network"]["sha256"] = "n"
    board: dict[str, Any] = {"tensorrt_package": "10.3.0.30", "jetson_linux": "36.4.3", "parts": ["3767-0005"]}

    def key(program: str = "10.3", board: dict[str, Any] = board, **changes: Any) -> str:
        return engine.key_of(engine.made_of(of(program), {**data, **changes}, board))

    keys = [
        key(),
        key("8.5"),
        key(network={**data["network"], "sha256": "other"}),
        key(parameters={"precision": "fp32"}),
        key(calibration={"file": "calibration.cache"}),
        key(target={"module": "orin-nano-4gb", "mode": "15W"}),
        key(target={"module": "orin-nano-8gb", "mode": "7W"}),
        key(board={**board, "jetson_linux": "36.4.4"}),
        key(board={**board, "tensorrt_package": "10.3.0.31"}),
        key(board={**board, "parts": ["3767-0003"]}),
    ]
    assert len(set(keys)) == len(keys) and key() == keys[0]


# ---- the board ----


@pytest.mark.parametrize(
    ("compatible", "files"),
    [
        (JP5_NANO, {}),
        ("nvidia,p3737-0000+p3701-0000\0nvidia,tegra234\0", {"ids": "3701-0004-500-J.0 3737-0000-TS4\0"}),
        ("nvidia,p4071-0000+p3834-0008\0nvidia,p3834-0008\0nvidia,tegra264\0", {}),
        ("nvidia,p3449-0000-b00+p3448-0000-b00\0nvidia,jetson-nano\0nvidia,tegra210\0", {}),
        ("nvidia,p2972-0000+p2888-0001\0nvidia,tegra194\0", {"memory": "MemTotal:       32692908 kB\n"}),
        ("nvidia,p2972-0000+p2888-0001\0nvidia,tegra194\0", {"memory": "MemTotal:       16692908 kB\n"}),
        ("raspberrypi,4-model-b\0brcm,bcm2711\0", {}),
    ],
)
@pytest.mark.parametrize(
    "module", ["orin-nano-8gb", "orin-nano-8gb-super", "agx-orin-32gb", "t5000", "agx-xavier-32gb"]
)
def test_it_knows_a_board_as_the_kit_does(tmp_path: Path, compatible: str, files: dict[str, str], module: str) -> None:
    root = plant(tmp_path, compatible, model="NVIDIA Jetson\0" if "nvidia" in compatible else "Pi\0", **files)
    kit, found = boards.read_board(root), jetson.read_board(root)
    assert tuple(found["parts"]) == kit.parts
    slug = (kit.slug or "").removesuffix("-super")
    if slug == module.removesuffix("-super"):
        assert jetson.check_board(found, target_of(module, None, None))  # notes: Jetson Linux was not checked
    else:
        with pytest.raises(Refused, match=r"module|machine"):
            jetson.check_board(found, target_of(module, None, None))


# ---- numerics ----


@given(
    st.sampled_from([(1, 4, 2, 2), (2, 3), (1, 1, 5), (7,), (2, 3, 1, 4)]),
    st.integers(0, 2**32 - 1),
    st.floats(0, 2, allow_subnormal=False),
)
@settings(max_examples=60, deadline=None)
def test_errors_are_those_of_numpy(shape: tuple[int, ...], seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    right = rng.normal(size=shape).astype(np.float32)
    found = right + scale * rng.normal(size=shape)
    row = numerics.compare(found.ravel().tolist(), right.tobytes(), list(shape))
    error = found - right
    assert math.isclose(row["rms"], np.sqrt(np.mean(error**2) / np.mean(right.astype(float) ** 2)), rel_tol=1e-9)
    assert math.isclose(row["peak"], np.abs(error).max() / np.abs(right).max(), rel_tol=1e-9)
    same = np.mean(found.argmax(1) == right.argmax(1)) if len(shape) > 1 else 1.0
    assert math.isclose(row["agreement"], same, rel_tol=1e-9)


def test_outputs_as_trtexec_writes_them(tmp_path: Path) -> None:
    path = tmp_path / "o.json"
    path.write_text(
        '[\n  { "name" : "nan"\n  , "dimensions" : "1x4"\n  , "values" : [ 1.5, -2e-05, -nan, inf ]\n  }\n]\n'
    )
    values = numerics.read_outputs(path)["nan"]
    assert values[:2] == [1.5, -2e-05] and not any(map(math.isfinite, values[2:]))
    with pytest.raises(Refused, match="finite"):
        numerics.compare(values, struct.pack("<4f", 1, 2, 3, 4), [1, 4])
    with pytest.raises(Refused, match="4 values"):
        numerics.compare(values, struct.pack("<3f", 1, 2, 3), [1, 3])
    for text in ("", "[", "{}", '[{"name": "a"}]', '[{"name": "a", "values": ["x"]}]', "[" * 5000):
        path.write_text(text)
        if text != "{}":
            with pytest.raises(Refused, match="exportOutput"):
                numerics.read_outputs(path)


def test_each_tolerance_is_judged() -> None:
    allowed = {"rms": 0.1, "peak": 0.2, "agreement": 0.9}
    right = {"output": "o", "vector": 0, "rms": 0.1, "peak": 0.2, "agreement": 0.9, "positions": 100}
    numerics.judge(right, allowed)
    for name, value in (("rms", 0.11), ("peak", 0.21), ("agreement", 0.89)):
        with pytest.raises(Refused, match=name):
            numerics.judge({**right, name: value}, allowed)


def test_a_tie_in_one_place_is_no_other_network() -> None:
    """A classifier or a policy has one position: rounding may turn it without anything being wrong."""
    allowed = {"rms": 0.1, "peak": 0.2, "agreement": 0.97}
    right, turned = struct.pack("<4f", 1.0, 1.001, -3.0, 0.5), [1.001, 1.0, -3.0, 0.5]
    numerics.judge({**numerics.compare(turned, right, [1, 4]), "output": "o", "vector": 0}, allowed)
    row = numerics.compare(turned * 2, right * 2, [2, 4])
    assert (row["positions"], row["agreement"]) == (2, 0.0)
    with pytest.raises(Refused, match="agreement"):
        numerics.judge({**row, "output": "o", "vector": 0}, allowed)


def test_a_single_number_is_compared() -> None:
    assert numerics.compare([1.5], struct.pack("<f", 1.0), [])["rms"] == 0.5
