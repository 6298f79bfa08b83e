"""Reference Jetson profiles: a module in a power mode, and how long the brain's work takes on it.

Nothing in a profile is set by hand. Network latencies come from the twin (or a measured profile, which takes
precedence there), CPU times from the work table scaled by a published single-thread benchmark, cores and DLAs from the
catalogue. All three are read from ``autograder/profiles`` (see paths.profile_directory).
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType

from robotbrain.errors import InputError
from robotbrain.jetson.catalogue import list_modules, load_cpu_hosts, load_module
from robotbrain.jetson.figures import PROVENANCES
from robotbrain.jetson.paths import profile_directory
from robotbrain.jetson.resize import at_image_size
from robotbrain.jetson.work import WorkTable, load_work

__all__ = ["PROVENANCES", "JetsonProfile", "list_profiles", "load_profile"]

PRECISION = "fp16"
"""Precision the brain's networks run in unless told otherwise."""


def default_network() -> Path:
    """Return the path of the shipped segmentation network."""
    return Path(__file__).resolve().parents[1] / "pipeline" / "weights" / "segmentation.onnx"


@dataclass(frozen=True)
class JetsonProfile:
    """A Jetson module in a power mode, as the kit's brain meets it.

    What-if profiles are made with ``dataclasses.replace(profile, cpu_factor=2 * profile.cpu_factor)``.

    Attributes:
        slug: of the module, e.g. ``orin-nano-8gb``.
        name: of the module.
        power_mode: as nvpmodel spells it.
        cpu_cores: cores online.
        dla: deep-learning accelerators that are on.
        cpu_factor: how many times longer CPU work takes than on the computer where it was timed.
        work: the timed CPU work.
        network_factor: how many times longer a network takes than the twin says; 1 but for what-ifs.
        cpu_source: where ``cpu_factor`` comes from, in words.
    """

    slug: str
    name: str
    power_mode: str
    cpu_cores: int
    dla: int
    cpu_factor: float
    work: WorkTable
    network_factor: float = 1.0
    cpu_source: str = "given by hand"

    # ------------------------------------------------------------ networks

    def network_ms(
        self, model: str | Path, precision: str = PRECISION, image_size: tuple[int, int] | None = None
    ) -> float:
        """Return the latency of one inference at batch 1 on the module's GPU, ms.

        Args:
            model: path of an ONNX file.
            precision: ``fp32``, ``fp16`` or ``int8``.
            image_size: (width, height) of another input size, for a fully convolutional network; None: the file's.

        Raises:
            InputError: if the file is no network that the twin can predict.
        """
        return self.network_factor * self._network(Path(model), precision, image_size)[0]

    def _network(
        self, model: Path, precision: str, image_size: tuple[int, int] | None = None
    ) -> tuple[float, str, str]:
        # A profile is a snapshot: what it once said it keeps saying.
        key = (str(model), precision, image_size)
        if key not in self._networks:
            self._networks[key] = _network_ms(model, self.slug, self.power_mode, precision, image_size)
        return self._networks[key]

    @cached_property
    def _networks(self) -> dict[tuple[str, str, tuple[int, int] | None], tuple[float, str, str]]:
        return {}

    @property
    def segmentation_ms(self) -> float:
        """Latency of the shipped segmentation network, ms."""
        return self.network_ms(default_network())

    # ------------------------------------------------------------ CPU

    def work_cost(self, kind: str) -> tuple[float, float]:
        """Return what one call and one unit of a kind of work take here, ns.

        Raises:
            InputError: for an unknown kind.
        """
        found = self.work.kind(kind)
        return found.fixed_ns * self.cpu_factor, found.unit_ns * self.cpu_factor

    def work_ns(self, kind: str, units: float) -> int:
        """Return what one call with so many units of work takes on one core, ns.

        Raises:
            InputError: for an unknown kind.
        """
        call, unit = self.work_cost(kind)
        return round(call + unit * units)

    @cached_property
    def callback_ms(self) -> Mapping[str, float]:
        """CPU time on one core of a typical callback by short name, the messages it takes and sends included, ms."""
        return MappingProxyType({name: self.callback_ns(name) * 1e-6 for name in self.work.callbacks})

    def callback_ns(self, callback: str) -> int:
        """Return the CPU time of a typical callback on one core in ns, its messages included.

        Raises:
            InputError: for an unknown callback.
        """
        found = self.work.callbacks.get(callback)
        if found is None:
            raise InputError(
                "callback",
                given=callback,
                expected="one of " + ", ".join(self.work.callbacks),
                fix="Choose one of these.",
            )
        return round(self.work.callback_ns(found) * self.cpu_factor)

    def planning_ns(self, expanded: int) -> int:
        """Return the CPU time of a typical plan, but with this many cells expanded by A*, in ns."""
        typical = self.work.callbacks["planner"].work["astar"][1]
        return self.callback_ns("planner") + round(self.work_cost("astar")[1] * (expanded - typical))

    # ------------------------------------------------------------ origins

    @property
    def provenance(self) -> Mapping[str, str]:
        """Provenance of the groups of numbers: ``segmentation`` (asks the twin), ``callbacks``, ``planner``."""
        return {
            "segmentation": self._network(default_network(), PRECISION)[1],
            "callbacks": "predicted",
            "planner": "predicted",
        }

    @property
    def source(self) -> Mapping[str, str]:
        """Source of each group of numbers, in words."""
        cpu = f"{self.work.source}, timed on {self.work.cpu}, times {self.cpu_factor:.3g} by {self.cpu_source}"
        return {"segmentation": self._network(default_network(), PRECISION)[2], "callbacks": cpu, "planner": cpu}


def _network_ms(
    model: Path, slug: str, mode: str, precision: str, image_size: tuple[int, int] | None
) -> tuple[float, str, str]:
    """Return latency in ms, provenance and source, from the twin (which prefers measured profiles)."""
    directory = profile_directory()
    # Whatever the answer depends on is part of the key: a profile that is edited or added counts at once.
    changed = tuple(sorted((str(path), path.stat().st_mtime_ns) for path in [model, *_files(directory)]))
    return _predict(model, slug, mode, precision, image_size, changed)


def _files(directory: Path) -> list[Path]:
    return [path for path in directory.rglob("*") if path.suffix in (".toml", ".json", ".csv")]


@functools.lru_cache(maxsize=256)
def _predict(
    model: Path,
    slug: str,
    mode: str,
    precision: str,
    image_size: tuple[int, int] | None,
    _changed: tuple[tuple[str, int], ...],
) -> tuple[float, str, str]:
    from robotbrain.jetson.twin import predict

    network = model if image_size is None else at_image_size(model, image_size)
    prediction = predict(network, slug, mode=mode, precision=precision)
    return prediction.latency_ms, prediction.provenance, "; ".join(prediction.sources)


def list_profiles() -> list[str]:
    """Return the slugs of all modules; each is a profile in its default power mode."""
    return list_modules()


def load_profile(slug: str, mode: str | int | None = None) -> JetsonProfile:
    """Return the profile of one module in a power mode.

    Args:
        slug: of the module; ``"nano-4gb:5W"`` names the mode too.
        mode: power mode as nvpmodel spells it, an alias or its number; None for the module's default.

    Raises:
        InputError: for an unknown module or mode, or two modes that differ.
    """
    module_slug, colon, named = str(slug).partition(":")
    module = load_module(module_slug)
    if colon and mode is not None and module.mode(named) != module.mode(mode):
        raise InputError(
            "power mode", given=f"{slug!r} and {mode!r}", expected="one power mode", fix="Name it in one place only."
        )
    chosen = module.mode(named if colon else mode)
    work = load_work()
    hosts = load_cpu_hosts()
    if work.host not in hosts:
        raise InputError(
            "work.toml: [host] key",
            given=work.host,
            expected="one of cpu_hosts.toml: " + ", ".join(hosts),
            fix="Add the computer where the work was timed to cpu_hosts.toml.",
        )
    host = hosts[work.host].single_thread
    return JetsonProfile(
        slug=module.slug,
        name=module.name,
        power_mode=chosen.name,
        cpu_cores=chosen.cpu_online,
        dla=module.dla_count if chosen.dla_mhz is not None else 0,
        cpu_factor=host.value / module.cpu_score(chosen),
        work=work,
        cpu_source=f"single-thread {host.unit} (published: {host.source}; {module.cpu_single_thread.source}) and clock",
    )
