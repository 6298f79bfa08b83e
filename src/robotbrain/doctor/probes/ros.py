"""ROS 2. The kit has its own; where the genuine one is in the way, or half there, imports fail in odd places."""

from __future__ import annotations

import importlib.machinery
import os
import re
import sys
from pathlib import Path

from robotbrain.doctor.finding import (
    Cure,
    Finding,
    Severity,
    Situation,
    fault,
    note,
    ok,
    posix_or_windows,
    quoted,
    set_variable,
    unset_variable,
    warning,
)
from robotbrain.doctor.isolated import try_out

INSTALLED_BELOW = Path("/opt/ros")
HIGHEST_DOMAIN = 232
HIGHEST_SAFE_DOMAIN = 101  # above it, a domain's ports meet those that Linux hands out by itself
_RANGES = ("SUBNET", "LOCALHOST", "OFF", "SYSTEM_DEFAULT")


def ros(situation: Situation) -> list[Finding]:
    """Which ROS 2 this terminal sees, and whether this Python can use it."""
    prefixes = [Path(p) for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    distro = os.environ.get("ROS_DISTRO", "")
    origin = _rclpy()
    found = _settings(prefixes)
    if os.environ.get("ROBOTBRAIN_ROS_BACKEND") == "kit":
        return [ok("the kit's own ROS is chosen (ROBOTBRAIN_ROS_BACKEND=kit)"), *found]
    if not prefixes and origin is None:
        return [_absent(), *found]
    found += _prefixes(prefixes, distro)
    found += _interpreter(prefixes, distro, origin, situation)
    if any(finding.severity is Severity.FAULT for finding in found):
        return found
    return [ok(f"ROS 2 {distro or '(unnamed)'}, rclpy from {origin.parent if origin else 'the kit'}"), *found]


def _rclpy() -> Path | None:
    """Where a genuine rclpy would be imported from."""
    spec = importlib.machinery.PathFinder.find_spec("rclpy", sys.path)
    return Path(spec.origin).parent if spec is not None and spec.origin else None


def _absent() -> Finding:
    installed = sorted(p for p in INSTALLED_BELOW.glob("*") if (p / "setup.bash").is_file())
    if not installed:
        return ok("no ROS 2; the kit's own stands in")
    return note(
        f"ROS 2 {', '.join(p.name for p in installed)} is installed and not sourced: the kit's own stands in",
        Cure(f"source {quoted(installed[-1] / 'setup.bash')} (only to drive a robot on ROS 2: --transport rclpy)"),
    )


def _kit_instead() -> str:
    return "export ROBOTBRAIN_ROS_BACKEND=kit (or a new terminal that sources no setup.bash; look into ~/.bashrc)"


def _prefixes(prefixes: list[Path], distro: str) -> list[Finding]:
    found = []
    new_terminal = Cure(
        "Open a new terminal and source one setup.bash only, of a ROS 2 that is there (`ls /opt/ros`); then build "
        "your workspace again: rm -r build install log && colcon build",
        "Open a new terminal and source one setup only; then build your workspace again",
        r"Open a new terminal and call one local_setup.ps1 only; then build your workspace again",
    )
    gone = [p for p in prefixes if not p.is_dir()]
    if gone:
        found.append(
            fault(f"AMENT_PREFIX_PATH names {', '.join(map(str, gone))}, which does not exist (any more)", new_terminal)
        )
    distros = sorted({name for p in prefixes if (name := _distro_of(p))})
    if len(distros) > 1:
        found.append(fault(f"two ROS 2 distributions are mixed in one terminal: {', '.join(distros)}", new_terminal))
    elif distro and distros and distro not in distros:
        found.append(fault(f"ROS_DISTRO is {distro}, but what is sourced is {distros[0]}", new_terminal))
    return found


def _distro_of(prefix: Path) -> str:
    """Name of the distribution that a prefix belongs to, by its place or by its own setup file."""
    if prefix.parent.name == "ros":
        return prefix.name
    try:
        text = (prefix / "share" / "ros_environment" / "environment" / "1.ros_distro.sh").read_text(encoding="utf-8")
    except OSError:
        return ""
    match = re.search(r"ROS_DISTRO=(\w+)", text)
    return match.group(1) if match else ""


def _interpreter(prefixes: list[Path], distro: str, origin: Path | None, situation: Situation) -> list[Finding]:
    """Whether rclpy is for this Python."""
    mine = f"{sys.version_info[0]}.{sys.version_info[1]}"
    trees = [p for prefix in prefixes for p in prefix.glob("lib/python3.*/site-packages/rclpy")]
    place = origin or next(iter(trees), None)
    if place is None:
        if not prefixes:
            return []
        return [
            warning(
                "ROS 2 is sourced, but there is no rclpy in it: the kit's own stands in",
                Cure(f"sudo apt install ros-{distro or 'DISTRO'}-rclpy (only to drive a robot on ROS 2)"),
            )
        ]
    match = re.search(r"python(3\.\d+)", place.as_posix())
    theirs = match.group(1) if match else mine
    if theirs != mine:
        what = f"rclpy of ROS 2 {distro or ''} ({place}) is for Python {theirs}; this is Python {mine}".replace(
            "  ", " "
        )
        cure = posix_or_windows(
            f"{_kit_instead()}; or, to use this ROS 2, an environment of its Python: /usr/bin/python{theirs} -m venv "
            "--system-site-packages .venv-ros",
            "$env:ROBOTBRAIN_ROS_BACKEND = 'kit' (or a new terminal that calls no local_setup.ps1)",
        )
        if origin is None:
            return [note(f"{what}; the kit's own stands in", cure)]
        return [fault(f"{what}: `import rclpy` finds it (PYTHONPATH) and fails", cure)]
    if origin is None:
        return [
            warning(
                f"{place} is there, but not on this Python's path: ROS 2 is sourced by half",
                Cure(f"source {quoted(place.parents[3] / 'setup.bash')}"),
            )
        ]
    outcome = try_out(["import:rclpy.impl.implementation_singleton"], situation.limit_s)
    trial = outcome["import:rclpy.impl.implementation_singleton"]
    if trial.fine:
        return []
    return [
        fault(
            f"rclpy is found in {place} and cannot be imported",
            posix_or_windows(
                f"source the setup.bash of that ROS 2 in this terminal; or {_kit_instead()}",
                "call the local_setup.ps1 of that ROS 2; or $env:ROBOTBRAIN_ROS_BACKEND = 'kit'",
            ),
            trial.message,
        )
    ]


def _settings(prefixes: list[Path]) -> list[Finding]:
    """Environment variables of ROS 2 whose value does not fit."""
    found: list[Finding] = []
    domain = os.environ.get("ROS_DOMAIN_ID", "")
    if domain and not (domain.isdigit() and int(domain) <= HIGHEST_DOMAIN):
        found.append(
            fault(f"ROS_DOMAIN_ID={domain} is no number from 0 to {HIGHEST_DOMAIN}", unset_variable("ROS_DOMAIN_ID"))
        )
    elif domain and int(domain) > HIGHEST_SAFE_DOMAIN:
        found.append(
            warning(
                f"ROS_DOMAIN_ID={domain}: above {HIGHEST_SAFE_DOMAIN} its ports may be in use by other programs",
                set_variable("ROS_DOMAIN_ID", "42"),
            )
        )
    reach = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "")
    if reach and reach not in _RANGES:
        found.append(
            warning(
                f"ROS_AUTOMATIC_DISCOVERY_RANGE={reach} is none of {', '.join(_RANGES)}: nodes find one another by "
                "accident",
                set_variable("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST"),
            )
        )
    middleware = os.environ.get("RMW_IMPLEMENTATION", "")
    if middleware and prefixes and not any(_has_library(prefix, middleware) for prefix in prefixes):
        package = middleware.replace("_", "-")
        distro = os.environ.get("ROS_DISTRO") or "DISTRO"
        found.append(
            fault(
                f"RMW_IMPLEMENTATION={middleware} is not installed: every node stops when it starts",
                posix_or_windows(
                    f"unset RMW_IMPLEMENTATION, or sudo apt install ros-{distro}-{package}",
                    "Remove-Item Env:RMW_IMPLEMENTATION",
                ),
            )
        )
    return found


def _has_library(prefix: Path, name: str) -> bool:
    return any(
        (prefix / folder / f"{start}{name}{end}").exists()
        for folder, start, end in (("lib", "lib", ".so"), ("lib", "lib", ".dylib"), ("bin", "", ".dll"))
    )
