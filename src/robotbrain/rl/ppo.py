"""Proximal policy optimisation in one file: collect with the policy, estimate advantages, improve the policy a little.

Source: Schulman et al., "Proximal policy optimization algorithms", 2017; advantages as in Schulman et al.,
"High-dimensional continuous control using generalized advantage estimation", 2016; the adaptive learning rate and the
names of all settings as in rsl-rl, so that a configuration carries over to Isaac Lab. The loop around it, with logs and
checkpoints, is :func:`robotbrain.rl.ppo_train.train_ppo`.

Shapes: T control steps of N environments, B = T N samples; n observations, A actions. Everything is float32 on the CPU.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from robotbrain.errors import InputError, RobotBrainError
from robotbrain.rl.configclass import did_you_mean
from robotbrain.rl.ppo_cfg import OPTIMIZERS, RslRlMLPModelCfg, RslRlOnPolicyRunnerCfg, check_ppo_cfg
from robotbrain.rl.ppo_env import Observations, PpoEnv, check_finite

ACTIVATIONS: dict[str, type[nn.Module]] = {
    "elu": nn.ELU,
    "selu": nn.SELU,
    "relu": nn.ReLU,
    "crelu": nn.CELU,  # the name that rsl-rl has for it
    "lrelu": nn.LeakyReLU,
    "tanh": nn.Tanh,
    "sigmoid": nn.Sigmoid,
    "softplus": nn.Softplus,
    "gelu": nn.GELU,
    "swish": nn.SiLU,
    "mish": nn.Mish,
    "identity": nn.Identity,
}
_LOWEST_RATE, _HIGHEST_RATE = 1e-5, 1e-2

# ------------------------------------------------------------ the mathematics


def gae(
    reward: Tensor,
    value: Tensor,
    next_value: Tensor,
    terminated: Tensor,
    truncated: Tensor,
    gamma: float,
    lam: float,
) -> Tensor:
    """Return the advantages (T, N) by generalised advantage estimation.

    ``A_t = sum_k (gamma lam)^k delta_{t+k}`` up to the end of the episode, with
    ``delta_t = reward_t + gamma next_value_t - value_t``. After a terminated step there is nothing more to earn; after
    a truncated one there is, as much as ``next_value`` says, but the following row belongs to another episode.

    Args:
        reward, value: (T, N), of each step and of the observation that it began with.
        next_value: (T, N), of the observation that each step led to: where it ended its episode, the last of that one.
        terminated, truncated: (T, N) bool.
        gamma: discount, 0 to 1.
        lam: 0 (one step) to 1 (all of the episode).
    """
    goes_on = (~(terminated | truncated)).to(reward)
    delta = reward + gamma * next_value * (~terminated).to(reward) - value
    advantage = torch.empty_like(reward)
    following = torch.zeros_like(reward[0])
    for t in reversed(range(len(reward))):
        following = delta[t] + gamma * lam * goes_on[t] * following
        advantage[t] = following
    return advantage


def surrogate_loss(log_prob: Tensor, old_log_prob: Tensor, advantage: Tensor, clip: float) -> Tensor:
    """Return PPO's clipped objective with the sign of a loss; all arguments (B,).

    Where a sample's probability has already moved by more than ``clip`` in the direction that its advantage asks for,
    there is no reward for moving it further, and no gradient.
    """
    ratio = (log_prob - old_log_prob).exp()
    return -torch.min(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage).mean()


def value_loss(value: Tensor, old_value: Tensor, target: Tensor, clip: float | None) -> Tensor:
    """Return the mean squared error of the critic; all (B,).

    With ``clip``, each sample counts with the larger of two errors: of the value, and of the value held near the old.
    """
    error = (value - target).square()
    if clip is None:
        return error.mean()
    near = old_value + (value - old_value).clamp(-clip, clip)
    return torch.max(error, (near - target).square()).mean()


def gaussian_log_prob(action: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """Return the log density (B,) of actions (B, A) under independent normal distributions."""
    return (-0.5 * ((action - mean) / std).square() - std.log() - 0.5 * math.log(2 * math.pi)).sum(-1)


def gaussian_kl(old_mean: Tensor, old_std: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """Return the Kullback-Leibler divergence KL(old || new), (B,), nats, of independent normal distributions."""
    return ((std / old_std).log() + (old_std.square() + (old_mean - mean).square()) / (2 * std.square()) - 0.5).sum(-1)


def adapted_rate(rate: float, kl: float, desired_kl: float) -> float:
    """Return the learning rate after a step: smaller where the policy moved too far, larger where it hardly moved."""
    if kl > 2 * desired_kl:
        return max(_LOWEST_RATE, rate / 1.5)
    if 0 < kl < desired_kl / 2:
        return min(_HIGHEST_RATE, rate * 1.5)
    return rate


# ------------------------------------------------------------ the networks


class RunningNorm(nn.Module):
    """Normalises (B, n) by mean and deviation of all samples so far; a part of the network, so exported with it."""

    mean: Tensor
    var: Tensor
    count: Tensor

    def __init__(self, size: int, eps: float = 1e-2) -> None:
        super().__init__()
        self.eps = eps
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("var", torch.ones(size))
        self.register_buffer("count", torch.zeros((), dtype=torch.long))

    def forward(self, x: Tensor) -> Tensor:
        """Return ``(x - mean) / (deviation + eps)``."""
        return (x - self.mean) / (self.var.sqrt() + self.eps)

    @torch.no_grad()
    def update(self, x: Tensor) -> None:
        """Take samples (B, n) into account (Chan, Golub & LeVeque, 1979)."""
        self.count += len(x)
        rate = len(x) / self.count
        delta = x.mean(0) - self.mean
        self.mean += rate * delta
        # delta times the distance to the new mean: what the groups' distance adds to the variance
        self.var += rate * (x.var(0, unbiased=False) - self.var + delta * (x.mean(0) - self.mean))


class Network(nn.Module):
    """The actor or the critic.

    Args:
        group_sizes: the observation groups that it sees, by name, with their sizes.
        outputs: A for the actor, 1 for the critic.
        cfg: its configuration.

    Called with raw observations (B, n), the groups side by side; returns (B, outputs): the mean of the actions, or the
    value. The actor as it is can be exported as the deterministic policy.
    """

    def __init__(self, group_sizes: Mapping[str, int], outputs: int, cfg: RslRlMLPModelCfg) -> None:
        super().__init__()
        self.groups = tuple(group_sizes)
        size = sum(group_sizes.values())
        self.normalizer = RunningNorm(size) if cfg.obs_normalization else nn.Identity()
        if cfg.activation not in ACTIVATIONS:
            raise InputError(
                "activation",
                given=cfg.activation,
                expected="a known activation function",
                fix=did_you_mean(cfg.activation, ACTIVATIONS),
            )
        sizes = [size, *cfg.hidden_dims]
        layers: list[nn.Module] = []
        for inputs, units in itertools.pairwise(sizes):
            layers += [nn.Linear(inputs, units), ACTIVATIONS[cfg.activation]()]
        last = nn.Linear(sizes[-1], outputs)
        self.mlp = nn.Sequential(*layers, last)
        self._std_range = (1e-6, 1e6)
        self._log = False
        if cfg.distribution_cfg is not None:
            normal = cfg.distribution_cfg
            if not isinstance(normal, RslRlMLPModelCfg.GaussianDistributionCfg):
                raise InputError(
                    "distribution_cfg",
                    given=type(normal).__name__,
                    expected="a GaussianDistributionCfg",
                    fix="Other distributions: robotbrain.rl.rsl_rl_runner.",
                )
            self._log, self._std_range = normal.std_type == "log", normal.std_range
            std = torch.full((outputs,), float(normal.init_std))
            self.std_param = nn.Parameter(std.log() if self._log else std)
            # Near-zero actions at first: the agent explores around the default pose instead of around random ones.
            with torch.no_grad():
                last.weight.mul_(0.01)

    def forward(self, obs: Tensor) -> Tensor:
        """Return the outputs (B, outputs) for raw observations (B, n)."""
        result: Tensor = self.mlp(self.normalizer(obs))
        return result

    def inputs(self, obs: Mapping[str, Tensor]) -> Tensor:
        """Return the groups that this network sees side by side, (..., n)."""
        chosen = [obs[name] for name in self.groups]
        return chosen[0] if len(chosen) == 1 else torch.cat(chosen, dim=-1)

    def std(self) -> Tensor:
        """Return the deviation of each action, (A,)."""
        std = self.std_param.exp() if self._log else self.std_param
        return std.clamp(*self._std_range)


# ------------------------------------------------------------ the algorithm


@dataclass
class Rollout:
    """T steps of N environments under one policy; tensors are (T, N) or (T, N, size).

    Attributes:
        obs: what each step began with, by group.
        action, mean, log_prob: what was done, what would have been done without exploring, and its log density.
        std: (A,) deviation of the actions.
        value, advantage: by the critic, and by :func:`gae`.
        reward, done: of each step.
        logs: what the environments reported.
    """

    obs: Observations
    action: Tensor
    mean: Tensor
    log_prob: Tensor
    std: Tensor
    value: Tensor
    advantage: Tensor
    reward: Tensor
    done: Tensor
    logs: list[Mapping[str, float]] = field(default_factory=list)


class PPO:
    """An actor, a critic, and how they learn.

    Args:
        obs_sizes: size of each observation group.
        num_actions: A.
        cfg: its settings; ``cfg.seed`` decides the initial weights, the exploration and the order of samples.
        env: handed to ``symmetry_cfg.data_augmentation_func``.

    Attributes:
        actor, critic: :class:`Network`.
        learning_rate: at present.

    Raises:
        InputError: for settings that are missing, or that only rsl-rl knows.
    """

    def __init__(
        self, obs_sizes: Mapping[str, int], num_actions: int, cfg: RslRlOnPolicyRunnerCfg, *, env: Any = None
    ) -> None:
        check_ppo_cfg(cfg, obs_sizes)
        self.cfg, self.env = cfg, env
        self.obs_sizes, self.num_actions = dict(obs_sizes), num_actions
        self.generator = torch.Generator().manual_seed(cfg.seed)
        with torch.random.fork_rng(devices=[]):  # the initial weights come from torch's global generator
            torch.manual_seed(cfg.seed)
            groups = {role: {name: obs_sizes[name] for name in names} for role, names in cfg.obs_groups.items()}
            self.actor = Network(groups["actor"], num_actions, cfg.actor)
            self.critic = Network(groups["critic"], 1, cfg.critic)
        self.learning_rate = float(cfg.algorithm.learning_rate)
        options = {} if cfg.algorithm.optimizer == "rmsprop" else {"fused": True}
        parameters = [*self.actor.parameters(), *self.critic.parameters()]
        make_optimizer = getattr(torch.optim, OPTIMIZERS[cfg.algorithm.optimizer])
        self.optimizer: torch.optim.Optimizer = make_optimizer(parameters, lr=self.learning_rate, **options)

    @torch.no_grad()
    def act(self, obs: Mapping[str, Tensor]) -> Tensor:
        """Return the actions (N, A) without exploring."""
        return self.actor(self.actor.inputs(obs))  # type: ignore[no-any-return]

    @torch.no_grad()
    def collect(self, env: PpoEnv, obs: Observations) -> tuple[Rollout, Observations]:
        """Act for ``num_steps_per_env`` control steps from ``obs``; return what happened, and what is seen now."""
        settings, horizon = self.cfg.algorithm, self.cfg.num_steps_per_env
        std = self.actor.std().clone()
        # Copies at once: an environment may write its next answer into the same memory.
        shown = {name: x.new_empty((horizon, *x.shape)) for name, x in obs.items()}
        action, mean = torch.empty(2, horizon, env.num_envs, env.num_actions)
        reward = torch.empty(horizon, env.num_envs)
        terminated, truncated = torch.zeros(2, horizon, env.num_envs, dtype=torch.bool)
        finals, logs = [], []
        for t in range(horizon):
            for name, x in obs.items():
                shown[name][t] = x
            mean[t] = self.actor(self.actor.inputs(obs))
            action[t] = mean[t] + std * torch.randn(mean[t].shape, generator=self.generator)
            step = env.step(action[t].clone())
            if self.cfg.check_for_nan:
                check_finite(step)
            if step.final_obs is not None and (rows := step.truncated.nonzero().squeeze(1)).numel():
                finals.append((t, rows, self.critic.inputs(step.final_obs)[rows]))
            if step.log:
                logs.append(step.log)
            obs, reward[t], terminated[t], truncated[t] = step.obs, step.reward, step.terminated, step.truncated
        # The critic does not change while collecting: all its values at once cost less than step by step.
        seen = torch.cat([self.critic.inputs(shown), self.critic.inputs(obs)[None]])
        values = self.critic(seen.flatten(0, 1)).view(len(seen), -1)
        next_value = values[1:].clone()
        for t, rows, final in finals:
            next_value[t, rows] = self.critic(final).squeeze(-1)
        rollout = Rollout(
            obs=shown,
            action=action,
            mean=mean,
            log_prob=gaussian_log_prob(action, mean, std),
            std=std,
            value=values[:-1],
            advantage=gae(reward, values[:-1], next_value, terminated, truncated, settings.gamma, settings.lam),
            reward=reward,
            done=terminated | truncated,
            logs=logs,
        )
        return rollout, obs

    def update(self, rollout: Rollout) -> dict[str, float]:
        """Improve actor and critic with a rollout; return figures of it, means over the gradient steps."""
        settings = self.cfg.algorithm
        obs = {name: x.flatten(0, 1) for name, x in rollout.obs.items()}
        action, old_mean = rollout.action.flatten(0, 1), rollout.mean.flatten(0, 1)
        old_log_prob, old_value, advantage = (x.flatten() for x in (rollout.log_prob, rollout.value, rollout.advantage))
        target = advantage + old_value
        if not settings.normalize_advantage_per_mini_batch:
            advantage = _standardised(advantage)
        samples = len(action)
        obs, action = self._mirrored(obs, action)
        # Copies (originals first) by samples by size. Normalised once: the statistics stay until the next rollout.
        with torch.no_grad():
            actor_in, critic_in = (
                net.normalizer(net.inputs(obs)).view(-1, samples, sum(self.obs_sizes[name] for name in net.groups))
                for net in (self.actor, self.critic)
            )
            action = action.view(-1, samples, self.num_actions)
        totals = torch.zeros(5)
        size = samples // settings.num_mini_batches
        for _ in range(settings.num_learning_epochs):
            order = torch.randperm(samples, generator=self.generator)
            for part in order[: size * settings.num_mini_batches].view(-1, size):
                totals += self._gradient_step(
                    actor_in[:, part],
                    critic_in[:, part],
                    action[:, part],
                    old_mean[part],
                    rollout.std,
                    old_log_prob[part],
                    old_value[part],
                    advantage[part],
                    target[part],
                )
        for net in (self.actor, self.critic):
            if isinstance(net.normalizer, RunningNorm):
                net.normalizer.update(net.inputs(obs))
        names = ("loss/surrogate", "loss/value", "loss/mirror", "policy/entropy", "policy/kl")
        means = (totals / (settings.num_learning_epochs * settings.num_mini_batches)).tolist()
        figures = dict(zip(names, means, strict=True))
        if settings.symmetry_cfg is None:
            del figures["loss/mirror"]
        return figures | {"policy/std": self.actor.std().mean().item(), "policy/learning_rate": self.learning_rate}

    def _gradient_step(
        self,
        actor_in: Tensor,
        critic_in: Tensor,
        action: Tensor,
        old_mean: Tensor,
        old_std: Tensor,
        old_log_prob: Tensor,
        old_value: Tensor,
        advantage: Tensor,
        target: Tensor,
    ) -> Tensor:
        """Take one step on b samples, (copies, b, ...) for what has mirrored copies; return the figures, (5,)."""
        settings = self.cfg.algorithm
        symmetry = settings.symmetry_cfg
        copies, batch = action.shape[:2]
        used = copies if symmetry is None or symmetry.use_data_augmentation else 1
        if settings.normalize_advantage_per_mini_batch:
            advantage = _standardised(advantage)
        mean, std = self.actor.mlp(actor_in.flatten(0, 1)), self.actor.std()
        with torch.no_grad():
            kl = gaussian_kl(old_mean, old_std, mean[:batch], std).mean()
        if settings.schedule == "adaptive":
            self.learning_rate = adapted_rate(self.learning_rate, kl.item(), settings.desired_kl)
            for group in self.optimizer.param_groups:
                group["lr"] = self.learning_rate
        log_prob = gaussian_log_prob(action[:used].flatten(0, 1), mean[: used * batch], std)
        value = self.critic.mlp(critic_in[:used].flatten(0, 1)).squeeze(-1)
        surrogate = surrogate_loss(log_prob, old_log_prob.repeat(used), advantage.repeat(used), settings.clip_param)
        clip = settings.clip_param if settings.use_clipped_value_loss else None
        error = value_loss(value, old_value.repeat(used), target.repeat(used), clip)
        entropy = (std.log() + 0.5 * math.log(2 * math.pi * math.e)).sum()
        loss = surrogate + settings.value_loss_coef * error - settings.entropy_coef * entropy
        mirror = torch.zeros(())
        if symmetry is not None and copies > 1:
            wanted = symmetry.data_augmentation_func(env=self.env, obs=None, actions=mean[:batch].detach())[1]
            mirror = (mean[batch:] - wanted[batch:]).square().mean()
            if symmetry.use_mirror_loss:
                loss = loss + symmetry.mirror_loss_coeff * mirror
        self.optimizer.zero_grad(set_to_none=True)
        torch.autograd.backward(loss)
        for net in (self.actor, self.critic):
            norm = nn.utils.clip_grad_norm_(net.parameters(), settings.max_grad_norm)
            if not torch.isfinite(norm):
                raise RobotBrainError(
                    "The training diverged: a gradient is not a number. Use a smaller learning_rate or a smaller "
                    "reward, or clip the observations; the last checkpoint is unharmed."
                )
        self.optimizer.step()
        return torch.stack([x.detach() for x in (surrogate, error, mirror, entropy, kl)])

    def _mirrored(self, obs: Observations, action: Tensor) -> tuple[Observations, Tensor]:
        symmetry = self.cfg.algorithm.symmetry_cfg
        if symmetry is None:
            return obs, action
        more_obs, more_action = symmetry.data_augmentation_func(env=self.env, obs=obs, actions=action)
        sizes = {name: tuple(x.shape) for name, x in [*more_obs.items(), ("actions", more_action)]}
        if len({shape[0] for shape in sizes.values()}) != 1 or len(more_action) % len(action):
            raise InputError(
                "result of data_augmentation_func",
                given=sizes,
                expected=f"a multiple of {len(action)} rows in the observations and in the actions",
                fix="Put the mirrored samples below the given ones: torch.cat([x, mirrored]).",
            )
        return dict(more_obs), more_action

    def state_dict(self) -> dict[str, Any]:
        """Return everything that decides how the learning goes on."""
        return {
            "actor": self.actor.state_dict(),
            "critic": self.critic.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "learning_rate": self.learning_rate,
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from such a state."""
        self.actor.load_state_dict(state["actor"])
        self.critic.load_state_dict(state["critic"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.learning_rate = state["learning_rate"]
        self.generator.set_state(state["generator"])


def _standardised(x: Tensor) -> Tensor:
    return (x - x.mean()) / (x.std() + 1e-8)
