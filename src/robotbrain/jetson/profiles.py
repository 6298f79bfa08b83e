"""Reference Jetson profiles: a module in a power mode, and how long the brain's work takes on it.

Profiles are TOML files under ``autograder/profiles``. They are looked for in the directory named by the environment
variable ``ROBOTBRAIN_PROFILES``, then in the checkout, then in the copy that is installed with the package.
"""

from __future__ import annotations

import difflib
import os
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robotbrain.errors import InputError

PROVENANCES = ("datasheet", "published", "predicted", "measured", "assumed")
"""Where a number about a Jetson may come from."""

CALLBACKS = ("perception", "estimator_scan", "estimator_wheels", "mapper", "mission", "controller")
"""Callbacks whose CPU time a profile states."""


@dataclass(frozen=True)
class JetsonProfile:
    """A Jetson module in a power mode, with the fixed latencies of the kit's brain on it.

    Attributes:
        slug: short name, e.g. ``orin-nano-8gb``.
        name: full name.
        power_mode: as nvpmodel spells it.
        segmentation_ms: one inference of the segmentation network, batch 1.
        callback_ms: CPU time by callback (see CALLBACKS).
        planner_fixed_ms, planner_per_1000_cells_ms: CPU time of one plan, fixed and per 1000 cells expanded.
        provenance: of each group of numbers, one of PROVENANCES.
        source: of each group of numbers.
    """

    slug: str
    name: str
    power_mode: str
    segmentation_ms: float
    callback_ms: Mapping[str, float]
    planner_fixed_ms: float
    planner_per_1000_cells_ms: float
    provenance: Mapping[str, str]
    source: Mapping[str, str]

    def callback_ns(self, callback: str) -> int:
        """Return the CPU time of one callback in ns."""
        return round(self.callback_ms[callback] * 1e6)

    def planning_ns(self, expanded: int) -> int:
        """Return the CPU time of a plan that expanded this many cells, in ns."""
        return round((self.planner_fixed_ms + self.planner_per_1000_cells_ms * expanded / 1000) * 1e6)


def profile_directory() -> Path:
    """Return the directory the profiles are read from."""
    override = os.environ.get("ROBOTBRAIN_PROFILES")
    here = Path(__file__).resolve()
    candidates = [Path(override)] if override else [here.parents[3] / "autograder" / "profiles", here.parent / "data"]
    for candidate in candidates:
        if any(candidate.glob("*.toml")):
            return candidate
    raise InputError(
        "reference profiles",
        given=[str(c) for c in candidates],
        expected="a directory with *.toml profiles",
        fix="Unset ROBOTBRAIN_PROFILES, or point it at a copy of autograder/profiles.",
    )


def list_profiles() -> list[str]:
    """Return the slugs of all profiles, sorted."""
    return sorted(path.stem for path in profile_directory().glob("*.toml"))


def load_profile(slug: str) -> JetsonProfile:
    """Return the profile of one module.

    Raises:
        InputError: for an unknown slug or a file that does not hold what a profile must.
    """
    path = profile_directory() / f"{slug}.toml"
    known = list_profiles()
    if slug not in known:
        near = difflib.get_close_matches(slug, known, n=1, cutoff=0.4)
        raise InputError(
            "Jetson profile",
            given=slug,
            expected="one of " + ", ".join(known),
            fix=f"Did you mean {near[0]!r}?" if near else "Choose one of these.",
        )
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(str(path), given=str(error), expected="a TOML file", fix="Restore it from git.") from error
    return _parse(path, data)


def _parse(path: Path, data: dict[str, Any]) -> JetsonProfile:
    def group_of(table: str) -> dict[str, Any]:
        found = data.get(table, {})
        if not isinstance(found, dict):
            raise InputError(
                f"{path.name}: {table}", given=found, expected="a table", fix=f"Begin it with a line [{table}]."
            )
        return found

    def number(table: str, key: str) -> float:
        value = group_of(table).get(key)
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < 1e5:
            raise InputError(
                f"{path.name}: [{table}] {key}",
                given=value,
                expected="a time in milliseconds, 0 or more",
                fix="Compare with the other profiles.",
            )
        return float(value)

    def text(key: str, table: str | None = None) -> str:
        value = (data if table is None else group_of(table)).get(key)
        if not isinstance(value, str) or not value:
            where = f"{path.name}: {key}" if table is None else f"{path.name}: [{table}] {key}"
            raise InputError(where, given=value, expected="text", fix="Compare with the other profiles.")
        return value

    groups = ("segmentation", "callbacks", "planner")
    provenance = {group: text("provenance", group) for group in groups}
    for group, label in provenance.items():
        if label not in PROVENANCES:
            raise InputError(
                f"{path.name}: [{group}] provenance",
                given=label,
                expected="one of " + ", ".join(PROVENANCES),
                fix="Say where the number comes from.",
            )
    if text("slug") != path.stem:
        raise InputError(
            f"{path.name}: slug",
            given=data["slug"],
            expected=path.stem,
            fix="A profile is named like its file.",
        )
    return JetsonProfile(
        slug=path.stem,
        name=text("name"),
        power_mode=text("power_mode"),
        segmentation_ms=number("segmentation", "value_ms"),
        callback_ms={name: number("callbacks", f"{name}_ms") for name in CALLBACKS},
        planner_fixed_ms=number("planner", "fixed_ms"),
        planner_per_1000_cells_ms=number("planner", "per_1000_cells_ms"),
        provenance=provenance,
        source={group: text("source", group) for group in groups},
    )
