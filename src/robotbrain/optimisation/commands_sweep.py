"""``robotbrain optimise sweep``, ``report`` and ``compare``."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from robotbrain.errors import InputError
from robotbrain.jetson.tables import format_table, short, wrap
from robotbrain.optimisation.command_pieces import budget, budget_arguments, kb, positive


def sweep_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``robotbrain optimise sweep``."""
    parser.description = (
        "Make and judge compositions of distillation, channel pruning, sparsity and quantisation: accuracy, time here "
        "(measured) and on Jetsons (predicted), size. Stop it with Ctrl-C at any time; the same command goes on."
    )
    parser.add_argument("--out", type=Path, default=Path("sweep"), metavar="DIR", help="folder (default: sweep)")
    parser.add_argument("--modules", metavar="A,B", help="Jetson modules (default: nano-4gb,xavier-nx,orin-nano-8gb)")
    parser.add_argument(
        "--recipes", type=Path, metavar="FILE.json", help="own compositions: a list of objects (see Recipe)"
    )
    parser.add_argument("--validation", type=positive, default=400, metavar="N", help="images (default: 400)")
    parser.add_argument("--rounds", type=positive, default=7, metavar="N", help="turns of the timing (default: 7)")
    parser.add_argument("--fresh", action="store_true", help="judge everything anew; trainings are still taken")
    parser.add_argument("--list", action="store_true", help="print the compositions and stop")
    budget_arguments(parser)


def sweep_main(arguments: argparse.Namespace) -> int:
    """Run it."""
    from robotbrain.optimisation.sweep import MODULES, Sweep, default_recipes

    recipes = default_recipes() if arguments.recipes is None else _read_recipes(arguments.recipes)
    if arguments.list:
        print("\n".join(recipe.label for recipe in recipes))
        return 0
    modules = MODULES if arguments.modules is None else [w.strip() for w in arguments.modules.split(",") if w.strip()]
    sweep = Sweep(
        recipes,
        modules,
        arguments.out,
        budget=budget(arguments),
        validation=arguments.validation,
        rounds=arguments.rounds,
    )
    rows = sweep.run(resume=not arguments.fresh)
    _report(rows, arguments.out, None)
    return 1 if any("error" in row for row in rows) else 0


def report_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``robotbrain optimise report``."""
    parser.add_argument("folder", type=Path, metavar="DIR", help="of a sweep")
    parser.add_argument("--module", metavar="M", help="that the figure shows (default: the last of the sweep's)")
    parser.add_argument("--json", action="store_true", help="the rows as one JSON array, and nothing else")


def report_main(arguments: argparse.Namespace) -> int:
    """Run it."""
    from robotbrain.optimisation.sweep import load_rows

    rows = load_rows(arguments.folder)
    if arguments.json:
        print(json.dumps(rows, indent=1))
        return 0
    folder = arguments.folder if arguments.folder.is_dir() else arguments.folder.parent
    _report(rows, folder, arguments.module)
    return 0


def _report(rows: list[dict[str, Any]], folder: Path, module: str | None) -> None:
    from robotbrain.figures import save
    from robotbrain.optimisation.sweep import best_row, clock_note, complete
    from robotbrain.optimisation.sweep_plots import plot_sweep
    from robotbrain.optimisation.sweep_report import table_rows, write_sweep_report

    picture = save(plot_sweep(rows, module), folder / "sweep.png", dpi=150)
    page = write_sweep_report(rows, folder / "report.html", module)
    good = complete(rows)
    head, body = table_rows(good, list(good[0]["twin_ms"]))
    print(format_table(head, body))
    best = best_row(rows)
    print(
        wrap(
            f"The fastest here that loses at most one point: {best['label']}, {best['host_speedup']:.1f} times faster "
            f"than the teacher, {best['drop']:+.2f} points. Times on Jetsons are the twin's predictions."
        )
    )
    if warning := clock_note(rows):
        print(wrap(warning))
    for row in rows:
        if "error" in row:
            print(wrap(row["error"], "  ", f"not made: {row['label']}: "))
    print(f"{page}\n{picture}")


def _read_recipes(path: Path) -> list[Any]:
    from robotbrain.optimisation.recipe import Recipe

    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(content, list) or not content:
            raise ValueError("not a list with entries")
    except (OSError, ValueError) as error:
        raise InputError(
            "--recipes",
            given=str(path),
            expected='a JSON list such as [{"student": "student", "quantise": "ptq"}]',
            fix=f"Check the file ({error}).",
        ) from error
    return [Recipe.from_dict(entry) for entry in content]


# ---------------------------------------------------------------- compare


def compare_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``robotbrain optimise compare``."""
    parser.description = (
        "Compare networks of the kit's perception task: accuracy on the validation split, time here (in turns, one "
        "thread), the twin's prediction, size. The first is what the others are compared with."
    )
    parser.add_argument("models", type=Path, nargs="+", metavar="MODEL.onnx")
    parser.add_argument("--module", default="orin-nano-8gb", metavar="M", help="Jetson (default: orin-nano-8gb)")
    parser.add_argument("--images", type=positive, default=400, metavar="N", help="to judge on (default: 400)")
    parser.add_argument("--split", default="validation", metavar="S", help="validation (default) or test")
    parser.add_argument("--rounds", type=positive, default=7, metavar="N", help="turns of the timing (default: 7)")


def compare_main(arguments: argparse.Namespace) -> int:
    """Run it."""
    from robotbrain.optimisation.data import scenes
    from robotbrain.optimisation.evaluate import mean_iou
    from robotbrain.optimisation.latency import host_latency, speedup
    from robotbrain.optimisation.onnx_files import QUANTISERS, check_feed, read_model
    from robotbrain.optimisation.sweep import twin_figures
    from robotbrain.optimisation.workshop import weight_facts

    if arguments.split not in ("validation", "test"):
        raise InputError("--split", given=arguments.split, expected="validation or test", fix="Choose one of these.")
    names = [str(path) for path in arguments.models]
    if len(set(names)) < len(names):
        raise InputError("models", given=names, expected="each file once", fix="Leave the repeated one out.")
    models = {name: read_model(name) for name in names}
    images = scenes(arguments.split, arguments.images, progress=True)
    for model in models.values():
        check_feed(model, images[:1].inputs())  # before minutes go into the first of them
    times = host_latency(dict(zip(names, arguments.models, strict=True)), rounds=arguments.rounds)
    body, first = [], None
    for name, model in models.items():
        precision = "int8" if any(node.op_type in QUANTISERS for node in model.graph.node) else "fp32"
        iou = mean_iou(name, images, optimise=precision == "fp32").mean
        first = iou if first is None else first
        twin = twin_figures(Path(name), arguments.module, precision)
        best = min(twin, key=lambda p: twin[p]["latency_ms"]) if twin else None
        content = Path(name).read_bytes()
        body.append(
            [
                name,
                precision,
                f"{iou:.4f}",
                f"{100 * (first - iou):+.2f}",
                short(times[name].median_ms),
                *(f"{speedup(times[names[0]], times[name], cpu=cpu):.2f}" for cpu in (False, True)),
                f"{short(twin[best]['latency_ms'])} {best}" if best else "none",
                kb(len(content)),
                kb(weight_facts(content)["weights_bytes"]),
            ]
        )
    head = ["file", "precision", "mIoU", "lost (points)", "here (ms)", "times faster", "by CPU time"]
    print(format_table([*head, f"{arguments.module} (ms)", "file", "weights"], body, left=(0, 1)))
    print(wrap("Time here is measured, in turns; on the Jetson it is the twin's prediction, not a measurement."))
    return 0
