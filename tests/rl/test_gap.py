"""The gap study: deployment against the training environment, statistics, the report, and what is shipped."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from robotbrain.errors import InputError
from robotbrain.rl.deployment import RobotView
from robotbrain.rl.envs.gym import TaskVectorEnv
from robotbrain.rl.export import OnnxPolicy, export_policy
from robotbrain.rl.gap import (
    TERMS,
    VARIANTS,
    StudyOptions,
    dissect,
    record_reach,
    shipped_policy,
    shipped_report,
    train_policy,
)
from robotbrain.rl.gap_report import GapReport, Measurement, mean_interval
from robotbrain.rl.gap_variants import reach_cfg, reach_meta
from robotbrain.rl.surrogate import RANGES, SurrogateReachEnv, draw, neutral
from robotbrain.rl.surrogate.parameters import DIFFERENCES
from robotbrain.rl.surrogate.reach import ReachEpisodes


class _Reach(torch.nn.Module):
    """A policy of plain algebra: towards the target with the columns of a fixed Jacobian."""

    def __init__(self, size: int) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(0)
        self.weight = torch.nn.Parameter(torch.randn(size, 7, generator=generator) * 0.3)

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        return torch.tanh(obs @ self.weight)


@pytest.fixture(scope="module")
def plain() -> tuple[TaskVectorEnv, OnnxPolicy]:
    cfg = reach_cfg()
    cfg.scene.num_envs, cfg.seed = 6, 3
    env = TaskVectorEnv(cfg, num_threads=1)
    return env, env


@pytest.fixture(scope="module")
def policy(plain: Any, tmp_path_factory: pytest.TempPathFactory) -> OnnxPolicy:
    meta = reach_meta(plain[0].env, why="a test")
    path = tmp_path_factory.mktemp("policy") / "p.onnx"
    return OnnxPolicy(export_policy(_Reach(meta.observation_dim), path, meta))


def _state(env: TaskVectorEnv) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    robot = env.env.scene["robot"].data
    goal = env.env.command_manager.get_command("ee_pose")
    position, velocity = robot.joint_pos.torch.numpy(), robot.joint_vel.torch.numpy()
    return position.astype(float), velocity.astype(float), goal.numpy().astype(float)


def test_the_robots_own_computer_sees_what_the_training_saw(plain: Any, policy: OnnxPolicy) -> None:
    env = plain[0]
    obs, _ = env.reset(seed=1)
    runner = SurrogateReachEnv(range(6)).runner(policy)
    for _ in range(3):
        action = np.random.default_rng(0).uniform(-1, 1, (6, 7)).astype(np.float32)
        obs = env.step(action)[0]
        position, velocity, goal = _state(env)
        mine = runner.observe(RobotView(position, velocity, action.astype(float)), goal)
        np.testing.assert_allclose(mine, obs, atol=2e-5)


def test_a_neutral_surrogate_is_the_training_simulation(plain: Any, policy: OnnxPolicy) -> None:
    env = plain[0]
    obs, _ = env.reset(seed=2)
    start, _, goal = _state(env)
    arms = SurrogateReachEnv(range(6), params=[neutral(7)] * 6, ramp_s=0.0)
    readings = arms.reset(start=start, target=goal[:, :3])
    runner = arms.runner(policy)
    ours, theirs = [], []
    body = env.env.scene["robot"].find_bodies("ee")[0][0]
    for _ in range(45):
        readings, distance = arms.step(runner.act(readings.joint_pos, readings.joint_vel, arms.target))
        obs = env.step(policy(obs))[0]
        hand = env.env.scene["robot"].data.body_pos_w.torch[:, body]
        ours.append(distance)
        theirs.append((hand - torch.as_tensor(goal[:, :3])).norm(dim=1).numpy())
    # Training rounds to float32 and this controller amplifies; a delay of a single physics step differs by centimetres.
    np.testing.assert_allclose(ours, theirs, atol=2e-3)


def test_all_variants_observe_the_same_and_differ_in_events() -> None:
    groups = {}
    for name in ("plain", "randomised"):
        cfg = reach_cfg(VARIANTS[name])
        cfg.scene.num_envs = 64
        env = TaskVectorEnv(cfg, num_threads=1)
        env.reset(seed=0)
        groups[name] = env.env
    one, other = groups["plain"], groups["randomised"]
    assert reach_meta(one).observation_names == reach_meta(other).observation_names
    for env, spread in ((one, False), (other, True)):
        latency = env.action_manager.get_term("arm_action").delay.latency
        stiffness = env.scene["robot"].data.joint_stiffness.torch[:, 0]
        friction = env.scene["robot"].data.joint_friction_coeff.torch[:, 0]
        mass = env.scene["robot"].data.body_mass.torch[:, 3]
        for values in (latency, stiffness, friction, mass):
            assert (len(values.unique()) > 5) == spread
    assert int(other.action_manager.get_term("arm_action").delay.latency.max()) == 10
    assert set(VARIANTS["all but latency"]) == set(TERMS) - {"latency"}


def test_dissection_leaves_one_kind_of_difference(policy: OnnxPolicy, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    run = SurrogateReachEnv.run

    def spy(self: SurrogateReachEnv, *args: Any, **kwargs: Any) -> ReachEpisodes:
        seen.append(self)
        return run(self, *args, **kwargs)

    monkeypatch.setattr(SurrogateReachEnv, "run", spy)
    found = dissect(policy, [3])
    assert list(found) == ["interpolation", *DIFFERENCES]
    assert sorted(sum(DIFFERENCES.values(), ())) == sorted(RANGES["arm"])
    real, clean = vars(draw(3)), vars(neutral(7))
    for kind, env in zip(found, seen, strict=True):
        for name, value in vars(env.fleet.params[0]).items():
            expected = real if name in DIFFERENCES.get(kind, ()) else clean
            np.testing.assert_array_equal(value, expected[name])


def test_unknown_names_are_refused() -> None:
    with pytest.raises(InputError, match="colour"):
        reach_cfg(["colour"])
    with pytest.raises(InputError, match="variant"):
        StudyOptions(variants=["nothing"])
    with pytest.raises(InputError):
        StudyOptions(seeds=())


def test_training_is_repeatable_to_the_byte(tmp_path: Path) -> None:
    small = {"hidden": (16, 16), "warmup_steps": 128, "eval_every": 640, "progress": False}
    files = [train_policy(tmp_path / f"{i}.onnx", randomise=TERMS, seed=1, steps=640, **small) for i in range(2)]
    assert files[0].read_bytes() == files[1].read_bytes()
    meta = OnnxPolicy(files[0]).meta
    assert meta.provenance["randomise"] == list(TERMS)
    assert meta.joint_names == tuple(f"joint{i}" for i in range(1, 8))


def _report(rng: np.random.Generator, seeds: int = 5) -> GapReport:
    def made(level: float) -> Measurement:
        robots = np.clip(level + 0.1 * rng.standard_normal(20), 0, 1)
        return Measurement(float(robots.mean()), 0.01 / level, tuple(robots), tuple(0.01 / level + 0.001 * robots))

    levels = {"plain": (0.95, 0.3), "randomised": (0.93, 0.85)}
    rows = {v: {s: {"simulation": made(a), "surrogate": made(b)} for s in range(seeds)} for v, (a, b) in levels.items()}
    kinds = {"plain": {0: {"delays": 0.25, "play": 1.0}, 1: {"delays": 0.75, "play": 1.0}}}
    return GapReport(rows, {"serials": list(range(20)), "episodes": 1}, kinds)


def test_the_report_says_what_the_numbers_say(tmp_path: Path) -> None:
    report = _report(np.random.default_rng(0))
    assert report.over_trainings().p_value == pytest.approx(1 / 252)  # all of 5 above all of 5
    assert report.over_robots().p_value < 1e-4
    assert report.over_trainings("plain", "randomised").p_value > 0.9
    np.testing.assert_allclose(
        report.gap("plain"), report.values("plain", "simulation") - report.values("plain", "surrogate")
    )
    table = report.table()
    assert f"{report.values('plain', 'surrogate').mean():.0%}" in table
    assert "p = 0.004" in table
    again = GapReport.load(report.save(tmp_path / "r.json"))
    assert again.to_json() == report.to_json()
    assert again.table() == table
    assert again.dissected("plain") == {"delays": 0.5, "play": 1.0}


def test_figures_have_words() -> None:
    report = _report(np.random.default_rng(0))
    for figure in (report.plot(), report.plot_sensitivity(), report.plot_dissection()):
        assert figure.axes
        assert "plain" in str(figure.get_label())
    assert len(report.sensitivity("plain")) == 15


def test_sensitivity_finds_the_parameter_that_decides() -> None:
    serials = list(range(60))
    report = _report(np.random.default_rng(0))
    delay = GapReport(report.rows, {"serials": serials}).surrogate_parameters()["command_delay_s"]
    done = Measurement(0.5, 0.1, (0.5,) * 60, tuple(delay))
    found = GapReport({"plain": {0: {"simulation": done, "surrogate": done}}}, {"serials": serials}).sensitivity(
        "plain"
    )
    assert next(iter(found)) == "command_delay_s"
    assert found["command_delay_s"] == pytest.approx(1.0)


def test_the_interval_covers_as_often_as_it_says() -> None:
    rng = np.random.default_rng(1)
    hits = 0
    for _ in range(1000):
        found = mean_interval(rng.normal(3.0, 2.0, 5))
        hits += found.low <= 3.0 <= found.high
    assert hits / 1000 == pytest.approx(0.95, abs=0.02)
    assert np.isnan(mean_interval([0.5]).low)


def test_episodes_are_grouped_by_robot() -> None:
    distance = np.full((6, 10), 0.5)
    distance[[0, 3, 4]] = 0.001  # robot 0 twice, robot 1 once
    distance[2, -6] = distance[2, -7:-5].mean()
    done = Measurement.from_episodes(ReachEpisodes(np.array([7, 8, 9, 7, 8, 9]), np.zeros((6, 3)), distance))
    assert done.by_robot == (1.0, 0.5, 0.0)
    assert done.success == 0.5
    late = np.full((1, 10), 0.001)
    late[0, -5] = 0.03  # outside during the last five steps
    assert not ReachEpisodes(np.array([0]), np.zeros((1, 3)), late).success[0]


@pytest.mark.parametrize("text", ["", "{}", '{"format": "other"}', json.dumps({"format": "robotbrain-gap/1"})])
def test_what_is_no_report_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "r.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError):
        GapReport.load(path)


def test_the_shipped_study_shows_the_lesson() -> None:
    report = shipped_report()
    assert report.over_trainings().p_value < 0.01
    assert report.over_robots().p_value < 0.01
    assert len(report.rows["plain"]) >= 5
    assert report.values("plain", "simulation").mean() > 0.95
    assert report.gap("plain").mean() > 0.3 > 2 * report.gap("randomised").mean()


def test_the_shipped_policy_reaches_on_surrogates_it_has_never_met() -> None:
    done = SurrogateReachEnv(range(5000, 5030), seed=77).run(OnnxPolicy(shipped_policy()))
    assert done.success.mean() > 0.8
    motion = record_reach(serial=5000, episodes=1)
    assert "surrogate 5000" in motion.label
