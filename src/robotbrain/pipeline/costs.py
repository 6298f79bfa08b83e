"""What the brain's callbacks cost on a Jetson: its nodes count their work, a profile turns it into time.

The kit's nodes say what they did in units (``charge_work("astar", cells)``), so the cost follows the work: a longer
search takes longer, a cluttered room makes the controller slower. The kinds of work are listed here; what a unit of
each takes was timed by ``benchmarks/cpu_work.py`` and is scaled to the module by a published single-thread benchmark.
These are nodes in Python and NumPy, as a student writes them: the same brain in C++ would be a good deal faster.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING

from robotbrain.jetson.work import MIDDLEWARE

if TYPE_CHECKING:
    from robotbrain.jetson.profiles import JetsonProfile

KINDS: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        "message_in": ("byte", "any brain node: a message taken off the wire (CDR) and handed to its callback"),
        "message_out": ("byte", "any brain node: a message checked and put on the wire (CDR)"),
        "preprocess": ("pixel", "perception: image message to the network's normalised input"),
        "decode": ("pixel", "perception: class scores to class ids"),
        "back_project": ("pixel", "perception: depth image to points in the base frame"),
        "label_points": ("pixel", "perception: floor and obstacle points, marker, messages filled in"),
        "pose": ("message", "mapper, mission, controller: a pose of the odometry stored by its stamp"),
        "wheel_update": ("update", "estimator: Kalman prediction, standstill update, odometry message filled in"),
        "scan_match": ("neighbour", "estimator: ICP, points times iterations, and the Kalman update"),
        "keyframe": ("point", "estimator: look for a near keyframe; points of the tree rebuilt with a new one"),
        "map_scan": ("point", "mapper: points along the beams of a scan written into the lidar's log-odds grid"),
        "map_points": ("point", "mapper: camera points written into the camera's log-odds grid"),
        "map_render": ("cell", "mapper: log-odds grid to occupancy message"),
        "map_read": ("cell", "planner, mission: occupancy message to grid"),
        "costmap": ("cell", "planner: crop, inflate, set the search up"),
        "astar": ("cell expanded", "planner: A* search"),
        "smooth": ("cell of the path", "planner: straighten and resample the path"),
        "view": ("cell", "mission: cells along the camera's rays marked as viewed"),
        "explore": ("cell", "mission: search for the next place to look at"),
        "near_points": ("ray", "controller: scan to obstacle points"),
        "thin_out": ("point", "controller: camera points thinned out"),
        "obstacles": ("point", "controller: remembered obstacle points into the robot's frame"),
        "arcs": ("arc", "controller: pure pursuit; arcs and stops checked for obstacles"),
        "distances": ("distance", "controller: distances from positions along these arcs to obstacle points"),
    }
)
"""Kinds of CPU work: the unit counted, and what it stands for."""

SCALES_WITH: Mapping[str, str] = MappingProxyType(
    {
        **dict.fromkeys(("preprocess", "decode", "back_project", "label_points", "thin_out", "map_points"), "image"),
        **dict.fromkeys(("near_points", "scan_match", "keyframe", "map_scan"), "scan"),
    }
)
"""Kinds of work whose units are in proportion to the pixels of an image or the beams of a scan."""

CALLBACKS: Mapping[str, tuple[str, str, str]] = MappingProxyType(
    {
        "perception": ("perception", "subscription", "/camera/image"),
        "estimator_scan": ("estimator", "subscription", "/scan"),
        "estimator_wheels": ("estimator", "subscription", "/joint_states"),
        # Scans and points wait for the odometry of their time, so that is the callback in which they are mapped.
        "mapper": ("mapper", "subscription", "/odometry/filtered"),
        "mapper_publish": ("mapper", "timer", ""),
        "planner": ("planner", "service", "/plan"),
        "mission": ("mission", "timer", ""),
        "controller": ("controller", "timer", ""),
        "controller_scan": ("controller", "subscription", "/scan"),
        "controller_points": ("controller", "subscription", "/perception/points"),
    }
)
"""Callbacks whose typical cost is recorded, by short name: (role, kind, topic or service; empty for a timer)."""


class ProfileCosts:
    """Cost model of ``robotbrain.ros`` for a brain on a Jetson.

    Nodes pay once they are assigned a role; others (the robot itself) are free. Every message that a brain node takes
    or sends costs the middleware's work. A callback of a node that is not the kit's and charges nothing itself pays
    what the reference's callback in that place takes on average.

    Args:
        profile: turns work into ns.
        scales: how many times more work in ``image`` and ``scan`` is charged than is done (Deployment.scales).
    """

    def __init__(self, profile: JetsonProfile, scales: Mapping[str, float] | None = None) -> None:
        self._profile = profile
        self._kinds: dict[str, tuple[float, float]] = {}
        for name in profile.work.kinds:
            call, unit = profile.work_cost(name)
            self._kinds[name] = (call, unit * (scales or {}).get(SCALES_WITH.get(name, ""), 1.0))
        self._typical = {
            (found.role, found.kind, found.topic): round(
                sum(
                    calls * self._kinds[kind][0] + units * self._kinds[kind][1]
                    for kind, (calls, units) in found.work.items()
                    if kind not in MIDDLEWARE
                )
            )
            for found in profile.work.callbacks.values()
        }
        self._roles: dict[str, str] = {}
        self._foreign: set[str] = set()

    def assign(self, node_name: str, role: str, *, foreign: bool = False) -> None:
        """Say which role the node of this fully qualified name plays, and whether it is somebody else's code."""
        self._roles[node_name] = role
        if foreign:
            self._foreign.add(node_name)

    @property
    def roles(self) -> dict[str, str]:
        """Roles by fully qualified node name."""
        return dict(self._roles)

    def role(self, node_name: str) -> str:
        """Return a node's role, empty for none."""
        return self._roles.get(node_name, "")

    def cost(self, node_name: str, kind: str, name: str) -> int:
        """Return 0: nothing costs the same every time."""
        return 0

    def work_ns(self, kind: str, units: float) -> int:
        """Return the time of one call of work on the profile's module, ns.

        Raises:
            InputError: for a kind that the work table does not have.
        """
        costs = self._kinds.get(kind)
        if costs is None:
            return self._profile.work_ns(kind, units)
        return round(costs[0] + costs[1] * units)

    def uncharged_ns(self, node_name: str, kind: str, name: str) -> int:
        """Return what a callback costs that charged nothing itself, ns."""
        if node_name not in self._foreign:
            return 0
        return self._typical.get((self._roles[node_name], kind, "" if kind == "timer" else name), 0)

    def traffic_ns(self, node_name: str, received: int | None, sent: Sequence[int]) -> int:
        """Return the middleware's time for a message of ``received`` bytes and some of ``sent`` bytes, ns."""
        if node_name not in self._roles:
            return 0
        total = 0 if received is None else self.work_ns("message_in", received)
        for size in sent:
            total += self.work_ns("message_out", size)
        return total
