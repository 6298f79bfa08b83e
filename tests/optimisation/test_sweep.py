"""Sweeps: whole rows, one truth after an interruption, and no promise for a module that could not run the file."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from robotbrain.errors import InputError, RobotBrainError
from robotbrain.jetson import predict
from robotbrain.optimisation import evaluate, latency, networks
from robotbrain.optimisation.evaluate import mean_iou
from robotbrain.optimisation.latency import HostLatency
from robotbrain.optimisation.recipe import Recipe
from robotbrain.optimisation.sweep import Sweep, front_of, host_figures, latency_of, load_rows
from tests.optimisation import tiny

RECIPES = [
    Recipe(student=4, distil=False),
    Recipe(student=4, distil=False, quantise="ptq"),
    Recipe(student=4, distil=False, sparsity=0.5),
]
TIMED = ("host_ms", "host_speedup", "host_clock", "training_seconds")


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder, before = tiny.make_weights(tmp_path_factory.mktemp("weights")), networks.WEIGHTS
    networks.WEIGHTS = folder
    yield folder
    networks.WEIGHTS = before


def sweep_of(folder: Path, recipes: list[Recipe] = RECIPES, **options: Any) -> Sweep:
    options = {"validation": tiny.noise(4, 3), "rounds": 1, "workshop": tiny.workshop(folder)} | options
    return Sweep(recipes, ("nano-4gb", "orin-nano-8gb"), folder, **options)


@pytest.fixture(scope="module")
def whole(weights: Path, tmp_path_factory: pytest.TempPathFactory) -> Sweep:
    """A sweep that nobody interrupted."""
    sweep = sweep_of(tmp_path_factory.mktemp("whole"))
    sweep.run(progress=False)
    return sweep


def untimed(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows without what a clock says, and without the key of measurements."""
    return [{name: value for name, value in row.items() if name not in TIMED} for row in rows]


def test_rows_hold_what_was_measured_and_predicted(whole: Sweep) -> None:
    rows = load_rows(whole.out)
    assert [row["label"] for row in rows] == ["teacher", *(r.label for r in RECIPES)]
    scenes = tiny.noise(4, 3)
    for row in rows:
        path = whole.out / row["onnx"]
        expected = mean_iou(path, scenes, optimise=row["precision"] == "fp32").mean
        assert row["mean_iou"] == pytest.approx(expected, abs=1e-6)
        assert row["drop"] == pytest.approx(100 * (rows[0]["mean_iou"] - row["mean_iou"]), abs=1e-3)
        assert row["host_ms"] > 0 and row["size_bytes"] == path.stat().st_size
        for module, figures in row["twin"].items():
            for precision, figure in figures.items():
                prediction = predict(path, module, precision=precision)
                assert figure["latency_ms"] == pytest.approx(prediction.latency_ms, abs=1e-5)
                assert figure["energy_mj"] == pytest.approx(prediction.energy_mj, abs=1e-4)
                assert row["twin_ms"][module] <= figure["latency_ms"]
    assert rows[3]["sparsity"] == pytest.approx(0.5, abs=0.01)


def test_a_module_without_int8_gets_no_figure_for_an_int8_file(whole: Sweep) -> None:
    rows = load_rows(whole.results)
    int8 = rows[2]
    assert int8["precision"] == "int8" and int8["twin"]["nano-4gb"] == {}
    assert latency_of(int8, "nano-4gb") is None and int8["energy_mj"]["nano-4gb"] is None
    assert set(int8["twin"]["orin-nano-8gb"]) == {"int8"}
    assert set(rows[0]["twin"]["nano-4gb"]) == {"fp32", "fp16"}
    assert int8["label"] not in [row["label"] for row in front_of(rows, "nano-4gb")]


def test_zeros_change_neither_the_twin_nor_the_file_but_the_compressed_one(whole: Sweep) -> None:
    _, dense, _, sparse = load_rows(whole.out)
    assert sparse["twin"] == dense["twin"] and sparse["size_bytes"] == dense["size_bytes"]
    assert sparse["gzip_bytes"] < 0.75 * dense["gzip_bytes"]


def test_int8_is_judged_without_the_fused_kernels_that_saturate(whole: Sweep, monkeypatch: pytest.MonkeyPatch) -> None:
    judged = {}

    def spy(path: Path, scenes: Any, *, optimise: bool) -> Any:
        judged[path.stem] = optimise
        return mean_iou(path, scenes, optimise=optimise)

    monkeypatch.setattr(evaluate, "mean_iou", spy)
    sweep_of(whole.out, RECIPES[1:2]).run(resume=False, progress=False)
    assert judged == {"teacher": True, RECIPES[1].slug: False}
    sweep_of(whole.out).run(progress=False)


def test_a_second_run_reads(whole: Sweep, monkeypatch: pytest.MonkeyPatch) -> None:
    before, rows = whole.results.read_bytes(), load_rows(whole.out)

    def never(*_: Any) -> None:
        raise AssertionError("measured again")

    monkeypatch.setattr(Sweep, "_measure", never)
    assert sweep_of(whole.out).run(progress=False) == rows
    assert whole.results.read_bytes() == before
    # Another choice of recipes in the same folder: only what is new in it costs anything.
    fewer = sweep_of(whole.out, RECIPES[:1]).run(progress=False)
    assert fewer == rows[:2]
    with pytest.raises(AssertionError, match="measured again"):
        sweep_of(whole.out, validation=tiny.noise(4, 4)).run(progress=False)  # other scenes, other rows
    with pytest.raises(AssertionError, match="measured again"):
        sweep_of(whole.out).run(resume=False, progress=False)
    sweep_of(whole.out).run(progress=False)


def test_killed_in_the_middle_it_goes_on_to_the_same_rows(whole: Sweep, weights: Path, tmp_path: Path) -> None:
    """The process dies while it trains the third recipe: no clean-up, no exception handler, half a cache."""
    program = f"""
        import os
        from pathlib import Path
        from robotbrain.optimisation import networks, training, workshop
        from tests.optimisation.test_sweep import sweep_of
        networks.WEIGHTS = Path({str(weights)!r})
        fit, calls = training.fit, []
        def dying(*args, **options):
            calls.append(1)
            if len(calls) == 2:
                os._exit(9)
            return fit(*args, **options)
        training.fit = dying
        sweep_of(Path({str(tmp_path)!r})).run(progress=False)
    """
    root = Path(__file__).parents[2]
    path = os.pathsep.join([str(root), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = os.environ | {"PYTHONPATH": path}
    process = subprocess.run([sys.executable, "-c", textwrap.dedent(program)], env=environment, timeout=120)
    assert process.returncode == 9
    halfway = load_rows(tmp_path)
    assert untimed(halfway) == untimed(load_rows(whole.out))[:3]

    resumed = sweep_of(tmp_path)
    rows = resumed.run(progress=False)
    assert rows[:3] == halfway  # to the last digit of the clock: read, not measured again
    assert untimed(rows) == untimed(load_rows(whole.out)) == untimed(load_rows(tmp_path))
    files = {p.relative_to(whole.out): p.read_bytes() for p in whole.out.glob("artefacts/*.onnx")}
    assert {p.relative_to(tmp_path): p.read_bytes() for p in tmp_path.glob("artefacts/*.onnx")} == files


def test_ctrl_c_leaves_whole_rows(whole: Sweep, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    measure, calls = Sweep._measure, []

    def interrupted(self: Sweep, *rest: Any) -> Any:
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return measure(self, *rest)

    shutil.copytree(whole.out / "steps", tmp_path / "steps")
    monkeypatch.setattr(Sweep, "_measure", interrupted)
    with pytest.raises(KeyboardInterrupt):
        sweep_of(tmp_path, RECIPES[:1]).run(progress=False)
    assert [row["label"] for row in load_rows(tmp_path)] == ["teacher"]
    assert not list(tmp_path.rglob("*.tmp"))


def test_a_recipe_that_fails_does_not_take_the_others_along(
    whole: Sweep, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make = type(whole._workshop).make  # type: ignore[arg-type]

    def failing(self: Any, recipe: Recipe) -> Any:
        if recipe.quantise:
            raise RobotBrainError("no such luck")
        return make(self, recipe)

    shutil.copytree(whole.out / "steps", tmp_path / "steps")
    monkeypatch.setattr(type(whole._workshop), "make", failing)
    rows = sweep_of(tmp_path, RECIPES[:2]).run(progress=False)
    assert rows[2]["error"] == "no such luck" and "error" not in rows[1]
    assert [row["label"] for row in front_of(rows, "host")]
    monkeypatch.setattr(type(whole._workshop), "make", make)
    assert "error" not in sweep_of(tmp_path, RECIPES[:2]).run(progress=False)[2]  # and is tried again


def test_the_front_is_of_drop_and_latency() -> None:
    def row(label: str, drop: float, host: float, orin: float | None) -> dict[str, Any]:
        return {"label": label, "drop": drop, "host_ms": host, "twin_ms": {"orin": orin}}

    rows = [
        row("big", 0.0, 9.0, 3.0),
        row("mid", 1.0, 3.0, None),
        row("bad", 2.0, 4.0, 2.0),
        row("tiny", 5.0, 1.0, 1.0),
    ]
    failed = {"label": "none", "error": "x"}
    assert [r["label"] for r in front_of([*rows, failed], "host")] == ["tiny", "mid", "big"]
    assert [r["label"] for r in front_of([*rows, failed], "orin")] == ["tiny", "bad", "big"]


def test_a_disturbed_timing_is_told_by_processor_time(monkeypatch: pytest.MonkeyPatch) -> None:
    quiet = HostLatency(8.0, 7.9, 7.5, (8.0, 7.9, 8.1), (7.5, 7.5, 7.5))
    busy = HostLatency(9.0, 1.0, 1.5, (1.0, 9.0, 9.0), (1.5, 1.5, 1.5))
    calm = HostLatency(2.0, 2.0, 1.9, (2.0, 2.0, 2.0), (1.9, 1.9, 1.9))
    cut = HostLatency(6.0, 6.0, 1.5, (6.0, 6.0, 6.0), (1.5, 1.5, 1.5))  # in every turn, so that none is fast
    for this, expected in (
        (calm, {"host_ms": 2.0, "host_speedup": 4.0, "host_clock": "wall"}),
        (busy, {"host_ms": 1.5, "host_speedup": 5.0, "host_clock": "cpu"}),
        (cut, {"host_ms": 1.5, "host_speedup": 5.0, "host_clock": "cpu"}),
    ):
        monkeypatch.setattr(latency, "host_latency", lambda *_, this=this, **__: {"teacher": quiet, "this": this})
        assert host_figures(Path("a"), Path("b"), 3) == expected


@pytest.mark.parametrize(
    "options",
    [
        {"recipes": []},
        {"recipes": ["student"]},
        {"modules": ("toaster",)},
        {"modules": "nano-4gb"},
        {"rounds": 0},
        {"validation": 0},
    ],
)
def test_refusals(options: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected"):
        Sweep(**({"out": tmp_path} | options))


def test_rows_of_nothing(tmp_path: Path) -> None:
    for content in (None, "", "[1]\n", '{"label": 1\n', json.dumps({"a": 1})):
        if content is not None:
            (tmp_path / "results.jsonl").write_text(content, encoding="utf-8")
        with pytest.raises(InputError, match="robotbrain optimise sweep"):
            load_rows(tmp_path)
