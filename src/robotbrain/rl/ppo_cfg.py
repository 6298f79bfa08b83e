"""Configuration of PPO, with the field names and defaults of Isaac Lab 3.0's ``isaaclab_rl.rsl_rl``.

A configuration written here trains with this kit's :mod:`robotbrain.rl.ppo`, with rsl-rl through
:mod:`robotbrain.rl.rsl_rl_runner`, and, exported, in Isaac Lab. Isaac Lab's deprecated fields are left out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal

from robotbrain.errors import InputError
from robotbrain.rl.configclass import MISSING, Config, configclass, did_you_mean

OPTIMIZERS = {"adam": "Adam", "adamw": "AdamW", "sgd": "SGD", "rmsprop": "RMSprop"}
"""Names of optimizers in a configuration, and in ``torch.optim``."""


@configclass
class RslRlMLPModelCfg(Config):
    """A multi-layer perceptron: the actor (with a distribution) or the critic (without).

    Attributes:
        class_name: of the model in rsl-rl.
        hidden_dims: units of each hidden layer.
        activation: between the layers: elu, selu, relu, crelu (which is CELU there), lrelu, tanh, sigmoid, softplus,
            gelu, swish, mish or identity.
        obs_normalization: subtract a running mean from the observations and divide by a running deviation.
        distribution_cfg: of the actions; None for a deterministic output.
    """

    class_name: str = "MLPModel"
    hidden_dims: list[int] = MISSING
    activation: str = MISSING
    obs_normalization: bool = False
    distribution_cfg: DistributionCfg | None = None

    @configclass
    class DistributionCfg(Config):
        """A distribution of actions; ``class_name`` is that in rsl-rl."""

        class_name: str = MISSING

    @configclass
    class GaussianDistributionCfg(DistributionCfg):
        """Independent normal distributions whose deviations do not depend on the observation.

        Attributes:
            class_name: of the distribution in rsl-rl.
            init_std: deviation at the beginning, in units of the action.
            std_type: whether the deviation or its logarithm is learnt.
            std_range: the deviation is clamped to it.
        """

        class_name: str = "GaussianDistribution"
        init_std: float = MISSING
        std_type: Literal["scalar", "log"] = "scalar"
        std_range: tuple[float, float] = (1e-6, 1e6)


@configclass
class RslRlSymmetryCfg(Config):
    """Use of a robot's mirror symmetry (Mittal et al., "Symmetry considerations for learning task symmetric robot
    policies", ICRA 2024).

    Attributes:
        use_data_augmentation: learn from mirrored samples too.
        use_mirror_loss: punish a policy that does not act mirrored where the world is mirrored.
        data_augmentation_func: ``func(env, obs, actions)`` returns both with the mirrored samples below the given ones:
            ``obs`` maps groups to (B, n) tensors and comes back with (2 B, n) or more copies, ``actions`` likewise;
            either may be None and then is None in the result.
        mirror_loss_coeff: weight of the mirror loss.
    """

    use_data_augmentation: bool = False
    use_mirror_loss: bool = False
    data_augmentation_func: Callable[..., tuple[Any, Any]] = MISSING
    mirror_loss_coeff: float = 0.0


@configclass
class RslRlPpoAlgorithmCfg(Config):
    """Proximal policy optimisation.

    Attributes:
        class_name: of the algorithm in rsl-rl.
        num_learning_epochs: passes over the samples of an iteration.
        num_mini_batches: parts of a pass; one gradient step each.
        learning_rate: at the beginning.
        schedule: ``"adaptive"`` keeps the policy's change near ``desired_kl``, ``"fixed"`` does nothing.
        gamma: discount of a step.
        lam: of generalised advantage estimation.
        entropy_coef: weight of the policy's entropy.
        desired_kl: Kullback-Leibler divergence from the policy that collected the samples, nats.
        max_grad_norm: of the actor's and of the critic's gradient, each.
        optimizer: adam, adamw, sgd or rmsprop.
        value_loss_coef: weight of the critic's loss.
        use_clipped_value_loss: keep the critic within ``clip_param`` of its values when collecting.
        clip_param: how far the ratio of new to old probability matters, from 1.
        normalize_advantage_per_mini_batch: over each part instead of over all samples.
        share_cnn_encoders, use_mixed_precision, rnd_cfg: of rsl-rl only.
        symmetry_cfg: None uses no symmetry.
    """

    class_name: str = "PPO"
    num_learning_epochs: int = MISSING
    num_mini_batches: int = MISSING
    learning_rate: float = MISSING
    schedule: str = MISSING
    gamma: float = MISSING
    lam: float = MISSING
    entropy_coef: float = MISSING
    desired_kl: float = MISSING
    max_grad_norm: float = MISSING
    optimizer: Literal["adam", "adamw", "sgd", "rmsprop"] = "adam"
    value_loss_coef: float = MISSING
    use_clipped_value_loss: bool = MISSING
    clip_param: float = MISSING
    normalize_advantage_per_mini_batch: bool = False
    share_cnn_encoders: bool = False
    use_mixed_precision: bool = False
    rnd_cfg: Any = None
    symmetry_cfg: RslRlSymmetryCfg | None = None


@configclass
class RslRlBaseRunnerCfg(Config):
    """What surrounds the algorithm.

    Attributes:
        seed: of networks, actions and order of samples.
        device: where Isaac Lab trains. This kit trains on the CPU, whatever it says.
        num_steps_per_env: control steps of each environment in an iteration.
        init_at_random_ep_len: begin at random times of the episodes, so that they do not all end together.
        max_iterations: iterations of collecting and learning.
        obs_groups: the environment's observation groups that the ``"actor"`` and the ``"critic"`` see.
        clip_actions: actions are clamped to this magnitude before they reach the environment; None leaves them.
        check_for_nan: stop at an observation or reward that is not a number.
        save_interval: iterations between checkpoints.
        experiment_name, run_name: of folders.
        logger, neptune_project, wandb_project, resume, load_run, load_checkpoint: of Isaac Lab's scripts only; the
            kit's have options for that.
    """

    seed: int = 42
    device: str = "cuda:0"
    num_steps_per_env: int = MISSING
    init_at_random_ep_len: bool = True
    max_iterations: int = MISSING
    obs_groups: dict[str, list[str]] = MISSING
    clip_actions: float | None = None
    check_for_nan: bool = True
    save_interval: int = MISSING
    experiment_name: str = MISSING
    run_name: str = ""
    logger: Literal["tensorboard", "neptune", "wandb"] = "tensorboard"
    neptune_project: str = "isaaclab"
    wandb_project: str = "isaaclab"
    resume: bool = False
    load_run: str = ".*"
    load_checkpoint: str = "model_.*.pt"


@configclass
class RslRlOnPolicyRunnerCfg(RslRlBaseRunnerCfg):
    """Everything about a training with PPO.

    Attributes:
        class_name: of the runner in rsl-rl.
        actor, critic: the networks.
        algorithm: PPO's settings.
        torch_compile_mode: of rsl-rl only.
    """

    class_name: str = "OnPolicyRunner"
    actor: RslRlMLPModelCfg = MISSING
    critic: RslRlMLPModelCfg = MISSING
    algorithm: RslRlPpoAlgorithmCfg = MISSING
    torch_compile_mode: Literal["default", "max-autotune-no-cudagraphs"] | None = None


def usual_runner_cfg(
    name: str,
    group: str = "policy",
    *,
    iterations: int = 1000,
    save_interval: int = 50,
    init_std: float = 1.0,
    gamma: float = 0.99,
    entropy_coef: float = 0.005,
) -> RslRlOnPolicyRunnerCfg:
    """Return the settings that many tasks of Isaac Lab begin with.

    Args:
        name: of the experiment.
        group: of observations, which actor and critic see.
        iterations, save_interval: ``max_iterations`` and how often a checkpoint is written.
        init_std: of the exploration, in the action's unit.
        gamma, entropy_coef: of PPO.
    """
    return RslRlOnPolicyRunnerCfg(
        num_steps_per_env=24,
        max_iterations=iterations,
        save_interval=save_interval,
        experiment_name=name,
        obs_groups={"actor": [group], "critic": [group]},
        actor=RslRlMLPModelCfg(
            hidden_dims=[128, 128],
            activation="elu",
            obs_normalization=True,
            distribution_cfg=RslRlMLPModelCfg.GaussianDistributionCfg(init_std=init_std),
        ),
        critic=RslRlMLPModelCfg(hidden_dims=[128, 128], activation="elu", obs_normalization=True),
        algorithm=RslRlPpoAlgorithmCfg(
            num_learning_epochs=5,
            num_mini_batches=4,
            learning_rate=1e-3,
            schedule="adaptive",
            gamma=gamma,
            lam=0.95,
            entropy_coef=entropy_coef,
            desired_kl=0.01,
            max_grad_norm=1.0,
            value_loss_coef=1.0,
            use_clipped_value_loss=True,
            clip_param=0.2,
        ),
    )


def model_cfg(values: Mapping[str, Any]) -> RslRlMLPModelCfg:
    """Return the configuration of a network from what its ``to_dict`` gave."""
    plain = dict(values)
    distribution = plain.pop("distribution_cfg", None)
    if distribution is not None:
        distribution = RslRlMLPModelCfg.GaussianDistributionCfg(**distribution)
    return RslRlMLPModelCfg(**plain, distribution_cfg=distribution)


def check_ppo_cfg(cfg: RslRlOnPolicyRunnerCfg, obs_sizes: Mapping[str, int]) -> None:
    """Check that the kit's PPO can work with ``cfg`` on observation groups of these sizes.

    Raises:
        InputError: for settings that are missing, unknown, or that only rsl-rl knows.
    """
    cfg.validate()
    settings = cfg.algorithm
    for what, given, known in (
        ("algorithm.optimizer", settings.optimizer, list(OPTIMIZERS)),
        ("algorithm.schedule", settings.schedule, ["adaptive", "fixed"]),
        ("algorithm.class_name", settings.class_name, ["PPO"]),
        ("actor.class_name", cfg.actor.class_name, ["MLPModel"]),
        ("critic.class_name", cfg.critic.class_name, ["MLPModel"]),
        ("algorithm.rnd_cfg", settings.rnd_cfg, [None]),
    ):
        if given not in known:
            raise InputError(
                what, given=given, expected=f"one of {known}", fix="More is in robotbrain.rl.rsl_rl_runner (rsl-rl)."
            )
    for role in ("actor", "critic"):
        for name in cfg.obs_groups.get(role, ["(none)"]):
            if name not in obs_sizes:
                raise InputError(
                    f"obs_groups[{role!r}]",
                    given=name,
                    expected="observation groups of the environment",
                    fix=did_you_mean(name, obs_sizes),
                )
    if cfg.actor.distribution_cfg is None:
        raise InputError(
            "actor.distribution_cfg",
            given=None,
            expected="a distribution to explore with",
            fix="distribution_cfg=RslRlMLPModelCfg.GaussianDistributionCfg(init_std=1.0)",
        )
