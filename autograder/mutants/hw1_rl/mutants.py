"""Named wrong solutions of `hw1_rl`: each is a mistake that students make, and must lose its own points."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

from robotbrain.grading.harmful_onnx import endless_loop, weights_in_another_file
from robotbrain.grading.sample import Mutant

PLAIN, ROBUST = "reach_policy.onnx", "reach_policy_robust.onnx"


def _edited(name: str, change: Callable[[Any], None]) -> Callable[[Path], bytes]:
    """Return what makes a changed copy of a reference policy; ``change`` gets the ONNX model."""

    def make(folder: Path) -> bytes:
        import onnx

        model = onnx.load_model_from_string((folder / name).read_bytes())
        change(model)
        content: bytes = model.SerializeToString(deterministic=True)
        return content

    return make


def _metadata(key: str, value: str) -> Callable[[Any], None]:
    """Return what sets one entry of the metadata (JSON)."""

    def change(model: Any) -> None:
        for entry in model.metadata_props:
            if entry.key == key:
                entry.value = value

    return change


def _weights(change: Callable[[Any, Any], Any]) -> Callable[[Any], None]:
    """Return what replaces every array of weights by ``change(array, rng)``."""

    def all_weights(model: Any) -> None:
        import numpy as np
        from onnx import numpy_helper

        rng = np.random.default_rng(0)
        for tensor in model.graph.initializer:
            changed = change(numpy_helper.to_array(tensor), rng).astype("float32")
            tensor.CopyFrom(numpy_helper.from_array(changed, tensor.name))

    return all_weights


def _other_task(folder: Path) -> bytes:
    return _edited(PLAIN, _metadata("task", '"navigation"'))(folder)


MUTANTS = [
    Mutant(
        name="detach-is-fatal",
        exercise="bugs",
        hint="who-is-optimised",
        describe="holds the missing detach for a mistake in what is learned",
        loses=0.4,
        replace={"bugs": [('"b": "wastes"', '"b": "breaks"')]},
    ),
    Mutant(
        name="minus-sign-suspected",
        exercise="bugs",
        hint="as-in-the-paper",
        describe="takes the minus of the actor's loss for a bug",
        loses=0.4,
        replace={"bugs": [('"g": "fine"', '"g": "breaks"')]},
    ),
    # ------------------------------------------------------------ buffer
    Mutant(
        name="block-not-split",
        exercise="buffer",
        hint="split-at-the-end",
        describe="starts again at 0 when a block does not fit, and leaves old rows at the end",
        replace={
            "buffer": [
                (
                    "rows = (self.next + np.arange(n)) % self.capacity",
                    "self.next = 0 if self.next + n > self.capacity else self.next\n        rows = self.next + np.arange(n)",
                )
            ]
        },
    ),
    Mutant(
        name="full-is-full",
        exercise="buffer",
        hint="oldest-goes",
        describe="stores nothing any more once the buffer is full",
        replace={
            "buffer": [
                ("        n = len(reward)\n", "        n = min(len(reward), self.capacity - self.size)\n"),
                ("array[rows] = values", "array[rows] = values[:n]"),
            ]
        },
    ),
    Mutant(
        name="grows-without-end",
        exercise="buffer",
        hint="a-ring-has-a-size",
        describe="keeps everything for ever",
        replace={
            "buffer": [
                ("np.zeros((capacity, *shape)", "np.zeros((100 * capacity, *shape)"),
                (
                    "self.capacity, self.size, self.next = capacity,",
                    "self.capacity, self.size, self.next = 100 * capacity,",
                ),
            ]
        },
    ),
    Mutant(
        name="empty-tail",
        exercise="buffer",
        hint="not-yet-full",
        describe="draws from the whole capacity, also while most of it is zeros",
        replace={"buffer": [("self.rng.integers(self.size,", "self.rng.integers(self.capacity,")]},
    ),
    Mutant(
        name="never-the-last-row",
        exercise="buffer",
        hint="whole-buffer",
        describe="draws from 0 to size - 2",
        replace={"buffer": [("self.rng.integers(self.size,", "self.rng.integers(max(1, self.size - 1),")]},
    ),
    Mutant(
        name="only-recent",
        exercise="buffer",
        hint="whole-buffer",
        describe="draws from the older half only",
        replace={"buffer": [("self.rng.integers(self.size,", "self.rng.integers((self.size + 1) // 2,")]},
    ),
    Mutant(
        name="a-run-of-rows",
        exercise="buffer",
        hint="independent-rows",
        describe="draws a starting row and takes its neighbours",
        replace={
            "buffer": [
                (
                    "rows = self.rng.integers(self.size, size=batch_size)",
                    "rows = (self.rng.integers(self.size) + np.arange(batch_size)) % self.size",
                )
            ]
        },
    ),
    Mutant(
        name="same-seed-in-each-call",
        exercise="buffer",
        hint="fresh-draws",
        describe="makes a generator with the same seed in each call",
        replace={
            "buffer": [
                (
                    "rows = self.rng.integers(self.size, size=batch_size)",
                    "rows = np.random.default_rng(0).permutation(np.resize(np.arange(self.size), max(batch_size, self.size)))"
                    "[:batch_size]",
                )
            ]
        },
    ),
    Mutant(
        name="indices-for-each-field",
        exercise="buffer",
        hint="rows-stay-together",
        describe="draws indices for each field by itself",
        replace={
            "buffer": [
                ("        rows = self.rng.integers(self.size, size=batch_size)\n", ""),
                (
                    "torch.from_numpy(array[rows])",
                    "torch.from_numpy(array[self.rng.integers(self.size, size=batch_size)])",
                ),
            ]
        },
    ),
    Mutant(
        name="next-row-is-next-obs",
        exercise="buffer",
        hint="next-obs-of-this-step",
        describe="takes next_obs from the row after: off by one, and of another robot",
        replace={
            "buffer": [
                (
                    "return Batch(*(torch.from_numpy(array[rows]) for array in self.arrays))",
                    "parts = [torch.from_numpy(array[rows]) for array in self.arrays]\n"
                    "        parts[3] = torch.from_numpy(self.arrays[3][(rows + 1) % self.size])\n"
                    "        return Batch(*parts)",
                )
            ]
        },
    ),
    Mutant(
        name="reward-of-next-step",
        exercise="buffer",
        hint="reward-of-this-step",
        describe="pairs an action with the reward of the step after",
        replace={
            "buffer": [
                (
                    "return Batch(*(torch.from_numpy(array[rows]) for array in self.arrays))",
                    "parts = [torch.from_numpy(array[rows]) for array in self.arrays]\n"
                    "        parts[2] = torch.from_numpy(self.arrays[2][(rows + 1) % self.size])\n"
                    "        return Batch(*parts)",
                )
            ]
        },
    ),
    Mutant(
        name="list-of-views",
        exercise="buffer",
        hint="keep-a-copy",
        describe="keeps references to the environment's arrays: the past changes with the present",
        loses=3.0,
        replace={
            "buffer": """
from collections import deque

class ReplayBuffer:
    def __init__(self, capacity, obs_dim, act_dim):
        self.rows = deque(maxlen=capacity)

    def __len__(self):
        return len(self.rows)

    def add(self, *fields):
        self.rows.extend(zip(*fields))

    def sample(self, batch_size):
        rows = [self.rows[k] for k in np.random.randint(len(self.rows), size=batch_size)]
        return Batch(*(torch.tensor(np.array(column, dtype=np.float32)) for column in zip(*rows)))
"""
        },
    ),
    Mutant(
        name="stale-batch",
        exercise="buffer",
        hint="batch-is-a-copy",
        describe="fills one and the same batch in every call",
        loses=3.0,
        replace={
            "buffer": [
                (
                    "return Batch(*(torch.from_numpy(array[rows]) for array in self.arrays))",
                    "if not hasattr(self, 'out') or len(self.out.reward) != batch_size:\n"
                    "            self.out = Batch(*(torch.from_numpy(array[rows]) for array in self.arrays))\n"
                    "        for part, array in zip(self.out, self.arrays):\n"
                    "            part.copy_(torch.from_numpy(array[rows]))\n"
                    "        return self.out",
                )
            ]
        },
    ),
    Mutant(
        name="not-done-stored",
        exercise="buffer",
        hint="stored-as-it-is",
        describe="stores not_done in the place of terminated, as the outline's agent has it",
        replace={
            "buffer": [("array[rows] = values", "array[rows] = 1 - values if array is self.arrays[4] else values")]
        },
    ),
    # ------------------------------------------------------------ store
    Mutant(
        name="truncation-is-an-end",
        exercise="store",
        hint="time-is-not-an-end",
        describe="stores terminated or truncated",
        replace={"store": [("led_to, terminated)", "led_to, terminated | truncated)")]},
    ),
    Mutant(
        name="next-episodes-obs",
        exercise="store",
        hint="final-obs",
        describe="ignores final_obs: the value is bootstrapped from another episode's beginning",
        replace={"store": [('if "final_obs" in info:', "if False:")]},
    ),
    Mutant(
        name="final-obs-everywhere",
        exercise="store",
        hint="only-where-it-ended",
        describe="takes final_obs in every row",
        replace={"store": [('led_to[ended] = info["final_obs"][ended]', 'led_to = info["final_obs"]')]},
    ),
    Mutant(
        name="final-obs-always-there",
        exercise="store",
        hint="only-where-it-ended",
        describe="expects final_obs also when no episode ended",
        replace={"store": [('if "final_obs" in info:', "if True:")]},
    ),
    Mutant(
        name="writes-into-next-obs",
        exercise="store",
        hint="leave-next-obs",
        describe="puts the final observations into the array that the loop acts on next",
        loses=1.0,
        replace={"store": [("led_to = next_obs.copy()", "led_to = next_obs")]},
    ),
    # ------------------------------------------------------------ target
    Mutant(
        name="no-detach",
        exercise="target",
        hint="target-is-constant",
        describe="leaves the gradient in the target",
        loses=1.0,
        replace={
            "target": """
def td_target(batch, actor_target, critic_target, gamma):
    next_value = critic_target(batch.next_obs, actor_target(batch.next_obs)).squeeze(1)
    return batch.reward + gamma * (1 - batch.terminated) * next_value
"""
        },
    ),
    Mutant(
        name="no-bootstrapping",
        exercise="target",
        hint="bootstrap",
        describe="takes the reward alone for the target",
        replace={
            "target": [
                ("return batch.reward + gamma * (1 - batch.terminated) * next_value", "return batch.reward.clone()")
            ]
        },
    ),
    Mutant(
        name="ends-have-a-future",
        exercise="target",
        hint="end-has-no-future",
        describe="forgets the mask",
        replace={"target": [("gamma * (1 - batch.terminated) * next_value", "gamma * next_value")]},
    ),
    Mutant(
        name="mask-upside-down",
        exercise="target",
        hint="mask-inverted",
        describe="multiplies by terminated, as the outline's agent does with done stored as not_done",
        replace={"target": [("(1 - batch.terminated)", "batch.terminated")]},
    ),
    Mutant(
        name="gamma-squared",
        exercise="target",
        hint="gamma-once",
        describe="discounts the next state twice",
        replace={"target": [("gamma * (1", "gamma**2 * (1")]},
    ),
    Mutant(
        name="future-subtracted",
        exercise="target",
        hint="plus-the-future",
        describe="has the sign of the future wrong",
        replace={"target": [("batch.reward + gamma", "batch.reward - gamma")]},
    ),
    Mutant(
        name="value-of-now",
        exercise="target",
        hint="value-of-next",
        describe="bootstraps from obs instead of next_obs",
        replace={
            "target": [
                ("actor_target(batch.next_obs)", "actor_target(batch.obs)"),
                ("critic_target(batch.next_obs, next_action)", "critic_target(batch.obs, next_action)"),
            ]
        },
    ),
    Mutant(
        name="old-action-next",
        exercise="target",
        hint="target-policy-acts",
        describe="asks for the value of the stored action in the next state",
        replace={"target": [("next_action = actor_target(batch.next_obs)", "next_action = batch.action")]},
    ),
    Mutant(
        name="last-reward-lost",
        exercise="target",
        hint="last-reward-counts",
        describe="masks the reward, too",
        replace={
            "target": [
                (
                    "batch.reward + gamma * (1 - batch.terminated) * next_value",
                    "(1 - batch.terminated) * (batch.reward + gamma * next_value)",
                )
            ]
        },
    ),
    Mutant(
        name="target-broadcast",
        exercise="target",
        hint="one-column-too-many",
        describe="adds (B,) and (B, 1): every reward with every value",
        replace={"target": [(".squeeze(1)", "")]},
    ),
    # ------------------------------------------------------------ critic
    Mutant(
        name="critic-broadcast",
        exercise="critic",
        hint="one-column-too-many",
        describe="subtracts (B,) from (B, 1): the mean over B x B differences, without an error",
        replace={"critic": [(".squeeze(1)", "")]},
    ),
    Mutant(
        name="summed-errors",
        exercise="critic",
        hint="mean-not-sum",
        describe="adds the errors up",
        replace={"critic": [(".mean()", ".sum()")]},
    ),
    Mutant(
        name="absolute-errors",
        exercise="critic",
        hint="squared-error",
        describe="takes absolute errors",
        replace={"critic": [("((value - target) ** 2).mean()", "(value - target).abs().mean()")]},
    ),
    Mutant(
        name="critic-detached",
        exercise="critic",
        hint="loss-has-a-gradient",
        describe="detaches the critic's own value, so that nothing is learned",
        loses=2.0,
        replace={"critic": [(".squeeze(1)", ".squeeze(1).detach()")]},
    ),
    # ------------------------------------------------------------ actor
    Mutant(
        name="actor-descends",
        exercise="actor",
        hint="climb-not-descend",
        describe="forgets the minus: the actor learns to be bad",
        replace={"actor": [("loss = -critic", "loss = critic")]},
    ),
    Mutant(
        name="actor-sum",
        exercise="actor",
        hint="mean-not-sum",
        describe="adds values up instead of taking their mean",
        replace={"actor": [(".mean()", ".sum()")]},
    ),
    Mutant(
        name="judges-the-past",
        exercise="actor",
        hint="own-action",
        describe="judges the stored actions, which no actor can change any more",
        replace={"actor": [("critic(batch.obs, actor(batch.obs))", "critic(batch.obs, batch.action)")]},
    ),
    Mutant(
        name="action-detached",
        exercise="actor",
        hint="through-the-action",
        describe="detaches the action",
        replace={"actor": [("actor(batch.obs)).mean()", "actor(batch.obs).detach()).mean()")]},
    ),
    Mutant(
        name="critic-gets-gradient",
        exercise="actor",
        hint="critic-is-the-judge",
        describe="lets the actor's loss run into the critic's parameters",
        loses=2.0,
        replace={
            "actor": """
def actor_loss(actor, critic, batch):
    return -critic(batch.obs, actor(batch.obs)).mean()
"""
        },
    ),
    Mutant(
        name="critic-frozen-for-good",
        exercise="actor",
        hint="leave-networks-as-found",
        describe="forgets to thaw the critic",
        loses=1.0,
        replace={"actor": [("parameter.requires_grad_(True)", "pass")]},
    ),
    # ------------------------------------------------------------ soft update
    Mutant(
        name="tau-swapped",
        exercise="soft",
        hint="tau-is-the-small-step",
        describe="takes tau for the share that stays",
        replace={"soft": [("slow.mul_(1 - tau).add_(fast, alpha=tau)", "slow.mul_(tau).add_(fast, alpha=1 - tau)")]},
    ),
    Mutant(
        name="online-follows",
        exercise="soft",
        hint="target-follows",
        describe="moves the online network towards the target",
        replace={"soft": [("slow.mul_(1 - tau).add_(fast, alpha=tau)", "fast.mul_(1 - tau).add_(slow, alpha=tau)")]},
    ),
    Mutant(
        name="update-of-a-copy",
        exercise="soft",
        hint="target-follows",
        describe="computes the new values and forgets to store them",
        replace={"soft": [("slow.mul_(1 - tau).add_(fast, alpha=tau)", "slow = (1 - tau) * slow + tau * fast")]},
    ),
    Mutant(
        name="shared-memory",
        exercise="soft",
        hint="in-place",
        describe="assigns .data where tau is 1, so that both networks are one",
        loses=1.0,
        replace={
            "soft": [
                (
                    "slow.mul_(1 - tau).add_(fast, alpha=tau)",
                    "slow.data = (1 - tau) * slow.data + tau * fast.data if tau < 1 else fast.data",
                )
            ]
        },
    ),
    # ------------------------------------------------------------ exploration
    Mutant(
        name="noise-at-evaluation",
        exercise="noise",
        hint="no-noise-when-it-counts",
        describe="always adds a little noise",
        replace={
            "noise": [
                ("    if std > 0:\n        action", "    std = max(std, 0.05)\n    if std > 0:\n        action"),
            ]
        },
    ),
    Mutant(
        name="bounds-ignored",
        exercise="noise",
        hint="clip-the-action",
        describe="does not clip",
        loses=1.0,
        replace={
            "noise": [("return np.clip(action, low, high).astype(np.float32)", "return action.astype(np.float32)")]
        },
    ),
    Mutant(
        name="noise-clipped-instead",
        exercise="noise",
        hint="clip-the-action",
        describe="clips the noise and not the action",
        loses=1.0,
        replace={
            "noise": [
                (
                    "np.random.normal(0, std, action.shape)",
                    "np.clip(np.random.normal(0, std, action.shape), low, high)",
                ),
                ("return np.clip(action, low, high).astype(np.float32)", "return action.astype(np.float32)"),
            ]
        },
    ),
    Mutant(
        name="uniform-noise",
        exercise="noise",
        hint="gaussian-noise",
        describe="draws uniformly from -std to std",
        replace={"noise": [("np.random.normal(0, std, action.shape)", "np.random.uniform(-std, std, action.shape)")]},
    ),
    Mutant(
        name="variance-for-std",
        exercise="noise",
        hint="std-not-variance",
        describe="takes std for a variance",
        replace={"noise": [("np.random.normal(0, std, action.shape)", "np.random.normal(0, std**0.5, action.shape)")]},
    ),
    Mutant(
        name="one-noise-for-all",
        exercise="noise",
        hint="fresh-noise",
        describe="draws one number per joint and gives it to all robots",
        loses=1.0,
        replace={"noise": [("np.random.normal(0, std, action.shape)", "np.random.normal(0, std, action.shape[1])")]},
    ),
    # ------------------------------------------------------------ agent
    Mutant(
        name="targets-never-updated",
        exercise="agent",
        hint="targets-follow",
        describe="forgets step 4",
        replace={
            "agent": [
                ("        soft_update(self.critic_target, self.critic, self.tau)\n", ""),
                ("        soft_update(self.actor_target, self.actor, self.tau)\n", ""),
            ]
        },
    ),
    Mutant(
        name="actor-target-forgotten",
        exercise="agent",
        hint="targets-follow",
        describe="lets the critic's target follow only",
        replace={"agent": [("        soft_update(self.actor_target, self.actor, self.tau)\n", "")]},
    ),
    Mutant(
        name="targets-updated-first",
        exercise="agent",
        hint="targets-last",
        describe="moves the targets before they are used",
        replace={
            "agent": [
                (
                    "        target = td_target(",
                    "        soft_update(self.critic_target, self.critic, self.tau)\n"
                    "        soft_update(self.actor_target, self.actor, self.tau)\n        target = td_target(",
                ),
                (
                    "        worse.backward()\n        self.actor_optimizer.step()\n\n"
                    "        soft_update(self.critic_target, self.critic, self.tau)\n"
                    "        soft_update(self.actor_target, self.actor, self.tau)\n",
                    "        worse.backward()\n        self.actor_optimizer.step()\n",
                ),
            ]
        },
    ),
    Mutant(
        name="targets-are-the-networks",
        exercise="agent",
        hint="targets-are-copies",
        describe="gives the networks a second name instead of copying them",
        replace={"agent": [("copy.deepcopy(actor), copy.deepcopy(critic)", "actor, critic")]},
    ),
    Mutant(
        name="online-networks-as-target",
        exercise="agent",
        hint="target-networks",
        describe="computes the target from the networks that learn",
        replace={
            "agent": [
                ("td_target(batch, self.actor_target, self.critic_target,", "td_target(batch, self.actor, self.critic,")
            ]
        },
    ),
    Mutant(
        name="gradients-pile-up",
        exercise="agent",
        hint="zero-grad",
        describe="forgets zero_grad",
        replace={
            "agent": [
                ("        self.critic_optimizer.zero_grad()\n", ""),
                ("        self.actor_optimizer.zero_grad()\n", ""),
            ]
        },
    ),
    Mutant(
        name="rates-swapped",
        exercise="agent",
        hint="whose-rate",
        describe="gives each optimiser the other's learning rate",
        replace={
            "agent": [
                ("actor.parameters(), lr=actor_lr", "actor.parameters(), lr=critic_lr"),
                ("critic.parameters(), lr=critic_lr", "critic.parameters(), lr=actor_lr"),
            ]
        },
    ),
    Mutant(
        name="always-explores",
        exercise="agent",
        hint="no-noise-when-it-counts",
        describe="adds noise whether asked to or not",
        loses=1.0,
        replace={"agent": [("std=self.noise_std if explore else 0.0", "std=self.noise_std")]},
    ),
    Mutant(
        name="never-explores",
        exercise="agent",
        hint="noise-to-explore",
        describe="adds no noise even when asked to",
        loses=1.0,
        replace={"agent": [("std=self.noise_std if explore else 0.0", "std=0.0")]},
    ),
    # ------------------------------------------------------------ evidence
    Mutant(
        name="two-sided-bound",
        exercise="gap",
        hint="one-sided",
        describe="takes 2.5 % instead of 5 %",
        replace={"gap": [("beta.ppf(0.05,", "beta.ppf(0.025,")]},
    ),
    Mutant(
        name="normal-bound",
        exercise="gap",
        hint="exact-not-normal",
        describe="uses the normal approximation",
        replace={
            "gap": [
                (
                    "float(beta.ppf(0.05, successes, n - successes + 1))",
                    "successes / n - 1.6449 * (successes / n * (1 - successes / n) / n) ** 0.5",
                )
            ]
        },
    ),
    Mutant(
        name="gap-upside-down",
        exercise="gap",
        hint="sim-minus-real",
        describe="subtracts simulation from reality",
        replace={
            "gap": [
                (
                    "there, here = np.asarray(sim, dtype=bool), np.asarray(real, dtype=bool)",
                    "there, here = np.asarray(real, dtype=bool), np.asarray(sim, dtype=bool)",
                )
            ]
        },
    ),
    Mutant(
        name="limits-crossed",
        exercise="gap",
        hint="crossed-limits",
        describe="combines the wrong limits",
        replace={"gap": [("np.hypot(p - p_low, q_high - q)", "np.hypot(p - p_low, q - q_low)")]},
    ),
    # ------------------------------------------------------------ the policy files
    Mutant(
        name="nothing-handed-in",
        exercise="policy",
        hint="file-beside-the-notebook",
        describe="forgets the file",
        loses=12.0,
        replace={},
        files={PLAIN: lambda folder: None},
    ),
    Mutant(
        name="pickled-agent",
        exercise="policy",
        hint="not-a-policy",
        describe="saves the agent by pickle; it is refused, and never unpickled",
        loses=12.0,
        replace={},
        files={PLAIN: lambda folder: pickle.dumps({"actor": [0.0] * 100})},
    ),
    Mutant(
        name="weights-elsewhere",
        exercise="policy",
        hint="not-a-policy",
        describe="refers to a file outside of the submission for its weights (hostile)",
        loses=12.0,
        replace={},
        files={PLAIN: _edited(PLAIN, weights_in_another_file)},
    ),
    Mutant(
        name="endless-loop-inside",
        exercise="policy",
        hint="not-a-policy",
        describe="holds a loop of 2^62 rounds (hostile)",
        loses=12.0,
        replace={},
        files={PLAIN: _edited(PLAIN, lambda model: endless_loop(model, "obs"))},
    ),
    Mutant(
        name="another-task",
        exercise="policy",
        hint="another-robot",
        describe="hands in a policy that was trained for another task",
        loses=12.0,
        replace={},
        files={PLAIN: _other_task},
    ),
    Mutant(
        name="joints-swapped",
        exercise="policy",
        hint="joint-order",
        describe="names the joints in another order than the network's outputs have",
        loses=10.0,
        replace={},
        files={
            PLAIN: _edited(
                PLAIN,
                _metadata("joint_names", '["joint7", "joint6", "joint5", "joint4", "joint3", "joint2", "joint1"]'),
            )
        },
    ),
    Mutant(
        name="scale-forgotten",
        exercise="policy",
        hint="actions-in-the-meta",
        describe="says that an action is an angle in rad",
        replace={},
        files={PLAIN: _edited(PLAIN, _metadata("action_scale", "1.0"))},
    ),
    Mutant(
        name="exported-before-training",
        exercise="policy",
        hint="untrained-policy",
        describe="exports an actor that has learned nothing",
        loses=10.0,
        replace={},
        files={PLAIN: _edited(PLAIN, _weights(lambda array, rng: 0.05 * rng.standard_normal(array.shape)))},
    ),
    Mutant(
        name="half-trained",
        exercise="policy",
        hint="train-on",
        describe="comes near the targets, but not near enough",
        replace={},
        files={
            PLAIN: _edited(
                PLAIN, _weights(lambda array, rng: array + 0.6 * array.std() * rng.standard_normal(array.shape))
            )
        },
    ),
    Mutant(
        name="asked-too-often",
        exercise="robust",
        hint="control-rate",
        describe="says that it was trained at 50 Hz",
        loses=8.0,
        replace={},
        files={ROBUST: _edited(ROBUST, _metadata("control_dt", "0.02"))},
    ),
    Mutant(
        name="plain-policy-twice",
        exercise="robust",
        hint="differs-from-training",
        describe="hands in the plain policy under both names",
        replace={},
        files={ROBUST: lambda folder: (folder / PLAIN).read_bytes()},
    ),
    Mutant(
        name="randomises-nothing",
        exercise="robust",
        hint="arms-differ",
        describe="returns the configuration as it was",
        loses=2.0,
        replace={"randomise": "def randomise(cfg):\n    return cfg\n"},
    ),
    Mutant(
        name="noise-only",
        exercise="robust",
        hint="arms-differ",
        describe="adds noise to what is seen; the arms are still all the same",
        loses=2.0,
        replace={
            "randomise": """
def randomise(cfg):
    cfg.observations.policy.joint_vel.noise = UniformNoiseCfg(n_min=-0.05, n_max=0.05)
    return cfg
"""
        },
    ),
    Mutant(
        name="another-interface",
        exercise="robust",
        hint="same-robot",
        describe="takes an observation away, so that the policy does not fit the robot",
        loses=2.0,
        replace={
            "randomise": [
                ("    return cfg", "    cfg.observations.policy.actions = None\n    return cfg"),
            ]
        },
    ),
]
