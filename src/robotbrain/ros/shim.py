"""Makes ``import rclpy``, ``from geometry_msgs.msg import Twist`` … resolve to the kit.

The finder stands at the end of ``sys.meta_path``: whatever is really installed is found first.
"""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import sys
import types
from collections.abc import Sequence

from robotbrain.ros.tf2 import TF2_MODULES

RCLPY_MODULES: dict[str, str] = {
    "rclpy": "api",
    "rclpy.action": "action",
    "rclpy.action.client": "action.client",
    "rclpy.action.graph": "action.graph",
    "rclpy.action.server": "action.server",
    "rclpy.callback_groups": "callback_groups",
    "rclpy.client": "services",
    "rclpy.clock": "clock",
    "rclpy.clock_type": "time",
    "rclpy.context": "context",
    "rclpy.duration": "time",
    "rclpy.event_handler": "event_handler",
    "rclpy.exceptions": "exceptions",
    "rclpy.executors": "executors",
    "rclpy.experimental": "experimental",
    "rclpy.experimental.events_executor": "experimental",
    "rclpy.guard_condition": "guard_condition",
    "rclpy.logging": "logging",
    "rclpy.node": "node",
    "rclpy.parameter": "parameter",
    "rclpy.parameter_client": "parameter_client",
    "rclpy.parameter_event_handler": "parameter_event_handler",
    "rclpy.parameter_service": "parameter_service",
    "rclpy.publisher": "publisher",
    "rclpy.qos": "qos",
    "rclpy.qos_event": "event_handler",
    "rclpy.qos_overriding_options": "qos_overriding_options",
    "rclpy.serialization": "serialization",
    "rclpy.service": "services",
    "rclpy.signals": "signals",
    "rclpy.subscription": "subscription",
    "rclpy.task": "task",
    "rclpy.time": "time",
    "rclpy.timer": "timer",
    "rclpy.topic_endpoint_info": "endpoint_info",
    "rclpy.utilities": "utilities",
    "rclpy.wait_for_message": "wait_for_message",
}
"""Module of rclpy -> module of ``robotbrain.ros`` whose public names it shows."""

MODULES: dict[str, str] = {**RCLPY_MODULES, **TF2_MODULES, "message_filters": "message_filters"}
"""All modules that are shown under another name."""

_EXTRA_NAMES: dict[str, dict[str, str]] = {
    "rclpy.clock": {"ClockType": "time"},
    "rclpy.executors": {"ExternalShutdownException": "executors"},
    "rclpy.logging": {},
    "rclpy.node": {"Parameter": "parameter"},
    "rclpy": {
        "Context": "context",
        "Node": "node",
        "Parameter": "parameter",
        "get_rmw_implementation_identifier": "utilities",
    },
}


_KINDS = ("", "msg", "srv", "action")


class KitFinder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds ``rclpy`` and the standard interface packages in the kit."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: types.ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Return a spec for a module the kit stands in for, else None."""
        if fullname in MODULES:
            return importlib.machinery.ModuleSpec(fullname, self, is_package=_is_package(fullname))
        package, _, kind = fullname.partition(".")
        if kind not in _KINDS or not package.endswith(("_msgs", "_srvs", "_interfaces", "_common")):
            return None
        from robotbrain.ros.typedefs import packages, typenames

        if package not in packages():
            return None
        if kind and not any(name.startswith(f"{package}/{kind}/") for name in typenames()):
            return None
        return importlib.machinery.ModuleSpec(fullname, self, is_package=True)

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> types.ModuleType | None:
        """Return an empty module."""
        module = types.ModuleType(spec.name)
        module.__doc__ = f"{spec.name} of robotbrain.ros (simulated time)."
        return module

    def exec_module(self, module: types.ModuleType) -> None:
        """Fill the module; message classes are made when first asked for."""
        name = module.__name__
        if name in MODULES:
            _fill_rclpy(module)
        elif "." in name:
            _fill_interfaces(module)


def _is_package(name: str) -> bool:
    return any(other.startswith(name + ".") for other in MODULES)


def _fill_rclpy(module: types.ModuleType) -> None:
    source = importlib.import_module(f"robotbrain.ros.{MODULES[module.__name__]}")
    public = getattr(source, "__all__", None) or [key for key in vars(source) if not key.startswith("_")]
    for key in public:
        value = getattr(source, key)
        if not isinstance(value, types.ModuleType):
            setattr(module, key, value)
    for key, where in _EXTRA_NAMES.get(module.__name__, {}).items():
        file, _, other = where.partition(":")
        setattr(module, key, getattr(importlib.import_module(f"robotbrain.ros.{file}"), other or key))
    if "." not in module.__name__:
        # Genuine packages import these submodules themselves, so that rclpy.qos.QoSProfile works after `import rclpy`.
        for submodule in MODULES:
            if submodule.startswith(module.__name__ + "."):
                importlib.import_module(submodule)


def _fill_interfaces(module: types.ModuleType) -> None:
    from robotbrain.ros.messages import action_class, is_action, is_service, message_class, service_class
    from robotbrain.ros.typedefs import typenames

    prefix = module.__name__.replace(".", "/") + "/"
    names = sorted(name.removeprefix(prefix) for name in typenames() if name.startswith(prefix))
    services = sorted({name.removesuffix("_Request") for name in names if name.endswith("_Request")})
    actions = sorted({name.removesuffix("_Goal") for name in names if name.endswith("_Goal")})

    def load(key: str) -> object:
        if key in names:
            value: object = message_class(prefix + key)
        elif key in actions and is_action(prefix + key):
            value = action_class(prefix + key)
        elif key in services and is_service(prefix + key):
            value = service_class(prefix + key)
        else:
            raise AttributeError(f"{module.__name__} has no {key!r}; it has: {', '.join(actions or services or names)}")
        setattr(module, key, value)
        return value

    module.__getattr__ = load  # type: ignore[method-assign]
    module.__all__ = [*actions, *services, *names]  # type: ignore[attr-defined]
    module.__dir__ = lambda: [*actions, *services, *names]  # type: ignore[method-assign]


_finder = KitFinder()


def genuine_rclpy_available() -> bool:
    """Tell whether an rclpy that is not the kit's can be imported."""
    loaded = sys.modules.get("rclpy")
    if loaded is not None:
        return not isinstance(getattr(loaded, "__loader__", None), KitFinder)
    for finder in sys.meta_path:
        if isinstance(finder, KitFinder):
            continue
        find = getattr(finder, "find_spec", None)
        # A bare folder called rclpy is found as a namespace package, without a loader or origin.
        if find is not None and (spec := find("rclpy", None, None)) is not None and spec.origin is not None:
            return True
    return False


def install(*, force: bool = False) -> str:
    """Let imports of rclpy and interface packages find the kit; return the backend in use.

    Args:
        force: take precedence over a genuine rclpy (simulation on a machine with ROS 2 sourced). Only before
            anything imported the genuine one.

    Returns:
        ``"kit"``, or ``"rclpy"`` when genuine rclpy is installed and ``force`` is not set.
    """
    if not force and genuine_rclpy_available():
        return "rclpy"
    if _finder in sys.meta_path:
        sys.meta_path.remove(_finder)
    if force:
        sys.meta_path.insert(0, _finder)
    else:
        sys.meta_path.append(_finder)
    importlib.invalidate_caches()
    return "kit"


def uninstall() -> None:
    """Undo :func:`install`: remove the finder and the modules it made."""
    if _finder in sys.meta_path:
        sys.meta_path.remove(_finder)
    for name, module in list(sys.modules.items()):
        if isinstance(getattr(module, "__loader__", None), KitFinder):
            del sys.modules[name]
