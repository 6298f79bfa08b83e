"""How `hw1_rl` judges a policy file: on targets and arms that its author has not seen, by what its successes prove.

Nothing is trained here, and nothing that a student wrote runs here: the file is data, which `OnnxPolicy` reads and
checks before ONNX Runtime sees it, and arms move in the tests' own process.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import stats

from robotbrain.errors import InputError
from robotbrain.grading import expect, fail
from robotbrain.grading.suites import hw1_rl_probes as probes
from robotbrain.grading.suites import policy_file
from robotbrain.grading.suites.hw1_rl_evidence import exact_bound

if TYPE_CHECKING:
    from robotbrain.rl.onnx_policy import OnnxPolicy
    from robotbrain.rl.surrogate.reach import ReachEpisodes

HALF = 0.60
"""What is proved at least for half of the points."""
PRACTICE_SERIALS = range(100)
"""Surrogates that students may try; hidden tests use others."""
CONTROL_DT, ACTION_SCALE = 0.04, 0.3

HINTS = {
    "file-beside-the-notebook": "The file must lie beside the notebook, under the name that the notebook gives it, and "
    "be handed in with it.",
    "not-a-policy": "This file is not a policy as `export_policy` writes it. Export the actor again, with "
    "`reach_meta(env.env)`.",
    "another-robot": "This policy is for another task or another robot. Did a file of that name lie there before?",
    "control-rate": "The arm is asked 25 times a second: the policy's metadata must say control_dt = 0.04.",
    "joint-order": "The metadata names the joints in another order than the task does: the action for one joint moves "
    "another. Use `reach_meta(env.env)` as it is.",
    "actions-in-the-meta": "The metadata says that actions mean something else than in training. Use "
    "`reach_meta(env.env)` as it is.",
    "untrained-policy": "This policy does next to nothing useful: was it exported before it was trained, or was it the "
    "critic's or the wrong agent's network?",
    "train-on": "It reaches some targets. Look at the learning curve: train longer, or change gamma, learning rates, "
    "noise, one at a time.",
    "differs-from-training": "It reaches targets in simulation and not here: nothing in training prepared it for arms "
    "that lag, rub, or carry something.",
    "arms-differ": "With these events all arms still move alike. Vary something that moves them differently: latency, "
    "load, friction, motor strength, mass.",
    "same-robot": "Change events and noise only: observations, actions and rewards must stay as they are, or the "
    "policy does not fit the robot.",
}


def load(student: Any, name: Any) -> OnnxPolicy:
    """Return the policy in the file ``name`` that was handed in, or fail and say what it is instead."""
    if not isinstance(name, str) or Path(name).name != name:
        fail("the name of the policy file should be a plain file name", got=name, expected='"reach_policy.onnx"',
             hint="file-beside-the-notebook")  # fmt: skip
    policy = policy_file.handed_in(student, name)
    meta = policy.meta
    expect(meta.task == "reach", f"{name} holds a policy for another task", got=meta.task, expected="reach",
           hint="another-robot")  # fmt: skip
    expect(abs(meta.control_dt - CONTROL_DT) < 1e-9, f"{name} holds a policy for another control rate",
           got=f"control_dt = {meta.control_dt:g} s", expected=f"{CONTROL_DT:g} s", hint="control-rate")  # fmt: skip
    return policy


def episodes(policy: OnnxPolicy, serials: Sequence[int], seed: int, *, nominal: bool) -> ReachEpisodes:
    """Let a policy reach a target with each arm.

    Args:
        policy: with metadata.
        serials: of the arms.
        seed: of targets, start poses and sensor noise.
        nominal: in simulation, where every arm is as the model says.
    """
    from robotbrain.rl.surrogate import SurrogateReachEnv, neutral

    if nominal:
        env = SurrogateReachEnv(serials, seed, params=[neutral(7)] * len(serials), ramp_s=0.0)
    else:
        env = SurrogateReachEnv(serials, seed)
    try:
        return env.run(policy)
    except InputError as error:
        fail(f"this policy cannot run the arm: {error.what}", got=error.given, expected=error.expected,
             hint="another-robot")  # fmt: skip
        raise  # for the type checker: fail always raises


Looks = tuple[tuple[int, float], ...]
"""After how many targets to look, and with how much doubt the wanted rate may then be thought to be proved. A policy
that reaches nearly all of them needs few: all of the first look's settle it."""


@dataclass(frozen=True)
class Trial:
    """Where a policy is tried, and what it must prove there.

    Attributes:
        nominal: in simulation, as in :func:`episodes`.
        threshold: at least this success rate; proved is the lower end of the exact one-sided 95 % interval.
        practice_seed: of what students may try.
        practice, final: the looks.
    """

    nominal: bool
    threshold: float
    practice_seed: int
    practice: Looks
    final: Looks


SIMULATION = Trial(True, 0.85, 20, ((15, 0.10), (40, 0.05), (100, 0.05)), ((20, 0.04), (60, 0.01), (300, 0.05)))
SURROGATES = Trial(False, 0.80, 21, ((11, 0.10), (40, 0.05), (100, 0.05)), ((15, 0.04), (60, 0.01), (300, 0.05)))


def practise(student: Any, name: Any, trial: Trial) -> None:
    """Judge a policy by the targets and arms that students may try."""
    judge(student, name, trial, PRACTICE_SERIALS, trial.practice_seed, trial.practice)


def decide(student: Any, name: Any, trial: Trial, rng: np.random.Generator) -> None:
    """Judge a policy by targets and arms that nobody has seen."""
    first, seed = (int(number) for number in rng.integers(10**6, 10**9, 2))
    judge(student, name, trial, range(first, first + trial.final[-1][0]), seed, trial.final)


def judge(student: Any, name: Any, trial: Trial, serials: Sequence[int], seed: int, looks: Looks) -> None:
    """Fail unless the successes prove a rate of the trial's threshold; half of the points for ``HALF``.

    Args:
        student: whose files they are.
        name: of the file.
        serials, seed: as in :func:`episodes`.
        looks: a policy that cannot come to half of the points any more is not looked at any further.
    """
    nominal, threshold = trial.nominal, trial.threshold
    policy = load(student, name)
    errors, reached, n = [], 0, 0
    for number, (count, doubt) in enumerate(looks):
        run = episodes(policy, serials[n:count], seed + number, nominal=nominal)
        errors.append(run.final_error)
        reached, n = reached + int(run.success.sum()), count
        if exact_bound(reached, n, doubt) >= threshold:
            return
        if 1 - exact_bound(n - reached, n, 0.001) < HALF:  # the rate is less than this
            break
    bound, error = exact_bound(reached, n), np.concatenate(errors)
    place = "in simulation" if nominal else "on surrogate arms"
    expect(
        bound >= threshold,
        f"too few targets are reached {place}",
        given=f"{n} targets; reached is within 2 cm over the last 5 of 50 steps",
        got=f"{reached} of {n} reached, which proves at least {bound:.1%}; mean distance at the end "
        f"{100 * float(np.mean(error)):.1f} cm",
        expected=f"a proved rate of at least {threshold:.0%}",
        hint=_why(policy, error, nominal),
        credit=0.5 if bound >= HALF else 0.0,
    )


def _why(policy: OnnxPolicy, error: Any, nominal: bool) -> str:
    """Return the hint for a policy that reaches too little."""
    names = [f"joint{k}" for k in range(1, 8)]
    if list(policy.meta.joint_names) != names:
        return "joint-order"
    scale = np.asarray(policy.meta.action_scale)
    if policy.meta.action_kind != "held_relative_joint_position" or not np.allclose(scale, ACTION_SCALE):
        return "actions-in-the-meta"
    if float(np.median(error)) > 0.15:
        return "untrained-policy"
    return "train-on" if nominal else "differs-from-training"


# ---------------------------------------------------------------- arms that differ


def compare_randomised(student: Any, rng: np.random.Generator, arms: int = 5, steps: int = 6) -> None:
    """With the student's events, arms that begin alike and are commanded alike end up apart; the interface stays.

    The configuration comes as plain values; the arms that it describes are made and moved here.
    """
    found = student.run(probes.randomised)
    _check_interface(found["cfg"])
    try:
        spread = _spread(_with_events(found["events"]), arms, steps, seed=int(rng.integers(2**31)))
    except InputError as error:
        fail(f"these events cannot be used: {error.what}", got=error.given, expected=error.expected, hint="arms-differ")
        raise  # for the type checker: fail always raises
    # Without events the arms move alike to the last bit.
    expect(spread > 1e-3, "all arms still move alike",
           given=f"{arms} arms from the same pose, the same {steps} actions",
           got=f"their joint angles differ by {spread:.2g} rad", expected="more than 0.001 rad",
           hint="arms-differ")  # fmt: skip


def _spread(cfg: Any, arms: int, steps: int, seed: int) -> float:
    """Return the standard deviation of the joint angles (rad) that the arms come to, of the joint where it is most."""
    import torch

    from robotbrain.rl.envs import ManagerBasedRLEnv

    cfg.scene.num_envs, cfg.seed = arms, seed
    env = ManagerBasedRLEnv(cfg, num_threads=1)
    env.reset(seed=seed)
    robot = env.scene["robot"]
    start = robot.data.default_joint_pos.torch
    robot.write_joint_state_to_sim(start, torch.zeros_like(start))
    action = torch.zeros(arms, env.num_actions)
    for k in range(steps):
        action[:] = 0.5 if k < steps // 2 else -0.5
        env.step(action)
    return float(robot.data.joint_pos.torch.std(dim=0).max())


@functools.cache
def _plain_task() -> Any:
    from robotbrain.rl.gap_variants import reach_cfg

    return reach_cfg()


def _check_interface(answer: Any) -> None:
    """Fail where more than events and noise differs from the task that was given."""
    given = _plain_task().to_dict()
    for part, wanted in given.items():
        if part in ("events", "seed"):
            continue
        got = answer[part]
        if part == "observations":
            got, wanted = (_without_noise(value) for value in (got, wanted))
        differs = _difference(got, wanted, part)
        expect(not differs, "the robot's interface changed", got=f"another {differs}", expected="as it was given",
               hint="same-robot")  # fmt: skip


def _without_noise(observations: Any) -> dict[str, Any]:
    """Return a copy of the observation groups without their terms' noise."""
    return {
        group: {
            name: {key: v for key, v in term.items() if key != "noise"} if isinstance(term, dict) else term
            for name, term in terms.items()
            if name != "enable_corruption"
        }
        for group, terms in observations.items()
    }


def _difference(got: Any, wanted: Any, where: str) -> str:
    """Return the path to the first value that differs, or ''."""
    if isinstance(wanted, dict):
        if not isinstance(got, dict):
            return where
        if got.keys() != wanted.keys():
            return f"{where}: {', '.join(sorted(map(str, got.keys() ^ wanted.keys())))}"
        return next(filter(None, (_difference(got[k], wanted[k], f"{where}.{k}") for k in wanted)), "")
    if isinstance(wanted, (list, tuple)):
        got, wanted = (list(v) if isinstance(v, (list, tuple)) else v for v in (got, wanted))
    return "" if type(got) is type(wanted) and got == wanted else where


_EVENTS = ("apply_", "push_", "randomize_", "reset_")
"""How the names of events in robotbrain.rl.mdp begin."""


def _with_events(answer: Any) -> Any:
    """Return the plain task with the events that the student described."""
    from robotbrain.rl import mdp
    from robotbrain.rl.gap_variants import reach_cfg
    from robotbrain.rl.managers import EventTermCfg

    cfg = reach_cfg()
    for name in vars(cfg.events):
        setattr(cfg.events, name, None)
    for name, term in answer.items():
        module, _, function = str(term["func"]).partition(":")
        known = module.startswith(f"{mdp.__name__}.") and function.startswith(_EVENTS) and hasattr(mdp, function)
        expect(known, f"the event {name!r} is not one of robotbrain.rl.mdp", got=term["func"],
               expected="e.g. mdp.randomize_motor_strength", hint="arms-differ")  # fmt: skip
        fields = {key: value for key, value in term.items() if key not in ("func", "params")}
        params = {key: _entity(value) for key, value in term["params"].items()}
        setattr(cfg.events, str(name), EventTermCfg(func=getattr(mdp, function), params=params, **fields))
    return cfg


def _entity(value: Any) -> Any:
    """Return an event's parameter; a selection of joints or bodies as the configuration that it was."""
    from robotbrain.rl.managers import SceneEntityCfg

    if not isinstance(value, dict) or "joint_names" not in value:
        return value
    everything = str(slice(None))
    chosen = {key: v for key, v in value.items() if not (key in ("joint_ids", "body_ids") and v == everything)}
    return SceneEntityCfg(**chosen)


def warm_students() -> None:
    """Describe the task for the first time, as it comes back from students' processes."""
    probes.events_of(_plain_task())
    _plain_task().to_dict()


def warm() -> None:
    """Import, compile and cache what judging needs."""
    from robotbrain.rl.onnx_policy import OnnxPolicy  # noqa: F401
    from robotbrain.rl.surrogate import SurrogateReachEnv, neutral

    stats.beta.ppf(0.05, 3, 4)
    for params in (None, [neutral(7)]):
        SurrogateReachEnv([0], 0, params=params).reset()
    _spread(_with_events(probes.events_of(_plain_task())), 2, 1, seed=0)
