"""A sweep over compositions: what each costs and what it is worth, measured alike and stored as it comes in.

Accuracy comes from the validation split (choices are made on it; the test split is for the figure at the end), of INT8
files with ONNX Runtime's optimisations off, which computes the Q/DQ arithmetic in floating point: its fused kernels
saturate on processors without VNNI. Latency on this machine is measured in turns with the teacher, optimisations on.
Latency and energy on a Jetson are the twin's predictions; they are nobody's measurements, and rows say so.
"""

from __future__ import annotations

import hashlib
import json
import math
import platform
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotbrain.errors import InputError, RobotBrainError
from robotbrain.files import write_text
from robotbrain.optimisation.recipe import REVISION, TWO_FOUR, Artefact, Budget, Recipe
from robotbrain.optimisation.workshop import Workshop, scenes_digest

if TYPE_CHECKING:
    from robotbrain.optimisation.data import Scenes

Row = dict[str, Any]

MODULES = ("nano-4gb", "xavier-nx", "orin-nano-8gb")
"""Jetson modules of a sweep unless others are asked for: without INT8, with it, and with sparse tensor cores."""

TEACHER = Recipe(student="teacher")
"""What everything is compared with: the teacher as it is shipped, in float32."""

RESULTS = "results.jsonl"

NOISY = 1.25
"""Median over fastest turn, and over processor time, from which a latency counts as disturbed by other processes."""

NEAR = 1.0
"""Points of mIoU that a composition may lose and still be called as good as the teacher."""


def default_recipes() -> list[Recipe]:
    """Return the compositions of the course's sweep: each technique alone, in doses, and together."""
    one = Recipe()
    plain = Recipe(student="student_plain")
    return [
        TEACHER,
        Recipe(student="teacher", quantise="ptq"),
        plain,
        Recipe(student="student_plain", quantise="ptq"),
        one,
        *(Recipe(quantise="ptq", calibration=method) for method in ("minmax", "percentile", "entropy")),
        Recipe(quantise="ptq", per_channel=False),
        Recipe(quantise="qat"),
        *(Recipe(prune_channels=0.25, quantise=q) for q in (None, "ptq")),
        *(Recipe(prune_channels=0.5, quantise=q) for q in (None, "ptq")),
        Recipe(prune_channels=0.5, distil=False),
        *(Recipe(sparsity=share) for share in (0.5, 0.8, 0.95)),
        Recipe(sparsity=0.8, quantise="ptq"),
        *(Recipe(sparsity=TWO_FOUR, quantise=q) for q in (None, "ptq")),
        *(Recipe(student=6, quantise=q) for q in (None, "ptq")),
        Recipe(student=6, distil=False),
        Recipe(prune_channels=0.25, sparsity=TWO_FOUR, quantise="ptq"),
    ]


class Sweep:
    """Every recipe made, judged and written down, one after the other.

    Rows are kept under a key of all that went into them, so that an interrupted sweep goes on where it was, another
    set of recipes only costs what is new in it, and a sweep that is done is read.

    Args:
        recipes: the compositions; the teacher is added in front if it is missing.
        modules: slugs of Jetson modules for the twin.
        out: folder: ``results.jsonl``, artefacts, steps, rows.
        budget: of the trainings; Budget() if None.
        validation: scenes to measure accuracy on, or how many of the validation split.
        rounds: turns of the latency measurement, 5 or more for a figure to be quoted.
        workshop: makes the artefacts; one in ``out`` if None.

    Raises:
        InputError: for no recipes, unknown modules, or numbers out of range.
    """

    def __init__(
        self,
        recipes: Iterable[Recipe] | None = None,
        modules: Sequence[str] = MODULES,
        out: str | Path = "sweep",
        *,
        budget: Budget | None = None,
        validation: Scenes | int = 400,
        rounds: int = 7,
        workshop: Workshop | None = None,
    ) -> None:
        from robotbrain.jetson.catalogue import load_module

        chosen = list(dict.fromkeys(default_recipes() if recipes is None else recipes))
        if not chosen or not all(isinstance(recipe, Recipe) for recipe in chosen):
            raise InputError("recipes", given=chosen, expected="Recipe objects, at least one", fix="Try [Recipe()].")
        if isinstance(modules, str) or not modules:
            raise InputError("modules", given=modules, expected="a list of slugs", fix='Try ["orin-nano-8gb"].')
        images = validation if isinstance(validation, int) else len(validation)
        if images < 1 or rounds < 1:
            given = f"{images} images, {rounds} rounds"
            raise InputError("sweep", given=given, expected="1 or more of each", fix="Leave them out.")
        self.recipes = [TEACHER, *(r for r in chosen if r != TEACHER)]
        self.modules = tuple(dict.fromkeys(load_module(slug).slug for slug in modules))
        self.out, self.rounds, self._validation = Path(out), rounds, validation
        self._workshop = workshop
        self._budget = budget

    @property
    def results(self) -> Path:
        """The file of rows, one JSON object a line, in the order of the recipes."""
        return self.out / RESULTS

    def run(self, resume: bool = True, progress: bool = True) -> list[Row]:
        """Make and judge what is missing, and return all rows.

        ``results.jsonl`` is rewritten, whole, after each row. A recipe that cannot be carried out (a package is
        missing, a training diverges) gets a row with an ``error`` and is tried again next time.

        Args:
            resume: take rows that are there; False judges everything anew (trainings are still taken).
            progress: show bars and what is being done.

        Returns:
            For each recipe: ``label``, ``recipe``, ``key``, ``mean_iou`` and ``iou`` per class, ``drop`` (points of
            mIoU lost against the teacher), ``host_ms``, ``host_speedup`` (times faster than the teacher, in turns),
            ``host_clock`` (see :func:`host_figures`),
            ``twin`` (module -> precision -> ``latency_ms``, ``energy_mj``), ``twin_ms``, ``twin_precision`` and
            ``energy_mj`` (module -> at the fastest precision, None where TensorRT would refuse the file),
            ``size_bytes``, ``gzip_bytes``, ``weights_bytes``, ``sparsity``, ``onnx`` (relative to the folder).
        """
        from tqdm.auto import tqdm

        rows: list[Row] = []
        teacher: Artefact | None = None
        with tqdm(total=len(self.recipes), desc="sweep", unit="recipe", disable=not progress) as bar:
            shop = self._workshop or Workshop(self.out, self._budget, progress=False)
            shop.say = bar.set_postfix_str
            scenes = self._scenes()
            digest = scenes_digest(scenes)
            for recipe in self.recipes:
                try:
                    artefact = shop.make(recipe)
                    teacher = teacher or artefact
                    key = self._row_key(recipe, artefact, teacher, digest)
                    measured = self._stored(key) if resume else None
                    if measured is None:
                        shop.say(f"measuring: {recipe.label}")
                        measured = {"key": key} | self._measure(shop, artefact, teacher, scenes)
                        write_text(self._row_path(key), json.dumps(measured) + "\n")
                    rows.append(self._row(artefact, measured, rows))
                except RobotBrainError as error:
                    if recipe == TEACHER:  # without it there is nothing to compare with
                        raise
                    rows.append({"label": recipe.label, "recipe": recipe.to_dict(), "error": str(error)})
                write_text(self.results, "".join(json.dumps(row) + "\n" for row in rows))
                bar.update()
            bar.set_postfix_str("done")
        return rows

    def _scenes(self) -> Scenes:
        from robotbrain.optimisation.data import scenes

        return scenes("validation", self._validation) if isinstance(self._validation, int) else self._validation

    def _measure(self, shop: Workshop, artefact: Artefact, teacher: Artefact, scenes: Scenes) -> Row:
        """Return what running the network here tells."""
        from robotbrain.optimisation.evaluate import mean_iou

        result = mean_iou(artefact.onnx, scenes, optimise=artefact.facts["precision"] == "fp32")
        return {
            "mean_iou": round(result.mean, 6),
            "iou": {name: round(v, 6) if math.isfinite(v) else None for name, v in result.per_class.items()},
            **host_figures(teacher.onnx, shop.host_file(artefact), self.rounds),
        }

    def _row(self, artefact: Artefact, measured: Row, before: Sequence[Row]) -> Row:
        """Return a whole row: what was measured, what the file says, and what the twin predicts (never stored)."""
        facts = artefact.facts
        reference = before[0]["mean_iou"] if before else measured["mean_iou"]
        twin = {module: twin_figures(artefact.onnx, module, facts["precision"]) for module in self.modules}
        fastest = {m: min(p, key=lambda name: p[name]["latency_ms"]) if p else None for m, p in twin.items()}
        return {
            "label": facts["label"],
            "recipe": facts["recipe"],
            **measured,
            "drop": round(100.0 * (reference - measured["mean_iou"]), 4),
            "twin": twin,
            "twin_ms": {m: twin[m][p]["latency_ms"] if p else None for m, p in fastest.items()},
            "twin_precision": fastest,
            "energy_mj": {m: twin[m][p]["energy_mj"] if p else None for m, p in fastest.items()},
            "size_bytes": facts["size_bytes"],
            "gzip_bytes": facts["gzip_bytes"],
            "weights_bytes": facts["weights_bytes"],
            "sparsity": round(facts["zero_weights"] / max(1, facts["weights"]), 4),
            "precision": facts["precision"],
            "training_seconds": round(sum(step["seconds"] for step in facts["steps"]), 1),
            "onnx": artefact.onnx.relative_to(artefact.onnx.parents[1]).as_posix(),
            "sha256": facts["sha256"],
        }

    # ------------------------------------------------------------------ what is kept

    def _row_key(self, recipe: Recipe, artefact: Artefact, teacher: Artefact, scenes: str) -> str:
        import onnxruntime

        files = [artefact.facts["sha256"], teacher.facts["sha256"], artefact.facts["key"]]
        here = [platform.node(), onnxruntime.__version__]  # on another machine the clock says something else
        content = [REVISION, files, scenes, self.rounds, here, recipe.to_dict()]
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:24]

    def _row_path(self, key: str) -> Path:
        return self.out / "rows" / f"{key}.json"

    def _stored(self, key: str) -> Row | None:
        try:
            row = json.loads(self._row_path(key).read_text(encoding="utf-8"))
            return row if row["key"] == key and {"mean_iou", "host_ms", "host_clock"} <= row.keys() else None
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return None


def host_figures(teacher: Path, this: Path, rounds: int) -> dict[str, Any]:
    """Return the latency of a file on this machine: ``host_ms``, ``host_speedup`` and ``host_clock``.

    By the wall clock (``"wall"``), unless either file took NOISY times its processor time or its fastest turn: then
    others were in the way, and processor time (``"cpu"``) says, with one thread, what an idle machine would show.
    """
    from robotbrain.optimisation.latency import host_latency, speedup

    times = host_latency({"teacher": teacher, "this": this}, rounds=rounds)
    disturbed = any(t.median_ms > NOISY * min(t.fastest_ms, t.cpu_ms) for t in times.values())
    return {
        "host_ms": round(times["this"].cpu_ms if disturbed else times["this"].median_ms, 4),
        "host_speedup": round(speedup(times["teacher"], times["this"], cpu=disturbed), 3),
        "host_clock": "cpu" if disturbed else "wall",
    }


def twin_figures(path: Path, module: str, precision: str) -> dict[str, dict[str, float]]:
    """Return what the twin predicts for a file on a module, by the precisions that it can be built in.

    A file without Q/DQ nodes is built in float32 or float16; one with them in INT8, which TensorRT refuses on modules
    that have none: an empty result.
    """
    from robotbrain.jetson.catalogue import load_module
    from robotbrain.jetson.twin import predict

    if precision == "int8" and load_module(module).int8_tops is None:
        return {}
    found = {}
    for name in ("int8",) if precision == "int8" else ("fp32", "fp16"):
        prediction = predict(path, module, precision=name)
        found[name] = {
            "latency_ms": round(prediction.latency_ms, 5),
            "latency_low_ms": round(prediction.latency_low_ms, 5),
            "latency_high_ms": round(prediction.latency_high_ms, 5),
            "energy_mj": round(prediction.energy_mj, 4),
        }
    return found


def load_rows(path: str | Path) -> list[Row]:
    """Return the rows of a sweep, those with an error included.

    Args:
        path: of the sweep's folder, or of its ``results.jsonl``.

    Raises:
        InputError: for a file that is missing or not one of rows.
    """
    file = Path(path) / RESULTS if Path(path).is_dir() else Path(path)
    try:
        rows = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines() if line.strip()]
        if not rows or not all(isinstance(row, dict) and "label" in row for row in rows):
            raise ValueError("no rows")
    except (OSError, ValueError) as error:
        raise InputError(
            "results of a sweep",
            given=str(path),
            expected=f"a folder with {RESULTS}",
            fix=f"Run `robotbrain optimise sweep --out FOLDER` first ({error}).",
        ) from error
    return rows


def complete(rows: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return the rows without an error."""
    return [row for row in rows if "error" not in row]


def latency_of(row: Mapping[str, Any], where: str) -> float | None:
    """Return a row's latency in ms, None where it cannot run.

    Args:
        row: of a sweep.
        where: ``"host"`` for this machine, as measured; else a module, as the twin predicts.
    """
    value = row["host_ms"] if where == "host" else row["twin_ms"].get(where)
    return None if value is None else float(value)


def front_of(rows: Iterable[Mapping[str, Any]], where: str) -> list[Mapping[str, Any]]:
    """Return the Pareto front of accuracy drop and latency at a place (see :func:`latency_of`), fastest first."""
    from robotbrain.optimisation.pareto import pareto_front

    able = [row for row in complete(rows) if latency_of(row, where) is not None]

    def latency(row: Mapping[str, Any]) -> float:
        return latency_of(row, where) or math.inf

    return sorted(pareto_front(able, ["drop", latency]), key=latency)


def best_row(rows: Iterable[Mapping[str, Any]], where: str = "host", points: float = NEAR) -> Mapping[str, Any]:
    """Return the fastest row that loses at most so many points of mIoU."""
    able = [row for row in complete(rows) if row["drop"] <= points and latency_of(row, where) is not None]
    return min(able, key=lambda row: latency_of(row, where) or 0.0)


def clock_note(rows: Iterable[Mapping[str, Any]]) -> str:
    """Return what is to be said of timings that others disturbed; nothing if there are none."""
    clocks = [row["host_clock"] == "cpu" for row in complete(rows)]
    if not any(clocks):
        return ""
    return (
        f"This machine was busy: {sum(clocks)} of {len(clocks)} timings are processor time, not the wall clock. Sweep "
        "again with --fresh when it is idle; nothing is trained anew."
    )
