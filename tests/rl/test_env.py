"""The environment against plain MuJoCo, and its promises: determinism, resuming, resets, states that diverge."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from robotbrain.errors import InputError
from robotbrain.rl.configclass import configclass
from robotbrain.rl.envs import ManagerBasedRLEnv
from robotbrain.rl.managers import ActionTermCfg, EventTermCfg, ObservationTermCfg, RewardTermCfg
from tests.rl import tiny_tasks as tiny

torch.set_num_threads(1)


def actions(env: ManagerBasedRLEnv, steps: int, seed: int = 0) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return [torch.randn(env.num_envs, env.num_actions, generator=generator) for _ in range(steps)]


def run(env: ManagerBasedRLEnv, steps: int, seed: int = 0, reset: bool = True) -> list[torch.Tensor]:
    """Everything that steps return, and the physical states."""
    seen = []
    if reset:
        obs, _ = env.reset(seed=seed)
        seen.append(obs["policy"])
    for action in actions(env, steps, seed + 1):
        obs, reward, terminated, time_outs, extras = env.step(action)
        seen += [obs["policy"], reward, terminated, time_outs, torch.from_numpy(env.scene.world.rows.copy())]
        seen += [torch.as_tensor(v, dtype=torch.float32) for v in extras.get("log", {}).values()]
    return seen


def equal(one: list[torch.Tensor], two: list[torch.Tensor]) -> bool:
    return len(one) == len(two) and all(torch.equal(a, b) for a, b in zip(one, two, strict=True))


def plain_mujoco(xml: str, qpos: np.ndarray, targets: list[np.ndarray], decimation: int) -> mujoco.MjData:
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    for target in targets:
        data.ctrl[:] = target
        for _ in range(decimation):
            mujoco.mj_step(model, data)
    return data


def test_stepping_agrees_with_plain_mujoco() -> None:
    cfg = tiny.ArmCfg(episode_length_s=10.0)
    env = ManagerBasedRLEnv(cfg, num_threads=2)
    env.reset(seed=3)
    start = env.scene.world.qpos.copy()
    sent = actions(env, 25)
    for action in sent:
        env.step(action)
    robot = env.scene["robot"]
    for i in range(env.num_envs):
        # the model lists the elbow's actuator first: targets go by joint, not by position
        targets = [(0.5 * a[i]).double().numpy()[[1, 0]] for a in sent]
        data = plain_mujoco(tiny.ARM, start[i], targets, cfg.decimation)
        np.testing.assert_allclose(env.scene.world.qpos[i], data.qpos, rtol=0, atol=1e-9)
        np.testing.assert_allclose(robot.data.joint_vel.torch[i], data.qvel, rtol=0, atol=1e-5)
        np.testing.assert_allclose(robot.actuators.applied_effort.torch[i], data.qfrc_actuator, rtol=1e-5, atol=1e-5)


def test_applying_actions_every_physics_step_is_the_same_physics() -> None:
    one, two = tiny.WalkerCfg(), tiny.WalkerCfg()
    two.actions.joints = ActionTermCfg(class_type=tiny.PositionEverySubstep, asset_name="robot")
    first, second = (ManagerBasedRLEnv(c, num_threads=1) for c in (one, two))
    assert equal(run(first, 30), run(second, 30))


@pytest.mark.parametrize("cfg", [tiny.ArmCfg, tiny.WalkerCfg])
def test_same_seed_same_bytes_with_any_number_of_threads(cfg: Any) -> None:
    reference = run(ManagerBasedRLEnv(cfg(), num_threads=1), 60)
    for threads in (1, 2, 4):
        assert equal(reference, run(ManagerBasedRLEnv(cfg(), num_threads=threads), 60))
    assert not equal(reference, run(ManagerBasedRLEnv(cfg(), num_threads=1), 60, seed=5))


def test_seeding_again_repeats_the_run_in_the_same_environment() -> None:
    env = ManagerBasedRLEnv(tiny.ArmCfg(), num_threads=1)
    assert equal(run(env, 30, seed=7), run(env, 30, seed=7))


def test_environments_do_not_influence_each_other() -> None:
    results = []
    for wild in (0.0, 3.0):
        cfg = tiny.ArmCfg(events=None)
        env = ManagerBasedRLEnv(cfg, num_threads=2)
        env.reset(seed=0)
        for action in actions(env, 15):
            action[1:] *= wild
            env.step(action)
        results.append(env.scene.world.rows[0].copy())
    np.testing.assert_array_equal(results[0], results[1])


def test_looking_at_data_does_not_change_a_run() -> None:
    runs = []
    for look in (False, True):
        env = ManagerBasedRLEnv(tiny.WalkerCfg(), num_threads=1)
        env.reset(seed=0)
        for action in actions(env, 40):
            env.step(action)
            if look:
                env.observation_manager.get_term_cfg("policy", "forces")
                data = env.scene["robot"].data
                for name in ("body_pos_w", "body_quat_w", "body_vel_w", "root_state_w", "joint_acc"):
                    getattr(data, name).torch.sum()
                env.scene["lidar"].data.ranges.torch.sum()
        runs.append(env.scene.world.rows.copy())
    np.testing.assert_array_equal(runs[0], runs[1])


def heavier(env: Any, env_ids: Any) -> None:
    robot = env.scene["robot"]
    factor = 1 + torch.rand(env.num_envs, 1, generator=env.generator)
    robot.model_param("body_mass").copy_(robot.default_model_param("body_mass") * factor)
    robot.mark_const_dirty()


@configclass
class HeavyEventsCfg(tiny.WalkerEventsCfg):
    heavier = EventTermCfg(func=heavier, mode="startup")


def test_resuming_continues_bit_by_bit(tmp_path: Any) -> None:
    def cfg() -> Any:
        task = tiny.WalkerCfg(events=HeavyEventsCfg())
        task.observations.policy.late = ObservationTermCfg(
            func=tiny.joint_vel, delay_min_lag=1, delay_max_lag=3, delay_hold_prob=0.5, history_length=2
        )
        return task

    def with_late(env: ManagerBasedRLEnv) -> ManagerBasedRLEnv:
        assert "late" in env.observation_manager.active_terms["policy"]
        return env

    env = with_late(ManagerBasedRLEnv(cfg(), num_threads=1))
    env.reset(seed=1)
    for action in actions(env, 37):
        env.step(action)
    torch.save(env.state_dict(), tmp_path / "state.pt")
    expected = run(env, 60, reset=False)
    other = with_late(ManagerBasedRLEnv(cfg().replace(seed=99), num_threads=2))
    other.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    assert torch.equal(other.get_observations()["policy"], torch.load(tmp_path / "state.pt")["obs"]["policy"])
    assert equal(expected, run(other, 60, reset=False))


def test_derived_constants_are_resumed_where_no_event_has_run_yet() -> None:
    cfg = tiny.WalkerCfg(events=HeavyEventsCfg())
    cfg.events.heavier.mode, cfg.events.heavier.interval_range_s = "interval", (0.02, 0.05)
    env = ManagerBasedRLEnv(cfg, num_threads=1)
    env.reset(seed=1)
    for action in actions(env, 20):
        env.step(action)
    state = env.state_dict()
    expected = run(env, 3, reset=False)
    fresh = ManagerBasedRLEnv(cfg, num_threads=1)
    assert not fresh.scene.world.has_own_constants
    fresh.load_state_dict(state)
    assert equal(expected, run(fresh, 3, reset=False))


def test_a_state_of_another_size_is_refused() -> None:
    env = ManagerBasedRLEnv(tiny.ArmCfg(), num_threads=1)
    state = env.state_dict()
    state["physics"] = state["physics"][:2]
    with pytest.raises(InputError, match="same configuration"):
        env.load_state_dict(state)


def test_rewards_are_weight_times_dt_and_add_up_in_the_log() -> None:
    cfg = tiny.ArmCfg()
    env = ManagerBasedRLEnv(cfg, num_threads=1)
    env.reset(seed=0)
    total = torch.zeros(4)
    for action in actions(env, 20):
        _, reward, _, time_outs, extras = env.step(action)
        total += reward
    assert time_outs.all() and env.episode_length_buf.eq(0).all()
    log = extras["log"]
    assert log["Episode_Reward/alive"] == pytest.approx(20 * env.step_dt / cfg.episode_length_s)
    sums = log["Episode_Reward/alive"] + log["Episode_Reward/effort"]
    assert float(sums) * cfg.episode_length_s == pytest.approx(float(total.mean()), rel=1e-4)
    assert float(log["Episode_Termination/time_out"]) == 1.0


def test_changed_weights_count_at_once_and_zero_weights_are_not_evaluated() -> None:
    cfg = tiny.ArmCfg()
    calls = []

    def counted(env: Any) -> torch.Tensor:
        calls.append(1)
        return torch.ones(env.num_envs)

    cfg.rewards.counted = RewardTermCfg(func=counted, weight=0.0)
    cfg.rewards.effort.weight = 0.0
    env = ManagerBasedRLEnv(cfg, num_threads=1)
    env.reset(seed=0)
    zero = torch.zeros(4, 2)
    assert torch.allclose(env.step(zero)[1], torch.full((4,), env.step_dt)) and not calls
    env.reward_manager.get_term_cfg("counted").weight = -3.0
    assert torch.allclose(env.step(zero)[1], torch.full((4,), -2 * env.step_dt)) and len(calls) == 1


def test_only_positive_rewards() -> None:
    cfg = tiny.ArmCfg(only_positive_rewards=True)
    cfg.rewards.alive.weight = -1.0
    env = ManagerBasedRLEnv(cfg, num_threads=1)
    env.reset(seed=0)
    assert (env.step(torch.zeros(4, 2))[1] == 0).all()


def test_final_observations_are_those_before_the_reset() -> None:
    cfg = tiny.ArmCfg(compute_final_obs=True)
    cfg.observations.policy.step = ObservationTermCfg(func=tiny.step_number)
    env = ManagerBasedRLEnv(cfg, num_threads=1)
    env.reset(seed=0)
    for action in actions(env, 20):
        obs, *_, extras = env.step(action)
    before = extras["final_obs"]["policy"]
    assert (before[:, -1] == 20).all() and (obs["policy"][:, -1] == 0).all()
    assert torch.equal(before[:, 4:6], action) and (obs["policy"][:, 4:6] == 0).all()


def test_a_diverged_state_ends_that_environment_only() -> None:
    env = ManagerBasedRLEnv(tiny.ArmCfg(), num_threads=2)
    healthy = ManagerBasedRLEnv(tiny.ArmCfg(), num_threads=2)
    env.reset(seed=0), healthy.reset(seed=0)
    sent = actions(env, 6)
    with pytest.warns(RuntimeWarning, match="environment 2 .* diverged"):
        results = []
        for step, action in enumerate(sent):
            if step == 3:
                env.scene.world.qvel[2, 0] = np.nan
            results.append(env.step(action))
    expected = [healthy.step(a) for a in sent]
    others = torch.tensor([0, 1, 3])
    for step, (got, want) in enumerate(zip(results, expected, strict=True)):
        assert got[2].tolist() == [False, False, step == 3, False]
        assert torch.equal(got[0]["policy"][others], want[0]["policy"][others])
        assert all(torch.isfinite(v).all() for v in (got[0]["policy"], got[1]))
    assert results[3][1][2] == 0.0 != expected[3][1][2]  # the default state earns nothing
    assert results[3][4]["log"]["Episode_Termination/non_finite_state"] == 1
    assert env.episode_length_buf.tolist() == [6, 6, 2, 6]


def test_a_reward_that_is_not_finite_ends_that_environment_only() -> None:
    cfg = tiny.ArmCfg()

    def bad(env: Any) -> torch.Tensor:
        value = torch.zeros(env.num_envs)
        value[1] = torch.inf if env.common_step_counter == 2 else 0.0
        return value

    cfg.rewards.bad = RewardTermCfg(func=bad, weight=1.0)
    env = ManagerBasedRLEnv(cfg, num_threads=1)
    env.reset(seed=0)
    env.step(torch.zeros(4, 2))
    with pytest.warns(RuntimeWarning, match="reward bad"):
        _, reward, terminated, _, extras = env.step(torch.zeros(4, 2))
    assert terminated.tolist() == [False, True, False, False] and reward[1] == 0 and torch.isfinite(reward).all()
    assert all(np.isfinite(float(v)) for v in extras["log"].values())


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (torch.full((4, 2), torch.nan), "environment 0, term 'joints', component 0"),
        (
            torch.tensor([[0.0, 0.0], [0.0, 0.0], [0.0, torch.inf], [0.0, 0.0]]),
            "environment 2, term 'joints', component 1",
        ),
        (torch.zeros(4, 3), "one row per environment"),
        (torch.zeros(3, 2), "one row per environment"),
    ],
)
def test_actions_that_cannot_be_used_are_refused(action: torch.Tensor, message: str) -> None:
    env = ManagerBasedRLEnv(tiny.ArmCfg(), num_threads=1)
    env.reset(seed=0)
    with pytest.raises(InputError, match=message):
        env.step(action)


def test_partial_resets_touch_no_other_environment() -> None:
    env = ManagerBasedRLEnv(tiny.ArmCfg(), num_threads=1)
    env.reset(seed=0)
    for action in actions(env, 5):
        env.step(action)
    before = env.scene.world.rows.copy()
    env.reset(env_ids=[1, 3])
    np.testing.assert_array_equal(env.scene.world.rows[[0, 2]], before[[0, 2]])
    assert env.episode_length_buf.tolist() == [5, 0, 5, 0]
    assert not np.array_equal(env.scene.world.qpos[1], before[1, 1:3])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"decimation": 0}, "decimation"),
        ({"episode_length_s": float("nan")}, "episode_length_s"),
        ({"seed": -1}, "seed"),
        ({"scene": tiny.ArmSceneCfg(num_envs=0)}, "num_envs"),
        ({"actions": {}}, "at least one term"),
        ({"observations": {}}, "at least one group"),
        ({"rewards": {"alive": 3}}, "RewardTermCfg"),
    ],
)
def test_configurations_that_cannot_work_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        ManagerBasedRLEnv(tiny.ArmCfg(**change), num_threads=1)


def test_stepping_needs_a_reset_first() -> None:
    env = ManagerBasedRLEnv(tiny.ArmCfg(), num_threads=1)
    with pytest.raises(InputError, match="reset"):
        env.step(torch.zeros(4, 2))
