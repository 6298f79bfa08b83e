"""``robotbrain demo``: the main job in one command, and one page that shows what came of it.

It generates the students' lab, makes the sample class, grades it with nbgrader, drives the reference brain on an
emulated Jetson, lets the same brain drive on a small, two middling and a large one, and writes ``demo/index.html``.
"""

from __future__ import annotations

import argparse
import html
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robotbrain.files import atomic_path, write_text

if TYPE_CHECKING:
    from robotbrain.grading.classroom import ClassResult
    from robotbrain.grading.mutation import Row
    from robotbrain.pipeline.brain import RunResult
    from robotbrain.pipeline.devices import DeviceSummary

LAB = "lab_integration"
SEEDS = (1, 2, 3)
PROFILE = "orin-nano-8gb"
DEVICE_SEEDS = (8000, 8001, 8002, 8003)
"""Worlds in which the Jetsons are compared."""
_KINDS = {"reference": "reference", "style": "right, in another style", "mutant": "planted mistake"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``robotbrain demo``."""
    parser.add_argument("--out", type=Path, help="folder for the page (default: demo/ in the course folder)")
    parser.add_argument("--jobs", type=int, help="submissions graded at the same time (default: one per core, and one)")
    parser.add_argument("--fresh", action="store_true", help="grade everything again, also what has not changed")


def main(arguments: argparse.Namespace) -> int:
    """Run the demo; 1 if a submission was not graded as it should be or a drive failed."""
    from robotbrain.grading import mutation
    from robotbrain.grading.course import find_course
    from robotbrain.grading.scheduler import fitting_workers

    began = time.perf_counter()
    course = find_course(None)
    out: Path = (arguments.out or course.home / "demo").resolve()
    result, manifest = _grade(course, out, arguments.jobs or fitting_workers(), arguments.fresh)
    verdicts = mutation.judge(result.to_dict(), manifest)
    print(mutation.table(verdicts))
    runs = _drive()
    devices = _compare()
    page = _write_page(out, result, manifest, verdicts, runs, devices, time.perf_counter() - began)
    wrong = [row for row in verdicts if row.problems]
    print(f"\n{len(verdicts)} submissions graded, {len(wrong)} of them not as they should be.")
    print(f"{sum(run.success for run in runs)} of {len(runs)} drives reached the goal.")
    print(f"Took {time.perf_counter() - began:.0f} s. Open the page:\n  {page.as_uri()}")
    return 1 if wrong or not all(run.success for run in runs) else 0


def _grade(course: Any, out: Path, jobs: int, fresh: bool) -> tuple[ClassResult, dict[str, dict[str, Any]]]:
    from robotbrain.grading.classroom import grade_class, progress_bar
    from robotbrain.grading.course import generate
    from robotbrain.grading.marks import table
    from robotbrain.grading.sample import make_class

    print("1. Generating the students' lab from the solution notebook")
    generate(course, LAB)
    manifest = make_class(course, LAB, out / "class")
    print(f"2. Grading a sample class of {len(manifest)} submissions with nbgrader, {jobs} at a time")
    with progress_bar() as progress:
        result = grade_class(
            course,
            LAB,
            submitted=out / "class",
            out=out / "graded",
            workers=jobs,
            fresh=fresh,
            progress=progress,
        )
    print(table(result.rows, widest_reason=48))
    return result, manifest


def _drive() -> list[RunResult]:
    from robotbrain.pipeline.brain import drive

    print(f"3. Driving the reference brain on an emulated {PROFILE}")
    runs = []
    for seed in SEEDS:
        run = drive(seed, profile=PROFILE)
        runs.append(run)
        print(f"   world {seed}: {run.reason} after {run.seconds:.1f} s ({run.real_time_factor:.1f} x real time)")
    return runs


def _compare() -> list[DeviceSummary]:
    from tqdm import tqdm

    from robotbrain.pipeline import devices

    print("4. The same brain on other Jetsons, charged for a 640x480 camera and a network of ResNet-50's size")
    small = devices.DEVICES[0]
    with tqdm(total=(len(devices.DEVICES) + 1) * len(DEVICE_SEEDS), unit="drive", file=sys.stderr, disable=None) as bar:

        def progress(run: RunResult) -> None:
            bar.set_postfix_str(f"{run.profile} {run.power_mode}", refresh=False)
            bar.update()

        summaries = devices.compare_devices(DEVICE_SEEDS, label="one thread", progress=progress)
        apart = devices.detector_deployment(one_thread=False)
        summaries += devices.compare_devices(
            DEVICE_SEEDS, [small], deployment=apart, label="node by node", progress=progress
        )
    print(devices.table(summaries))
    return summaries


def _write_page(
    out: Path,
    result: ClassResult,
    manifest: dict[str, dict[str, Any]],
    verdicts: Sequence[Row],
    runs: Sequence[RunResult],
    devices: Sequence[DeviceSummary],
    seconds: float,
) -> Path:
    for run in runs:
        run.replay().to_html(out / f"replay-{run.seed}.html", title=f"World {run.seed}")
    with atomic_path(out / "paths.png") as temporary:
        alt = _plot_paths(runs, temporary)
    with atomic_path(out / "devices.png") as temporary:
        devices_alt = _plot_devices(devices, temporary)
    mutants = [row for row in verdicts if row.kind == "mutant"]
    caught = sum(not row.problems for row in mutants)
    parts = [
        f"<h1>robotbrain demo</h1><p>Made by <code>robotbrain demo</code> in {seconds:.0f} s. The robot is simulated,"
        " the Jetson is emulated: each callback takes, in simulated time, what the profile says.</p>",
        f"<h2>The drives</h2>{_drive_table(runs)}",
        f'<img src="paths.png" alt="{html.escape(alt)}">',
        f"<h2>World {runs[0].seed} in 3D</h2><p>Drag to turn, scroll to zoom. Blue is the plan, orange the way"
        f' driven. <a href="replay-{runs[0].seed}.html">Full page</a></p>'
        f'<iframe src="replay-{runs[0].seed}.html" title="3D replay of world {runs[0].seed}"></iframe>',
        f"<h2>The same brain on other Jetsons</h2>{_device_table(devices)}",
        f'<img src="devices.png" alt="{html.escape(devices_alt)}">',
        f"<h2>The class</h2><p>{len(result.rows)} submissions, graded by nbgrader. {caught} of {len(mutants)} planted"
        " mistakes lost their own points, and only these, and showed their own hint. A name leads to the feedback that"
        " the student gets.</p>",
        _class_table(result, manifest, out),
    ]
    return write_text(out / "index.html", _PAGE.replace("@BODY@", "\n".join(parts)))


def _plot_paths(runs: Sequence[RunResult], path: Path) -> str:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from robotbrain.sim.view import plot_topdown

    figure, axes = plt.subplots(1, len(runs), figsize=(5 * len(runs), 5.6), layout="constrained")
    for run, ax in zip(runs, np.atleast_1d(axes), strict=True):
        plot_topdown(run.world, run.trajectory[:, 1:3], ax, title=f"World {run.seed}: {run.reason}")
    figure.savefig(path, dpi=110, format="png", bbox_inches="tight")
    plt.close(figure)
    drives = "; ".join(f"world {r.seed}: {r.reason} after {r.path_length:.1f} m" for r in runs)
    return f"The rooms from above with walls, shelves, boxes, the goal and the path driven. {drives}."


def _plot_devices(devices: Sequence[DeviceSummary], path: Path) -> str:
    from robotbrain.pipeline.devices import plot_devices

    figure, alt = plot_devices(devices)
    figure.savefig(path, dpi=110, format="png")
    return alt


def _device_table(devices: Sequence[DeviceSummary]) -> str:
    rows = "".join(
        f"<tr><th scope=row>{html.escape(s.name)}, {html.escape(s.power_mode)}</th><td>{html.escape(s.label)}</td>"
        f"<td>{s.network_ms:.1f}</td><td>{s.control_hz:.1f}</td><td>{s.e2e_p50_ms:.0f}</td><td>{s.e2e_p99_ms:.0f}</td>"
        f"<td class={'full' if s.successes == s.runs else 'lost'}>{s.successes} of {s.runs}</td>"
        f"<td>{s.power_w:.1f}</td><td>{s.energy_j_per_m:.0f}</td></tr>"
        for s in devices
    )
    return (
        "<div class=wide><table><thead><tr><th scope=col>Jetson</th><th scope=col>nodes</th>"
        "<th scope=col>network (ms)</th><th scope=col>control rate (Hz)</th><th scope=col>end to end, median (ms)</th>"
        "<th scope=col>99th percentile (ms)</th><th scope=col>worlds solved</th><th scope=col>module (W)</th>"
        f"<th scope=col>energy (J/m)</th></tr></thead><tbody>{rows}</tbody></table></div>"
        "<p>What the robot sees is the same everywhere; what its work takes is not. It is charged for a 640 x 480"
        " camera and a network of ResNet-50's size. <em>One thread</em>: all nodes under one <code>rclpy.spin</code>,"
        " so that each inference holds up the controller. <em>Node by node</em>: a process for each node. Latencies"
        " and power are predicted (<code>robotbrain jetson show</code> gives their origin); CPU times are those of"
        " Python nodes, scaled by a published single-thread benchmark.</p>"
    )


def _drive_table(runs: Sequence[RunResult]) -> str:
    rows = "".join(
        f"<tr><th scope=row>{run.seed}</th><td>{html.escape(run.reason)}</td><td>{run.seconds:.1f}</td>"
        f"<td>{run.path_length:.1f}</td><td>{run.goal_distance:.2f}</td><td>{np.median(run.perception_ms):.1f}</td>"
        f"<td>{_percentile(run.planning_ms)}</td><td>{run.real_time_factor:.1f}</td>"
        f"<td><code>{run.log_sha256[:12]}</code></td></tr>"
        for run in runs
    )
    return (
        "<div class=wide><table><thead><tr><th scope=col>world</th><th scope=col>outcome</th>"
        "<th scope=col>time (s)</th><th scope=col>driven (m)</th><th scope=col>from goal (m)</th>"
        "<th scope=col>image to segmentation, median (ms)</th><th scope=col>planning, p95 (ms)</th>"
        "<th scope=col>speed (x real time)</th><th scope=col>log digest</th></tr></thead>"
        f"<tbody>{rows}</tbody></table></div><p>Latencies are simulated, on {PROFILE}. The digest covers every message:"
        " the same seed gives the same digest on this machine.</p>"
    )


def _percentile(values: NDArray[np.float64]) -> str:
    """The 95th percentile, or a dash where a run ended before anything was measured."""
    return f"{np.percentile(values, 95):.0f}" if len(values) else "-"


def _class_table(result: ClassResult, manifest: dict[str, dict[str, Any]], out: Path) -> str:
    from robotbrain.grading.classroom import feedback_page
    from robotbrain.grading.marks import columns

    names = columns(result.rows)
    worth = {mark.exercise: mark.points for row in result.rows for mark in row.marks}
    head = "".join(f"<th scope=col>{html.escape(n.replace('_', ' '))} /{worth[n]:g}</th>" for n in names)
    lines = []
    for row in result.rows:
        entry = manifest[row.student]
        kind = _KINDS.get(entry["kind"], "accident" if entry["kind"] == "accident" else "unfinished")
        marks = {mark.exercise: mark for mark in row.marks}
        cells = "".join(_mark_cell(marks.get(name)) for name in names)
        page = feedback_page(result, row.student)
        student = html.escape(row.student)
        link = f'<a href="{page.relative_to(out).as_posix()}">{student}</a>' if page else student
        lines.append(
            f"<tr><th scope=row>{link}</th><td>{kind}: {html.escape(entry['name'])}</td>{cells}"
            f"<td>{row.earned:g}</td><td>{row.seconds:.0f}</td>"
            f"<td class=reason>{html.escape(row.reason()[:160])}</td></tr>"
        )
    return (
        "<div class=wide><table><thead><tr><th scope=col>student</th><th scope=col>what it is</th>"
        f"{head}<th scope=col>total</th><th scope=col>s</th><th scope=col>reason</th></tr></thead>"
        f"<tbody>{''.join(lines)}</tbody></table></div>"
    )


def _mark_cell(mark: Any) -> str:
    if mark is None:
        return "<td>-</td>"
    if mark.earned is None:
        return "<td class=hand>by hand</td>"
    kind = "full" if mark.earned >= mark.points - 1e-9 else "lost"
    return f"<td class={kind}>{mark.earned:g}</td>"


_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>robotbrain demo</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>
body { font: 16px/1.5 system-ui, sans-serif; color: #1b1b1b; background: #fff; margin: 2rem auto; max-width: 76rem;
  padding: 0 1rem; }
h1, h2 { line-height: 1.2; } h2 { margin-top: 2.2rem; }
img, iframe { max-width: 100%; width: 100%; border: 1px solid #ccc; } iframe { height: 32rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .86rem; }
th, td { padding: .25rem .55rem; border-bottom: 1px solid #ddd; text-align: right; vertical-align: top; }
th[scope=row], td:nth-child(2), td.reason { text-align: left; } td.reason { min-width: 18rem; }
thead th { background: #f2f2f2; }
td.lost { color: #8a1f11; font-weight: 600; } td.lost::after { content: " \\2717"; } td.hand { color: #555; }
a { color: #0b5394; }
</style></head><body><main>
@BODY@
</main></body></html>
"""
