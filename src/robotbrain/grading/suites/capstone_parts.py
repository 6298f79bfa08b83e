"""How `capstone` judges the parts by themselves: the network, the policy, what the policy is shown, the planner.

Files come from strangers: they are read by the hardened loaders of homework 2 and of the policies, and measured in the
tests' own process.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robotbrain.errors import InputError
from robotbrain.grading import expect, fail
from robotbrain.grading.suites import hw2_optimisation_judge as scenes
from robotbrain.grading.suites import hw2_optimisation_network as network_file
from robotbrain.grading.suites import judging, policy_file
from robotbrain.grading.suites.capstone_probes import whose_planner
from robotbrain.grading.suites.hw1_rl_evidence import exact_bound
from robotbrain.pipeline.capstone import BRIEF
from robotbrain.pipeline.geometry import inverse, transform
from robotbrain.rl.tasks import navigation_spec as spec

if TYPE_CHECKING:
    from robotbrain.grading import Student
    from robotbrain.rl.onnx_policy import OnnxPolicy

Array = NDArray[np.float64]
Pose = tuple[float, float, float]

REACHED = 0.75
"""At least this share of goals in unseen rooms must be proved to be reached (one-sided 95 % interval) ..."""
TOUCHED = 0.12
"""... and at most this share of episodes may end at an obstacle."""
PRACTICE_ROOMS, ROOMS = 40, 100
GOALS = (0.5, 1.5)
"""Distance of the goals, m: as far as the planner's waypoints are, and further."""
SAME_POLICY = 0.05
"""Two policies whose actions differ by less on average are one."""

HINTS = network_file.HINTS | {
    key: scenes.HINTS[key]
    for key in (
        "int8-by-qdq",
        "tensorrt-safe",
        "most-of-it-in-int8",
        "quantisation-broke-it",
        "labels-are-not-enough",
        "no-better-than-chance",
    )
}
HINTS |= {
    "too-slow-for-the-module": "The network is too slow at the camera's 640 x 480. Is it quantised at all? Has it more "
    "channels than it needs?",
    "too-much-memory": "The twin counts weights, activations and the runtime. Weights in INT8 take a quarter of FP32, "
    "and activations at 640 x 480 grow with the channels of the first layers.",
    "not-a-policy": "This file is no policy as `robotbrain rl export` writes it: a feed-forward network with its "
    "metadata.",
    "policy-of-another-task": "The base needs a policy of the task `navigation`: 43 observations in, forward speed and "
    "turning rate out. Homework 1's policy moves an arm.",
    "untrained-policy": "This policy reaches hardly any goal, even in rooms like those of its training. Was it "
    "exported before it was trained?",
    "policy-touches": "It reaches goals, but touches too much on the way. Train longer; look at `collision` and "
    "`obstacle_proximity` among the rewards.",
    "train-a-policy": "This is the starter policy. For these two points train one: `robotbrain rl train navigation "
    "--seed N`, then `robotbrain rl export`.",
    "write-a-planner": "This is the starter planner, or it calls the kit's. For these points bring your own of the "
    "lab.",
    "goal-in-the-robots-frame": "The waypoint is given in the map, the policy thinks in the robot's frame: subtract "
    "the robot's position FIRST, then turn by MINUS its yaw.",
    "bearing-as-cos-and-sin": "The goal is shown as cos and sin of its bearing, and its distance over 3 m, clipped to "
    "1.",
    "log-of-the-range": "Ranges are clipped to LIDAR_NEAREST .. LIDAR_RANGE and shown as log(range / LIDAR_NEAREST) * "
    "LIDAR_SCALE.",
    "points-are-in-the-robots-frame": "The points are in the robot's frame already: hand them to `sector_ranges` as "
    "they are.",
    "order-of-the-groups": "The numbers are right, their order is not: velocity (2), goal (3), ranges (36), last "
    "action (2). A network cannot tell, it only drives oddly.",
    "last-action-belongs-to-it": "The last two numbers are the policy's last action, as it is given.",
    "forty-three-numbers": "Return one flat array of 43 numbers: `np.concatenate`.",
    "robots-radius": "The path must keep 0.22 m from every occupied cell: inflate the map before you search it, with "
    "the map's own resolution.",
    "answer-the-service": "The service callback must return its response, with an empty path where there is no route.",
}


# ---------------------------------------------------------------- the network


def file_name(student: Student, name: str) -> str:
    """Return the name of a file that the notebook gives, or fail."""
    given = student[name]
    if not isinstance(given, str) or Path(given).name != given:
        fail(f"{name} should be a plain file name", got=given, expected=f'"{name.lower()}.onnx"',
             hint="file-beside-the-notebook")  # fmt: skip
    return str(given)


def handed_in(student: Student) -> Any:
    """Return the student as homework 2's judge wants to see one: with the name of the network's file."""
    return SimpleNamespace(STUDENT=file_name(student, "NETWORK"), files=student.files)


def check_int8(student: Student) -> None:
    """Fail unless the network runs in INT8, nearly all of it, and TensorRT takes it."""
    scenes.check_int8(handed_in(student))


def check_fits(student: Student) -> None:
    """Fail unless the network keeps within latency and memory of the brief."""
    network = network_file.load(handed_in(student))
    found = predict(network.path, "int8" if network.quantised else "fp32")
    given = f"{BRIEF.module}, images of {BRIEF.image_size[0]} x {BRIEF.image_size[1]}, {found.precision}"
    expect(found.latency_ms <= BRIEF.network_ms, "the network is too slow for the module",
           got=f"{found.latency_ms:.1f} ms", expected=f"at most {BRIEF.network_ms:g} ms", given=given,
           hint="too-slow-for-the-module")  # fmt: skip
    expect(found.memory_mb <= BRIEF.network_mb, "the network needs too much memory", got=f"{found.memory_mb:.0f} MB",
           expected=f"at most {BRIEF.network_mb:g} MB", given=given, hint="too-much-memory")  # fmt: skip


def predict(path: Path, precision: str) -> Any:
    """Return the twin's prediction for a network on the brief's module at its image size."""
    from robotbrain import jetson
    from robotbrain.jetson.resize import at_image_size

    module, _, mode = BRIEF.module.partition(":")
    return jetson.predict(at_image_size(path, BRIEF.image_size), module, mode=mode, precision=precision)


def judge_scenes(student: Student, seeds: Sequence[int], looks: Sequence[tuple[int, float]]) -> None:
    """Fail unless the network sees nearly as well as the teacher, as homework 2 judges it."""
    scenes.judge_accuracy(handed_in(student), seeds, looks)


# ---------------------------------------------------------------- the policy


def load_policy(student: Student) -> OnnxPolicy:
    """Return the policy in the file that was handed in, or fail and say what it is instead."""
    name = file_name(student, "POLICY")
    policy = policy_file.handed_in(student, name)
    try:
        spec.check_meta(policy.meta)
    except InputError as error:
        fail(f"{name} is for something else: {error.what}", got=error.given, expected=error.expected,
             hint="policy-of-another-task")  # fmt: skip
    return policy


def check_own_policy(student: Student) -> None:
    """Fail if the policy does what the kit's does."""
    obs = np.random.default_rng(3).uniform(-1, 1, (64, sum(size for _, size in spec.OBSERVATIONS)))
    kits = policy_file.opened(spec.default_policy())
    mine, theirs = (policy.meta.clip(policy(obs)) for policy in (load_policy(student), kits))
    apart = float(np.abs(mine - theirs).mean())
    expect(apart > SAME_POLICY, "this is the starter policy", given="64 made-up observations",
           got=f"actions that differ from the starter's by {apart:.3f} on average", hint="train-a-policy")  # fmt: skip


def judge_policy(student: Student, episodes: int, seed: int) -> None:
    """Fail unless the policy is proved to reach goals in rooms that it has not seen, without touching much."""
    policy = load_policy(student)
    try:
        reached, touched = rooms(policy, episodes, seed)
    except InputError as error:
        fail(f"this policy cannot drive: {error.what}", got=error.given, expected=error.expected, hint="not-a-policy")
    bound = exact_bound(reached, episodes)
    got = f"{reached} of {episodes} goals reached, which proves at least {bound:.0%}; {touched} ended at an obstacle"
    given = f"{episodes} unseen rooms, goals {GOALS[0]:g} to {GOALS[1]:g} m away"
    # Few rooms prove little: practice asks for the share itself, the final judgement for its proof.
    share = bound if episodes >= ROOMS else reached / episodes
    expect(touched <= math.ceil(TOUCHED * episodes), "the policy touches too much", got=got, given=given,
           expected=f"at most {math.ceil(TOUCHED * episodes)} episodes that end at an obstacle",
           hint="untrained-policy" if reached < episodes / 2 else "policy-touches")  # fmt: skip
    expect(share >= REACHED, "the policy reaches too few goals", got=got, given=given,
           expected=f"{'a proved share' if episodes >= ROOMS else 'a share'} of at least {REACHED:.0%}",
           hint="untrained-policy")  # fmt: skip


def rooms(policy: OnnxPolicy, episodes: int, seed: int) -> tuple[int, int]:
    """Return how many goals a policy reaches, and how many episodes end at an obstacle, in unseen rooms."""
    from robotbrain.rl.envs import ManagerBasedRLEnv
    from robotbrain.rl.evaluate import run_episodes
    from robotbrain.rl.tasks.navigation import NavigationEnvCfg

    cfg = NavigationEnvCfg()
    cfg.play_mode()
    cfg.scene.num_envs, cfg.seed, cfg.commands.goal.distance = episodes, seed, GOALS
    cfg.events.layout.params = {**cfg.events.layout.params, "layouts": episodes}
    names = ("goal_reached", "collision")
    table = run_episodes(
        ManagerBasedRLEnv(cfg, num_threads=1),
        policy,
        episodes,
        seed=seed,
        measure=lambda env, step: {name: env.termination_manager.get_term(name).float() for name in names},
        tail=1,
    )
    reached, touched = (int((table.tail[name][:, -1] > 0.5).sum()) for name in names)
    return reached, touched


# ---------------------------------------------------------------- what the policy is shown


def observe(pose: Pose, velocity: Any, waypoint: Any, points: Any, last_action: Any) -> Any:
    """Return what the policy is shown; the stand-in for a student's function of this name."""
    goal = transform(inverse(pose), np.asarray(waypoint, dtype=float))
    return spec.observation(velocity, goal, spec.sector_ranges(points), last_action)[0]


def random_question(rng: np.random.Generator, far: bool = False) -> tuple[Any, ...]:
    """Return arguments for ``observe`` in which every group of numbers is another."""
    pose = (*(float(v) for v in rng.uniform(-3, 3, 2)), float(rng.uniform(-3, 3)))
    bearing, distance = rng.uniform(-3, 3), rng.uniform(3.5, 6.0) if far else rng.uniform(0.3, 2.5)
    waypoint = (float(pose[0] + distance * np.cos(bearing)), float(pose[1] + distance * np.sin(bearing)))
    angles, ranges = rng.uniform(-np.pi, np.pi, 60), rng.uniform(0.1, 3.5, 60)
    points = ranges[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    velocity = (float(rng.uniform(0.05, 0.5)), float(rng.uniform(-1.2, 1.2)))
    return pose, velocity, waypoint, points, rng.uniform(-1, 1, 2)


def compare_observe(student: Student, question: tuple[Any, ...], what: slice = slice(None)) -> None:
    """Compare (a part of) what the student's function shows the policy with what it was trained on."""
    expected = np.asarray(observe(*question), dtype=float)
    answer = student.observe(*question)
    numbers = judging.as_numbers(answer)
    if numbers is None or numbers.shape != expected.shape:
        shape = "no numbers" if numbers is None else f"shape {numbers.shape}"
        fail("the policy takes one flat array of 43 numbers", got=shape, expected="shape (43,)",
             hint="forty-three-numbers")  # fmt: skip
    assert numbers is not None
    pose, velocity, waypoint, points, last = question
    given = f"pose {tuple(round(v, 2) for v in pose)}, waypoint {tuple(round(v, 2) for v in waypoint)}"

    def mistakes() -> list[tuple[str, Array]]:
        return [(hint, wrong[what]) for hint, wrong in _mistakes(pose, velocity, waypoint, points, last)]

    hint = "order-of-the-groups" if np.allclose(np.sort(numbers), np.sort(expected), atol=1e-4) else ""
    judging.compare(numbers[what], expected[what], mistakes, atol=2e-4, match_atol=1e-3, hint=hint, given=given,
                    what="what the policy is shown")  # fmt: skip


def _mistakes(pose: Pose, velocity: Any, waypoint: Any, points: Any, last: Any) -> list[tuple[str, Array]]:
    ahead = np.asarray(waypoint) - np.asarray(pose[:2])
    back = transform((0.0, 0.0, pose[2]), ahead)
    turned = transform((0.0, 0.0, -pose[2]), np.asarray(waypoint))
    goals = [np.asarray(waypoint), ahead, back, turned - np.asarray(pose[:2]), -transform(inverse(pose), waypoint)]
    ranges = spec.sector_ranges(points)

    def shown(goal: Any = None, scan: Any = None, action: Any = last) -> Array:
        right = transform(inverse(pose), np.asarray(waypoint)) if goal is None else goal
        return np.asarray(spec.observation(velocity, right, ranges if scan is None else scan, action)[0], dtype=float)

    found = [("goal-in-the-robots-frame", shown(goal)) for goal in goals]
    plain = shown()
    x, y = transform(inverse(pose), np.asarray(waypoint))
    away = math.hypot(x, y)
    for goal in ((x, y, away), (x, y, away / 3), (x / 3, y / 3, away / 3), (x / away, y / away, away),
                 (x / away, y / away, away / 3), (y / away, x / away, min(away, 3) / 3)):  # fmt: skip
        found.append(("bearing-as-cos-and-sin", np.concatenate([plain[:2], goal, plain[5:]])))
    clipped = np.clip(ranges, spec.LIDAR_NEAREST, spec.LIDAR_RANGE)
    for scan in (ranges, clipped, ranges / 3, clipped / 3, np.log(clipped), np.log(clipped / spec.LIDAR_NEAREST),
                 np.log(np.maximum(ranges, 1e-9) / spec.LIDAR_NEAREST) * spec.LIDAR_SCALE):  # fmt: skip
        found.append(("log-of-the-range", np.concatenate([plain[:5], scan, plain[41:]])))
    for there in (pose, inverse(pose)):
        found.append(("points-are-in-the-robots-frame", shown(scan=spec.sector_ranges(transform(there, points)))))
    found.append(("last-action-belongs-to-it", shown(action=np.zeros(2))))
    found.append(("last-action-belongs-to-it", np.concatenate([plain[:41], np.asarray(velocity)])))
    return found


# ---------------------------------------------------------------- the planner


def check_own_planner(student: Student) -> None:
    """Fail if the planner is the kit's."""
    why = student.run(whose_planner, "MyPlanner")
    expect(not why, str(why), hint="write-a-planner")


def stand_in_planner() -> Any:
    """Return the kit's planner node, for a student's that is not right yet."""
    from robotbrain.pipeline.nodes.planner import PlannerNode

    return PlannerNode()


def warm() -> None:
    """Import, compile and cache what judging needs."""
    scenes.warm()
    rooms(policy_file.opened(spec.default_policy()), 2, 0)
    predict(Path(spec.__file__).parents[2] / "optimisation" / "weights" / "student.onnx", "int8")
