"""How `hw1_rl` judges a policy file: on targets and arms that its author has not seen, by what its successes prove.

Nothing is trained here, and nothing that a student wrote runs here: the file is data, which `OnnxPolicy` reads and
checks before ONNX Runtime sees it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from robotbrain.errors import InputError
from robotbrain.grading import expect, fail
from robotbrain.grading.suites.hw1_rl_evidence import exact_bound

if TYPE_CHECKING:
    from robotbrain.rl.onnx_policy import OnnxPolicy
    from robotbrain.rl.surrogate.reach import ReachEpisodes

SIMULATION_BOUND = 0.85
"""At least this success rate must be proved in simulation ..."""
SURROGATE_BOUND = 0.80
"""... and this on surrogates. Proved: the lower end of the exact one-sided 95 % interval."""
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


def load(name: Any) -> OnnxPolicy:
    """Return the policy in the file ``name`` beside the notebook, or fail and say what it is instead."""
    from robotbrain.rl.onnx_policy import OnnxPolicy

    if not isinstance(name, str) or Path(name).name != name:
        fail("the name of the policy file should be a plain file name", got=name, expected='"reach_policy.onnx"',
             hint="file-beside-the-notebook")  # fmt: skip
    if not Path(name).is_file():
        fail(f"there is no file {name} beside the notebook", hint="file-beside-the-notebook")
    try:
        policy = OnnxPolicy(name)
    except InputError as error:
        fail(f"{name} cannot be used: {error.what}", got=error.given, expected=error.expected, hint="not-a-policy")
    meta = policy.meta
    expect(meta.task == "reach", f"{name} holds a policy for another task", got=meta.task, expected="reach",
           hint="another-robot")  # fmt: skip
    expect(abs(meta.control_dt - CONTROL_DT) < 1e-9, f"{name} holds a policy for another control rate",
           got=f"control_dt = {meta.control_dt:g} s", expected=f"{CONTROL_DT:g} s", hint="control-rate")  # fmt: skip
    return policy


def episodes(
    policy: OnnxPolicy, serials: Sequence[int], seed: int, *, nominal: bool, repeats: int = 1
) -> ReachEpisodes:
    """Let a policy reach targets, ``repeats`` with each arm.

    Args:
        policy: with metadata.
        serials: of the arms.
        seed: of targets, start poses and sensor noise.
        nominal: in simulation, where every arm is as the model says.
        repeats: targets per arm.
    """
    from robotbrain.rl.surrogate import SurrogateReachEnv, neutral

    if nominal:
        env = SurrogateReachEnv(serials, seed, params=[neutral(7)] * len(serials), ramp_s=0.0)
    else:
        env = SurrogateReachEnv(serials, seed)
    try:
        return env.run(policy, repeats)
    except InputError as error:
        fail(f"this policy cannot run the arm: {error.what}", got=error.given, expected=error.expected,
             hint="another-robot")  # fmt: skip
        raise  # for the type checker: fail always raises


def judge(name: Any, serials: Sequence[int], seed: int, *, nominal: bool, threshold: float, repeats: int = 1) -> None:
    """Fail unless the successes prove a rate of at least ``threshold``; half of the points for ``HALF``.

    Args:
        name: of the file.
        serials, seed, nominal, repeats: as in :func:`episodes`.
        threshold: for the lower end of the exact one-sided 95 % interval.
    """
    policy = load(name)
    run = episodes(policy, serials, seed, nominal=nominal, repeats=repeats)
    reached, n = int(run.success.sum()), len(run.success)
    bound = exact_bound(reached, n)
    place = "in simulation" if nominal else "on surrogate arms"
    expect(
        bound >= threshold,
        f"too few targets are reached {place}",
        given=f"{n} targets; reached is within 2 cm over the last 5 of 50 steps",
        got=f"{reached} of {n} reached, which proves at least {bound:.1%}; mean distance at the end "
        f"{100 * float(np.mean(run.final_error)):.1f} cm",
        expected=f"a proved rate of at least {threshold:.0%}",
        hint=_why(policy, run, nominal),
        credit=0.5 if bound >= HALF else 0.0,
    )


def _why(policy: OnnxPolicy, run: ReachEpisodes, nominal: bool) -> str:
    """Return the hint for a policy that reaches too little."""
    names = [f"joint{k}" for k in range(1, 8)]
    if list(policy.meta.joint_names) != names:
        return "joint-order"
    scale = np.asarray(policy.meta.action_scale)
    if policy.meta.action_kind != "held_relative_joint_position" or not np.allclose(scale, ACTION_SCALE):
        return "actions-in-the-meta"
    if float(np.median(run.final_error)) > 0.15:
        return "untrained-policy"
    return "train-on" if nominal else "differs-from-training"


def compare_randomised(randomise: Any, arms: int = 8, steps: int = 12) -> None:
    """With the student's events, arms that begin alike and are commanded alike end up apart; the interface stays."""
    import torch

    from robotbrain.rl.envs import ManagerBasedRLEnv
    from robotbrain.rl.gap_variants import reach_cfg

    spreads = []
    for change in (lambda cfg: cfg, randomise):
        cfg = reach_cfg()
        changed = change(cfg)
        cfg = cfg if changed is None else changed
        cfg.scene.num_envs, cfg.seed = arms, 3
        env = ManagerBasedRLEnv(cfg, num_threads=1)
        obs, _ = env.reset(seed=3)
        seen = obs["policy"]
        sizes = (seen.shape[1] if isinstance(seen, torch.Tensor) else 0, env.num_actions)
        expect(sizes == (34, 7), "the robot's interface changed", got=f"observations and actions: {sizes}",
               expected=(34, 7), hint="same-robot")  # fmt: skip
        robot = env.scene["robot"]
        start = robot.data.default_joint_pos.torch
        robot.write_joint_state_to_sim(start, torch.zeros_like(start))
        action = torch.zeros(arms, 7)
        for k in range(steps):
            action[:] = 0.5 if k < steps // 2 else -0.5
            env.step(action)
        spreads.append(float(robot.data.joint_pos.torch.std(dim=0).max()))
    expect(spreads[1] > max(1e-3, 10 * spreads[0]), "all arms still move alike",
           given=f"{arms} arms from the same pose, the same {steps} actions",
           got=f"their joint angles differ by {spreads[1]:.2g} rad", expected="more than 0.001 rad",
           hint="arms-differ")  # fmt: skip
