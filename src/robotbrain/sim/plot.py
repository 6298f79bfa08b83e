"""A top-down figure of a world and of paths in it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from robotbrain.figures import BLUE, GREEN, GREY, INK, MAUVE, VERMILLION
from robotbrain.sim.robot import CHASSIS_RADIUS, LIDAR_HEIGHT
from robotbrain.sim.world import MARKER_MAT_RADIUS, Obstacle, World

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Kinds also differ by hatching, so the figure works in grey.
_STYLE: dict[str, dict[str, Any]] = {
    "wall": {"facecolor": INK},
    "shelf or barrier": {"facecolor": GREY},
    "tall box": {"facecolor": "#B9DDF6", "hatch": "//"},
    "low box (camera only)": {"facecolor": "#FFF6B0", "hatch": "xx"},
}


def obstacle_label(o: Obstacle) -> str:
    """What an obstacle is to the robot, for legends; one of the keys of the figure's styles."""
    if not o.movable:
        return "wall" if o.kind == "wall" else "shelf or barrier"
    return "low box (camera only)" if o.height < LIDAR_HEIGHT else "tall box"


def plot_topdown(
    world: World,
    path: ArrayLike | None = None,
    ax: Axes | None = None,
    *,
    plan: ArrayLike | None = None,
    title: str | None = None,
) -> Axes:
    """Draw a world from above, in the world frame.

    Args:
        world: what to draw.
        path: driven way, (n, 2) (m), drawn solid.
        ax: axes to draw into; new ones by default.
        plan: planned way, (n, 2) (m), drawn dashed.
        title: of the axes; names the world by default.

    Returns:
        The axes; ``describe(world)`` gives alt text.
    """
    import matplotlib.pyplot as plt
    from matplotlib.patches import Circle, Polygon

    if ax is None:
        _, ax = plt.subplots(figsize=(6.0, 6.0), layout="constrained")
    seen: set[str] = set()
    for o in (*world.outer_walls, *world.obstacles):
        label = obstacle_label(o)
        shown = None if label in seen else label
        seen.add(label)
        ax.add_patch(Polygon([(x, y) for x, y in o.corners()], edgecolor="black", lw=0.6, label=shown, **_STYLE[label]))
    goal, start = world.goal, world.start
    ax.add_patch(Circle((goal.x, goal.y), MARKER_MAT_RADIUS, facecolor=MAUVE, edgecolor="black", label="goal marker"))
    ax.add_patch(Circle((start.x, start.y), CHASSIS_RADIUS, facecolor=GREEN, edgecolor="black", label="robot at start"))
    nose = CHASSIS_RADIUS * 2.0
    ax.plot([start.x, start.x + nose * np.cos(start.yaw)], [start.y, start.y + nose * np.sin(start.yaw)], "k-", lw=1.5)
    for points, colour, dashes, label in (
        (plan, BLUE, "--", "planned path"),
        (path, VERMILLION, "-", "driven path"),
    ):
        if points is not None:
            xy = np.asarray(points, float)
            ax.plot(xy[:, 0], xy[:, 1], lw=2.0, color=colour, ls=dashes, label=label)
    ax.set_aspect("equal")
    ax.set_xlim(-world.half_x - 0.2, world.half_x + 0.2)
    ax.set_ylim(-world.half_y - 0.2, world.half_y + 0.2)
    ax.set_xlabel("x (m)")
    ax.set_ylabel("y (m)")
    ax.set_title(title or f"World of seed {world.spec.seed}, difficulty {world.spec.difficulty:g}")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), ncol=3, fontsize="small", frameon=False)
    return ax


def describe(world: World) -> str:
    """One sentence about a world, for use as alt text."""
    counts: dict[str, int] = {}
    for o in world.obstacles:
        counts[obstacle_label(o)] = counts.get(obstacle_label(o), 0) + 1
    things = ", ".join(f"{n} x {label}" for label, n in sorted(counts.items())) or "nothing else"
    apart = np.hypot(world.goal.x - world.start.x, world.goal.y - world.start.y)
    return (
        f"Top view of a room of {2 * world.half_x:g} by {2 * world.half_y:g} m with the robot's start and the "
        f"goal marker {apart:.1f} m apart; in it: {things}."
    )
