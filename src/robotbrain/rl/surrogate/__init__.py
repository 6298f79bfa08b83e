"""The surrogate arm and quadruped: stand-ins for physical robots whose parameters nobody is told.

A surrogate is the task's robot with other friction, masses, payload, motors, play, delays and encoders. Each has a
serial number; the parameters follow from it and are unknown to the student. ``Surrogate(serial=7)`` is one of them,
``SurrogateFleet`` many at once, ``SurrogateReachEnv`` the reach task on them, ``walk`` the velocity task;
:mod:`~robotbrain.rl.surrogate.node` puts one behind the topics of a physical arm. The names load when first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from robotbrain.lazy import lazy

if TYPE_CHECKING:
    from robotbrain.rl.surrogate.fleet import Readings, Surrogate, SurrogateFleet
    from robotbrain.rl.surrogate.parameters import RANGES, SurrogateParams, draw, neutral
    from robotbrain.rl.surrogate.reach import ReachEpisodes, SurrogateReachEnv
    from robotbrain.rl.surrogate.velocity import Walks, walk

__all__ = [
    "RANGES",
    "ReachEpisodes",
    "Readings",
    "Surrogate",
    "SurrogateFleet",
    "SurrogateParams",
    "SurrogateReachEnv",
    "Walks",
    "draw",
    "neutral",
    "walk",
]

_HOME = {
    "fleet": ("Readings", "Surrogate", "SurrogateFleet"),
    "parameters": ("RANGES", "SurrogateParams", "draw", "neutral"),
    "reach": ("ReachEpisodes", "SurrogateReachEnv"),
    "velocity": ("Walks", "walk"),
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}
__getattr__, __dir__ = lazy(__name__, _MODULE_OF, globals())
