"""Named wrong solutions of `hw3_performance`: each is a mistake that students make, and must lose its own points."""

from __future__ import annotations

from robotbrain.grading.sample import Mutant

MUTANTS = [
    Mutant(
        name="nanoseconds-as-ms",
        exercise="ages",
        hint="ns-to-ms",
        describe="divides nanoseconds by 1000",
        replace={"ages": [("(command.released_ns - known[-1]) / 1e6", "(command.released_ns - known[-1]) / 1e3")]},
    ),
    Mutant(
        name="callback-time",
        exercise="ages",
        hint="callback-is-not-latency",
        describe="reports how long the controller's callback took instead of how old its image is",
        replace={
            "ages": [
                (
                    "(command.released_ns - known[-1]) / 1e6",
                    "(trace.sender[command.id].end_ns - trace.sender[command.id].start_ns) / 1e6",
                )
            ]
        },
    ),
    Mutant(
        name="sent-not-taken",
        exercise="ages",
        hint="stamp-is-the-truth",
        describe="measures from when perception sent its points, not from when the image was taken",
        replace={
            "ages": [
                (
                    "(c.end_ns, trace.stamps[c.message]) for c",
                    "(c.end_ns, trace.message_by_id[c.message].released_ns) for c",
                )
            ]
        },
    ),
    Mutant(
        name="mean-plus-sigma",
        exercise="ages",
        hint="percentile-not-mean",
        describe="takes the 95th percentile for mean plus 1.645 standard deviations",
        replace={
            "ages": [
                (
                    "p50, p95, p99 = np.percentile(ages_ms, [50, 95, 99])",
                    "p50, p95, p99 = (np.mean(ages_ms) + z * np.std(ages_ms) for z in (0, 1.645, 2.326))",
                )
            ]
        },
    ),
    Mutant(
        name="nothing-is-zero",
        exercise="ages",
        hint="nothing-is-nan",
        describe="says 0 ms where there was nothing to measure",
        loses=1.0,
        replace={
            "ages": [
                ('"p50": float("nan"), "p95": float("nan"), "p99": float("nan")', '"p50": 0.0, "p95": 0.0, "p99": 0.0')
            ]
        },
    ),
    Mutant(
        name="waiting-forgotten",
        exercise="deadlines",
        hint="from-ready-on",
        describe="lets the deadline run from the callback's start",
        replace={
            "deadlines": [
                ("ended = {c.message: c.end_ns for c", "ended = {c.message: (c.end_ns - c.start_ns) for c"),
                ("ended[message.id] > deadline", "ended[message.id] > deadline_ms * 1e6"),
            ]
        },
    ),
    Mutant(
        name="lost-ignored",
        exercise="deadlines",
        hint="lost-is-late",
        describe="counts callbacks, so that dropped and stuck messages do not exist",
        replace={
            "deadlines": [
                (
                    "if message.name != topic or deadline > trace.end_ns:",
                    "if message.name != topic or deadline > trace.end_ns or message.id not in ended:",
                )
            ]
        },
    ),
    Mutant(
        name="not-due-counted",
        exercise="deadlines",
        hint="not-due-yet",
        describe="counts messages as missed whose deadline is still to come",
        replace={"deadlines": [("if message.name != topic or deadline > trace.end_ns:", "if message.name != topic:")]},
    ),
    Mutant(
        name="spread-of-timestamps",
        exercise="rhythm",
        hint="spread-of-intervals",
        describe="takes the standard deviation of the time stamps for jitter",
        replace={"rhythm": [("float(np.std(intervals))", "float(np.std(starts)) / 1e6")]},
    ),
    Mutant(
        name="drift-per-period",
        exercise="rhythm",
        hint="drift-per-second",
        describe="gives the drift per interval instead of per second",
        replace={"rhythm": [("1000 * (np.mean(intervals) / period_ms - 1)", "np.mean(intervals) - period_ms")]},
    ),
    Mutant(
        name="cores-forgotten",
        exercise="utilisation",
        hint="all-the-cores",
        describe="does not divide by the number of cores",
        replace={"utilisation": [("ns / (length * trace.capacity[resource])", "ns / length")]},
    ),
    Mutant(
        name="waiting-is-cpu",
        exercise="utilisation",
        hint="waiting-is-not-busy",
        describe="counts the wait for the GPU as CPU time",
        replace={
            "utilisation": [
                (
                    "            resources[resource] += ns / (length * trace.capacity[resource])",
                    "            resources[resource] += (ns if resource != 'cpu' else 0) / (length * trace.capacity[resource])\n"
                    "        resources['cpu'] += (callback.end_ns - callback.start_ns) / (length * trace.capacity['cpu'])",
                )
            ]
        },
    ),
    Mutant(
        name="thread-without-waits",
        exercise="utilisation",
        hint="thread-is-held",
        describe="counts a thread as free while its callback waits for the GPU",
        replace={
            "utilisation": [
                (
                    "(callback.end_ns - callback.start_ns) / length",
                    "sum(ns for r, ns in callback.segments if r == 'cpu') / length",
                )
            ]
        },
    ),
    Mutant(
        name="stops-at-the-timer",
        exercise="chain",
        hint="timers-have-inputs",
        describe="ends the chain at the controller's timer, because no message set it off",
        replace={"chain": [("            if not inputs:\n", "            if True:\n")]},
    ),
    Mutant(
        name="first-input",
        exercise="chain",
        hint="newest-input",
        describe="follows the first input instead of the newest",
        replace={"chain": [("callback = inputs[-1]", "callback = inputs[0]")]},
    ),
    Mutant(
        name="queueing-only",
        exercise="chain",
        hint="holding-is-waiting",
        describe="counts a callback's own queueing only: time between the links gets lost",
        replace={"chain": [("(b.start_ns - a.end_ns) / 1e6", "b.queued_ns / 1e6")]},
    ),
    Mutant(
        name="longest-callback",
        exercise="bottleneck",
        hint="long-is-not-full",
        describe="names the node with the longest mean callback",
        replace={
            "bottleneck": """
def find_bottleneck(trace):
    times, asked = defaultdict(list), defaultdict(int)
    for callback in trace.callbacks:
        role = trace.roles.get(callback.node, callback.node)
        times[role].append(callback.end_ns - callback.start_ns)
        for resource, ns in callback.segments:
            asked[role, resource] += ns
    role = max(times, key=lambda r: np.mean(times[r]))
    return role, "gpu" if asked[role, "gpu"] > asked[role, "cpu"] else "cpu"
"""
        },
    ),
    Mutant(
        name="most-frequent-callback",
        exercise="bottleneck",
        hint="often-is-not-full",
        describe="names the node whose callbacks come most often",
        replace={
            "bottleneck": """
def find_bottleneck(trace):
    count, asked = defaultdict(int), defaultdict(int)
    for callback in trace.callbacks:
        role = trace.roles.get(callback.node, callback.node)
        count[role] += 1
        for resource, ns in callback.segments:
            asked[role, resource] += ns
    role = max(count, key=count.get)
    return role, "gpu" if asked[role, "gpu"] > asked[role, "cpu"] else "cpu"
"""
        },
    ),
    Mutant(
        name="busiest-resource",
        exercise="bottleneck",
        hint="thread-is-held",
        describe="calls a thread free while it waits for the GPU, and finds nothing saturated",
        replace={
            "bottleneck": [
                (
                    "+= callback.end_ns - callback.start_ns\n    thread",
                    "+= sum(ns for r, ns in callback.segments if r == 'cpu')\n    thread",
                )
            ]
        },
    ),
    Mutant(
        name="never-sharing",
        exercise="bottleneck",
        hint="sharing-or-not",
        describe="blames the largest of many equal shares",
        replace={"bottleneck": [("if by_role[role] < 2 / 3 * held[thread]:", "if False:")]},
    ),
    Mutant(
        name="pipeline-by-the-sum",
        exercise="gain",
        hint="slowest-stage",
        describe="takes the gain in latency for that in throughput",
        replace={"gain": [("pace if pipelined else latency}", "latency}")]},
    ),
    Mutant(
        name="after-over-before",
        exercise="gain",
        hint="before-over-after",
        describe="returns ratios upside down",
        loses=6.0,
        replace={
            "gain": [
                ("sum(stages.values()) / sum(after.values())", "sum(after.values()) / sum(stages.values())"),
                ("max(stages.values()) / max(after.values())", "max(after.values()) / max(stages.values())"),
            ]
        },
    ),
    Mutant(
        name="gains-added",
        exercise="gain",
        hint="gains-do-not-add",
        describe="adds the speed-ups of the stages",
        loses=6.0,
        replace={"gain": [("latency = sum(stages.values()) / sum(after.values())", "latency = sum(change.values())")]},
    ),
    Mutant(
        name="everything-faster",
        exercise="prediction",
        hint="amdahl",
        describe="divides the whole time by the factor, not only the part that gets faster",
        loses=4.0,
        replace={
            "prediction": [
                (
                    "callback.end_ns - callback.start_ns - spent + spent / factor",
                    "(callback.end_ns - callback.start_ns) / factor",
                )
            ]
        },
    ),
    Mutant(
        name="never-looks-again",
        exercise="planner",
        hint="check-the-rest",
        describe="reuses the path without a look at the newest map, through a new obstacle",
        replace={"planner": [("if points is None or not is_free(points, occupancy, frame):", "if points is None:")]},
    ),
    Mutant(
        name="goal-ignored",
        exercise="planner",
        hint="goal-moved",
        describe="reuses the path although the goal has moved",
        loses=1.0,
        replace={
            "planner": [
                (
                    "if self.path is not None and np.hypot(goal[0] - self.goal[0], goal[1] - self.goal[1]) <= 0.1:",
                    "if self.path is not None:",
                )
            ]
        },
    ),
    Mutant(
        name="from-the-start-again",
        exercise="planner",
        hint="from-the-robot-on",
        describe="answers with the whole old path, from where the robot was then",
        replace={"planner_parts": [("return path[nearest:] if", "return path if")]},
    ),
    Mutant(
        name="never-reuses",
        exercise="planner",
        hint="same-path",
        describe="plans anew each time",
        replace={"planner": [("points = rest_of_path(self.path, start)", "points = None")]},
    ),
    Mutant(
        name="works-for-free",
        exercise="planner",
        hint="charge-the-search",
        describe="charges nothing",
        loses=2.0,
        replace={
            "planner": [
                ('        charge_work("map_read", occupancy.size)\n', ""),
                ('        charge_work("costmap", result.cells)\n', ""),
                ('        charge_work("astar", result.expanded)\n', ""),
                ('        charge_work("smooth", result.path_cells)\n', ""),
            ],
            "planner_parts": [('    charge_work("costmap", window.size)\n', "")],
        },
    ),
    Mutant(
        name="whole-path-checked",
        exercise="planner",
        hint="behind-does-not-matter",
        describe="gives a path up for an obstacle behind the robot",
        loses=1.0,
        replace={"planner": [("not is_free(points, occupancy, frame)", "not is_free(self.path, occupancy, frame)")]},
    ),
    Mutant(
        name="response-not-returned",
        exercise="planner",
        hint="return-response",
        describe="fills the response but does not return it",
        replace={
            "planner": [
                (
                    "            response.plan = numpy_to_path(points)\n        return response",
                    "            response.plan = numpy_to_path(points)",
                )
            ]
        },
    ),
    Mutant(
        name="never-lost",
        exercise="planner",
        hint="lost-the-path",
        describe="keeps to the old path however far the robot is from it",
        loses=1.0,
        replace={
            "planner_parts": [("if distances[nearest] <= 0.3 else None", "if distances[nearest] <= 30 else None")]
        },
    ),
    Mutant(
        name="quantised-only",
        exercise="repair",
        hint="measure-again",
        describe="cures what everybody cures first, the network's precision, and nothing else",
        loses=6.0,
        replace={
            "repair": [
                ("image_size=(640, 480), precision=", "precision="),
                (", camera_queue=1, one_thread=False", ""),
            ]
        },
    ),
    Mutant(
        name="image-too-small",
        exercise="repair",
        hint="keep-requirements",
        describe="lowers the resolution below the requirement",
        loses=1.0,
        replace={"repair": [("image_size=(640, 480)", "image_size=(320, 240)")]},
    ),
    Mutant(
        name="bigger-module",
        exercise="repair",
        hint="keep-requirements",
        describe="buys a bigger module",
        replace={
            "repair": [
                (
                    "replace(setup, deployment=deployment",
                    'replace(setup, module="agx-orin-64gb:MAXN", deployment=deployment',
                )
            ]
        },
    ),
    Mutant(
        name="one-thread-kept",
        exercise="repair",
        hint="measure-again",
        describe="stops after the first cures: good enough on one module only",
        loses=2.0,
        replace={"repair": [("camera_queue=1, one_thread=False", "camera_queue=1")]},
    ),
    Mutant(
        name="upside-down",
        exercise="validate",
        hint="before-over-after",
        describe="divides after by before",
        replace={"validate": [("else old / new)", "else new / old)")]},
    ),
    Mutant(
        name="dead-run-is-nan",
        exercise="validate",
        hint="no-run-is-inf",
        describe="lets a run that never acted turn the whole comparison into NaN",
        loses=2.0,
        replace={"validate": [("if len(run.e2e_ms) else np.inf", "if len(run.e2e_ms) else np.nan")]},
    ),
    Mutant(
        name="survivors-only",
        exercise="validate",
        hint="survivorship",
        describe="leaves the worlds out in which a run failed",
        replace={
            "validate": [
                ("    for run in before:\n", "    for run in [r for r in before if r.success]:\n"),
            ]
        },
    ),
    Mutant(
        name="pairs-by-position",
        exercise="validate",
        hint="pair-by-world",
        describe="pairs the runs by their place in the lists",
        loses=1.0,
        replace={
            "validate": [
                ("    later = {run.seed: p95(run) for run in after}\n", "    later = [p95(run) for run in after]\n"),
                ("    for run in before:\n", "    for place, run in enumerate(before):\n"),
                ("later[run.seed]\n", "later[place]\n"),
            ]
        },
    ),
    Mutant(
        name="ratio-of-means",
        exercise="validate",
        hint="ratio-of-pairs",
        describe="divides the mean before by the mean after, unpaired",
        replace={
            "validate": [
                (
                    '"speedup": float(np.median(ratios))',
                    '"speedup": float(np.mean([p95(r) for r in before]) / np.mean([p95(r) for r in after]))',
                )
            ]
        },
    ),
    Mutant(
        name="interval-ignored",
        exercise="validate",
        hint="interval-decides",
        describe="accepts whatever is faster in the median",
        loses=2.0,
        replace={"validate": [("low > 1 and", "np.median(ratios) > 1 and")]},
    ),
    Mutant(
        name="no-failure-seen",
        exercise="validate",
        hint="not-worse",
        describe="takes the absence of failures in a few runs for a proof",
        loses=2.0,
        replace={"validate": [("rates[1][1] >= rates[0][0] - 0.1", "rates[1][0] >= rates[0][0] - 0.1")]},
    ),
    Mutant(
        name="wald-interval",
        exercise="validate",
        hint="wilson-not-wald",
        describe="gives the textbook interval, which is a point after 8 of 8",
        replace={
            "validate": [
                ("    centre = rate + z**2 / (2 * n)\n", "    centre = rate * (1 + z**2 / n)\n"),
                (
                    "half = z * np.sqrt(rate * (1 - rate) / n + z**2 / (4 * n**2))",
                    "half = z * np.sqrt(rate * (1 - rate) / n) * (1 + z**2 / n)",
                ),
            ]
        },
    ),
]
