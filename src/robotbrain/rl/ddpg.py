"""Deep deterministic policy gradient (DDPG; Lillicrap et al., 2016), from top to bottom in one file.

1. The algorithm as five small functions. 2. Actor and critic. 3. The agent, which updates them from replayed
transitions. 4. Collection from a vector environment. 5. The training loop, which can be stopped and resumed exactly.

Inside, actions are scaled to [-1, 1]; `scale_action` turns them into the environment's own units.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import itertools
import math
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from robotbrain.errors import InputError, RobotBrainError
from robotbrain.rl.checkpoint import load_checkpoint, save_checkpoint
from robotbrain.rl.interrupt import InterruptFlag
from robotbrain.rl.logs import Progress, RunLog
from robotbrain.rl.noise import GaussianNoise, OrnsteinUhlenbeckNoise
from robotbrain.rl.replay import Batch, ReplayBuffer

FloatArray = NDArray[np.float32]
BoolArray = NDArray[np.bool_]
Policy = Callable[[FloatArray], FloatArray]

# ---------------------------------------------------------------------------------------------- 1. the algorithm


def td_target(reward: Tensor, terminated: Tensor, next_q: Tensor, gamma: float) -> Tensor:
    """One-step target of the critic, ``r + gamma (1 - terminated) Q'(s', pi'(s'))``; all (B,).

    ``terminated`` is 1 only where the task itself ended. After a time limit the robot's future goes on, and so does its
    value. The target is a constant: no gradient flows through it.
    """
    return (reward + gamma * next_q * (1.0 - terminated)).detach()


def critic_loss(critic: nn.Module, obs: Tensor, action: Tensor, target: Tensor) -> Tensor:
    """Mean squared error between the critic's ``Q(s, a)`` and the target (B,)."""
    return functional.mse_loss(critic(obs, action), target)


def actor_loss(actor: nn.Module, critic: nn.Module, obs: Tensor) -> Tensor:
    """Minus the value that the critic expects of the actor's own actions: ``-mean Q(s, pi(s))``."""
    loss: Tensor = -critic(obs, actor(obs)).mean()
    return loss


@torch.no_grad()
def soft_update(target: nn.Module, source: nn.Module, tau: float) -> None:
    """Move every parameter of ``target`` the fraction ``tau`` of the way to ``source``, in place (Polyak averaging)."""
    torch._foreach_lerp_(list(target.parameters()), list(source.parameters()), tau)


def scale_action(action: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Map actions from [-1, 1] to the bounds ``[low, high]``; (..., act_dim)."""
    return low + (action + 1.0) * 0.5 * (high - low)


# -------------------------------------------------------------------------------------------- 2. actor and critic


def _mlp(sizes: tuple[int, ...]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for inputs, outputs in itertools.pairwise(sizes):
        layers += [nn.Linear(inputs, outputs), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


class Actor(nn.Module):
    """The policy: observation (B, obs_dim) to action (B, act_dim) in [-1, 1]."""

    def __init__(self, obs_dim: int, act_dim: int, hidden: tuple[int, ...] = (256, 256)) -> None:
        super().__init__()
        self.net = _mlp((obs_dim, *hidden, act_dim))

    def forward(self, obs: Tensor) -> Tensor:
        """Return the action of each observation."""
        return torch.tanh(self.net(obs))


class Critic(nn.Module):
    """The value Q(s, a): the discounted reward to come, (B,), after ``action`` in the state of ``obs``."""

    def __init__(self, obs_dim: int, act_dim: int, hidden: tuple[int, ...] = (256, 256)) -> None:
        super().__init__()
        self.net = _mlp((obs_dim + act_dim, *hidden, 1))

    def forward(self, obs: Tensor, action: Tensor) -> Tensor:
        """Return the value of each pair."""
        value: Tensor = self.net(torch.cat([obs, action], dim=1))
        return value.squeeze(1)


# --------------------------------------------------------------------------------------------------- 3. the agent


@dataclasses.dataclass(frozen=True)
class DDPGConfig:
    """Everything that can be set. Steps are transitions, counted over all environments."""

    total_steps: int = 100_000  #: length of the training
    warmup_steps: int = 1_000  #: uniform random actions and no updates at first
    updates_per_step: float = 1.0  #: update-to-data ratio; with 64 environments 0.125 makes 8 updates a vector step
    batch_size: int = 128  #: transitions per update
    buffer_size: int = 300_000  #: transitions kept
    gamma: float = 0.99  #: discount per step
    tau: float = 0.005  #: how fast the target networks follow
    actor_lr: float = 1e-4  #: Adam's step size
    critic_lr: float = 1e-3
    actor_every: int = 1  #: updates of the critic for one of the actor; the paper has 1, TD3 (2018) 2, which is cheaper
    hidden: tuple[int, ...] = (256, 256)  #: hidden layers of actor and critic
    noise: str = "gaussian"  #: exploration: "gaussian" or "ou"
    noise_std: float = 0.1  #: standard deviation ("ou": sigma), actions being in [-1, 1]
    noise_theta: float = 0.15  #: "ou": pull towards zero, 1/s
    noise_dt: float = 1.0  #: "ou": duration of a step, s
    averaged: bool = (
        False  #: judge and deploy the actor's target, an average of its latest selves, not the actor itself
    )
    overlap: bool = False  #: step the environments while the networks learn (same result on any machine)
    eval_every: int = 10_000  #: steps between records of the learning curve
    checkpoint_every: int = 50_000  #: steps between checkpoints (with a run folder)

    def __post_init__(self) -> None:
        object.__setattr__(self, "hidden", tuple(int(width) for width in self.hidden))
        for name in ("total_steps", "batch_size", "buffer_size", "actor_every", "eval_every", "checkpoint_every"):
            self._require(name, getattr(self, name) >= 1, "at least 1")
        for name in ("actor_lr", "critic_lr", "updates_per_step", "noise_dt", "noise_theta"):
            self._require(name, getattr(self, name) > 0, "greater than 0")
        for name in ("warmup_steps", "noise_std"):
            self._require(name, getattr(self, name) >= 0, "at least 0")
        self._require("gamma", 0 <= self.gamma < 1, "in [0, 1)")
        self._require("tau", 0 < self.tau <= 1, "in (0, 1]")
        self._require("noise", self.noise in ("gaussian", "ou"), "'gaussian' or 'ou'")
        self._require("hidden", all(width >= 1 for width in self.hidden), "widths of at least 1")

    def _require(self, name: str, right: bool, expected: str) -> None:
        if not right:
            raise InputError(f"DDPGConfig.{name}", given=getattr(self, name), expected=expected, fix="Change it.")


class Losses(NamedTuple):
    """What one update saw."""

    critic: float  #: mean squared error of the critic, before the step
    actor: float  #: minus the mean value of the actor's actions, when it was last updated


class DDPG:
    """Actor, critic, their slowly following targets, and the optimisers.

    Args:
        obs_dim: numbers in an observation.
        act_dim: numbers in an action.
        config: hyper-parameters.
        seed: of the initial weights and of all later draws.
    """

    def __init__(self, obs_dim: int, act_dim: int, config: DDPGConfig | None = None, seed: int = 0) -> None:
        self.obs_dim, self.act_dim = obs_dim, act_dim
        self.config = config = config or DDPGConfig()
        seeds = [int(word) for word in np.random.SeedSequence(seed).generate_state(3)]
        with torch.random.fork_rng(devices=[]):  # layers draw from the global generator: lend it to them
            torch.manual_seed(seeds[0])
            self.actor = Actor(obs_dim, act_dim, config.hidden)
            self.critic = Critic(obs_dim, act_dim, config.hidden)
        self.actor_target = copy.deepcopy(self.actor).requires_grad_(False)
        self.critic_target = copy.deepcopy(self.critic).requires_grad_(False)
        # The fused Adam updates all tensors in one call, three times as fast as the default on a CPU.
        self.actor_optimizer = torch.optim.Adam(self.actor.parameters(), lr=config.actor_lr, fused=True)
        self.critic_optimizer = torch.optim.Adam(self.critic.parameters(), lr=config.critic_lr, fused=True)
        self.generator = torch.Generator().manual_seed(seeds[1])  # draws batches and warm-up actions
        self.updates, self._actor_loss = 0, math.nan
        explorer = torch.Generator().manual_seed(seeds[2])
        self.noise = (
            OrnsteinUhlenbeckNoise(act_dim, config.noise_std, config.noise_theta, config.noise_dt, explorer)
            if config.noise == "ou"
            else GaussianNoise(act_dim, config.noise_std, explorer)
        )

    @property
    def policy(self) -> Actor:
        """The network to judge and to deploy.

        With large steps the actor circles around a good policy; its target, which follows slowly, is nearer to the
        middle, and good much earlier (``DDPGConfig.averaged``; Polyak and Juditsky, 1992). Learning is the same.
        """
        return self.actor_target if self.config.averaged else self.actor

    @torch.no_grad()
    def act(self, obs: FloatArray, explore: bool = False) -> FloatArray:
        """Return the action (N, act_dim) in [-1, 1] of each observation (N, obs_dim).

        Without ``explore`` that of `policy`, which is deterministic: evaluation never sees the noise.
        """
        network = self.actor if explore else self.policy
        action: FloatArray = network(torch.from_numpy(obs)).numpy()
        if explore:
            action = np.clip(action + self.noise.sample(len(action)), -1.0, 1.0)
        return action

    def random_action(self, num_envs: int) -> FloatArray:
        """Draw actions (num_envs, act_dim) uniformly from [-1, 1]."""
        draw: FloatArray = torch.rand(num_envs, self.act_dim, generator=self.generator).numpy()
        return draw * 2.0 - 1.0

    def update(self, batch: Batch) -> Losses:
        """Improve the critic, then the actor, by one step each, and let the targets follow."""
        with torch.no_grad():
            next_q = self.critic_target(batch.next_obs, self.actor_target(batch.next_obs))
            target = td_target(batch.reward, batch.terminated, next_q, self.config.gamma)
        q_loss = critic_loss(self.critic, batch.obs, batch.action, target)
        self.critic_optimizer.zero_grad()
        torch.autograd.backward(q_loss)
        self.critic_optimizer.step()
        self.updates += 1

        if self.updates % self.config.actor_every == 0:
            pi_loss = actor_loss(self.actor, self.critic, batch.obs)
            self.actor_optimizer.zero_grad()
            # Only the actor's gradients: those of the critic's weights would be a quarter of the work, and thrown away.
            torch.autograd.backward(pi_loss, inputs=list(self.actor.parameters()))
            self.actor_optimizer.step()
            self._actor_loss = pi_loss.item()

        soft_update(self.critic_target, self.critic, self.config.tau)
        soft_update(self.actor_target, self.actor, self.config.tau)
        return Losses(q_loss.item(), self._actor_loss)

    _PARTS = ("actor", "critic", "actor_target", "critic_target", "actor_optimizer", "critic_optimizer", "noise")

    def state_dict(self) -> dict[str, Any]:
        """Weights, optimisers and generators: all that later actions and updates depend on."""
        state = {name: getattr(self, name).state_dict() for name in self._PARTS}
        state |= {"updates": self.updates, "actor_loss": self._actor_loss}
        return state | {"generator": self.generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go back to a state that `state_dict` returned."""
        for name in self._PARTS:
            getattr(self, name).load_state_dict(state[name])
        self.updates, self._actor_loss = state["updates"], state["actor_loss"]
        self.generator.set_state(state["generator"])


# ------------------------------------------------------------------------------------------------- 4. collection


class Transitions(NamedTuple):
    """What one step of the vector environment taught; the columns of `ReplayBuffer.add`."""

    obs: FloatArray
    action: FloatArray
    reward: FloatArray
    next_obs: FloatArray
    terminated: BoolArray


class Collector:
    """Steps a vector environment and hands out its transitions, whatever way it resets.

    When an episode ends, the observation that an environment returns may already belong to the next one. What must be
    learnt from is the last observation of the old one. Gymnasium has three ways (``metadata["autoreset_mode"]``):
    SAME_STEP puts it into ``info["final_obs"]``; NEXT_STEP returns it, and then wastes a step on the reset, which is no
    transition; DISABLED leaves the reset to the caller.

    Args:
        env: with a flat Box as observation and a bounded Box as action space.
        seed: of the environments.
    """

    def __init__(self, env: gymnasium.vector.VectorEnv, seed: int) -> None:
        self.env, self.seed = env, seed
        self.obs_dim = _box(env, "observation").shape[0]
        actions = _box(env, "action")
        self.low, self.high = actions.low.astype(np.float32), actions.high.astype(np.float32)
        if not (np.isfinite(self.low).all() and np.isfinite(self.high).all()):
            raise InputError(
                "action space",
                given=actions,
                expected="a Box with finite bounds",
                fix="Bound it, for example with gymnasium.wrappers.vector.RescaleAction or in the environment.",
            )
        self.act_dim = len(self.low)
        self.mode = env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP)
        self.steps = 0  # vector steps
        self.returns = np.zeros(env.num_envs)  # of the episodes under way
        self.finished: list[float] = []  # of those that ended, until they are taken
        self.ended = np.zeros(env.num_envs, bool)  # in the latest step
        self.resetting = np.zeros(env.num_envs, bool)  # NEXT_STEP: where the next step is only a reset
        self.obs = self._checked(env.reset(seed=seed)[0], "observation")

    def step(self, action: FloatArray) -> Transitions:
        """Step all environments with actions (N, act_dim) in [-1, 1]."""
        self.steps += 1
        result = self.env.step(scale_action(action, self.low, self.high))
        obs, reward = self._checked(result[0], "observation"), self._checked(result[1], "reward")
        terminated, ended, info = result[2], result[2] | result[3], result[4]
        next_obs = obs
        if ended.any() and self.mode == AutoresetMode.SAME_STEP:
            next_obs = obs.copy()
            next_obs[ended] = np.stack(list(_final_obs(info)[ended]))
            self._checked(next_obs, "final observation")
        elif ended.any() and self.mode == AutoresetMode.DISABLED:
            obs = self._checked(self.env.reset(options={"reset_mask": ended})[0], "observation")
        real = ~self.resetting
        rows = Transitions(self.obs[real], action[real], reward[real], next_obs[real], terminated[real])
        self.returns += np.where(real, reward, 0.0)
        self.finished += self.returns[ended].tolist()
        self.returns[ended] = 0.0
        self.resetting = ended.copy() if self.mode == AutoresetMode.NEXT_STEP else np.zeros_like(ended)
        self.obs, self.ended = obs, ended
        return rows

    def take_returns(self) -> list[float]:
        """Return the undiscounted returns of the episodes that ended since the last call."""
        returns, self.finished = self.finished, []
        return returns

    def _checked(self, values: Any, what: str) -> FloatArray:
        """Copy to float32 (an environment may reuse its arrays) and insist on finite numbers."""
        array = np.array(values, dtype=np.float32)
        if not np.isfinite(array).all():
            bad = int(np.flatnonzero(~np.isfinite(array.reshape(len(array), -1)).all(axis=1))[0])
            raise InputError(
                f"{what} of environment {bad} at step {self.steps}",
                given=array[bad],
                expected="finite numbers",
                fix="Look at the terms that make it up in this state: a division by zero, or physics that blew up.",
            )
        return array

    def state_dict(self) -> dict[str, Any]:
        """The state of the environments, where they offer it (``env.state_dict()``), and of the episodes under way."""
        save = getattr(self.env, "state_dict", None)
        return {
            "env": save() if save else None,
            "steps": self.steps,
            "obs": torch.from_numpy(self.obs.copy()),
            "returns": torch.from_numpy(self.returns.copy()),
            "resetting": torch.from_numpy(self.resetting.copy()),
            "finished": list(self.finished),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go back to a state that `state_dict` returned; environments without state start new episodes instead."""
        self.steps, self.finished = state["steps"], list(state["finished"])
        if state["env"] is not None:
            self.env.load_state_dict(state["env"])
            self.obs, self.returns = state["obs"].numpy().copy(), state["returns"].numpy().copy()
            self.resetting = state["resetting"].numpy().copy()
        else:  # other episodes than at the start of the training
            seed = int(np.random.SeedSequence([self.seed, self.steps]).generate_state(1)[0])
            self.obs = self._checked(self.env.reset(seed=seed)[0], "observation")


def _final_obs(info: dict[str, Any]) -> NDArray[Any]:
    if "final_obs" not in info:
        raise InputError(
            "info of an environment that resets in the same step",
            given=sorted(info),
            expected='the last observations of the ended episodes as info["final_obs"]',
            fix="Without them a time limit cannot be told from an end; use Gymnasium 1.0's convention or another mode.",
        )
    found: NDArray[Any] = info["final_obs"]
    return found


def _box(env: gymnasium.vector.VectorEnv, kind: str) -> gymnasium.spaces.Box:
    space = getattr(env, f"single_{kind}_space", None)
    if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
        raise InputError(
            f"{kind} space",
            given=space if space is not None else type(env).__name__,
            expected="a flat Box of a gymnasium.vector.VectorEnv",
            fix="DDPG needs continuous actions and a vector as observation; wrap one environment in a SyncVectorEnv.",
        )
    return space


# -------------------------------------------------------------------------------------------- 5. the training loop

Record = dict[str, float]
"""A point of the learning curve: step, updates, seconds (of training, evaluation left out), train_return (mean of the
episodes that ended since the last point, noise included), critic_loss, actor_loss, and what the evaluation measured."""


class Trainer:
    """A training between two steps of the vector environment; `state_dict` is all that decides how it goes on.

    Args:
        env: the vector environment.
        config: hyper-parameters.
        seed: of weights, exploration, batches and environments.
    """

    def __init__(self, env: gymnasium.vector.VectorEnv, config: DDPGConfig, seed: int) -> None:
        self.config, self.seed = config, seed
        self.collector = Collector(env, seed)
        self.agent = DDPG(self.collector.obs_dim, self.collector.act_dim, config, seed)
        self.replay = ReplayBuffer(config.buffer_size, self.collector.obs_dim, self.collector.act_dim)
        self.step, self.updates, self.seconds = 0, 0, 0.0
        self.losses = Losses(math.nan, math.nan)
        self.curve: list[Record] = []

    def policy(self, obs: FloatArray) -> FloatArray:
        """Return the environment's action (N, act_dim) for each observation (N, obs_dim), without noise."""
        return scale_action(self.agent.act(obs), self.collector.low, self.collector.high)

    def advance(self, helper: ThreadPoolExecutor | None = None) -> None:
        """Step every environment once, store what happened, and make the updates that are due.

        With a ``helper`` thread the environments step while the networks learn from what is already stored. Neither
        looks at the other, so the outcome does not depend on which is faster.
        """
        began = time.perf_counter()
        if self.step < self.config.warmup_steps:
            action = self.agent.random_action(len(self.collector.obs))
        else:
            action = self.agent.act(self.collector.obs, explore=True)
        if helper is None:
            self._store(self.collector.step(action))
            self._learn()
        else:
            pending = helper.submit(self.collector.step, action)
            self._learn()
            self._store(pending.result())
        self.agent.noise.reset(self.collector.ended)
        self.seconds += time.perf_counter() - began

    def _store(self, rows: Transitions) -> None:
        self.replay.add(*rows)
        self.step += len(rows.reward)

    def _learn(self) -> None:
        due = int((self.step - self.config.warmup_steps) * self.config.updates_per_step)
        while self.updates < due:
            self.losses = self.agent.update(self.replay.sample(self.config.batch_size, self.agent.generator))
            self.updates += 1

    def record(self, evaluate: Callable[[Policy], dict[str, float]] | None) -> Record:
        """Add a point to the learning curve and return it."""
        if self.updates >= self.config.actor_every and not all(map(math.isfinite, self.losses)):
            raise RobotBrainError(
                f"The training diverged: the losses are {self.losses} after {self.updates} updates. Use smaller "
                "learning rates, or scale rewards and observations to about 1; the last checkpoint is unharmed."
            )
        returns = self.collector.take_returns()
        point: Record = {"step": self.step, "updates": self.updates, "seconds": round(self.seconds, 3)}
        point |= {"train_return": float(np.mean(returns)) if returns else math.nan}
        point |= {"critic_loss": self.losses.critic, "actor_loss": self.losses.actor}
        point |= evaluate(self.policy) if evaluate is not None else {}
        self.curve.append(point)
        return point

    _PARTS = ("agent", "replay", "collector")

    def state_dict(self) -> dict[str, Any]:
        """Everything, as plain values and tensors."""
        state: dict[str, Any] = {"config": dataclasses.asdict(self.config), "seed": self.seed}
        state |= {"step": self.step, "updates": self.updates, "seconds": self.seconds}
        state |= {"losses": tuple(self.losses), "curve": [dict(point) for point in self.curve]}
        return state | {name: getattr(self, name).state_dict() for name in self._PARTS}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go back to a state that `state_dict` returned; only ``total_steps`` may differ, to train for longer."""
        now = dataclasses.asdict(self.config) | {"seed": self.seed}
        then = state["config"] | {"seed": state["seed"]}
        differing = sorted(name for name in now if name != "total_steps" and now[name] != then.get(name))
        if differing:
            raise InputError(
                "configuration of the resumed training",
                given={name: now[name] for name in differing},
                expected=f"as in its checkpoint: { ({name: then.get(name) for name in differing}) }",
                fix="Resume with the same configuration and seed, or start in another run_dir.",
            )
        for name in self._PARTS:
            getattr(self, name).load_state_dict(state[name])
        self.step, self.updates, self.seconds = state["step"], state["updates"], state["seconds"]
        self.losses, self.curve = Losses(*state["losses"]), [dict(point) for point in state["curve"]]


@dataclasses.dataclass
class TrainingResult:
    """A trained agent and how it came about.

    Attributes:
        agent: as after the last step.
        curve: the learning curve.
        policy: observations (N, obs_dim) to the environment's actions (N, act_dim), without noise.
    """

    agent: DDPG
    curve: list[Record]
    policy: Policy


def train_ddpg(
    make_env: Callable[[], gymnasium.vector.VectorEnv],
    config: DDPGConfig | None = None,
    *,
    seed: int,
    run_dir: str | Path | None = None,
    resume: bool = False,
    evaluate: Callable[[Policy], dict[str, float]] | None = None,
    callback: Callable[[Record], bool | None] | None = None,
    progress: bool = True,
) -> TrainingResult:
    """Train on the environments that ``make_env()`` returns.

    Args:
        make_env: makes the vector environment, which is closed at the end.
        config: hyper-parameters.
        seed: of weights, exploration, batches, and environments (``env.reset(seed=...)``). Same seed, same weights.
        run_dir: folder for checkpoints (``checkpoint.pt``) and logs.
        resume: go on from the folder's checkpoint. The outcome is bitwise that of a training that was never stopped if
            the environment has ``state_dict`` and ``load_state_dict``; others start new episodes.
        evaluate: called every ``eval_every`` steps with the policy without noise; its figures join the learning curve.
            Give it environments of its own.
        callback: called with each point of the learning curve; True ends the training.
        progress: show a progress bar.

    Raises:
        InputError: for an environment, figures or a checkpoint that cannot be used.
        RobotBrainError: for a training that diverged.
        KeyboardInterrupt: after Ctrl-C, once the step is complete and the checkpoint written.
    """
    config = config or DDPGConfig()
    checkpoint = Path(run_dir) / "checkpoint.pt" if run_dir is not None else None
    saved = _saved(checkpoint, resume)
    env = make_env()
    with contextlib.ExitStack() as stack:
        stack.callback(env.close)
        stack.enter_context(_one_torch_thread())
        interrupt = stack.enter_context(InterruptFlag())
        trainer = Trainer(env, config, seed)
        if saved is not None:
            trainer.load_state_dict(saved)
        log = None
        if run_dir is not None:
            log = stack.enter_context(RunLog(run_dir, resume_step=trainer.step if saved else None))
            log.settings({"algorithm": "ddpg", "seed": seed, **dataclasses.asdict(config)})
        bar = stack.enter_context(Progress(config.total_steps, description="DDPG", enabled=progress))
        bar.update(trainer.step)
        helper = stack.enter_context(ThreadPoolExecutor(1)) if config.overlap else None
        finished = trainer.step >= config.total_steps
        while not finished:
            before = trainer.step
            trainer.advance(helper)
            bar.update(trainer.step - before)
            finished = trainer.step >= config.total_steps
            if finished or trainer.step // config.eval_every > before // config.eval_every:
                point = trainer.record(evaluate)
                if log is not None:
                    log.scalars({name: value for name, value in point.items() if name != "step"}, trainer.step)
                finished |= bool(callback is not None and callback(point))
            due = trainer.step // config.checkpoint_every > before // config.checkpoint_every
            if checkpoint is not None and (finished or due or interrupt.requested):
                save_checkpoint(checkpoint, trainer.state_dict(), kind="ddpg")
            if interrupt.requested:
                how = f"go on from {checkpoint} with resume=True" if checkpoint else "nothing is saved without run_dir"
                raise KeyboardInterrupt(f"stopped after {trainer.step} of {config.total_steps} steps; {how}")
    return TrainingResult(trainer.agent, trainer.curve, trainer.policy)


def _saved(checkpoint: Path | None, resume: bool) -> dict[str, Any] | None:
    if resume:
        if checkpoint is None:
            raise InputError("resume", given=True, expected="a run_dir", fix="Say which run to go on with.")
        return load_checkpoint(checkpoint, kind="ddpg")
    if checkpoint is not None and checkpoint.exists():
        raise InputError(
            "run_dir",
            given=str(checkpoint.parent),
            expected="a folder without a training in it",
            fix="Go on with it (resume=True), choose another folder, or delete this one.",
        )
    return None


@contextlib.contextmanager
def _one_torch_thread() -> Iterator[None]:
    """Layers of 256 units are too small to share: a second thread waits more than it works."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
