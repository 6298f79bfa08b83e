"""Managers: order of processing, timers, delays, histories, names, and messages for what is wrong."""

from __future__ import annotations

import itertools
from typing import Any

import pytest
import torch

from robotbrain.errors import InputError
from robotbrain.rl.configclass import configclass
from robotbrain.rl.envs import ManagerBasedRLEnv
from robotbrain.rl.managers import (
    CurriculumTermCfg,
    EventTermCfg,
    ManagerTermBase,
    ObservationGroupCfg,
    ObservationTermCfg,
    RewardTermCfg,
    SceneEntityCfg,
)
from robotbrain.rl.managers.buffers import DelayBuffer, HistoryBuffer
from robotbrain.rl.noise_cfg import ConstantNoiseCfg, GaussianNoiseCfg, UniformNoiseCfg
from tests.rl import tiny_tasks as tiny

torch.set_num_threads(1)


def make(cfg: Any = None, **changes: Any) -> ManagerBasedRLEnv:
    env = ManagerBasedRLEnv((cfg or tiny.ArmCfg)(**changes), num_threads=1)
    env.reset(seed=0)
    return env


def group(settings: dict[str, Any] | None = None, **terms: ObservationTermCfg) -> Any:
    made = ObservationGroupCfg(**(settings or {}))
    for name, term in terms.items():
        setattr(made, name, term)
    return {"policy": made}


def counter(env: Any) -> torch.Tensor:
    """10 * environment + step of the episode."""
    return (10.0 * torch.arange(env.num_envs) + env.episode_length_buf).unsqueeze(1)


def pair(env: Any) -> torch.Tensor:
    return torch.tensor([[1.0, -1.0]]).repeat(env.num_envs, 1)


# -- observations


@pytest.mark.parametrize("concatenate", [True, False])
def test_noise_comes_before_clip_before_scale(concatenate: bool) -> None:
    noisy = ObservationTermCfg(
        func=pair, noise=UniformNoiseCfg(n_min=2.0, n_max=2.0), clip=(0.0, 2.5), scale=(2.0, 3.0)
    )
    settings = {"enable_corruption": True, "concatenate_terms": concatenate}
    obs = make(observations=group(settings, noisy=noisy)).get_observations()["policy"]
    value = obs if concatenate else obs["noisy"]
    assert value[0].tolist() == [5.0, 3.0]  # (1 + 2 -> 2.5) * 2, (-1 + 2) * 3


def test_noise_needs_corruption() -> None:
    term = ObservationTermCfg(func=pair, noise=ConstantNoiseCfg(bias=5.0))
    assert make(observations=group(None, term=term)).get_observations()["policy"][0].tolist() == [1.0, -1.0]
    on = make(observations=group({"enable_corruption": True}, term=term))
    assert on.get_observations()["policy"][0].tolist() == [6.0, 4.0]


@pytest.mark.parametrize(
    ("noise", "mean", "std"),
    [
        (UniformNoiseCfg(n_min=-0.5, n_max=1.5), 0.5, 2 / 12**0.5),
        (GaussianNoiseCfg(mean=-1.0, std=0.3), -1.0, 0.3),
        (UniformNoiseCfg(n_min=0.0, n_max=2.0, operation="scale"), 0.0, 2 / 12**0.5),
    ],
)
def test_noise_has_its_distribution(noise: Any, mean: float, std: float) -> None:
    env = make(
        observations=group({"enable_corruption": True}, term=ObservationTermCfg(func=pair, noise=noise)),
        scene=tiny.ArmSceneCfg(num_envs=3000),
    )
    noise_seen = env.get_observations()["policy"] - torch.tensor([1.0, -1.0])
    offset = torch.tensor([1.0, -1.0]) if noise.operation == "add" else torch.tensor([-1.0, 1.0])
    shift = 0.0 if noise.operation == "add" else (noise.n_min + noise.n_max) / 2
    expected = mean if noise.operation == "add" else offset + shift * torch.tensor([1.0, -1.0])
    torch.testing.assert_close(noise_seen.mean(0), torch.zeros(2) + expected, atol=0.05, rtol=0)
    torch.testing.assert_close(noise_seen.std(0), torch.full((2,), std), atol=0.05, rtol=0)
    assert abs(torch.corrcoef(noise_seen.T)[0, 1]) < 0.06


def test_terms_are_concatenated_in_their_order_and_not_aliased() -> None:
    env = make(observations=group(None, b=ObservationTermCfg(func=counter), a=ObservationTermCfg(func=pair)))
    assert env.observation_manager.active_terms == {"policy": ["b", "a"]}
    assert env.observation_manager.group_obs_dim == {"policy": (3,)}
    obs = env.get_observations()["policy"]
    assert obs[2].tolist() == [20.0, 1.0, -1.0]
    kept = obs.clone()
    env.step(torch.zeros(4, 2))
    assert torch.equal(obs, kept)
    single = make(observations=group({"concatenate_terms": False}, q=ObservationTermCfg(func=tiny.joint_pos)))
    first = single.get_observations()["policy"]["q"]
    first += 100.0
    assert single.scene["robot"].data.joint_pos.torch.abs().max() < 10


def test_history_is_oldest_first_and_filled_by_the_first_sample() -> None:
    terms = {"c": ObservationTermCfg(func=counter), "p": ObservationTermCfg(func=pair)}
    env = make(observations=group({"history_length": 3}, **terms), episode_length_s=0.1)
    assert env.observation_manager.group_obs_dim == {"policy": (9,)}
    rows = [env.get_observations()["policy"][1].tolist()]
    rows += [env.step(torch.zeros(4, 2))[0]["policy"][1].tolist() for _ in range(6)]
    clocks = [row[:3] for row in rows]
    # the episode has 5 steps; at its end the next one begins at 0
    expected = [[10, 10, 10], [10, 10, 11], [10, 11, 12], [11, 12, 13], [12, 13, 14], [10, 10, 10], [10, 10, 11]]
    assert clocks == expected and rows[0][3:] == [1, -1] * 3
    env.observation_manager.compute()  # a mere look takes no sample
    assert env.step(torch.zeros(4, 2))[0]["policy"][1, :3].tolist() == [10, 11, 12]
    by_time = make(observations=group({"history_length": 2, "history_order": "time"}, **terms))
    by_time.step(torch.zeros(4, 2))
    assert by_time.step(torch.zeros(4, 2))[0]["policy"][0].tolist() == [1, 1, -1, 2, 1, -1]


def test_the_final_observation_has_the_last_sample_in_its_history_and_disturbs_nobodys() -> None:
    def run(**fields: Any) -> tuple[list[list[float]], list[list[float]]]:
        env = make(
            observations=group({"history_length": 3}, c=ObservationTermCfg(func=counter)),
            episode_length_s=0.1,
            **fields,
        )
        seen, final = [], []
        for step in range(12):
            if step == 2:
                env.reset(env_ids=[0])  # from here on environment 0 ends at other times than the rest
            obs, *_, extras = env.step(torch.zeros(4, 2))
            seen.append(obs["policy"].flatten().tolist())
            if "final_obs" in extras:
                final.append(extras["final_obs"]["policy"][int(len(final) % 2 == 0)].tolist())
        return seen, final

    seen, final = run(compute_final_obs=True)
    assert seen == run()[0]
    assert final == [[13, 14, 15], [3, 4, 5], [13, 14, 15], [3, 4, 5]]


def test_a_constant_delay_shows_old_samples_of_this_episode_only() -> None:
    late = ObservationTermCfg(func=counter, delay_min_lag=2, delay_max_lag=2)
    env = make(observations=group(None, late=late), episode_length_s=0.1)
    seen = [env.get_observations()["policy"][3].item()]
    seen += [env.step(torch.zeros(4, 2))[0]["policy"][3].item() for _ in range(7)]
    assert seen == [30, 30, 30, 31, 32, 30, 30, 30]
    assert env.observation_manager.compute()["policy"][3] == 30  # a look takes no sample
    assert env.step(torch.zeros(4, 2))[0]["policy"][3] == 31


def test_delays_are_drawn_per_environment_and_held() -> None:
    generator = torch.Generator().manual_seed(0)
    n = 4000
    buffer = DelayBuffer(1, 3, 1.0, n, (1,), generator)
    drawn = buffer.lags.clone()
    assert torch.bincount(drawn).tolist() == pytest.approx([0, n / 3, n / 3, n / 3], rel=0.1)
    for step in range(6):
        late = buffer.compute(torch.full((n, 1), float(step)), True)
    assert torch.equal(late[:, 0], 5.0 - drawn) and torch.equal(buffer.lags, drawn)
    buffer.reset(torch.arange(10))
    assert torch.equal(buffer.lags[10:], drawn[10:])
    restless = DelayBuffer(0, 4, 0.5, n, (1,), generator)
    before = restless.lags.clone()
    restless.compute(torch.zeros(n, 1), True)
    assert (restless.lags == before).float().mean().item() == pytest.approx(0.5 + 0.5 / 5, abs=0.04)


def test_history_buffer_of_vectors() -> None:
    buffer = HistoryBuffer(2, 3, (2,))
    one, two = torch.ones(3, 2), 2 * torch.ones(3, 2)
    assert torch.equal(buffer.compute(one, False), torch.stack((one, one), 1))
    buffer.compute(one, True)
    assert torch.equal(buffer.compute(two, True), torch.stack((one, two), 1))
    buffer.reset(torch.tensor([1]))
    mixed = buffer.compute(two, True)
    assert mixed[1].tolist() == [[2, 2], [2, 2]] and mixed[0].tolist() == [[2, 2], [2, 2]]
    assert torch.equal(buffer.compute(one, True)[0], torch.stack((two[0], one[0])))


def test_a_term_that_is_not_finite_is_named() -> None:
    def log(env: Any) -> torch.Tensor:
        return (env.episode_length_buf != 2).float().log().unsqueeze(1)

    env = make(observations=group(None, good=ObservationTermCfg(func=pair), bad=ObservationTermCfg(func=log)))
    env.step(torch.zeros(4, 2))
    with pytest.raises(InputError, match=r"policy/bad.*environment 0"):
        env.step(torch.zeros(4, 2))


# -- events, curriculum, commands


def test_interval_events_come_when_their_own_timer_is_up() -> None:
    times: list[tuple[int, int]] = []

    def event(env: Any, env_ids: torch.Tensor) -> None:
        times.extend((int(i), env.common_step_counter) for i in env_ids)

    cfg = EventTermCfg(func=event, mode="interval", interval_range_s=(0.1, 0.3), resample_interval_on_reset=False)
    env = make(events={"event": cfg}, scene=tiny.ArmSceneCfg(num_envs=50))
    for _ in range(200):
        env.step(torch.zeros(50, 2))
    gaps = []
    for i in range(50):
        steps = [0, *(s for e, s in times if e == i)]
        gaps += [b - a for a, b in itertools.pairwise(steps)]
    assert len({tuple(s for e, s in times if e == i) for i in range(50)}) == 50  # no two in step for good
    assert min(gaps) >= 5 and max(gaps) <= 15 and set(gaps) >= set(range(6, 15))  # 0.1 .. 0.3 s in steps of 0.02 s
    assert sum(gaps) / len(gaps) == pytest.approx(10.5, abs=0.4)  # half a step is lost in rounding up


def test_interval_timers_start_again_with_the_episode_or_are_common_to_all() -> None:
    calls: dict[str, list[Any]] = {"own": [], "common": []}

    def event(env: Any, env_ids: Any, name: str) -> None:
        calls[name].append(None if env_ids is None else env_ids.tolist())

    own = EventTermCfg(func=event, mode="interval", interval_range_s=(0.5, 0.5), params={"name": "own"})
    common = EventTermCfg(
        func=event, mode="interval", interval_range_s=(0.5, 0.5), is_global_time=True, params={"name": "common"}
    )
    env = make(events={"own": own, "common": common})  # episodes last 0.4 s
    for _ in range(60):
        env.step(torch.zeros(4, 2))
    assert calls == {"own": [], "common": [None, None]}


def test_reset_events_keep_their_distance() -> None:
    seen: list[tuple[int, list[int]]] = []

    def event(env: Any, env_ids: torch.Tensor) -> None:
        seen.append((env.common_step_counter, env_ids.tolist()))

    env = make(events={"event": EventTermCfg(func=event, mode="reset", min_step_count_between_reset=30)})
    for _ in range(70):
        env.step(torch.zeros(4, 2))
    # episodes of 20 steps end at 20, 40, 60
    assert seen == [(0, [0, 1, 2, 3]), (40, [0, 1, 2, 3])]


def test_startup_events_come_once_before_everything() -> None:
    order: list[str] = []

    def event(env: Any, env_ids: Any, name: str) -> None:
        order.append(name)

    events = {
        "reset": EventTermCfg(func=event, mode="reset", params={"name": "reset"}),
        "startup": EventTermCfg(func=event, mode="startup", params={"name": "startup"}),
    }
    env = make(events=events)
    env.reset()
    assert order == ["startup", "reset", "reset"]


def test_commands_last_as_long_as_they_are_meant_to() -> None:
    env = make(tiny.WalkerCfg, terminations={}, events=None, scene=tiny.WalkerSceneCfg(num_envs=20))
    term = env.command_manager.get_term("direction")
    last, since, lengths = term.command.clone(), torch.zeros(20), []
    for _ in range(100):
        env.step(torch.zeros(20, 2))
        since += 1
        changed = (term.command != last)[:, 0]
        lengths += since[changed].tolist()
        since[changed] = 0
        last = term.command.clone()
    assert min(lengths) >= 5 and max(lengths) <= 15 and sum(lengths) / len(lengths) == pytest.approx(10.5, abs=0.8)
    assert (term.command_counter > 6).all() and term.command.abs().max() <= 1


def test_curriculum_runs_before_the_reset_and_is_logged() -> None:
    def harder(env: Any, env_ids: Any, step: float) -> dict[str, float]:
        env.reward_manager.get_term_cfg("effort").weight -= step
        return {"weight": env.reward_manager.get_term_cfg("effort").weight, "age": float(env.episode_length_buf[0])}

    env = make(curriculum={"harder": CurriculumTermCfg(func=harder, params={"step": 0.5})})
    for _ in range(20):
        extras = env.step(torch.zeros(4, 2))[4]
    assert extras["log"]["Curriculum/harder/weight"] == pytest.approx(-1.01)
    assert extras["log"]["Curriculum/harder/age"] == 20.0


ELBOW = SceneEntityCfg("robot", joint_names="el.*")


class Counting(ManagerTermBase):
    """Counts its own calls per environment since the last reset."""

    created = 0

    def __init__(self, cfg: Any, env: Any) -> None:
        super().__init__(cfg, env)
        type(self).created += 1
        self.calls = torch.zeros(env.num_envs)
        self.joints = cfg.params["asset_cfg"].joint_names

    def reset(self, env_ids: torch.Tensor | None = None) -> None:
        self.calls[slice(None) if env_ids is None else env_ids] = 0

    def __call__(self, env: Any, asset_cfg: SceneEntityCfg = ELBOW) -> torch.Tensor:
        self.calls += 1
        return self.calls.clone()


def test_class_terms_are_created_once_with_resolved_parameters_and_reset() -> None:
    Counting.created = 0
    env = make(rewards={"counting": RewardTermCfg(func=Counting, weight=1.0)})
    rewards = [env.step(torch.zeros(4, 2))[1][0].item() / env.step_dt for _ in range(22)]
    assert rewards == pytest.approx([*range(1, 21), 1, 2]) and Counting.created == 1
    term = env.reward_manager.get_term_cfg("counting").func
    assert term.joints == ["elbow"]
    state = env.state_dict()
    env.step(torch.zeros(4, 2))
    env.load_state_dict(state)
    assert (term.calls == 2).all()


# -- names and mistakes


def test_entities_are_resolved_to_the_fastest_index() -> None:
    scene = make(tiny.WalkerCfg).scene
    cases: list[tuple[SceneEntityCfg, Any]] = [
        (SceneEntityCfg("robot"), slice(None)),
        (SceneEntityCfg("robot", body_names=".*"), slice(None)),
        (SceneEntityCfg("robot", body_names=".*_foot"), slice(2, 5, 2)),
        (SceneEntityCfg("robot", body_names=["right_foot", "left"], preserve_order=True), [4, 1]),
        (SceneEntityCfg("robot", body_names=["right_foot"]), [4]),
        (SceneEntityCfg("contact_forces", body_names="right.*"), [1]),
        (SceneEntityCfg("robot", body_ids=[1, 2]), slice(1, 3, 1)),
    ]
    names = scene["robot"].body_names
    assert names == ["trunk", "left", "left_foot", "right", "right_foot"]
    for cfg, expected in cases:
        cfg.resolve(scene)
        cfg.resolve(scene)  # again: nothing changes
        assert cfg.body_ids == expected if isinstance(expected, slice) else cfg.body_ids.tolist() == expected
    assert cases[3][0].body_names == ["right_foot", "left"] and cases[6][0].body_names == ["left", "left_foot"]


def effort_of(env: Any, asset_cfg: SceneEntityCfg, power: float = 2.0) -> torch.Tensor:
    return env.scene[asset_cfg.name].actuators.applied_effort.torch[:, asset_cfg.joint_ids].abs().pow(power).sum(1)


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"asset_cfg": SceneEntityCfg("robt")}, "Did you mean 'robot'"),
        (
            {"asset_cfg": SceneEntityCfg("robot", joint_names="elbw")},
            r"reward 'effort', parameter 'asset_cfg'.*'elbow'",
        ),
        ({"asset_cfg": SceneEntityCfg("robot", joint_ids=[7])}, r"0\.\.1"),
        ({"asset_cfg": SceneEntityCfg("robot", joint_names="elbow", joint_ids=[0])}, "not both"),
        ({"asset_cfg": SceneEntityCfg("robot"), "powr": 1.0}, "Did you mean 'power'"),
        ({}, "no default for 'asset_cfg'"),
    ],
)
def test_mistakes_in_parameters_are_explained(params: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        make(rewards={"effort": RewardTermCfg(func=effort_of, weight=1.0, params=params)})


def test_terms_share_no_configuration_and_have_their_defaults() -> None:
    shared = {"asset_cfg": SceneEntityCfg("robot", joint_names="elbow")}
    cfg = tiny.ArmCfg()
    cfg.rewards.effort = RewardTermCfg(func=effort_of, weight=1.0, params=shared)
    env = ManagerBasedRLEnv(cfg, num_threads=1)
    assert env.reward_manager.get_term_cfg("effort").params["power"] == 2.0
    assert shared["asset_cfg"].joint_ids == slice(None) and "power" not in shared


@configclass
class NotATerm:
    weight: float = 1.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rewards": {"flat": RewardTermCfg(func=lambda env: torch.zeros(3), weight=1.0)}}, r"\(4,\)"),
        ({"rewards": {"column": RewardTermCfg(func=lambda env: torch.zeros(4, 1), weight=1.0)}}, r"\(4,\)"),
        ({"rewards": {"number": RewardTermCfg(func=lambda env: 1.0, weight=1.0)}}, "torch tensor"),
        ({"rewards": {"other": NotATerm()}}, "RewardTermCfg"),
        ({"rewards": {"kind": RewardTermCfg(func=dict, weight=1.0)}}, "ManagerTermBase"),
        ({"rewards": {"open": RewardTermCfg(func=tiny.alive)}}, "weight"),
        ({"events": {"e": EventTermCfg(func=tiny.push, mode="interval", params={"speed": 1.0})}}, "interval_range_s"),
        ({"observations": group(None, p=ObservationTermCfg(func=pair, scale=(1.0, 2.0, 3.0)))}, "2 of them"),
        ({"observations": group(None, p=ObservationTermCfg(func=pair, delay_min_lag=2))}, "0 <= min <= max"),
        ({"observations": group(None, p=ObservationTermCfg(func=pair), n=ObservationTermCfg(func=tiny.alive))}, "2-D"),
        ({"observations": {"policy": tiny.TimeOutCfg()}}, "ObservationGroupCfg"),
    ],
)
def test_terms_that_cannot_work_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        make(**changes).step(torch.zeros(4, 2))


def test_unknown_names_get_a_proposal() -> None:
    env = make(tiny.WalkerCfg)
    for look_up in (
        lambda: env.reward_manager.get_term_cfg("alve"),
        lambda: env.command_manager.get_command("dirction"),
        lambda: env.action_manager.get_term("joint"),
        lambda: env.termination_manager.get_term("tiltd"),
        lambda: env.event_manager.get_term_cfg("psh"),
        lambda: env.observation_manager.get_term_cfg("policy", "rot"),
        lambda: env.observation_manager.compute_group("polcy"),
    ):
        with pytest.raises(InputError, match="Did you mean"):
            look_up()
    assert env.reward_manager.find_terms("a.*") == ["alive", "action_rate"]
    assert env.observation_manager.find_terms("joint.*") == ["joint_pos"]
