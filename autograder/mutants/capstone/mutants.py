"""Named wrong solutions of `capstone`: each is a mistake that students make, and must lose its own points."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from robotbrain.grading.sample import Mutant

NETWORK, POLICY = "perception.onnx", "policy.onnx"
Made = dict[str, Callable[[Path], bytes | None]]


def _code(name: str, exercise: str, hint: str, describe: str, *edits: tuple[str, str], loses: float | None = None,
          cell: str = "") -> Mutant:  # fmt: skip
    """Return a mutant made by edits of its exercise's answer."""
    return Mutant(name=name, exercise=exercise, hint=hint, describe=describe, loses=loses,
                  replace={cell or exercise: list(edits)})  # fmt: skip


def _file(name: str, exercise: str, hint: str, describe: str, files: Made, loses: float | None = None) -> Mutant:
    """Return a mutant whose notebook is right and whose file is not."""
    return Mutant(name=name, exercise=exercise, hint=hint, describe=describe, loses=loses, replace={}, files=files)


def _floating(folder: Path) -> bytes:
    """Return the reference network without its Q/DQ nodes."""
    import onnx

    from robotbrain.grading.suites.hw2_optimisation_judge import without_quantisers

    plain = without_quantisers(onnx.load_model_from_string((folder / NETWORK).read_bytes()))
    used = {name for node in plain.graph.node for name in node.input}
    kept = [tensor for tensor in plain.graph.initializer if tensor.name in used]
    del plain.graph.initializer[:]
    plain.graph.initializer.extend(kept)
    content: bytes = plain.SerializeToString(deterministic=True)
    return content


def _quantised(name: str) -> Made:
    """Return what quantises a network of the kit and hands it in."""

    def make(_folder: Path) -> bytes:
        import tempfile

        from robotbrain.optimisation.data import scenes_of
        from robotbrain.optimisation.networks import network_path
        from robotbrain.optimisation.ptq import quantise_onnx

        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / NETWORK
            quantise_onnx(network_path(name), out, scenes_of(range(2_400_000, 2_400_008), 4).inputs())
            return out.read_bytes()

    return {NETWORK: make}


def _weights(change: Callable[[Any, Any], Any]) -> Made:
    """Return what replaces every matrix of the policy by ``change(array, rng)``."""

    def make(folder: Path) -> bytes:
        import numpy as np
        import onnx
        from onnx import numpy_helper

        model = onnx.load_model_from_string((folder / POLICY).read_bytes())
        rng = np.random.default_rng(0)
        for tensor in model.graph.initializer:
            array = numpy_helper.to_array(tensor)
            if array.dtype == np.float32 and array.ndim == 2:
                tensor.CopyFrom(numpy_helper.from_array(change(array, rng).astype(np.float32), tensor.name))
        content: bytes = model.SerializeToString(deterministic=True)
        return content

    return {POLICY: make}


def _starter_policy(_folder: Path) -> bytes:
    from robotbrain.rl.tasks.navigation_spec import default_policy

    return default_policy().read_bytes()


def _arm_policy(folder: Path) -> bytes:
    return (folder.parent / "hw1_rl" / "reach_policy.onnx").read_bytes()


MUTANTS = [
    # ------------------------------------------------------------ network
    _file("fp32-network", "network", "too-slow-for-the-module", "hands the network in before it was quantised",
          {NETWORK: _floating}, loses=6.0),
    _file("teacher-in-int8", "network", "too-slow-for-the-module", "quantises the teacher instead of a student",
          _quantised("teacher")),
    _file("starter-network", "network", "train-your-own", "starts from the kit's network", _quantised("student"),
          loses=6.0),
    _file("network-forgotten", "network", "file-beside-the-notebook", "hands the notebook in alone",
          {NETWORK: lambda _folder: None}, loses=14.0),
    # ------------------------------------------------------------ policy
    _file("starter-policy", "policy", "train-a-policy", "starts from the kit's policy", {POLICY: _starter_policy},
          loses=2.0),
    _file("policy-of-the-arm", "policy", "policy-of-another-task", "hands in the policy of homework 1",
          {POLICY: _arm_policy}, loses=8.0),
    _file("policy-before-training", "policy", "untrained-policy", "exports the policy before it was trained",
          _weights(lambda array, rng: rng.normal(0, array.std(), array.shape)), loses=5.0),
    _file("policy-diverged", "policy", "not-a-policy", "hands in a policy whose training diverged",
          _weights(lambda array, _rng: array * float("nan")), loses=8.0),
    # ------------------------------------------------------------ what the policy is shown
    _code("goal-in-the-map", "observe", "goal-in-the-robots-frame", "shows the waypoint as it is in the map",
          ("    ahead = np.cos(yaw) * east + np.sin(yaw) * north\n    left = -np.sin(yaw) * east + np.cos(yaw) * north\n",
           "    ahead, left = waypoint\n")),
    _code("turned-the-wrong-way", "observe", "goal-in-the-robots-frame", "turns the waypoint by plus the yaw",
          ("np.cos(yaw) * east + np.sin(yaw) * north", "np.cos(yaw) * east - np.sin(yaw) * north"),
          ("-np.sin(yaw) * east", "np.sin(yaw) * east")),
    _code("metres-for-a-bearing", "observe", "bearing-as-cos-and-sin", "shows x and y instead of the bearing",
          ("[np.cos(bearing), np.sin(bearing),", "[ahead, left,")),
    _code("far-goals-unclipped", "observe", "bearing-as-cos-and-sin", "lets far goals be further than any in training",
          ("min(distance, GOAL_RANGE)", "distance"), loses=2.0),
    _code("ranges-in-metres", "observe", "log-of-the-range", "shows ranges without the logarithm",
          ("LIDAR_SCALE * np.log(ranges / LIDAR_NEAREST)", "ranges / LIDAR_RANGE")),
    _code("groups-out-of-order", "observe", "order-of-the-groups", "shows the goal before the velocity",
          ("[velocity, goal,", "[goal, velocity,")),
    _code("points-moved-again", "observe", "points-are-in-the-robots-frame", "moves the points into a frame they are in",
          ("sector_ranges(points)", "sector_ranges((np.asarray(points).reshape(-1, 2) - [x, y]) @ np.array(\n"
           "        [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]))")),
    _code("no-last-action", "observe", "last-action-belongs-to-it", "shows zeros for the last action",
          ("LIDAR_NEAREST), last_action]", "LIDAR_NEAREST), np.zeros(2)]")),
    # ------------------------------------------------------------ planner
    Mutant(name="starter-planner", exercise="planner", hint="write-a-planner", describe="starts from the kit's planner",
           loses=4.0, replace={"planner": "MyPlanner = starter_planner"}),
    _code("planner-ignores-inflation", "planner", "robots-radius", "plans for a robot without a radius",
          ("inflate(occupancy, frame.resolution)", "inflate(occupancy, frame.resolution, radius=0.0, weight=0.0)"),
          loses=5.0),
    _code("planner-forgets-the-response", "planner", "return-response", "returns nothing from the service callback",
          ("            response.plan = numpy_to_path(points)\n        return response",
           "            response.plan = numpy_to_path(points)")),
    _code("planner-without-a-map", "planner", "empty-when-stuck", "does not expect to be asked before there is a map",
          ("        if self.map is None:\n            return response\n", ""), loses=1.0),
    # ------------------------------------------------------------ supervisor
    _code("fallback-never-triggers", "supervise", "late-image-falls-back", "trusts the policy whatever it says",
          ('"policy" if health.now_s - self.bad_s >= 1.0 else "pursuit"', '"policy"')),
    _code("late-camera-is-fine", "supervise", "late-image-falls-back", "looks at the policy, and not at the camera",
          ("if stop or not sane or not health.image_age_s <= 0.5:", "if stop or not sane:")),
    _code("drives-blind", "supervise", "blind-stops", "drives on without any image",
          (" and health.image_age_s <= 2.0)", ")")),
    _code("drives-lost", "supervise", "old-inputs-stop", "drives on without a pose",
          (" and health.pose_age_s <= 0.5", "")),
    _code("nan-passes", "supervise", "nan-is-no-number", "compares so that NaN is never too old",
          ("not (health.scan_age_s <= 0.5 and health.pose_age_s <= 0.5 and health.image_age_s <= 2.0)",
           "health.scan_age_s > 0.5 or health.pose_age_s > 0.5 or health.image_age_s > 2.0")),
    _code("one-sign-only", "supervise", "outside-of-training", "looks for inputs that are too large, not too small",
          ("np.abs(health.inputs) <= 2.0", "np.array(health.inputs) <= 2.0")),
    _code("no-hysteresis", "supervise", "come-back-slowly", "gives the wheel back at the first good moment",
          (">= 1.0", "> 0.0")),
    _code("never-comes-back", "supervise", "come-back-at-all", "never trusts the policy again",
          ('return "policy" if health.now_s - self.bad_s >= 1.0 else', 'return "policy" if self.bad_s < 0 else')),
    Mutant(name="memory-in-the-class", exercise="supervise", hint="a-memory-of-its-own",
           describe="keeps the memory in the class, so that a new supervisor inherits the last one's troubles",
           replace={"supervise": [("        self.bad_s = -np.inf", "        pass"),
                                  ("class Supervisor:", "class Supervisor:\n    bad_s = -np.inf"),
                                  ("            self.bad_s = health.now_s", "            Supervisor.bad_s = health.now_s")]}),
    # ------------------------------------------------------------ all together
    _code("one-spin-for-all", "integrate", "who-shares-a-thread", "lets all nodes share one thread",
          ('(("perception",), ("estimator",), ("controller",), ("mapper", "planner", "mission"))',
           '(("perception", "estimator", "controller", "mapper", "planner", "mission"),)')),
    _code("estimator-behind-the-camera", "integrate", "who-shares-a-thread", "lets the wheels wait for images",
          ('("perception",), ("estimator",)', '("perception", "estimator")')),
    _code("int8-file-fp16-engine", "integrate", "build-it-in-int8", "builds the engine of an INT8 file in FP16",
          ('precision="int8"', 'precision="fp16"')),
    _code("images-queue", "integrate", "newest-image-only", "lets images queue", ("camera_queue=1", "camera_queue=None"),
          loses=2.0),
    _code("paths-for-ever", "integrate", "paths-grow-old", "plans again too rarely",
          ("replan_after=1.5", "replan_after=2.5"), loses=2.0),
    _code("budget-too-tight", "integrate", "measure-the-budget", "promises the median",
          ('"perception": 70.0', '"perception": 40.0'), loses=4.0),
    _code("budget-of-anything", "integrate", "measure-the-budget", "promises what nobody could break",
          ('"perception": 70.0', '"perception": 1000.0'), loses=4.0),
    _code("budget-above-the-brief", "integrate", "measure-the-budget", "promises less than the brief asks for",
          ('"end_to_end": 140.0', '"end_to_end": 180.0'), loses=4.0),
]  # fmt: skip
