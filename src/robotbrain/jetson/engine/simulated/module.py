"""The module that looks like ``tensorrt``."""

from __future__ import annotations

import enum
import types
from dataclasses import dataclass

from robotbrain.jetson.engine.simulated import building, executing
from robotbrain.jetson.engine.simulated.memory import SimulatedCuda
from robotbrain.jetson.engine.simulated.versions import VERSIONS, enums, number, restrict


@dataclass(frozen=True)
class World:
    """What the classes of one simulated module share.

    Attributes:
        version: major and minor.
        text: the whole version.
        cuda: the simulated GPU.
        enums: enumerations by name.
    """

    version: tuple[int, int]
    text: str
    cuda: SimulatedCuda
    enums: dict[str, type[enum.IntEnum]]


class ILogger:
    """Base class of loggers; ``log`` is overridden."""

    Severity: type[enum.IntEnum]

    def __init__(self) -> None:
        pass

    def log(self, severity: enum.IntEnum, msg: str) -> None:
        """Take a message."""
        raise NotImplementedError("override ILogger.log")


class SimulatedModule(types.ModuleType):
    """A module that says what it is."""

    def __init__(self, world: World) -> None:
        super().__init__(f"simulated_tensorrt_{world.text.replace('.', '_')}")
        self.__version__ = world.text

    def __repr__(self) -> str:
        return f"<simulated TensorRT {self.__version__}: computes with ONNX Runtime, has no latency>"


def make_module(version: str, cuda: SimulatedCuda) -> types.ModuleType:
    """Return a module like ``tensorrt`` of one of ``versions.VERSIONS``, on a simulated GPU."""
    at = number(version)
    world = World(at, VERSIONS[version], cuda, enums(at))
    module = SimulatedModule(world)
    made = {name: kind for name, kind in world.enums.items() if name != "Severity"}
    made["ILogger"] = restrict(ILogger, at, Severity=world.enums["Severity"])
    for kind in (*building.CLASSES, *executing.CLASSES):
        made[kind.__name__] = restrict(kind, at, _world=world)
    if at < (10, 0):
        del made["IProgressMonitor"]
    for name, value in made.items():
        setattr(module, name, value)
    return module
