"""Right solutions of `lab_integration`, written differently: each must earn every point."""

from __future__ import annotations

from robotbrain.grading.sample import Style

_LOOPS = {
    "preprocess": """
def preprocess(image):
    height, width, channels = image.shape
    out = np.zeros((1, channels, height, width), dtype=np.float32)
    for channel in range(channels):
        for row in range(height):
            for column in range(width):
                out[0, channel, row, column] = (image[row, column, channel] / 255 - 0.45) / 0.25
    return out
""",
    "back_project": """
import math

def back_project(depth, camera):
    points = np.zeros(depth.shape + (3,))
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            z = float(depth[row, column])
            if not math.isfinite(z):
                points[row, column] = math.nan
                continue
            right = (column - camera.cx) * z / camera.fx
            down = (row - camera.cy) * z / camera.fy
            ahead = z * math.cos(camera.pitch) - down * math.sin(camera.pitch)
            up = -z * math.sin(camera.pitch) - down * math.cos(camera.pitch)
            px, py, pz = camera.position
            points[row, column] = (px + ahead, py - right, pz + up)
    return points
""",
    "deadline_slack_ms": """
def deadline_slack_ms(profile, rate_hz):
    busy_s = (profile.segmentation_ms + profile.callback_ms["perception"]) / 1e3
    return (1 / rate_hz - busy_s) * 1e3
""",
    "inflate": """
from scipy.spatial import cKDTree

def inflate(occupancy, resolution, radius=0.22, decay=0.12, weight=12.0):
    rows, columns = occupancy.shape
    walls = [(r, c) for r in range(rows) for c in range(columns) if occupancy[r, c] >= 65]
    walls = np.array(walls, dtype=float).reshape(-1, 2)
    cost = np.ones((rows, columns))
    if len(walls):
        distance, _ = cKDTree(walls).query(np.argwhere(np.ones((rows, columns))))
        distance = distance.reshape(rows, columns)
    for r in range(rows):
        for c in range(columns):
            if len(walls):
                d = resolution * distance[r, c]
                cost[r, c] = np.inf if d <= radius else 1 + weight * np.exp((radius - d) / decay)
            if occupancy[r, c] < 0:
                cost[r, c] += 2
    return cost
""",
}

_DIJKSTRA = {
    # A heuristic of zero is admissible: slower, but as right.
    "astar": """
from heapq import heappop, heappush

def astar(cost, start, goal):
    distance = np.full(cost.shape, np.inf)
    previous = {}
    distance[start] = 0
    heap = [(0.0, start)]
    while heap:
        d, (r, c) = heappop(heap)
        if d > distance[r, c]:
            continue
        if (r, c) == tuple(goal):
            break
        for dr, dc in [(0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)]:
            a, b = r + dr, c + dc
            if a < 0 or b < 0 or a >= cost.shape[0] or b >= cost.shape[1]:
                continue
            if not np.isfinite([cost[r, c], cost[a, b], cost[r, b], cost[a, c]]).all() and dr and dc:
                continue
            new = d + np.hypot(dr, dc) * 0.5 * (cost[r, c] + cost[a, b])
            if np.isfinite(new) and new < distance[a, b]:
                distance[a, b] = new
                previous[a, b] = (r, c)
                heappush(heap, (new, (a, b)))
    if not np.isfinite(distance[goal]):
        return None
    route = [tuple(goal)]
    while route[-1] != tuple(start):
        route.append(previous[route[-1]])
    route.reverse()
    return route
""",
    "smooth": """
def smooth(path, cost, slack=1.05):
    result, i = [path[0]], 0
    while i < len(path) - 1:
        j = len(path) - 1
        while j > i + 1 and segment_cost(cost, path[i], path[j]) > slack * path_cost(cost, path[i:j + 1]) + 1e-9:
            j -= 1
        result.append(path[j])
        i = j
    return result

from robotbrain.pipeline.planning import path_cost, segment_cost
""",
}

_COMPACT = {
    "preprocess": '''
import torch

def preprocess(image):
    """By way of torch, like most code that students find."""
    tensor = torch.from_numpy(image.copy()).permute(2, 0, 1).unsqueeze(0).float().div(255)
    return tensor.sub(0.45).div(0.25).numpy()
''',
    "goal_tracker": '''
import bisect

class GoalTracker:
    """Without PoseBuffer, with complex numbers."""

    def __init__(self):
        self.stamps, self.where, self.heading, self.sum, self.n = [], [], [], 0j, 0

    def add_pose(self, stamp_ns, pose):
        self.stamps.append(stamp_ns)
        self.where.append(complex(pose[0], pose[1]))
        self.heading.append(np.exp(1j * pose[2]))

    def add_sighting(self, stamp_ns, point):
        k = bisect.bisect_left(self.stamps, stamp_ns)
        if not self.stamps or stamp_ns < self.stamps[0] or stamp_ns > self.stamps[-1] + 60_000_000:
            return
        if len(self.stamps) == 1:
            self.stamps, self.where, self.heading = 2 * self.stamps, 2 * self.where, 2 * self.heading
        k = min(max(k, 1), len(self.stamps) - 1)
        a, b = self.stamps[k - 1], self.stamps[k]
        f = min((stamp_ns - a) / max(b - a, 1), 1.0)
        turn = np.angle(self.heading[k] / self.heading[k - 1])
        heading = self.heading[k - 1] * np.exp(1j * f * turn)
        where = self.where[k - 1] + f * (self.where[k] - self.where[k - 1])
        self.sum += where + heading * complex(*point)
        self.n += 1

    def goal(self):
        return None if self.n < 3 else ((self.sum / self.n).real, (self.sum / self.n).imag)
''',
    "evaluate": """
from scipy.stats import binomtest

def evaluate(drive, seeds):
    results = list(map(drive, seeds))
    k = sum(1 for r in results if r.success)
    ci = binomtest(k, len(results)).proportion_ci(0.95, method="wilson")
    every = [ms for r in results for ms in r.perception_ms]
    return dict(success_rate=k / len(results), interval=(ci.low, ci.high), p95_ms=np.quantile(every, 0.95))
""",
    "paired_gap": """
from scipy.stats import ttest_rel

def paired_gap(simulated, surrogate):
    test = ttest_rel(surrogate, simulated)
    low, high = test.confidence_interval(0.95)
    return sum(np.subtract(surrogate, simulated)) / len(simulated), low, high
""",
}

STYLES = [
    Style("plain-loops", _LOOPS, "a beginner's loops instead of array operations"),
    Style("dijkstra", _DIJKSTRA, "a zero heuristic, and the smoother the other way round"),
    Style("libraries", _COMPACT, "torch, complex numbers and SciPy's own statistics"),
]
