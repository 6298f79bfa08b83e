"""DDPG against closed forms, finite differences, a plain second implementation, and itself interrupted."""

import dataclasses
import signal

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from torch import nn

from robotbrain.errors import InputError, RobotBrainError
from robotbrain.rl.ddpg import (
    DDPG,
    Actor,
    Collector,
    Critic,
    DDPGConfig,
    actor_loss,
    critic_loss,
    scale_action,
    soft_update,
    td_target,
    train_ddpg,
)
from robotbrain.rl.policies import load_policy
from robotbrain.rl.replay import Batch

# ------------------------------------------------------------ a linear system with quadratic cost, solved by hand
A, B, COST, GAMMA = 0.9, 0.5, 0.3, 0.95


def value_factor(k):
    """V(x) = -p x^2 of the policy a = -k x in x' = A x + B a with reward -(x^2 + COST a^2)."""
    return (1 + COST * k**2) / (1 - GAMMA * (A - B * k) ** 2)


def optimal_gain():
    p = 1.0
    for _ in range(1000):  # Riccati's equation by iteration
        k = GAMMA * p * A * B / (COST + GAMMA * p * B**2)
        p = 1 + COST * k**2 + GAMMA * p * (A - B * k) ** 2
    return k


class LinearActor(nn.Module):
    def __init__(self, k):
        super().__init__()
        self.k = nn.Parameter(torch.tensor(k, dtype=torch.float64))

    def forward(self, x):
        return -self.k * x


class QuadraticCritic(nn.Module):
    """Exactly Q of the policy a = -k x."""

    def __init__(self, k):
        super().__init__()
        self.p = nn.Parameter(torch.tensor(value_factor(k), dtype=torch.float64))

    def forward(self, x, a):
        return (-(x**2 + COST * a**2) - GAMMA * self.p * (A * x + B * a) ** 2).squeeze(1)


def pairs(n=64):
    return torch.randn(2, n, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("k", [0.2, 1.0, 1.5])
def test_exact_q_is_the_fixed_point_of_the_target(k):
    x, a = pairs()
    actor, critic = LinearActor(k), QuadraticCritic(k)
    reward, successor = -(x**2 + COST * a**2).squeeze(1), A * x + B * a
    target = td_target(reward, torch.zeros(64), critic(successor, actor(successor)), GAMMA)
    torch.testing.assert_close(target, critic(x, a), rtol=1e-12, atol=1e-12)
    assert critic_loss(critic, x, a, target).item() < 1e-24


def test_target_ends_with_the_task_and_carries_no_gradient():
    next_q = torch.tensor([5.0, 5.0], requires_grad=True)
    target = td_target(torch.tensor([1.0, 1.0]), torch.tensor([0.0, 1.0]), next_q, 0.9)
    assert target.tolist() == [5.5, 1.0]
    assert not target.requires_grad


def test_actor_loss_is_minus_the_value_and_flat_at_the_optimal_gain():
    x, _ = pairs()
    best = optimal_gain()
    for k, slope in ((best - 0.3, -1), (best, 0), (best + 0.3, 1)):
        actor, critic = LinearActor(k), QuadraticCritic(k)
        loss = actor_loss(actor, critic, x)
        assert loss.item() == pytest.approx(value_factor(k) * (x**2).mean().item(), rel=1e-12)
        loss.backward()
        assert abs(actor.k.grad.item()) < 1e-9 if slope == 0 else actor.k.grad.item() * slope > 0.01


def finite_difference(loss, parameter, index, step=1e-6):
    with torch.no_grad():
        flat = parameter.view(-1)
        middle = flat[index].item()
        flat[index] = middle + step
        above = loss().item()
        flat[index] = middle - step
        below = loss().item()
        flat[index] = middle
    return (above - below) / (2 * step)


def test_gradients_of_both_losses_agree_with_finite_differences():
    torch.manual_seed(0)
    actor, critic = Actor(3, 2, (16, 16)).double(), Critic(3, 2, (16, 16)).double()
    obs, action, target = torch.randn(8, 3).double(), torch.rand(8, 2).double(), torch.randn(8).double()
    for network, loss in (
        (critic, lambda: critic_loss(critic, obs, action, target)),
        (actor, lambda: actor_loss(actor, critic, obs)),
    ):
        parameters = list(network.parameters())
        gradients = torch.autograd.grad(loss(), parameters)
        for parameter, gradient in zip(parameters, gradients, strict=True):
            for index in range(0, parameter.numel(), max(1, parameter.numel() // 5)):
                expected = finite_difference(loss, parameter, index)
                assert gradient.view(-1)[index].item() == pytest.approx(expected, rel=1e-4, abs=1e-8)


def test_soft_update_follows_geometrically():
    target, source = nn.Linear(3, 2).double(), nn.Linear(3, 2).double()
    start, goal = target.weight.detach().clone(), source.weight.detach().clone()
    for n in range(1, 6):
        soft_update(target, source, 0.1)
        torch.testing.assert_close(target.weight, goal + 0.9**n * (start - goal), rtol=1e-12, atol=1e-12)
    assert torch.equal(source.weight, goal)


# ------------------------------------------------------------ the agent


def random_batch(seed, n=32, obs_dim=4, act_dim=2):
    g = torch.Generator().manual_seed(seed)
    draw = [torch.randn(n, obs_dim, generator=g), torch.rand(n, act_dim, generator=g) * 2 - 1]
    draw += [
        torch.randn(n, generator=g),
        torch.randn(n, obs_dim, generator=g),
        (torch.rand(n, generator=g) < 0.2).float(),
    ]
    return Batch(*draw)


@pytest.mark.parametrize("every", [1, 2])
def test_update_agrees_with_a_plain_implementation(every):
    config = DDPGConfig(hidden=(16, 16), gamma=0.9, tau=0.1, actor_lr=1e-2, critic_lr=3e-2, actor_every=every)
    agent = DDPG(4, 2, config, seed=3)
    nets = [
        {k: v.detach().clone().requires_grad_() for k, v in m.named_parameters()} for m in (agent.actor, agent.critic)
    ]
    slow = [{k: v.detach().clone() for k, v in net.items()} for net in nets]
    optimisers = [torch.optim.Adam(n.values(), lr, foreach=False) for n, lr in zip(nets, (1e-2, 3e-2), strict=True)]
    call = torch.func.functional_call
    for seed in range(5):
        b = random_batch(seed)
        losses = agent.update(b)
        ahead = call(agent.critic, slow[1], (b.next_obs, call(agent.actor, slow[0], b.next_obs)))
        y = torch.where(b.terminated > 0, b.reward, b.reward + 0.9 * ahead)
        q_loss = ((call(agent.critic, nets[1], (b.obs, b.action)) - y) ** 2).mean()
        optimisers[1].zero_grad()
        q_loss.backward()
        optimisers[1].step()
        if (seed + 1) % every == 0:
            pi_loss = -call(agent.critic, nets[1], (b.obs, call(agent.actor, nets[0], b.obs))).mean()
            optimisers[0].zero_grad()
            pi_loss.backward()
            optimisers[0].step()
        for lagging, net in zip(slow, nets, strict=True):
            for name in net:
                lagging[name] = 0.9 * lagging[name] + 0.1 * net[name].detach()
        assert losses.critic == pytest.approx(q_loss.item(), rel=1e-4)
        if seed + 1 >= every:
            assert losses.actor == pytest.approx(pi_loss.item(), rel=1e-4, abs=1e-6)
    ours = (agent.actor, agent.critic, agent.actor_target, agent.critic_target)
    for module, plain in zip(ours, (*nets, *slow), strict=True):
        for name, value in module.named_parameters():
            torch.testing.assert_close(value, plain[name], rtol=1e-3, atol=1e-5)


def test_policy_is_deterministic_and_exploration_keeps_to_the_bounds():
    agent = DDPG(4, 2, DDPGConfig(noise_std=5.0), seed=0)
    obs = np.random.default_rng(0).normal(size=(200, 4)).astype(np.float32)
    np.testing.assert_array_equal(agent.act(obs), agent.act(obs))
    noisy = agent.act(obs, explore=True)
    assert np.abs(noisy).max() == 1.0
    assert not np.array_equal(noisy, agent.act(obs))
    warm = agent.random_action(4000)
    assert warm.min() < -0.99 and warm.max() > 0.99 and abs(warm.mean()) < 0.05


def test_averaged_policy_is_the_target_s_and_learning_is_the_same():
    agents = [DDPG(4, 2, DDPGConfig(averaged=averaged, noise_std=0.0, actor_lr=1e-2), seed=0) for averaged in (0, 1)]
    for agent in agents:
        for seed in range(3):
            agent.update(random_batch(seed))
    plain, averaged = agents
    assert plain.policy is plain.actor and averaged.policy is averaged.actor_target
    assert same_weights(plain, averaged)
    obs = random_batch(9).obs.numpy()
    np.testing.assert_array_equal(averaged.act(obs), averaged.actor_target(torch.from_numpy(obs)).numpy())
    np.testing.assert_array_equal(averaged.act(obs, explore=True), plain.act(obs))  # without noise: the actor itself
    assert not np.array_equal(averaged.act(obs), plain.act(obs))


def test_seed_decides_the_weights_and_leaves_the_global_generator_alone():
    torch.manual_seed(5)
    before = torch.random.get_rng_state()
    one, same, other = (DDPG(4, 2, DDPGConfig(), seed=s).actor.net[0].weight for s in (1, 1, 2))
    assert torch.equal(one, same) and not torch.equal(one, other)
    assert torch.equal(before, torch.random.get_rng_state())


def test_actions_are_scaled_to_the_bounds():
    low, high = np.array([-2.0, 0.0], np.float32), np.array([2.0, 10.0], np.float32)
    scaled = scale_action(np.array([[-1, -1], [0, 0], [1, 0.5]], np.float32), low, high)
    np.testing.assert_allclose(scaled, [[-2, 0], [0, 5], [2, 7.5]])


# ------------------------------------------------------------ collection: a clock whose transitions are known


class Clock(gymnasium.Env):
    """Observes its steps so far; ends after ``length`` by termination or by truncation; rewards 1."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-3.0, 3.0, (1,), np.float32)

    def __init__(self, length, terminates):
        self.length, self.terminates = length, terminates

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.array([0.0], np.float32), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.t += 1
        over = self.t >= self.length
        obs = np.array([self.t], np.float32)
        return obs, 1.0, over and self.terminates, over and not self.terminates, {}


def clocks(mode, lengths=((3, True), (4, False), (2, True), (1, False))):
    return SyncVectorEnv([lambda n=n, t=t: Clock(n, t) for n, t in lengths], autoreset_mode=mode)


@pytest.mark.parametrize("mode", AutoresetMode)
def test_transitions_are_the_same_whatever_way_the_environment_resets(mode):
    collector = Collector(clocks(mode), seed=0)
    seen = set()
    for _ in range(24):
        rows = collector.step(np.zeros((4, 1), np.float32))
        seen |= {
            (float(o[0]), float(n[0]), bool(t))
            for o, n, t in zip(rows.obs, rows.next_obs, rows.terminated, strict=True)
        }
        assert (rows.reward == 1.0).all()
    by_clock = [[(t, t + 1, ends and t + 1 == n) for t in range(n)] for n, ends in ((3, 1), (4, 0), (2, 1), (1, 0))]
    assert seen == {(float(a), float(b), bool(c)) for rows in by_clock for a, b, c in rows}
    assert set(collector.take_returns()) == {3.0, 4.0, 2.0, 1.0}
    assert collector.take_returns() == []


@pytest.mark.parametrize("mode", AutoresetMode)
@pytest.mark.parametrize(("terminates", "value"), [(True, 1.0), (False, 2.0)])
def test_value_ends_at_a_termination_and_goes_on_after_a_truncation(mode, terminates, value):
    """Reward 1 in each step, gamma 0.5: worth 2 in a life cut into episodes by a clock, 1 if each step is the last."""
    config = DDPGConfig(
        total_steps=460,
        warmup_steps=60,
        updates_per_step=0.5,
        hidden=(8,),
        batch_size=32,
        gamma=0.5,
        tau=0.3,
        critic_lr=0.03,
    )

    class Blink(Clock):  # always looks the same, so that its value is one number
        def reset(self, **kwargs):
            super().reset(**kwargs)
            return np.zeros(1, np.float32), {}

        def step(self, action):
            return np.zeros(1, np.float32), *super().step(action)[1:]

    env = SyncVectorEnv([lambda: Blink(1, terminates) for _ in range(2)], autoreset_mode=mode)
    agent = train_ddpg(lambda: env, config, seed=0, progress=False).agent
    q = agent.critic(torch.zeros(3, 1), torch.tensor([[-1.0], [0.0], [1.0]]))
    torch.testing.assert_close(q.detach(), torch.full((3,), value), rtol=0.05, atol=0)


# ------------------------------------------------------------ training: points that shall go to the middle


class Points(gymnasium.vector.VectorEnv):
    """N points on a line, moved by up to 0.3 a step; reward 1 - x^2; cut after ``length`` steps; offers its state."""

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012
    single_observation_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
    single_action_space = gymnasium.spaces.Box(-2.0, 1.0, (1,), np.float32)  # off centre on purpose

    def __init__(self, num_envs=8, length=5, broken_at=None):
        self.num_envs, self.length, self.broken_at = num_envs, length, broken_at
        self.rng, self.steps = np.random.default_rng(0), 0

    def reset(self, *, seed=None, options=None):
        self.rng = np.random.default_rng(seed)
        self.x = self.rng.uniform(-1, 1, self.num_envs)
        self.t = self.rng.integers(0, self.length, self.num_envs)
        return self.x[:, None].astype(np.float32), {}

    def step(self, actions):
        assert (actions >= -2.0).all() and (actions <= 1.0).all()
        self.steps += 1
        self.x = np.clip(self.x + 0.2 * (actions[:, 0] + 0.5), -1, 1)
        self.t += 1
        ended = self.t >= self.length
        reward, final = 1 - self.x**2, self.x[:, None].astype(np.float32)
        self.x[ended], self.t[ended] = self.rng.uniform(-1, 1, ended.sum()), 0
        if self.steps == self.broken_at:
            reward[3] = np.nan
        info = {"final_obs": final, "_final_obs": ended} if ended.any() else {}
        return self.x[:, None].astype(np.float32), reward, np.zeros_like(ended), ended, info

    def state_dict(self):
        return {"x": torch.tensor(self.x), "t": torch.tensor(self.t), "rng": self.rng.bit_generator.state}

    def load_state_dict(self, state):
        self.x, self.t = state["x"].numpy().copy(), state["t"].numpy().copy()
        self.rng.bit_generator.state = state["rng"]

    def close(self, **kwargs): ...


SMALL = DDPGConfig(
    total_steps=2400,
    warmup_steps=160,
    updates_per_step=0.25,
    batch_size=64,
    hidden=(32, 32),
    gamma=0.9,
    tau=0.05,
    actor_lr=1e-3,
    critic_lr=3e-3,
    eval_every=800,
)


@pytest.mark.parametrize("noise", ["gaussian", "ou"])
def test_learns_to_go_to_the_middle_and_what_that_is_worth(noise):
    result = train_ddpg(Points, dataclasses.replace(SMALL, noise=noise), seed=0, progress=False)
    x = np.linspace(-1, 1, 21, dtype=np.float32)[:, None]
    for _ in range(12):
        x = np.clip(x + 0.2 * (result.policy(x) + 0.5), -1, 1).astype(np.float32)
    assert np.abs(x).max() < 0.15
    # In the middle for ever: 1 / (1 - gamma) = 10. Episodes of 5 steps taken for lives would be worth 4.1 at most.
    rest = torch.from_numpy(result.agent.act(np.zeros((1, 1), np.float32)))
    assert result.agent.critic(torch.zeros(1, 1), rest).item() == pytest.approx(10.0, rel=0.15)
    assert [point["step"] for point in result.curve] == [800, 1600, 2400]
    assert result.curve[-1]["updates"] == (2400 - 160) // 4
    assert result.curve[-1]["train_return"] > result.curve[0]["train_return"]


def same_weights(one, other):
    mine, theirs = one.state_dict(), other.state_dict()
    return all(
        torch.equal(value, theirs[part][name])
        for part in ("actor", "critic", "actor_target", "critic_target")
        for name, value in mine[part].items()
    )


class Stop:
    """An evaluation that presses Ctrl-C at its n-th call."""

    def __init__(self, at):
        self.calls, self.at = 0, at

    def __call__(self, policy):
        self.calls += 1
        if self.calls == self.at:
            signal.raise_signal(signal.SIGINT)
        return {"calls": self.calls}


@pytest.fixture(scope="module")
def uninterrupted():
    """One training with and one without stepping the environments while the networks learn."""
    return {
        overlap: train_ddpg(Points, interrupted_config(overlap), seed=1, progress=False) for overlap in (False, True)
    }


def interrupted_config(overlap):
    return dataclasses.replace(SMALL, total_steps=400, overlap=overlap, noise="ou", actor_every=3, eval_every=8)


@pytest.mark.parametrize(("overlap", "stop_after"), [(False, 80), (False, 304), (True, 160), (True, 304)])
def test_interrupted_and_resumed_it_ends_with_the_same_bytes(tmp_path, uninterrupted, overlap, stop_after):
    config, whole = interrupted_config(overlap), uninterrupted[overlap]
    with pytest.raises(KeyboardInterrupt, match=f"{stop_after} of 400.*resume=True"):
        train_ddpg(Points, config, seed=1, run_dir=tmp_path, evaluate=Stop(stop_after // 8), progress=False)
    resumed = train_ddpg(Points, config, seed=1, run_dir=tmp_path, resume=True, progress=False)
    assert same_weights(whole.agent, resumed.agent)
    for one, other in zip(whole.curve, resumed.curve, strict=True):
        assert one["train_return"] == pytest.approx(other["train_return"], nan_ok=True)
        assert (one["step"], one["updates"]) == (other["step"], other["updates"])


def test_weights_follow_from_the_seed(uninterrupted):
    again, other = (train_ddpg(Points, interrupted_config(True), seed=s, progress=False) for s in (1, 2))
    assert same_weights(uninterrupted[True].agent, again.agent)
    assert not same_weights(uninterrupted[True].agent, other.agent)


@pytest.mark.parametrize("averaged", [False, True])
def test_checkpoint_brings_back_the_policy_that_was_judged(tmp_path, averaged):
    config = dataclasses.replace(SMALL, total_steps=400, averaged=averaged)
    result = train_ddpg(Points, config, seed=0, run_dir=tmp_path, progress=False)
    obs = np.linspace(-1, 1, 9, dtype=np.float32)[:, None]
    np.testing.assert_array_equal(load_policy(tmp_path).act(obs), result.agent.act(obs))
    itself = result.agent.actor(torch.from_numpy(obs)).detach().numpy()
    assert np.array_equal(result.agent.act(obs), itself) != averaged


def test_a_finished_training_can_be_made_longer(tmp_path):
    longer = dataclasses.replace(SMALL, total_steps=480)
    train_ddpg(Points, dataclasses.replace(SMALL, total_steps=240), seed=0, run_dir=tmp_path, progress=False)
    resumed = train_ddpg(Points, longer, seed=0, run_dir=tmp_path, resume=True, progress=False)
    assert same_weights(resumed.agent, train_ddpg(Points, longer, seed=0, progress=False).agent)


def test_refuses_to_overwrite_or_to_mix_trainings(tmp_path):
    short = dataclasses.replace(SMALL, total_steps=80)
    with pytest.raises(InputError, match=r"checkpoint"):
        train_ddpg(Points, short, seed=0, run_dir=tmp_path, resume=True, progress=False)
    train_ddpg(Points, short, seed=0, run_dir=tmp_path, progress=False)
    with pytest.raises(InputError, match="resume=True"):
        train_ddpg(Points, short, seed=0, run_dir=tmp_path, progress=False)
    with pytest.raises(InputError, match=r"gamma.*0\.5"):
        train_ddpg(Points, dataclasses.replace(short, gamma=0.5), seed=0, run_dir=tmp_path, resume=True, progress=False)
    with pytest.raises(InputError, match="run_dir"):
        train_ddpg(Points, short, seed=0, resume=True, progress=False)


def test_callback_ends_the_training():
    result = train_ddpg(Points, SMALL, seed=0, callback=lambda point: point["step"] >= 1600, progress=False)
    assert result.curve[-1]["step"] == 1600


def test_torch_threads_are_as_before():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        train_ddpg(Points, dataclasses.replace(SMALL, total_steps=16), seed=0, progress=False)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


# ------------------------------------------------------------ what cannot work


def test_nan_is_named_with_environment_and_step():
    with pytest.raises(InputError, match="reward of environment 3 at step 7"):
        train_ddpg(lambda: Points(broken_at=7), SMALL, seed=0, progress=False)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"single_action_space": gymnasium.spaces.Discrete(3)}, "action space.*Discrete"),
        ({"single_action_space": gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float32)}, "finite bounds"),
        ({"single_observation_space": gymnasium.spaces.Box(0, 1, (4, 4), np.float32)}, "observation space"),
    ],
)
def test_spaces_that_cannot_work(change, named):
    with pytest.raises(InputError, match=named):
        train_ddpg(type("Odd", (Points,), change), SMALL, seed=0, progress=False)


@pytest.mark.parametrize(
    ("field", "value"),
    [("gamma", 1.0), ("tau", 0.0), ("batch_size", 0), ("noise", "pink"), ("actor_lr", -1.0), ("hidden", (0,))],
)
def test_settings_that_cannot_work(field, value):
    with pytest.raises(InputError, match=field):
        DDPGConfig(**{field: value})


def test_an_environment_that_hides_its_last_observation_is_refused():
    class Hiding(Points):
        def step(self, actions):
            return *super().step(actions)[:4], {}

    with pytest.raises(InputError, match="final_obs"):
        train_ddpg(Hiding, SMALL, seed=0, progress=False)


def test_an_environment_without_state_goes_on_with_new_episodes(tmp_path):
    class Forgetful(Points):
        state_dict = load_state_dict = None
        seeds = []  # noqa: RUF012

        def reset(self, *, seed=None, options=None):
            self.seeds.append(seed)
            return super().reset(seed=seed)

    config = dataclasses.replace(SMALL, total_steps=80)
    train_ddpg(Forgetful, config, seed=0, run_dir=tmp_path, progress=False)
    longer = dataclasses.replace(config, total_steps=160)
    result = train_ddpg(Forgetful, longer, seed=0, run_dir=tmp_path, resume=True, progress=False)
    assert result.curve[-1]["step"] == 160
    assert Forgetful.seeds[-1] != Forgetful.seeds[0]


def test_divergence_is_told():
    class Explosive(Points):
        def step(self, actions):
            obs, reward, *rest = super().step(actions)
            return obs, reward * 1e30, *rest

    with pytest.raises(RobotBrainError, match="diverged"):
        train_ddpg(Explosive, SMALL, seed=0, progress=False)
