"""Named wrong solutions of `lab_integration`: each is a mistake that students make, and must lose its own points."""

from __future__ import annotations

from robotbrain.grading.sample import Mutant

MUTANTS = [
    Mutant(
        name="pixels-not-scaled",
        exercise="preprocess",
        hint="scale-pixels",
        describe="forgets to divide by 255",
        loses=5.0,
        replace={"preprocess": [("image.astype(np.float32) / 255.0", "image.astype(np.float32)")]},
    ),
    Mutant(
        name="reshaped-not-transposed",
        exercise="preprocess",
        hint="reshape-is-not-transpose",
        describe="reshapes to channels first instead of moving the axis",
        loses=5.0,
        replace={"preprocess": [("scaled.transpose(2, 0, 1)[None]", "scaled.reshape(1, 3, *image.shape[:2])")]},
    ),
    Mutant(
        name="float64-input",
        exercise="preprocess",
        hint="float32",
        describe="hands the network float64",
        loses=1.0,
        replace={"preprocess": [("dtype=np.float32)", "dtype=np.float64)")]},
    ),
    Mutant(
        name="left-is-right",
        exercise="back_project",
        hint="y-points-left",
        describe="takes the base frame's y to point right, like the image's u",
        replace={"back_project": [("camera.position[1] - x_c", "camera.position[1] + x_c")]},
    ),
    Mutant(
        name="pitch-ignored",
        exercise="back_project",
        hint="pitch-rotates",
        describe="treats the tilted camera as level",
        replace={"back_project": [("np.cos(camera.pitch), np.sin(camera.pitch)", "1.0, 0.0")]},
    ),
    Mutant(
        name="depth-as-range",
        exercise="back_project",
        hint="depth-is-not-range",
        describe="takes the depth for the length of the ray",
        replace={
            "back_project": [
                (
                    "    x_c = (columns",
                    "    z_c = z_c / np.sqrt(1 + ((columns - camera.cx) / camera.fx) ** 2"
                    " + ((rows - camera.cy) / camera.fy) ** 2)\n    x_c = (columns",
                )
            ]
        },
    ),
    Mutant(
        name="period-in-seconds",
        exercise="deadline",
        hint="milliseconds",
        describe="subtracts milliseconds from seconds",
        loses=4.0,
        replace={"deadline_slack_ms": [("1000.0 / rate_hz", "1.0 / rate_hz")]},
    ),
    Mutant(
        name="inference-only",
        exercise="deadline",
        hint="both-costs",
        describe="forgets the CPU time",
        loses=4.0,
        replace={"deadline_slack_ms": [(' - profile.callback_ms["perception"]', "")]},
    ),
    Mutant(
        name="radius-in-cells",
        exercise="inflate",
        hint="cells-or-metres",
        describe="compares a distance in cells with a radius in metres",
        replace={"inflate": [(", sampling=resolution", "")]},
    ),
    Mutant(
        name="unknown-is-free",
        exercise="inflate",
        hint="unknown-costs-more",
        describe="treats cells that nobody has seen like seen floor",
        replace={"inflate": [("    cost[occupancy == -1] += 2.0\n", "")]},
    ),
    Mutant(
        name="no-lethal-zone",
        exercise="inflate",
        hint="lethal-radius",
        describe="raises the cost near obstacles but forbids nothing",
        replace={"inflate": [("        cost[distance <= radius] = np.inf\n", "")]},
    ),
    Mutant(
        name="diagonal-costs-one",
        exercise="astar",
        hint="diagonal-cost",
        describe="counts every step as one",
        replace={"astar": [("(dr * dr + dc * dc) ** 0.5 * (cost", "1.0 * (cost")]},
    ),
    Mutant(
        name="manhattan-heuristic",
        exercise="astar",
        hint="admissible-heuristic",
        describe="uses a heuristic that overestimates",
        replace={"astar": [("return max(dr, dc) + (2**0.5 - 1) * min(dr, dc)", "return 2.0 * (dr + dc)")]},
    ),
    Mutant(
        name="cuts-corners",
        exercise="astar",
        hint="corner-cutting",
        describe="allows diagonal steps between two obstacles",
        replace={"astar": [("            if dr and dc and (", "            if False and (")]},
    ),
    Mutant(
        name="ignores-costs",
        exercise="astar",
        hint="use-the-costs",
        describe="finds the shortest path instead of the cheapest",
        replace={"astar": [("(cost[cell] + cost[other]) / 2", "1.0")]},
    ),
    Mutant(
        name="stops-when-first-seen",
        exercise="astar",
        hint="expand-by-f",
        describe="returns as soon as the goal is seen, not when it is taken off the queue",
        replace={
            "astar": [
                (
                    "                best[other], parent[other] = total, cell\n",
                    "                best[other], parent[other] = total, cell\n"
                    "                if other == goal:\n"
                    "                    queue, closed, best[goal] = [(-1.0, goal)], set(), total\n"
                    "                    continue\n",
                )
            ]
        },
    ),
    Mutant(
        name="never-gives-up",
        exercise="astar",
        hint="no-route",
        describe="returns an empty list where there is no route",
        replace={
            "astar": [
                (
                    "heappush(queue, (total + bound(other), other))\n    return None",
                    "heappush(queue, (total + bound(other), other))\n    return []",
                )
            ]
        },
    ),
    Mutant(
        name="shortcut-through-walls",
        exercise="smooth",
        hint="lethal-shortcut",
        describe="checks only the ends of a segment",
        replace={
            "smooth": [
                (
                    "if segment_cost(cost, path[here], path[candidate]) <= slack * stretch + 1e-9:",
                    "if np.isfinite(cost[path[here]]) and np.isfinite(cost[path[candidate]]):",
                )
            ]
        },
    ),
    Mutant(
        name="hugs-corners",
        exercise="smooth",
        hint="keep-the-distance",
        describe="takes any segment free of collisions, however dear",
        replace={"smooth": [("<= slack * stretch + 1e-9", "< np.inf")]},
    ),
    Mutant(
        name="newest-pose",
        exercise="goal_tracker",
        hint="pose-at-stamp",
        describe="places an old sighting with the newest pose",
        replace={"goal_tracker": [("self.poses.at(stamp_ns)", "self.poses.latest()")]},
    ),
    Mutant(
        name="not-rotated",
        exercise="goal_tracker",
        hint="rotate-then-add",
        describe="adds a position in the base frame to one in the map frame",
        replace={"goal_tracker": [("np.cos(yaw), np.sin(yaw)", "1.0, 0.0")]},
    ),
    Mutant(
        name="rows-and-columns-swapped",
        exercise="planner_node",
        hint="row-is-y",
        describe="builds the path from (column, row)",
        replace={
            "planner_node": [
                (
                    "points = frame.to_points(smooth(path, cost))",
                    "points = frame.to_points(np.array(smooth(path, cost))[:, ::-1])",
                )
            ]
        },
    ),
    Mutant(
        name="response-not-returned",
        exercise="planner_node",
        hint="return-response",
        describe="fills the response but does not return it",
        replace={
            "planner_node": [
                (
                    "            response.plan = numpy_to_path(points)\n        return response",
                    "            response.plan = numpy_to_path(points)",
                )
            ]
        },
    ),
    Mutant(
        name="tolerance-ignored",
        exercise="planner_node",
        hint="off-the-map",
        describe="ends anywhere near a blocked goal, however far",
        replace={"planner_node": [("int(request.tolerance / frame.resolution)", "200")]},
    ),
    Mutant(
        name="point-robot",
        exercise="planner_node",
        hint="robot-has-a-radius",
        describe="plans for a robot without a radius",
        replace={
            "planner_node": [
                ("inflate(occupancy, frame.resolution)", "inflate(occupancy, frame.resolution, radius=0.0)")
            ]
        },
    ),
    Mutant(
        name="wald-interval",
        exercise="evaluate",
        hint="wilson-not-wald",
        describe="gives the textbook interval, which is a point after 12 of 12",
        replace={
            "evaluate": [
                ("    centre = rate + z**2 / (2 * n)", "    centre = rate"),
                ("np.sqrt(rate * (1 - rate) / n + z**2 / (4 * n**2))", "np.sqrt(rate * (1 - rate) / n)"),
                ("    scale = 1 + z**2 / n", "    scale = 1.0"),
            ]
        },
    ),
    Mutant(
        name="mean-of-percentiles",
        exercise="evaluate",
        hint="pool-latencies",
        describe="averages the runs' percentiles",
        replace={
            "evaluate": [
                (
                    "float(np.percentile(latencies, 95))",
                    "float(np.mean([np.percentile(run.perception_ms, 95) for run in runs]))",
                )
            ]
        },
    ),
    Mutant(
        name="unpaired",
        exercise="gap",
        hint="pairs",
        describe="throws the pairing away",
        loses=8.0,
        replace={
            "paired_gap": [
                (
                    "half = stats.t.ppf(0.975, n - 1) * differences.std(ddof=1) / np.sqrt(n)",
                    "half = stats.t.ppf(0.975, n - 1) * np.sqrt((np.var(simulated, ddof=1) + np.var(surrogate, ddof=1)) / n)",
                )
            ]
        },
    ),
    Mutant(
        name="normal-quantile",
        exercise="gap",
        hint="t-not-z",
        describe="uses 1.96 with a handful of pairs",
        loses=8.0,
        replace={"paired_gap": [("stats.t.ppf(0.975, n - 1)", "1.96")]},
    ),
]
