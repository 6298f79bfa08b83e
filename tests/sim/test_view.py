"""The meshcat page without a server, and the top-down figure."""

from __future__ import annotations

import base64
import dataclasses
import html
import io
import json
import math
import re
import socket
import subprocess
from pathlib import Path

import numpy as np
import pytest
import umsgpack

from robotbrain.errors import InputError
from robotbrain.sim import (
    Obstacle,
    Point2D,
    Pose2D,
    Replay,
    RobotSim,
    SceneView,
    World,
    describe,
    generate_world,
    plot_topdown,
    to_parent,
)
from robotbrain.sim.meshcat_page import png

MS = 1_000_000


@pytest.fixture(scope="module")
def replay() -> Replay:
    """A short drive into a box that moves, with two plans and a detection."""
    world = generate_world(1)
    box = Obstacle(
        "box_99", "box", *to_parent(world.start, [0.45, 0.0]), 0.0, 0.1, 0.1, 0.1, True, (0.5, 0.5, 0.5, 1.0)
    )
    sim = RobotSim(dataclasses.replace(world, obstacles=(*world.obstacles, box)))
    replay = Replay(sim.world)
    for k in range(61):
        sim.advance_to(k * 50 * MS)
        replay.record(sim)
        sim.set_twist(0.4, 0.2)
    replay.add_plan(0.5, [[0.0, 0.0], [1.0, 0.5], [2.0, 2.0]])
    replay.add_plan(1.5, [[0.0, 0.0], [2.0, 2.0]])
    replay.add_detection(1.0, Point2D(1.0, 2.0))
    return replay


def commands(page: str) -> list[dict]:
    found = re.search(r"for \(const text of (\[.*?\])\)", page)
    assert found
    return [umsgpack.unpackb(base64.b64decode(text)) for text in json.loads(found[1])]


def clips(page: str) -> dict[str, dict[str, list]]:
    """Tracks of the animation by path and name."""
    last = commands(page)[-1]
    assert last["type"] == "set_animation"
    assert last["options"]["play"]
    return {
        a["path"]: {
            t["name"]: [(key["time"] / a["clip"]["fps"], key["value"]) for key in t["keys"]]
            for t in a["clip"]["tracks"]
        }
        for a in last["animations"]
    }


def test_replay_moves_what_moved_and_nothing_else(replay: Replay) -> None:
    tracks = clips(replay.static_html())
    moving = {path for path in tracks if path.startswith("/boxes/")}
    assert moving == {"/boxes/box_99"}
    for path, poses in (("/robot", replay.robot), ("/boxes/box_99", [b[-1] for b in replay.boxes])):
        position, turn = tracks[path][".position"], tracks[path][".quaternion"]
        for (t, p), (_, q), when, pose in zip(position, turn, replay.times_s, poses, strict=False):
            assert t == pytest.approx(when)
            assert p == pytest.approx([pose.x, pose.y, 0.0], abs=1e-3)
            assert math.cos(2 * math.atan2(q[2], q[3]) - pose.yaw) == pytest.approx(1.0, abs=1e-5)
    assert len(replay.robot) == 31  # 3 s at 10 Hz


def test_only_the_latest_plan_shows(replay: Replay) -> None:
    tracks = clips(replay.static_html())

    def shown(path: str, t: float) -> bool:
        return [value for when, value in tracks[path][".visible"] if when <= t + 1e-9][-1]

    assert [shown("/plan/0", t) for t in (0.0, 1.0, 2.0)] == [False, True, False]
    assert [shown("/plan/1", t) for t in (0.0, 1.0, 2.0)] == [False, False, True]
    assert [shown("/detected/0", t) for t in (0.5, 1.2)] == [False, True]


def test_everything_stands_where_it_is(replay: Replay) -> None:
    world = replay.world
    placed = {
        c["path"]: np.array(c["matrix"]).reshape(4, 4).T
        for c in commands(SceneView(world).static_html())
        if c["type"] == "set_transform"
    }
    for o in world.obstacles:
        m = placed[f"/{'boxes' if o.movable else 'fixed'}/{o.name}"]
        assert m[:3, 3] == pytest.approx([o.x, o.y, 0.0])
        assert math.atan2(m[1, 0], m[0, 0]) == pytest.approx(math.remainder(o.yaw, 2 * math.pi))
    assert placed["/robot"][:2, 3] == pytest.approx([world.start.x, world.start.y])
    assert placed["/marker/mat"][:2, 3] == pytest.approx([world.goal.x, world.goal.y])


def test_page_is_self_contained_small_and_repeats(replay: Replay, tmp_path: Path) -> None:
    path = replay.to_html(tmp_path / "run" / "replay.html", title="Seed 1 </title>")
    page = path.read_text(encoding="utf-8")
    assert page == replay.static_html(title="Seed 1 </title>")
    assert len(page) < 1_100_000
    assert not re.search(r"(src|href)\s*=\s*[\"']?https?:", page.split("<script>")[0] + page.rsplit("<script>", 1)[1])
    assert "<title>Seed 1 &lt;/title&gt;</title>" in page


def test_no_server_no_socket_no_process(replay: Replay, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: object, **kwargs: object) -> None:
        raise AssertionError("the view must not open sockets or start processes")

    monkeypatch.setattr(socket.socket, "bind", refuse)
    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(subprocess, "Popen", refuse)
    cell = replay._repr_html_()
    assert cell == replay.show().data
    inner = re.search(r'srcdoc="([^"]*)"', cell)
    assert inner
    assert html.unescape(inner[1]) == replay.static_html()
    assert "<iframe" in SceneView(replay.world)._repr_html_()


def test_bad_records_are_named(replay: Replay) -> None:
    fresh = Replay(replay.world)
    fresh.add_state(0.0, Pose2D(0.0, 0.0, 0.0))
    with pytest.raises(InputError, match="replay time"):
        fresh.add_state(0.0, Pose2D(0.0, 0.0, 0.0))
    with pytest.raises(InputError, match="replay boxes"):
        fresh.add_state(1.0, Pose2D(0.0, 0.0, 0.0), (Pose2D(0.0, 0.0, 0.0),))
    with pytest.raises(InputError, match="plan"):
        fresh.add_plan(0.0, [1.0, 2.0, 3.0])
    assert "set_animation" not in {c["type"] for c in commands(Replay(replay.world).static_html())}
    assert commands(fresh.static_html())  # one moment only is a page, too


def test_png_is_read_back_by_pillow() -> None:
    image = pytest.importorskip("PIL.Image")
    rgb = np.random.default_rng(0).integers(0, 255, (7, 5, 3), np.uint8)
    assert np.array_equal(np.asarray(image.open(io.BytesIO(png(rgb)))), rgb)


def test_topdown_figure(replay: Replay) -> None:
    import matplotlib.pyplot as plt

    world: World = replay.world
    way = np.array([[p.x, p.y] for p in replay.robot])
    ax = plot_topdown(world, way, plan=way[::5])
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x (m)", "y (m)")
    drawn = (
        {tuple(np.round(p.get_xy()[0], 6)) for p in ax.patches if hasattr(p, "get_xy") and p.get_xy().ndim == 2}
        if ax.patches
        else set()
    )
    for o in world.obstacles:
        assert tuple(np.round(o.corners()[0], 6)) in drawn
    assert np.allclose(ax.lines[-1].get_xydata(), way)
    labels = {text.get_text() for text in ax.get_legend().get_texts()}
    assert {"goal marker", "robot at start", "low box (camera only)", "driven path", "planned path"} <= labels
    plt.close(ax.figure)
    assert f"{sum(o.movable and o.height < 0.2 for o in world.obstacles)} x low box" in describe(world)


@pytest.mark.browser
def test_page_in_a_browser(replay: Replay, chromium: str, tmp_path: Path) -> None:
    """It draws the room, plays, asks for nothing from any network, and logs no error."""
    api = pytest.importorskip("playwright.sync_api")
    path = replay.to_html(tmp_path / "replay.html")
    asked, errors = [], []
    flags = [
        "--no-sandbox",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        "--disable-background-networking",
    ]
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=flags)
        page = browser.new_page(viewport={"width": 800, "height": 500})
        page.on("request", lambda request: asked.append(request.url))
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(path.as_uri())
        where = "JSON.stringify(viewer.scene_tree.find(['robot']).object.position)"
        first = page.evaluate(where)
        page.wait_for_function(f"{where} !== {json.dumps(first)}", timeout=20_000)
        shot = page.screenshot()
        browser.close()
    assert not errors
    assert all(url.startswith(("file:", "data:", "blob:")) for url in asked)
    image = pytest.importorskip("PIL.Image")
    pixels = np.asarray(image.open(io.BytesIO(shot)).convert("RGB")).reshape(-1, 3)
    assert len(np.unique(pixels // 16, axis=0)) > 30  # a picture, not a blank pane
