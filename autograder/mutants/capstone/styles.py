"""Right solutions of `capstone`, written differently: each must earn every point."""

from __future__ import annotations

from robotbrain.grading.sample import Style

_COMPLEX = {
    "observe": """
import cmath
import math

def observe(pose, velocity, waypoint, points, last_action):
    # The plane as complex numbers.
    goal = complex(*waypoint) - complex(pose[0], pose[1])
    goal *= cmath.exp(-1j * pose[2])
    away = abs(goal)
    numbers = [float(v) for v in velocity]
    numbers += [goal.real / away, goal.imag / away, min(1.0, away / GOAL_RANGE)]
    for value in sector_ranges(points):
        value = min(max(float(value), LIDAR_NEAREST), LIDAR_RANGE)
        numbers.append(LIDAR_SCALE * math.log(value / LIDAR_NEAREST))
    return numbers + [float(v) for v in last_action]
""",
    "supervise": """
import math

class Supervisor:
    # A countdown instead of a time stamp; every doubt by itself.

    def __init__(self):
        self.trusted_from = None

    def known(self, age, limit):
        return not math.isnan(age) and age <= limit

    def doubts(self, health):
        if not self.known(health.image_age_s, 0.5):
            yield "image"
        for number in health.inputs:
            if not math.isfinite(number) or number > 2 or number < -2:
                yield "inputs"
        for number in health.action:
            if not math.isfinite(number):
                yield "action"

    def decide(self, health):
        lost = not self.known(health.scan_age_s, 0.5) or not self.known(health.pose_age_s, 0.5)
        blind = not self.known(health.image_age_s, 2.0)
        if lost or blind or any(self.doubts(health)):
            self.trusted_from = health.now_s + 1.0
            return "stop" if lost or blind else "pursuit"
        if self.trusted_from is not None and health.now_s - self.trusted_from < 0:
            return "pursuit"
        return "policy"
""",
    "integrate": """
NODES = ["perception", "estimator", "mapper", "planner", "mission", "controller"]
LAUNCH = Launch(executors=[[name] for name in NODES], precision="int8", camera_queue=1, replan_after=1.0)
BUDGET = dict(network=2.8, perception=60, planning=400, end_to_end=120)
""",
}

_DIJKSTRA = {
    "planner_costs": "pass",
    "planner_search": """
def steps(row, column):
    for dr in (-1, 0, 1):
        for dc in (-1, 0, 1):
            if dr or dc:
                yield row + dr, column + dc, dr and dc

def search(cost, start, goal):
    # Uniform costs but for the costmap, no heuristic, from the goal back: then the path comes out forwards.
    grid = cost.tolist()
    reached, towards, queue = {goal: 0.0}, {}, [(0.0, goal)]
    while queue:
        spent, here = heapq.heappop(queue)
        if here == start:
            path = [here]
            while path[-1] in towards:
                path.append(towards[path[-1]])
            return path
        if spent > reached[here]:
            continue
        row, column = here
        for r, c, diagonal in steps(row, column):
            if not (0 <= r < len(grid) and 0 <= c < len(grid[0])) or grid[r][c] == np.inf:
                continue
            if diagonal and np.inf in (grid[row][c], grid[r][column]):
                continue
            total = spent + (1.414213562 if diagonal else 1.0) * (grid[row][column] + grid[r][c]) / 2
            if total < reached.get((r, c), np.inf):
                reached[r, c], towards[r, c] = total, here
                heapq.heappush(queue, (total, (r, c)))
    return []
""",
    "planner": """
class GridPlanner(Node):
    def __init__(self):
        super().__init__("planner")
        self.cost = self.frame = None
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.create_subscription(OccupancyGrid, "map", self.on_map, latched)
        self.create_service(GetPlan, "plan", self.on_request)

    def on_map(self, msg):
        occupancy, self.frame = grid_from_msg(msg)
        walls = np.pad(occupancy >= 65, 1)
        away = ndimage.distance_transform_edt(~walls)[1:-1, 1:-1] * self.frame.resolution
        if not walls.any():
            away[:] = 10.0
        self.cost = np.where(away <= 0.24, np.inf, 1.0 + 10.0 * np.exp(-(away - 0.24) / 0.15))

    def on_request(self, request, response):
        if self.cost is None:
            return response
        a, b = request.start.pose.position, request.goal.pose.position
        size = self.frame.resolution
        begin = nearest_free(self.cost, self.frame.to_cell(a.x, a.y), int(0.5 / size))
        end = nearest_free(self.cost, self.frame.to_cell(b.x, b.y), int(request.tolerance / size))
        if begin is not None and end is not None:
            cells = search(self.cost, begin, end)
            if cells:
                response.plan = numpy_to_path(self.frame.to_points(cells))
        return response

MyPlanner = GridPlanner
""",
    "observe": """
def observe(pose, velocity, waypoint, points, last_action):
    c, s = np.cos(pose[2]), np.sin(pose[2])
    to_robot = np.array([[c, s], [-s, c]])
    goal = to_robot @ (np.array(waypoint, dtype=float) - np.array(pose[:2], dtype=float))
    shown = np.zeros(43)
    shown[0:2] = velocity
    angle = np.angle(goal[0] + 1j * goal[1])
    shown[2:5] = np.cos(angle), np.sin(angle), np.clip(np.linalg.norm(goal) / GOAL_RANGE, 0, 1)
    shown[5:41] = np.clip(LIDAR_SCALE * np.log(np.maximum(sector_ranges(points), LIDAR_NEAREST) / LIDAR_NEAREST), 0, 1)
    shown[41:] = last_action
    return shown
""",
    "integrate": """
LAUNCH = Launch(
    (("estimator",), ("perception",), ("planner", "mission", "mapper"), ("controller",)),
    precision="int8", replan_after=2,
)
BUDGET = {"end_to_end": 150, "planning": 500, "perception": 100, "network": 3.2}
""",
}

STYLES = [
    Style("complex-numbers", _COMPLEX, "complex numbers, a list of doubts, a process for each node"),
    Style("dijkstra-from-the-goal", _DIJKSTRA, "another planner without smoothing, matrices, other groups"),
]
