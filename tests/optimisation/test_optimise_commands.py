"""``robotbrain optimise``: every subcommand end to end on a tiny network, the figure's labels, the page, the errors."""

from __future__ import annotations

import json
import math
import random
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest

from robotbrain import rl
from robotbrain.cli import main
from robotbrain.errors import InputError
from robotbrain.optimisation import data, networks
from robotbrain.optimisation.export import export_onnx
from robotbrain.optimisation.recipe import Recipe
from robotbrain.optimisation.sweep import best_row, clock_note, front_of
from robotbrain.optimisation.sweep_plots import family_of, overlap, place_labels, plot_sweep, short_label
from robotbrain.optimisation.sweep_report import sweep_report
from tests.optimisation import tiny


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder, before = tiny.make_weights(tmp_path_factory.mktemp("weights")), networks.WEIGHTS
    networks.WEIGHTS = folder
    yield folder
    networks.WEIGHTS = before


@pytest.fixture
def images(monkeypatch: pytest.MonkeyPatch) -> None:
    """Noise instead of rendered images: the commands ask for splits by name."""
    monkeypatch.setattr(data, "scenes", lambda split, count, **_: tiny.noise(count, sorted(data.SPLITS).index(split)))


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return export_onnx(networks.build_student(4), tmp_path_factory.mktemp("network") / "net.onnx")


def row(recipe: Recipe, drop: float, host: float, jetson: float | None, size: int) -> dict[str, Any]:
    """A row as a sweep writes it."""
    precision = "int8" if recipe.quantise else "fp16"
    figures = {"latency_ms": jetson, "latency_low_ms": 0.3, "latency_high_ms": 2.0, "energy_mj": 4.0}
    return {
        "label": recipe.label,
        "recipe": recipe.to_dict(),
        "twin": {"nano-4gb": {}, "orin-nano-8gb": {precision: figures}},
        "mean_iou": 0.9 - drop / 100,
        "drop": drop,
        "host_ms": host,
        "host_speedup": round(9.0 / host, 2),
        "host_clock": "wall",
        "twin_ms": {"nano-4gb": None, "orin-nano-8gb": jetson},
        "twin_precision": {"nano-4gb": None, "orin-nano-8gb": precision},
        "energy_mj": {"nano-4gb": None, "orin-nano-8gb": jetson},
        "weights_bytes": size,
        "gzip_bytes": size,
        "sparsity": 0.0,
        "precision": recipe.precision,
    }


ROWS = [
    row(Recipe(student="teacher"), 0.0, 9.0, 1.2, 3_600_000),
    row(Recipe(student="student_plain"), 3.9, 1.30, 0.68, 190_000),
    row(Recipe(), 0.9, 1.31, 0.68, 190_000),
    row(Recipe(quantise="ptq"), 1.0, 1.2, 0.60, 48_000),
    row(Recipe(quantise="ptq", per_channel=False), 1.1, 1.2, 0.60, 48_000),
    row(Recipe(prune_channels=0.5), 2.2, 0.7, 0.66, 53_000),
    row(Recipe(prune_channels=0.5, quantise="ptq"), 2.3, 0.8, 0.59, 14_000),
    row(Recipe(sparsity=0.95), 7.0, 1.3, 0.68, 190_000),
    row(Recipe(student=8), 3.0, 0.6, 0.66, 48_000),
]


# ---------------------------------------------------------------- figure and page


def test_labels_cover_neither_each_other_nor_markers() -> None:
    rng = random.Random(0)
    for _ in range(20):
        points = [(rng.uniform(150, 850), rng.uniform(50, 450)) for _ in range(9)]
        points += [(points[0][0] + rng.uniform(-8, 8), points[0][1] + rng.uniform(-8, 8)) for _ in range(3)]
        sizes = [(rng.uniform(40, 130), 16.0) for _ in points]
        markers = [(x - 6, y - 6, x + 6, y + 6) for x, y in points]
        bounds = (0.0, 0.0, 1000.0, 500.0)
        boxes = place_labels(points, sizes, markers, bounds)
        for k, box in enumerate(boxes):
            assert all(overlap(box, other) == 0.0 for other in [*boxes[:k], *markers])
            assert box[0] >= 0 and box[1] >= 0 and box[2] <= 1000 and box[3] <= 500
            assert math.isclose(box[2] - box[0], sizes[k][0]) and math.isclose(box[3] - box[1], sizes[k][1])


def test_overlap_is_an_area() -> None:
    assert overlap((0, 0, 2, 2), (1, 1, 3, 4)) == 1.0
    assert overlap((0, 0, 2, 2), (2, 0, 3, 3)) == overlap((0, 0, 1, 1), (2, 2, 3, 3)) == 0.0


def test_the_figure_shows_and_says_what_the_rows_hold() -> None:
    figure = plot_sweep(ROWS, "orin-nano-8gb")
    panels = figure.axes
    assert len(panels) == 2
    for axes, where in zip(panels, ("host", "orin-nano-8gb"), strict=True):
        front = front_of(ROWS, where)
        texts = [text for text in axes.texts if text.get_text()]
        assert {short_label(r) for r in front} <= {text.get_text() for text in texts}
        assert len(axes.collections) == len(ROWS)  # every composition is there
        figure.draw_without_rendering()
        boxes = [tuple(text.get_window_extent().extents) for text in texts]
        assert all(overlap(a, b) == 0.0 for k, a in enumerate(boxes) for b in boxes[:k])
        (line,) = [li for li in axes.lines if li.get_label() == "Pareto front"]
        assert list(line.get_ydata()) == [r["drop"] for r in front]
    assert "Orin Nano" in figure.get_label() and "predict" in panels[1].get_title(loc="left")
    assert "measured" in panels[0].get_title(loc="left")
    with pytest.raises(InputError, match="module"):
        plot_sweep(ROWS, "tx2")
    with pytest.raises(InputError, match="rows"):
        plot_sweep([{"label": "x", "error": "y"}])


def test_a_module_that_runs_only_some_of_them_is_drawn_with_those() -> None:
    rows = [r | {"twin_ms": {"nano-4gb": None if r["precision"] == "int8" else 2.0}} for r in ROWS]
    assert len(plot_sweep(rows).axes[1].collections) == sum(r["precision"] == "fp32" for r in ROWS)


def test_what_failed_does_not_flatten_the_rest() -> None:
    rows = [*ROWS, row(Recipe(student=4), 60.0, 0.5, 0.6, 12_000)]
    axes = plot_sweep(rows).axes[0]
    one, far = (axes.transAxes.inverted().transform(axes.transData.transform((1.0, y)))[1] for y in (1.0, 60.0))
    assert one > 0.15 and far < 1.0


def test_disturbed_timings_are_named() -> None:
    rows = [*ROWS[:3], ROWS[3] | {"host_clock": "cpu"}]
    assert clock_note(ROWS) == "" and clock_note(rows).startswith("This machine was busy: 1 of 4")
    quiet, busy = ([r | {"twin_ms": {"orin-nano-8gb": 0.6}} for r in some] for some in (ROWS, rows))
    assert "--fresh" in sweep_report(busy) and "--fresh" not in sweep_report(quiet)


def test_families() -> None:
    assert [family_of(r) for r in (ROWS[0], ROWS[2], ROWS[6], ROWS[7], ROWS[8])] == [
        "teacher",
        "as it is",
        "channels removed",
        "zeros in the weights",
        "another width",
    ]


def test_the_page_needs_nothing_else_and_hides_no_failure() -> None:
    assert best_row(ROWS)["label"] == "student, INT8 PTQ"  # the fastest within a point
    assert best_row(ROWS, points=2.5)["label"] == "student, \N{MINUS SIGN}50% channels"
    rows = [dict(r, twin_ms={"orin-nano-8gb": r["twin_ms"]["orin-nano-8gb"]}) for r in ROWS]
    page = sweep_report([*rows, {"label": "qat", "error": "torchao <is> missing"}], "orin-nano-8gb")
    assert not re.search(r"""(?:src|href)=["'](?!data:|#)""", page)
    assert 'alt="Two scatter plots' in page and "torchao &lt;is&gt; missing" in page
    assert all(r["label"] in page for r in ROWS)
    assert "no measurements" in page and "nobody has published" in page


# ---------------------------------------------------------------- commands


def test_quantise_lint_and_compare(
    network: Path, images: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "net.int8.onnx"
    assert main(["optimise", "quantise", str(network), "--out", str(out), "--images", "4", "--per-tensor"]) == 0
    assert "Q/DQ" in capsys.readouterr().out and out.is_file()
    assert main(["optimise", "lint", str(out)]) == 0
    assert main(["optimise", "lint", str(out), "--json"]) == 0
    report = capsys.readouterr().out
    assert isinstance(json.loads(report[report.index("\n[") + 1 :] if "\n[" in report else report), list)
    command = ["optimise", "compare", str(network), str(out), "--images", "4", "--rounds", "1", "--module", "nano-4gb"]
    assert main(command) == 0
    text = capsys.readouterr().out
    lines = [line.split() for line in text.splitlines() if ".onnx" in line]
    assert [line[1] for line in lines] == ["fp32", "int8"] and "none" in lines[1]  # a Nano has no INT8
    assert "not a measurement" in text


def test_own_inputs_and_cpu_target(network: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    inputs = tmp_path / "inputs.npy"
    np.save(inputs, np.random.default_rng(0).standard_normal((3, 3, 64, 64)).astype(np.float32))
    out = tmp_path / "cpu.onnx"
    command = ["optimise", "quantise", str(network), "--out", str(out), "--inputs", str(inputs), "--target", "cpu"]
    assert main(command) == 0
    capsys.readouterr()
    kinds = {tensor.data_type for tensor in onnx.load(str(out)).graph.initializer}
    assert onnx.TensorProto.UINT8 in kinds  # unsigned zero points
    assert main(["optimise", "lint", str(out)]) == 1  # which TensorRT would refuse
    assert "error" in capsys.readouterr().out


def test_prune_sweep_and_report(
    weights: Path,
    images: None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("ROBOTBRAIN_CACHE", str(tmp_path / "cache"))
    budget = ["--train-images", "32", "--epochs", "1"]
    out = tmp_path / "small.onnx"
    command = ["optimise", "prune", "--channels", "0.5", "--no-teacher", "--out", str(out), *budget]
    assert main(command) == 0
    assert "50% channels" in capsys.readouterr().out
    facts = json.loads(out.with_suffix(".json").read_text(encoding="utf-8"))
    assert facts["onnx"] == "small.onnx" and facts["size_bytes"] == out.stat().st_size

    (tmp_path / "recipes.json").write_text('[{"student": "student_plain"}]', encoding="utf-8")
    folder = tmp_path / "sweep"
    command = ["optimise", "sweep", "--out", str(folder), "--recipes", str(tmp_path / "recipes.json"), *budget]
    command += ["--validation", "3", "--rounds", "1", "--modules", "orin-nano-8gb"]
    assert main(command) == 0
    assert "student (no teacher)" in capsys.readouterr().out
    for name in ("results.jsonl", "sweep.png", "report.html"):
        assert (folder / name).stat().st_size > 100
    (folder / "report.html").unlink()
    assert main(["optimise", "report", str(folder)]) == 0 and (folder / "report.html").is_file()
    capsys.readouterr()
    assert main(["optimise", "report", str(folder), "--json"]) == 0
    assert [r["label"] for r in json.loads(capsys.readouterr().out)] == ["teacher", "student (no teacher)"]


def test_list_says_what_a_sweep_would_do(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["optimise", "sweep", "--list"]) == 0
    assert len(capsys.readouterr().out.splitlines()) >= 20


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["quantise", "missing.onnx", "--out", "x.onnx"], "missing.onnx"),
        (["quantise", "NET", "--out", "x.onnx", "--inputs", "missing.npy"], "inputs missing.npy"),
        (["quantise", "NET", "--out", "x.onnx", "--target", "tpu"], "target"),
        (["lint", "missing.onnx"], "missing.onnx"),
        (["lint", "NET", "--jetpack", "99"], "jetpack"),
        (["prune", "--channels", "0", "--out", "x.onnx"], "--channels"),
        (["prune", "--channels", "1.5", "--out", "x.onnx"], "prune_channels"),
        (["prune", "--sparsity", "most", "--out", "x.onnx"], "--sparsity"),
        (["prune", "--sparsity", "0.5", "--out", "x.pt"], "--out"),
        (["prune", "--sparsity", "0.5", "--network", "pupil", "--out", "x.onnx"], "student"),
        (["sweep", "--recipes", "missing.json"], "--recipes"),
        (["sweep", "--modules", "toaster"], "toaster"),
        (["report", "missing"], "results of a sweep"),
        (["compare", "NET", "NET"], "each file once"),
        (["compare", "NET", "--split", "train"], "--split"),
        (["compare", "NET", "POLICY"], "expected"),
    ],
)
def test_errors_say_what_and_leave_nothing_behind(
    words: list[str],
    said: str,
    network: Path,
    images: None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    stand_ins = {"NET": str(network), "POLICY": str(Path(rl.__file__).with_name("weights") / "navigation.onnx")}
    assert main(["optimise", *(stand_ins.get(word, word) for word in words)]) == 2
    error = capsys.readouterr().err
    assert said in error and "expected" in error and "Traceback" not in error
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["quantise", "lint", "prune", "sweep", "report", "compare"])
def test_every_subcommand_has_help(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main(["optimise", name, "--help"])
    assert left.value.code == 0 and len(capsys.readouterr().out) > 100
