"""Right solutions of `hw1_rl`, written differently: each must earn every point, whatever generator it draws from."""

from __future__ import annotations

from robotbrain.grading.sample import Style

_TORCH = {
    "buffer": """
class ReplayBuffer:
    # One table of torch, a permutation of all rows for every batch.

    def __init__(self, capacity, obs_dim, act_dim):
        self.widths = [obs_dim, act_dim, 1, obs_dim, 1]
        self.table = torch.empty(capacity, sum(self.widths)).fill_(float("nan"))
        self.written = 0

    def __len__(self):
        return min(self.written, len(self.table))

    def add(self, *fields):
        columns = [torch.tensor(np.array(f), dtype=torch.float32).reshape(len(f), -1) for f in fields]
        for row in torch.cat(columns, dim=1):
            self.table[self.written % len(self.table)] = row
            self.written += 1

    def sample(self, batch_size):
        rows = torch.randperm(len(self))[:batch_size]
        obs, action, reward, next_obs, terminated = torch.split(self.table[rows], self.widths, dim=1)
        return Batch(obs.clone(), action.clone(), reward[:, 0].clone(), next_obs.clone(), terminated[:, 0].clone())
""",
    "store": """
def store_step(buffer, obs, action, next_obs, reward, terminated, truncated, info):
    mask = info.get("_final_obs", np.zeros(len(reward), dtype=bool))
    final = info.get("final_obs", next_obs)
    buffer.add(obs, action, reward, np.where(mask[:, None], final, next_obs), terminated.astype(np.float32))
""",
    "target": """
@torch.no_grad()
def td_target(batch, actor_target, critic_target, gamma):
    future = torch.flatten(critic_target(batch.next_obs, actor_target(batch.next_obs)))
    future[batch.terminated.bool()] = 0.0
    return torch.add(batch.reward, future, alpha=gamma)
""",
    "critic": """
def critic_loss(critic, batch, target):
    return torch.nn.functional.mse_loss(critic(batch.obs, batch.action), target.unsqueeze(1))
""",
    "actor": """
def actor_loss(actor, critic, batch):
    # The critic as a function of parameters that are constants.
    constants = {name: parameter.detach() for name, parameter in critic.named_parameters()}
    value = torch.func.functional_call(critic, constants, (batch.obs, actor(batch.obs)))
    return value.mean().neg()
""",
    "soft": """
def soft_update(target, online, tau):
    old, new = target.state_dict(), online.state_dict()
    target.load_state_dict({name: torch.lerp(old[name], new[name], tau) for name in old})
""",
    "noise": """
def select_action(actor, obs, std=0.0, low=-1.0, high=1.0):
    with torch.inference_mode():
        action = actor(torch.tensor(obs))
        if std:
            action = torch.normal(mean=action, std=std)
        return torch.clamp(action, low, high).cpu().numpy()
""",
    "agent": """
class DDPG:
    def __init__(self, actor, critic, gamma=0.9, tau=0.01, actor_lr=1e-3, critic_lr=1e-3, noise_std=0.1):
        self.actor, self.critic = actor, critic
        self.actor_target = copy.deepcopy(actor).requires_grad_(False)
        self.critic_target = copy.deepcopy(critic).requires_grad_(False)
        self.settings = dict(gamma=gamma, tau=tau, noise_std=noise_std)
        self.optimizers = [
            torch.optim.Adam(critic.parameters(), critic_lr, foreach=True),
            torch.optim.Adam(actor.parameters(), actor_lr, foreach=True),
        ]

    def act(self, obs, explore=False):
        std = self.settings["noise_std"] * explore
        return select_action(self.actor, obs, std)

    def update(self, batch):
        losses = []
        for k, optimizer in enumerate(self.optimizers):
            if k == 0:
                y = td_target(batch, self.actor_target, self.critic_target, self.settings["gamma"])
                loss = critic_loss(self.critic, batch, y)
            else:
                loss = actor_loss(self.actor, self.critic, batch)
            optimizer.zero_grad(set_to_none=False)
            loss.backward()
            optimizer.step()
            losses.append(float(loss.detach()))
        for slow, fast in ((self.actor_target, self.actor), (self.critic_target, self.critic)):
            soft_update(slow, fast, self.settings["tau"])
        return tuple(losses)
""",
}

_LISTS = {
    "buffer": """
import random
from collections import deque

class ReplayBuffer:
    # A deque of tuples; Python's own random numbers.

    def __init__(self, capacity, obs_dim, act_dim):
        self.memory = deque(maxlen=capacity)

    def __len__(self):
        return len(self.memory)

    def add(self, obs, action, reward, next_obs, terminated):
        for k in range(len(reward)):
            self.memory.append(
                (obs[k].tolist(), action[k].tolist(), float(reward[k]), next_obs[k].tolist(), float(terminated[k]))
            )

    def sample(self, batch_size):
        chosen = random.sample(list(self.memory), batch_size)
        return Batch(*(torch.tensor(column) for column in zip(*chosen)))
""",
    "store": """
def store_step(buffer, obs, action, next_obs, reward, terminated, truncated, info):
    real = []
    for k in range(len(reward)):
        if "final_obs" in info and info["_final_obs"][k]:
            real.append(info["final_obs"][k])
        else:
            real.append(next_obs[k])
    buffer.add(obs, action, reward, np.array(real), terminated)
""",
    "target": """
def td_target(batch, actor_target, critic_target, gamma):
    value = critic_target(batch.next_obs, actor_target(batch.next_obs)).detach()
    targets = []
    for k in range(len(batch.reward)):
        y = batch.reward[k].item()
        if batch.terminated[k] < 0.5:
            y += gamma * value[k, 0].item()
        targets.append(y)
    return torch.tensor(targets)
""",
    "critic": """
def critic_loss(critic, batch, target):
    total = 0.0
    for value, wanted in zip(critic(batch.obs, batch.action), target):
        total = total + (value[0] - wanted) ** 2
    return total / len(target)
""",
    "actor": """
def actor_loss(actor, critic, batch):
    # A frozen twin of the critic judges.
    judge = copy.deepcopy(critic)
    for parameter in judge.parameters():
        parameter.requires_grad = False
    values = judge(batch.obs, actor(batch.obs))
    return -torch.sum(values) / len(values)
""",
    "soft": """
def soft_update(target, online, tau):
    for a, b in zip(target.parameters(), online.parameters()):
        a.data.copy_(tau * b.data + (1 - tau) * a.data)
""",
    "noise": """
def select_action(actor, obs, std=0.0, low=-1.0, high=1.0):
    rows = actor(torch.from_numpy(np.asarray(obs, dtype=np.float32))).detach().tolist()
    for row in rows:
        for k in range(len(row)):
            if std > 0:
                row[k] += random.gauss(0, std)
            row[k] = max(low, min(high, row[k]))
    return np.array(rows, dtype=np.float32)
""",
    "gap": """
def success_bound(successes, n):
    # The rate at which so many successes or more would be a 5 % coincidence, by bisection.
    if successes == 0:
        return 0.0
    from scipy.stats import binom
    low, high = 0.0, 1.0
    for _ in range(60):
        middle = (low + high) / 2
        if binom.sf(successes - 1, n, middle) < 0.05:
            low = middle
        else:
            high = middle
    return low

def wilson(successes, n, z=1.96):
    p = successes / n
    root = z * (p * (1 - p) / n + z * z / (4 * n * n)) ** 0.5
    return (p + z * z / (2 * n) - root) / (1 + z * z / n), (p + z * z / (2 * n) + root) / (1 + z * z / n)

def gap(sim, real):
    p, q = sum(bool(v) for v in sim) / len(sim), sum(bool(v) for v in real) / len(real)
    a, b = wilson(p * len(sim), len(sim))
    c, d = wilson(q * len(real), len(real))
    return [p - q, p - q - ((p - a) ** 2 + (d - q) ** 2) ** 0.5, p - q + ((b - p) ** 2 + (q - c) ** 2) ** 0.5]
""",
}

_NUMPY = {
    "buffer": """
class ReplayBuffer:
    # A structured array, rolled so that the oldest row comes first; NumPy's legacy generator.

    def __init__(self, capacity, obs_dim, act_dim):
        self.kind = np.dtype([("obs", "f4", obs_dim), ("action", "f4", act_dim), ("reward", "f4"),
                              ("next_obs", "f4", obs_dim), ("terminated", "f4")])
        self.rows, self.capacity = np.zeros(0, self.kind), capacity

    def __len__(self):
        return self.rows.size

    def add(self, obs, action, reward, next_obs, terminated):
        new = np.zeros(len(reward), self.kind)
        for name, values in zip(self.kind.names, (obs, action, reward, next_obs, terminated)):
            new[name] = np.reshape(values, new[name].shape)
        self.rows = np.concatenate([self.rows, new])[-self.capacity:]

    def sample(self, batch_size):
        drawn = self.rows[np.random.choice(len(self.rows), batch_size)]
        return Batch(*(torch.as_tensor(drawn[name].copy()) for name in self.kind.names))
""",
    "store": """
def store_step(buffer, obs, action, next_obs, reward, terminated, truncated, info):
    ended = np.logical_or(terminated, truncated)
    fixed = np.array(next_obs)
    if ended.any():
        fixed[ended] = info["final_obs"][ended]
    buffer.add(np.array(obs), np.array(action), np.array(reward), fixed, 1.0 * terminated)
""",
    "target": """
def td_target(batch, actor_target, critic_target, gamma):
    q = critic_target(batch.next_obs, actor_target(batch.next_obs)).detach().numpy()[:, 0]
    y = np.where(batch.terminated.numpy() > 0, batch.reward.numpy(), batch.reward.numpy() + gamma * q)
    return torch.from_numpy(y.astype(np.float32))
""",
    "actor": """
def actor_loss(actor, critic, batch):
    # dQ/da, computed by hand, is what the actor is pushed along; the value is put back for the eyes.
    action = actor(batch.obs)
    probe = action.detach().requires_grad_(True)
    value = critic(batch.obs, probe).mean()
    slope, = torch.autograd.grad(value, probe)
    along = (slope * action).sum()
    return -(along - along.detach() + value.detach())
""",
    "noise": """
GENERATOR = np.random.default_rng()

def select_action(actor, obs, std=0.0, low=-1.0, high=1.0):
    with torch.no_grad():
        clean = np.asarray(actor(torch.as_tensor(obs)), dtype=np.float64)
    noisy = clean + std * GENERATOR.standard_normal(clean.shape)
    return np.minimum(np.maximum(noisy, low), high).astype(np.float32)
""",
    "gap": """
from scipy import stats

def success_bound(successes, n):
    return stats.binomtest(int(successes), int(n), alternative="greater").proportion_ci(0.95, method="exact").low

def gap(sim, real):
    rates, limits = [], []
    for outcome in (np.asarray(sim, float), np.asarray(real, float)):
        interval = stats.binomtest(int(outcome.sum()), outcome.size).proportion_ci(0.95, method="wilson")
        rates.append(outcome.mean())
        limits.append((interval.low, interval.high))
    difference = rates[0] - rates[1]
    low = difference - np.hypot(rates[0] - limits[0][0], limits[1][1] - rates[1])
    high = difference + np.hypot(limits[0][1] - rates[0], rates[1] - limits[1][0])
    return difference, low, high
""",
}

STYLES = [
    Style("torch-only", _TORCH, "everything in torch: one table, permutations, functional calls, state dicts"),
    Style("lists", _LISTS, "a deque of tuples, Python's random numbers, loops"),
    Style("numpy", _NUMPY, "structured arrays, NumPy's generators, a hand-made policy gradient"),
]
