"""rsl-rl's ``OnPolicyRunner`` on this kit's environments: the learner that Isaac Lab uses, with the same settings.

The names and settings of rsl-rl change with almost every version, so one is asked for (:data:`VERSIONS`); it is an
optional part of the kit (``pip install "robotbrain[rl]"``). Logs, checkpoints and exact resumption are those of
:mod:`robotbrain.rl.ppo_train`; besides, the last model is stored as rsl-rl stores it (``model.pt``), for Isaac Lab.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.metadata
import io
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from robotbrain.errors import InputError, MissingDependencyError
from robotbrain.files import atomic_path
from robotbrain.rl.checkpoint import save_checkpoint
from robotbrain.rl.logs import RunLog
from robotbrain.rl.ppo import Network
from robotbrain.rl.ppo_cfg import RslRlMLPModelCfg, RslRlOnPolicyRunnerCfg
from robotbrain.rl.ppo_env import PpoEnv, ppo_env
from robotbrain.rl.ppo_train import (
    CHECKPOINT_FILE,
    EpisodeFigures,
    PpoResult,
    PpoState,
    check_same,
    check_samples,
    group_size,
    saved_training,
    threads,
    training_loop,
)

KIND = "rsl-rl"
MODEL_FILE = "model.pt"
VERSIONS = ("5.5.",)
"""Beginnings of the versions of rsl-rl-lib that this module is written for."""


def require_rsl_rl() -> ModuleType:
    """Return the module ``rsl_rl.runners``.

    Raises:
        MissingDependencyError: when it is missing, or of another version.
    """
    # It imports GitPython, which refuses to be imported where the program git is missing, unless told to be quiet.
    os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")
    needed_for, install = "training with rsl-rl", 'pip install "robotbrain[rl]"'
    try:
        version = importlib.metadata.version("rsl-rl-lib")
        package = importlib.import_module("rsl_rl.runners")
    except ImportError as error:  # PackageNotFoundError too
        raise MissingDependencyError("rsl-rl-lib", needed_for=needed_for, install=install) from error
    if not version.startswith(VERSIONS):
        raise MissingDependencyError(
            f"rsl-rl-lib {' or '.join(f'{v}x' for v in VERSIONS)} (there is {version})",
            needed_for=needed_for,
            install=install,
        )
    return package


class RslRlVecEnv:
    """Environments as rsl-rl steps them (its abstract class ``VecEnv``): observations are TensorDicts.

    Args:
        env: what :func:`robotbrain.rl.ppo_env.ppo_env` takes.
        seed: of the first reset; rsl-rl does not reset by itself.
        clip_actions: actions are clamped to this magnitude.

    Attributes:
        rewards, dones, logs: of the steps since :meth:`taken`.
    """

    def __init__(self, env: Any, *, seed: int, clip_actions: float | None = None) -> None:
        self.stepper: PpoEnv = ppo_env(env, clip_actions)
        self.unwrapped = self.stepper.unwrapped
        self.cfg: Any = getattr(self.unwrapped, "cfg", {})
        self.num_envs, self.num_actions = self.stepper.num_envs, self.stepper.num_actions
        self.max_episode_length = int(getattr(self.unwrapped, "max_episode_length", 0) or 0)
        self.device = "cpu"
        self._clock = torch.zeros(self.num_envs, dtype=torch.long)
        self.obs = self.stepper.reset(seed)
        self.rewards: list[Tensor] = []
        self.dones: list[Tensor] = []
        self.logs: list[Mapping[str, float]] = []

    @property
    def episode_length_buf(self) -> Tensor:
        """Control steps since each environment's reset, (N,) int64."""
        found: Tensor = getattr(self.unwrapped, "episode_length_buf", self._clock)
        return found

    @episode_length_buf.setter
    def episode_length_buf(self, value: Tensor) -> None:
        self.episode_length_buf.copy_(value)

    def get_observations(self) -> Any:
        """Return what the environments show."""
        from tensordict import TensorDict

        return TensorDict(dict(self.obs), batch_size=[self.num_envs])

    def step(self, actions: Tensor) -> tuple[Any, Tensor, Tensor, dict[str, Any]]:
        """Take a control step; return observations, rewards (N,), dones (N,) int64, and time-outs among the extras."""
        # rsl-rl collects in inference mode; tensors made there could never again be written to in place.
        with torch.inference_mode(False), torch.no_grad():
            step = self.stepper.step(actions.clone())
            self.obs = step.obs
            self._clock = (self._clock + 1) * (~step.done)
            self.rewards.append(step.reward.clone())
            self.dones.append(step.done.clone())
            self.logs += [step.log] if step.log else []
            return self.get_observations(), step.reward, step.done.long(), {"time_outs": step.truncated}

    def taken(self) -> tuple[Tensor, Tensor, list[Mapping[str, float]]]:
        """Return rewards and dones (T, N) and logs of the steps since the last call."""
        found = torch.stack(self.rewards), torch.stack(self.dones), self.logs
        self.rewards, self.dones, self.logs = [], [], []
        return found


def runner_dict(cfg: RslRlOnPolicyRunnerCfg) -> dict[str, Any]:
    """Return ``cfg`` as rsl-rl's runner takes it; a symmetry function gets and returns TensorDicts there."""
    cfg.validate()
    plain = cfg.to_dict()
    symmetry = cfg.algorithm.symmetry_cfg
    if symmetry is not None:
        plain["algorithm"]["symmetry_cfg"]["data_augmentation_func"] = _with_tensordicts(
            symmetry.data_augmentation_func
        )
    return plain


def make_runner(env: RslRlVecEnv, cfg: RslRlOnPolicyRunnerCfg) -> Any:
    """Return rsl-rl's ``OnPolicyRunner``, without logs of its own.

    Raises:
        MissingDependencyError: see :func:`require_rsl_rl`.
        InputError: for settings that rsl-rl refuses.
    """
    runners = require_rsl_rl()
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # it prints its networks
            return runners.OnPolicyRunner(env, runner_dict(cfg), log_dir=None, device="cpu")
    except (TypeError, ValueError, KeyError, AttributeError) as error:
        raise InputError(
            "settings of the runner",
            given=cfg.experiment_name,
            expected="what rsl-rl takes",
            fix=f"rsl-rl says: {error}",
        ) from error


def train_rsl_rl(
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
    """Train a policy with rsl-rl; arguments and errors as of :func:`robotbrain.rl.ppo_train.train_ppo`.

    Returns:
        The result; its ``agent`` is rsl-rl's runner, :func:`actor_of` makes a plain network of its actor.

    Raises:
        MissingDependencyError: see :func:`require_rsl_rl`.
    """
    require_rsl_rl()
    path = None if run_dir is None else Path(run_dir) / CHECKPOINT_FILE
    saved = saved_training(path, resume, KIND)
    # rsl-rl draws from torch's global generator: here it has one of its own.
    with threads(torch_threads), torch.random.fork_rng(devices=[]):
        torch.manual_seed(cfg.seed)
        vec = RslRlVecEnv(env, seed=cfg.seed + (saved["iteration"] if saved else 0), clip_actions=cfg.clip_actions)
        runner = make_runner(vec, cfg)
        check_samples(vec.num_envs, cfg)
        shape = {
            "num_envs": vec.num_envs,
            "obs_sizes": {name: group_size(name, x) for name, x in vec.obs.items()},
            "num_actions": vec.num_actions,
            "cfg": cfg.to_dict(),
        }
        episodes = EpisodeFigures(vec.num_envs)
        iteration = steps = 0
        if saved is not None:
            check_same(saved, shape)
            runner.alg.load(saved["agent"], None, True)
            iteration, steps = saved["iteration"], saved["steps"]
            torch.set_rng_state(saved["rng"])
            if saved["env"] is not None:
                vec.stepper.load_state_dict(saved["env"])
                vec.obs = saved["obs"]
                episodes.load_state_dict(saved["episodes"])
        elif cfg.init_at_random_ep_len:
            vec.stepper.stagger(torch.default_generator)

        log = RunLog(run_dir, resume_step=None if saved is None else steps, tensorboard=tensorboard)
        log.settings({"algorithm": KIND, **(settings or {}), "cfg": cfg.to_dict(), "num_envs": vec.num_envs})
        losses: dict[str, float] = {}
        update = runner.alg.update
        runner.alg.update = lambda: losses.update(update()) or losses  # the runner keeps its figures to itself

        def iterate() -> dict[str, float]:
            with contextlib.redirect_stdout(io.StringIO()):
                runner.learn(1)
            std = runner.alg.get_policy().distribution.std.mean().item()
            policy = {"policy/std": std, "policy/learning_rate": runner.alg.learning_rate}
            return {f"loss/{name}": value for name, value in losses.items()} | policy | episodes.add(*vec.taken())

        def save(iteration: int, steps: int) -> None:
            if path is None:
                return
            state = {
                "agent": runner.alg.save(),
                "rng": torch.get_rng_state(),
                "env": vec.stepper.state_dict(),
                "obs": vec.obs,
                "episodes": episodes.state_dict(),
                "iteration": iteration,
                "steps": steps,
                **shape,
            }
            save_checkpoint(path, state, kind=KIND)
            runner.current_learning_iteration = iteration
            with atomic_path(path.with_name(MODEL_FILE)) as temporary:
                runner.save(str(temporary))

        return training_loop(
            iterate,
            save,
            agent=runner,
            log=log,
            iteration=iteration,
            total=cfg.max_iterations if iterations is None else iterations,
            steps_per_iteration=vec.num_envs * cfg.num_steps_per_env,
            save_interval=cfg.save_interval,
            minutes=minutes,
            callback=callback,
            progress=progress,
        )


def actor_of(runner: Any, cfg: RslRlMLPModelCfg) -> Network:
    """Return the actor of rsl-rl's runner as a plain network: (n, O) raw observations in, (n, A) actions out."""
    return network_from_rsl_rl(runner.alg.save()["actor_state_dict"], cfg)


def load_rsl_rl_actor(path: str | Path, cfg: RslRlMLPModelCfg) -> Network:
    """Return the actor of a file that rsl-rl saved (``model_*.pt``), here or in Isaac Lab. rsl-rl is not needed.

    Args:
        path: of the file; only tensors and plain values are read from it.
        cfg: ``actor`` of the configuration that it was trained with.

    Raises:
        InputError: for a file that is missing or not of rsl-rl, and for a network that does not fit ``cfg``.
    """
    source = Path(path)
    if not source.is_file():
        raise InputError("model", given=str(path), expected="an existing file", fix="rsl-rl writes model_*.pt.")
    try:
        content = torch.load(source, map_location="cpu", weights_only=True)
        state = content["actor_state_dict"]
    except Exception as error:  # whatever a foreign file makes of the reader
        raise InputError(
            "model", given=str(path), expected="a file saved by rsl-rl 5", fix=f"It cannot be read: {error}"
        ) from error
    return network_from_rsl_rl(state, cfg)


def network_from_rsl_rl(state: Mapping[str, Tensor], cfg: RslRlMLPModelCfg) -> Network:
    """Return the plain network with the weights of rsl-rl's ``MLPModel``.

    Raises:
        InputError: for a network that does not fit ``cfg``.
    """
    layers = sorted((int(name.split(".")[1]), x.shape) for name, x in state.items() if _is_weight(name))
    hidden = [int(shape[0]) for _, shape in layers[:-1]]
    if not layers or hidden != list(cfg.hidden_dims):
        raise InputError(
            "layers of rsl-rl's model",
            given=hidden,
            expected=f"hidden layers of {list(cfg.hidden_dims)} units",
            fix="Give the configuration that it was trained with.",
        )
    network = Network({"policy": int(layers[0][1][1])}, int(layers[-1][1][0]), cfg)
    names = {"distribution.std_param": "std_param", "distribution.log_std_param": "std_param"}
    renamed = {}
    for name, value in state.items():
        if name.startswith("obs_normalizer."):
            if name != "obs_normalizer._std":  # the root of the variance
                renamed["normalizer." + name.removeprefix("obs_normalizer.").lstrip("_")] = value.squeeze(0)
        else:
            renamed[names.get(name, name)] = value
    try:
        network.load_state_dict(renamed)
    except RuntimeError as error:
        raise InputError(
            "rsl-rl's model", given=sorted(state), expected="what the configuration describes", fix=str(error)
        ) from error
    return network.eval()


def _is_weight(name: str) -> bool:
    return name.startswith("mlp.") and name.endswith(".weight")


def _with_tensordicts(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a symmetry function for rsl-rl, which hands over its adapter and TensorDicts."""

    def call(env: RslRlVecEnv, obs: Any, actions: Tensor | None) -> tuple[Any, Tensor | None]:
        from tensordict import TensorDict

        groups = None if obs is None else dict(obs.items())
        more_obs, more_actions = function(env=env.unwrapped, obs=groups, actions=actions)
        if more_obs is None:
            return None, more_actions
        return TensorDict(dict(more_obs), batch_size=[len(next(iter(more_obs.values())))]), more_actions

    return call
