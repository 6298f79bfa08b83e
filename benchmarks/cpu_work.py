"""What a unit of each kind of CPU work takes on this machine: the numbers behind autograder/profiles/work.toml.

Run ``taskset --cpu-list 1 python benchmarks/cpu_work.py`` (Linux; elsewhere without taskset); with
``--write --host KEY`` it writes work.toml. The brain drives in a few worlds at no simulated cost. Whatever a node
charges by ``charge_work`` is matched with the CPU time of this thread since the node's last charge; (de)serialisation
is taken out and counted by itself. The perception node is fed enlarged images, too, because in a drive all images have
one size. All is done several times over, and the quickest time of each call counts: the calls are the same every time,
what differs is the rest of the machine. For each kind a line

    time of a call = fixed + units x (time of a unit)

is fitted to all its calls: least absolute relative deviations with non-negative coefficients, by iteratively
reweighted least squares. The deviation printed is the median over single calls.
"""

from __future__ import annotations

import argparse
import datetime
import platform
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from tqdm import tqdm

from robotbrain.files import write_text
from robotbrain.jetson import OnnxEngine
from robotbrain.jetson.paths import find_part
from robotbrain.jetson.profiles import JetsonProfile
from robotbrain.jetson.work import WorkKind, WorkTable
from robotbrain.pipeline.brain import default_model, drive
from robotbrain.pipeline.costs import CALLBACKS, KINDS
from robotbrain.pipeline.nodes.perception import PerceptionNode
from robotbrain.ros import SimContext, cdr, executors
from robotbrain.sim import CameraExtrinsics

JOINT = (("costmap", "astar", "smooth"), ("arcs", "distances"))
"""Kinds that one function does in one go; they are charged one after the other and fitted together."""

GROUP_OF = {kind: group for group in JOINT for kind in group}

now = time.thread_time_ns


@dataclass
class Records:
    """Calls of each kind as (units of each kind of its group, ns), and the work of each callback."""

    calls: dict[tuple[str, ...], list[tuple[tuple[float, ...], int]]] = field(default_factory=lambda: defaultdict(list))
    callbacks: dict[tuple[str, str, str], list[list[tuple[str, float]]]] = field(
        default_factory=lambda: defaultdict(list)
    )
    covered_ns: int = 0
    total_ns: int = 0


class Stopwatch:
    """Laps between charges, without the time spent on serialisation."""

    def __init__(self, records: Records) -> None:
        self.records = records
        self.overhead = int(np.median([-(now() - now()) for _ in range(2000)]))
        self.work: list[tuple[str, float]] | None = None
        self.mark = 0
        self.joint: list[float] = []
        self.joint_ns = 0

    def reset(self) -> None:
        self.mark = now()

    def exclude(self, since: int) -> None:
        self.mark += now() - since + self.overhead

    def lap(self, kind: str, units: float) -> None:
        if self.work is None:
            return
        elapsed = max(0, now() - self.mark - self.overhead)
        self.work.append((kind, units))
        group = GROUP_OF.get(kind)
        if group is not None:
            self.joint.append(units)
            self.joint_ns += elapsed
            if kind == group[-1]:
                self.add(group, tuple(self.joint), self.joint_ns)
                self.joint, self.joint_ns = [], 0
        else:
            self.add((kind,), (units,), elapsed)
        self.reset()

    def add(self, kinds: tuple[str, ...], units: tuple[float, ...], elapsed: int) -> None:
        self.records.calls[kinds].append((units, elapsed))
        self.records.covered_ns += elapsed

    def message(self, kind: str, size: int, elapsed: int) -> None:
        if self.work is not None:
            self.work.append((kind, size))
            self.add((kind,), (size,), max(0, elapsed - self.overhead))


@contextmanager
def stopwatch(records: Records) -> Iterator[None]:
    """Time every charge of every brain node inside the block."""
    watch = Stopwatch(records)
    call, take, put = executors.Executor._call, cdr.from_cdr, cdr.to_cdr
    started = [0]

    def timed_call(self: Any, work: Any) -> bool:
        entity = work.entity
        role = entity.node.get_name()
        inner = role in {role for role, _, _ in CALLBACKS.values()}
        watch.work = [] if inner else None
        started[0] = now()
        watch.reset()
        try:
            return call(self, work)
        finally:
            if inner and watch.work is not None:
                records.total_ns += now() - started[0] - watch.overhead
                topic = "" if entity.kind == "timer" else entity.name
                records.callbacks[role, entity.kind, topic].append(watch.work)
            watch.work = None

    def timed_take(data: bytes, cls: Any) -> Any:
        message = take(data, cls)
        # The executor's part in handing the message over is counted with it.
        watch.message("message_in", len(data), now() - started[0])
        watch.reset()
        return message

    def timed_put(message: Any) -> bytes:
        began = now()
        data = put(message)
        watch.message("message_out", len(data), now() - began)
        watch.exclude(began)
        return data

    def timed_charge(self: SimContext, nanoseconds: int, resource: str = "cpu") -> bool:
        # A network has run on this machine since the last charge; on the Jetson the GPU does that.
        records.total_ns -= now() - watch.mark - watch.overhead
        watch.reset()
        return True

    def timed_charge_work(self: SimContext, kind: str, units: float) -> bool:
        watch.lap(kind, units)
        return True

    with (
        mock.patch.object(executors.Executor, "_call", timed_call),
        mock.patch.object(cdr, "from_cdr", timed_take),
        mock.patch.object(cdr, "to_cdr", timed_put),
        mock.patch.object(SimContext, "charge", timed_charge),
        mock.patch.object(SimContext, "charge_work", timed_charge_work),
    ):
        yield


class HostProfile(JetsonProfile):
    """Nothing costs simulated time: the brain of the recorded drives is never late."""

    def network_ms(self, model: str | Path, precision: str = "fp16") -> float:
        return 0.0


def free_profile() -> HostProfile:
    kinds = {name: WorkKind(name, unit, what, 0.0, 0.0, 0.0) for name, (unit, what) in KINDS.items()}
    table = WorkTable("none", "none", "assumed", "kit:nothing costs anything", kinds, {})
    return HostProfile("host", "this machine", "none", 64, 0, 1.0, table)


class LargeImages:
    """The network at several times its resolution, by repetition: only what is around it is timed."""

    resource = "gpu"
    latency_ns = 0

    def __init__(self, factor: int) -> None:
        self._factor, self._engine = factor, OnnxEngine(default_model())

    def infer(self, batch: NDArray[np.float32]) -> NDArray[np.float32]:
        k = self._factor
        return self._engine.infer(np.ascontiguousarray(batch[:, :, ::k, ::k])).repeat(k, axis=2).repeat(k, axis=3)


def enlarge(frames: list[tuple[Any, Any, Any]], factor: int) -> None:
    """Run the perception node on recorded frames, enlarged."""
    from sensor_msgs.msg import CameraInfo, Image

    from robotbrain.ros.conversions import image_to_numpy, numpy_to_image
    from robotbrain.ros.node import Node

    mount = CameraExtrinsics()
    context = SimContext()
    with context.as_default():
        PerceptionNode(LargeImages(factor), (mount.x, mount.y, mount.z, mount.pitch))  # type: ignore[arg-type]
        camera = Node("camera")
        info_pub = camera.create_publisher(CameraInfo, "camera/camera_info", 10)
        depth_pub = camera.create_publisher(Image, "camera/depth", 10)
        image_pub = camera.create_publisher(Image, "camera/image", 10)
        for info, depth, image in frames:
            scaled = info.k * factor
            scaled[8] = 1.0
            info = type(info)(header=info.header, height=info.height * factor, width=info.width * factor, k=scaled)
            info_pub.publish(info)
            for publisher, message, encoding in ((depth_pub, depth, "32FC1"), (image_pub, image, "rgb8")):
                pixels = np.asarray(image_to_numpy(message)).repeat(factor, axis=0).repeat(factor, axis=1)
                publisher.publish(numpy_to_image(pixels, encoding, stamp=message.header.stamp))
            context.run_for(0.1)


def record_frames(seed: int, count: int) -> list[tuple[Any, Any, Any]]:
    """Return (info, depth, image) messages of one drive, evenly spread."""
    seen: dict[str, list[Any]] = defaultdict(list)

    class Recorder(PerceptionNode):
        def _on_info(self, msg: Any) -> None:
            super()._on_info(msg)
            seen["info"].append(msg)

        def _on_depth(self, msg: Any) -> None:
            super()._on_depth(msg)
            seen["depth"].append(msg)

        def _on_image(self, msg: Any) -> None:
            super()._on_image(msg)
            seen["image"].append(msg)

    mount = CameraExtrinsics()
    part = lambda: Recorder(OnnxEngine(default_model()), (mount.x, mount.y, mount.z, mount.pitch))  # noqa: E731
    drive(seed, profile=free_profile(), parts={"perception": part})
    frames = list(zip(seen["info"], seen["depth"], seen["image"], strict=True))
    return frames[:: max(1, len(frames) // count)][:count]


def quickest(runs: list[Records]) -> Records:
    """Return the first of equal runs with the quickest time of each call."""
    best = runs[0]
    for group, calls in best.calls.items():
        others = [run.calls[group] for run in runs]
        if any([units for units, _ in other] != [units for units, _ in calls] for other in others):
            raise AssertionError(f"{group}: the repeats did not do the same work")
        best.calls[group] = [(calls[k][0], min(other[k][1] for other in others)) for k in range(len(calls))]
    return best


def fit(units: NDArray[np.float64], elapsed: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Return (fixed, per unit of each column ...) >= 0 and the median relative deviation."""
    # What never varies cannot be told from the fixed part: one unit is a call, more are counted as units.
    varies = np.ptp(units, axis=0) > 0.2 * units.max(axis=0)
    fixed = bool(varies.any() or (units.max(axis=0) <= 1).all())
    columns = [np.full(len(units), float(fixed))] + [
        units[:, k] * (varies[k] or not fixed) for k in range(units.shape[1])
    ]
    design = np.stack(columns, axis=1)
    scale = np.maximum(np.abs(design).max(axis=0), 1e-12)
    weights = np.ones(len(elapsed))
    for _ in range(30):
        row = np.sqrt(weights) / elapsed
        found, _ = nnls(design / scale * row[:, None], elapsed * row)
        deviation = np.abs((design / scale) @ found / elapsed - 1)
        weights = 1 / np.maximum(deviation, 1e-3)
    return found / scale, float(np.median(deviation))


def fit_all(records: Records) -> dict[str, WorkKind]:
    found: dict[str, WorkKind] = {}
    for group, calls in records.calls.items():
        units = np.array([u for u, _ in calls], dtype=float)
        elapsed = np.maximum(np.array([ns for _, ns in calls], dtype=float), 1.0)
        values, error = fit(units, elapsed)
        for k, kind in enumerate(group):
            unit, what = KINDS[kind]
            found[kind] = WorkKind(kind, unit, what, float(values[0]) if k == 0 else 0.0, float(values[k + 1]), error)
    return {kind: found[kind] for kind in KINDS}


def typical(records: Records) -> dict[str, dict[str, tuple[float, float]]]:
    """Mean (calls, units) by kind of each callback listed in CALLBACKS."""
    result = {}
    for name, key in CALLBACKS.items():
        runs = records.callbacks[key]
        totals: dict[str, list[float]] = defaultdict(lambda: [0.0, 0.0])
        for work in runs:
            for kind, units in work:
                totals[kind][0] += 1
                totals[kind][1] += units
        order = [kind for kind in KINDS if kind in totals]
        result[name] = {kind: (totals[kind][0] / len(runs), totals[kind][1] / len(runs)) for kind in order}
    return result


def cpu_name() -> str:
    path = Path("/proc/cpuinfo")
    if path.exists():
        for line in path.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


HEADER = """\
# CPU work of the brain's nodes: what a unit of each kind takes on the computer named below, one thread, in nanoseconds.
# Written by benchmarks/cpu_work.py --write; do not edit. A module's time is this, times the single-thread benchmark of
# this computer, over the module's (cpu_hosts.toml, modules/*.toml).
# These are the kit's nodes, in Python with NumPy: what a student's Python node sees. A brain in C++ would be faster.
# The middleware (message_in, message_out) is the kit's own CDR codec and executor; genuine rclpy takes longer.
"""


def to_toml(
    kinds: dict[str, WorkKind], callbacks: dict[str, dict[str, tuple[float, float]]], records: Records, host: str
) -> str:
    software = f"Python {platform.python_version()}, NumPy {np.__version__}"
    lines = [HEADER, "[host]", f'key = "{host}"', f'cpu = "{cpu_name()}"', f'software = "{software}"']
    command = f"python benchmarks/cpu_work.py --write --host {host}"
    lines += [f'date = "{datetime.date.today().isoformat()}"', f'command = "{command}"']
    lines += ['provenance = "measured"', 'source = "kit:benchmarks/cpu_work.py"', ""]
    count = {kind: len(calls) for group, calls in records.calls.items() for kind in group}
    for kind in kinds.values():
        lines += [f"[kinds.{kind.name}]", f'unit = "{kind.unit}"', f'what = "{kind.what}"']
        lines += [f"fixed_ns = {kind.fixed_ns:.5g}", f"unit_ns = {kind.unit_ns:.5g}"]
        lines += [f"error = {kind.error:.2g}", f"calls = {count[kind.name]}", ""]
    for name, (role, entity, topic) in CALLBACKS.items():
        lines += [f"[callbacks.{name}]", f'role = "{role}"', f'kind = "{entity}"']
        lines += [f'topic = "{topic}"'] * bool(topic)
        lines += [f"[callbacks.{name}.work]  # calls and units of an average callback"]
        lines += [f"{kind} = [{calls:.4g}, {units:.5g}]" for kind, (calls, units) in callbacks[name].items()]
        lines.append("")
    return "\n".join(lines)


def print_table(kinds: dict[str, WorkKind], records: Records, seconds: float) -> None:
    load = defaultdict(float)
    for group, calls in records.calls.items():
        for units, _ in calls:
            for kind, amount in zip(group, units, strict=True):
                load[kind] += kinds[kind].host_ns(amount) / seconds * 1e-6
    print(f"{'kind':<14}{'calls':>8}{'fixed us':>10}{'ns/unit':>10}  {'unit':<18}{'deviation':>9}{'ms per s':>10}")
    count = {kind: len(calls) for group, calls in records.calls.items() for kind in group}
    for kind in kinds.values():
        print(
            f"{kind.name:<14}{count[kind.name]:>8}{kind.fixed_ns / 1e3:>10.1f}{kind.unit_ns:>10.3g}  {kind.unit:<18}"
            f"{kind.error:>9.0%}{load[kind.name]:>10.2f}"
        )
    print(f"all{sum(load.values()):>76.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=6100, help="seed of the first world")
    parser.add_argument("--worlds", type=int, default=4, help="worlds to drive in")
    parser.add_argument("--repeats", type=int, default=5, help="how often all of it is done")
    parser.add_argument("--write", action="store_true", help="write work.toml")
    parser.add_argument("--host", default="", help="key of this computer in cpu_hosts.toml (needed to write)")
    arguments = parser.parse_args()
    if arguments.write and not arguments.host:
        parser.error("--write needs --host, a key of cpu_hosts.toml: the times mean nothing without the benchmark")
    drive(arguments.first, profile=free_profile(), time_limit=2.0)  # imports and first calls
    frames = record_frames(arguments.first, 40)
    drives, enlarged = [], []
    for _ in tqdm(range(arguments.repeats), desc="repeats"):
        seconds = 0.0
        drives.append(Records())
        with stopwatch(drives[-1]):
            for seed in range(arguments.first, arguments.first + arguments.worlds):
                seconds += drive(seed, profile=free_profile()).seconds
        enlarged.append(Records())
        with stopwatch(enlarged[-1]):
            for factor in (1, 2, 4):
                enlarge(frames, factor)
    records = quickest(drives)
    callbacks = typical(records)
    share = float(np.median([run.covered_ns / run.total_ns for run in drives]))
    print(f"{share:.0%} of the CPU time of the brain's callbacks (without inference) is charged to some kind of work\n")
    driven = {group: list(calls) for group, calls in records.calls.items()}
    for kind, calls in quickest(enlarged).calls.items():
        records.calls[kind] += calls
    kinds = fit_all(records)
    records.calls = defaultdict(list, driven)
    print_table(kinds, records, seconds)
    if arguments.write:
        path = find_part("modules").parent / "work.toml"
        write_text(path, to_toml(kinds, callbacks, records, arguments.host))
        print(f"\nwrote {path}")


if __name__ == "__main__":
    main()
