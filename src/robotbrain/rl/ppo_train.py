"""The loop around PPO: collect, learn, log, save; stop at any time and go on as if nothing had been."""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from robotbrain.errors import InputError
from robotbrain.rl.checkpoint import load_checkpoint, save_checkpoint
from robotbrain.rl.interrupt import InterruptFlag
from robotbrain.rl.logs import Progress, Run, RunLog
from robotbrain.rl.ppo import PPO, Network
from robotbrain.rl.ppo_cfg import RslRlOnPolicyRunnerCfg, model_cfg
from robotbrain.rl.ppo_env import ppo_env

CHECKPOINT_FILE = "checkpoint.pt"
KIND = "ppo"
_MAY_DIFFER = ("max_iterations", "save_interval", "experiment_name", "run_name", "device", "check_for_nan")


@dataclass(frozen=True)
class PpoState:
    """Where a training is; handed to callbacks.

    Attributes:
        agent: being trained.
        iteration: how many are done.
        steps: environment steps so far, of all environments together.
        log: to log figures of one's own: ``state.log.scalar("eval/success", 0.9, state.steps)``.
        last: this is the last iteration.
    """

    agent: PPO
    iteration: int
    steps: int
    log: RunLog
    last: bool


@dataclass(frozen=True)
class PpoResult:
    """What :func:`train_ppo` returns.

    Attributes:
        agent: trained; ``agent.actor`` is what to export, ``agent.act(obs)`` what to try.
        run: its figures.
        iteration, steps, elapsed_s: of all sessions together.
        interrupted: stopped by Ctrl-C.
    """

    agent: PPO
    run: Run
    iteration: int
    steps: int
    elapsed_s: float
    interrupted: bool


def train_ppo(
    env: Any,
    cfg: RslRlOnPolicyRunnerCfg,
    *,
    run_dir: str | Path | None = None,
    resume: bool = False,
    iterations: int | None = None,
    minutes: float | None = None,
    torch_threads: int | None = None,
    callback: Callable[[PpoState], bool | None] | None = None,
    settings: Mapping[str, Any] | None = None,
    tensorboard: bool | None = None,
    progress: bool = True,
) -> PpoResult:
    """Train a policy.

    Resumed, the kit's environments and the networks go on bit by bit as if there had been no pause (with the same
    number of threads). Gymnasium's environments cannot tell their state; they begin new episodes.

    Args:
        env: a ``ManagerBasedRLEnv`` or a Gymnasium ``VectorEnv`` (see :func:`robotbrain.rl.ppo_env.ppo_env`).
        cfg: all settings; ``cfg.seed`` is also that of the environment.
        run_dir: for the log (:mod:`robotbrain.rl.logs`) and ``checkpoint.pt``; None keeps nothing on disk.
        resume: go on with what is in ``run_dir``; without anything there it begins.
        iterations: in all, those before a resumption included; ``cfg.max_iterations`` by default.
        minutes: of training in all, likewise; no limit by default.
        torch_threads: for the networks; None leaves torch's number.
        callback: called after every iteration; returns True to stop.
        settings: plain values for ``run.json``, beside the configuration.
        tensorboard: see :class:`robotbrain.rl.logs.RunLog`.
        progress: show a bar.

    Ctrl-C ends the iteration, saves, and returns with ``interrupted``; a second one stops at once.

    Raises:
        InputError: for settings that do not fit, a folder that already holds a training (without ``resume``), or a
            checkpoint of a training with other settings.
    """
    stepper = ppo_env(env, cfg.clip_actions)
    path = None if run_dir is None else Path(run_dir) / CHECKPOINT_FILE
    saved = saved_training(path, resume)
    with threads(torch_threads):
        # Every environment has to be reset once, also one whose state is then replaced.
        obs = stepper.reset(cfg.seed + (0 if saved is None else saved["iteration"]))
        agent = PPO(
            {name: group_size(name, x) for name, x in obs.items()}, stepper.num_actions, cfg, env=stepper.unwrapped
        )
        check_samples(stepper.num_envs, cfg)
        shape = {
            "num_envs": stepper.num_envs,
            "obs_sizes": agent.obs_sizes,
            "num_actions": agent.num_actions,
            "cfg": cfg.to_dict(),
        }
        episodes = EpisodeFigures(stepper.num_envs)
        iteration = steps = 0
        if saved is not None:
            check_same(saved, shape)
            agent.load_state_dict(saved["agent"])
            iteration, steps = saved["iteration"], saved["steps"]
            if saved["env"] is not None:
                stepper.load_state_dict(saved["env"])
                obs = saved["obs"]
                episodes.load_state_dict(saved["episodes"])
        elif cfg.init_at_random_ep_len:
            stepper.stagger(agent.generator)

        log = RunLog(run_dir, resume_step=None if saved is None else steps, tensorboard=tensorboard)
        log.settings({"algorithm": KIND, **(settings or {}), "cfg": cfg.to_dict(), "num_envs": stepper.num_envs})

        def iterate() -> dict[str, float]:
            nonlocal obs
            began = log.elapsed_s
            rollout, obs = agent.collect(stepper, obs)
            collected = log.elapsed_s
            figures = agent.update(rollout) | episodes.add(rollout.reward, rollout.done, rollout.logs)
            return figures | {"time/collect_s": collected - began, "time/learn_s": log.elapsed_s - collected}

        def save(iteration: int, steps: int) -> None:
            state = {
                "agent": agent.state_dict(),
                "env": stepper.state_dict(),
                "obs": obs,
                "episodes": episodes.state_dict(),
                "iteration": iteration,
                "steps": steps,
                **shape,
            }
            if path is not None:
                save_checkpoint(path, state, kind=KIND)

        return training_loop(
            iterate,
            save,
            agent=agent,
            log=log,
            iteration=iteration,
            total=cfg.max_iterations if iterations is None else iterations,
            steps_per_iteration=stepper.num_envs * cfg.num_steps_per_env,
            save_interval=cfg.save_interval,
            minutes=minutes,
            callback=callback,
            progress=progress,
        )


def training_loop(
    iterate: Callable[[], dict[str, float]],
    save: Callable[[int, int], None],
    *,
    agent: Any,
    log: RunLog,
    iteration: int,
    total: int,
    steps_per_iteration: int,
    save_interval: int,
    minutes: float | None,
    callback: Callable[[PpoState], bool | None] | None,
    progress: bool,
) -> PpoResult:
    """Iterate until ``total`` iterations, a limit, the callback or Ctrl-C; log, and save, always at the end.

    Args:
        iterate: collects and learns once; returns figures.
        save: stores everything after (iterations, environment steps).
        agent: for the callback and the result.
        log: closed at the end.
        iteration: done before.
        total, minutes: limits, in all.
        steps_per_iteration: of all environments together.
        save_interval: iterations.
        callback, progress: see :func:`train_ppo`.
    """
    steps = iteration * steps_per_iteration
    stop = iteration >= total
    bar = Progress(total * steps_per_iteration, description="training", enabled=progress)
    with log, InterruptFlag() as interrupt, bar:
        bar.update(steps)
        while not stop:
            began = log.elapsed_s
            figures = iterate()
            iteration, steps = iteration + 1, steps + steps_per_iteration
            figures["time/steps_per_s"] = steps_per_iteration / (log.elapsed_s - began)
            log.scalars(figures, steps)
            late = minutes is not None and log.elapsed_s >= 60 * minutes
            stop = iteration >= total or late or interrupt.requested
            if callback is not None:
                stop |= bool(callback(PpoState(agent, iteration, steps, log, stop)))
            stop |= interrupt.requested
            if stop or iteration % save_interval == 0:
                save(iteration, steps)
            shown = {"return": figures["train/return"]} if "train/return" in figures else {}
            bar.update(steps_per_iteration, **shown)
        return PpoResult(agent, log.run(), iteration, steps, log.elapsed_s, interrupt.requested)


def load_actor(path: str | Path) -> Network:
    """Return the actor of a checkpoint: raw observations (n, O) in, actions (n, A) out.

    Raises:
        InputError: see :func:`robotbrain.rl.checkpoint.load_checkpoint`.
    """
    return actor_from_state(load_checkpoint(path, kind=KIND))


def actor_from_state(saved: Mapping[str, Any]) -> Network:
    """Return the actor of what a checkpoint of PPO holds."""
    groups = {name: saved["obs_sizes"][name] for name in saved["cfg"]["obs_groups"]["actor"]}
    actor = Network(groups, saved["num_actions"], model_cfg(saved["cfg"]["actor"]))
    actor.load_state_dict(saved["agent"]["actor"])
    return actor.eval()


class EpisodeFigures:
    """Returns and lengths of the last episodes, while several are under way."""

    def __init__(self, num_envs: int, kept: int = 100) -> None:
        self._return, self._length = torch.zeros(num_envs), torch.zeros(num_envs)
        self._last: deque[tuple[float, float]] = deque(maxlen=kept)

    def add(self, rewards: Tensor, dones: Tensor, logs: Sequence[Mapping[str, float]]) -> dict[str, float]:
        """Take T steps (T, N) and what the environments reported into account; return the last episodes' figures."""
        for reward, done in zip(rewards, dones, strict=True):
            self._return += reward
            self._length += 1
            if done.any():
                self._last.extend(zip(self._return[done].tolist(), self._length[done].tolist(), strict=True))
                self._return[done] = 0
                self._length[done] = 0
        figures = {}
        if self._last:
            returns, lengths = zip(*self._last, strict=True)
            figures = {"train/return": sum(returns) / len(returns), "train/episode_length": sum(lengths) / len(lengths)}
        for name in dict.fromkeys(name for log in logs for name in log):
            values = [log[name] for log in logs if name in log]
            figures[f"env/{name}"] = sum(values) / len(values)
        return figures

    def state_dict(self) -> dict[str, Any]:
        """Return what is under way, and the last episodes."""
        return {"return": self._return, "length": self._length, "last": list(self._last)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from such a state."""
        self._return, self._length = state["return"], state["length"]
        self._last.extend(state["last"])


def saved_training(path: Path | None, resume: bool, kind: str = KIND) -> dict[str, Any] | None:
    """Return the checkpoint to go on with; None where the training begins.

    Raises:
        InputError: when ``resume`` does not agree with what is there.
    """
    if path is None:
        if resume:
            raise InputError("resume", given="no run_dir", expected="the folder of a run", fix="Give run_dir.")
        return None
    if not path.is_file():
        return None
    if not resume:
        raise InputError(
            "run_dir",
            given=str(path.parent),
            expected="a folder without a training",
            fix="Pass resume=True to go on with it, or choose another folder.",
        )
    return load_checkpoint(path, kind=kind)


def check_same(saved: Mapping[str, Any], state: Mapping[str, Any]) -> None:
    """Check that a checkpoint fits what is to go on with it.

    Raises:
        InputError: naming every setting that differs.
    """
    then, now = (
        {name: s[name] for name in ("num_envs", "obs_sizes", "num_actions")}
        | {f"cfg.{name}": value for name, value in _flat(s["cfg"]) if name not in _MAY_DIFFER}
        for s in (saved, state)
    )
    differ = sorted(name for name in {*now, *then} if now.get(name) != then.get(name))
    if differ:
        raise InputError(
            "settings of the resumed training",
            given=", ".join(f"{name} = {now.get(name)!r}" for name in differ),
            expected=", ".join(f"{name} = {then.get(name)!r}" for name in differ),
            fix="Resume with the settings it began with, or start a new training in another folder.",
        )


def _flat(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def check_samples(num_envs: int, cfg: RslRlOnPolicyRunnerCfg) -> None:
    """Raise InputError unless every mini-batch gets two samples: the deviation of one advantage is not a number."""
    parts = cfg.algorithm.num_mini_batches
    if num_envs * cfg.num_steps_per_env < 2 * parts:
        raise InputError(
            "num_steps_per_env",
            given=f"{cfg.num_steps_per_env} steps of {num_envs} environments",
            expected=f"at least {2 * parts} samples for {parts} mini-batches",
            fix="Take more environments or steps, or fewer mini-batches.",
        )


def group_size(name: str, x: Tensor) -> int:
    """Return the size of an observation group (num_envs, size).

    Raises:
        InputError: for another shape.
    """
    if x.ndim != 2:
        raise InputError(
            f"observation group {name!r}",
            given=f"shape {tuple(x.shape)}",
            expected="(num_envs, size)",
            fix="Concatenate its terms (concatenate_terms=True), or leave it out of obs_groups.",
        )
    return x.shape[1]


@contextlib.contextmanager
def threads(number: int | None) -> Iterator[None]:
    """Use this many threads in torch inside the block; None changes nothing."""
    former = torch.get_num_threads()
    torch.set_num_threads(number or former)
    try:
        yield
    finally:
        torch.set_num_threads(former)
