"""The catalogue of Jetson modules: one checked TOML file each (see module.Module for what it holds).

Every number is an inline table ``{ value, unit, provenance, source, note? }``, every fact in words
``{ text, provenance, source, note? }`` (see figures.py); ``source`` may be a short key of the file's ``[sources]``.
A file with a key too many or too few, another unit, a number out of range, or figures that contradict one another is
refused with the place of the mistake.
"""

from __future__ import annotations

import difflib
import functools
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from robotbrain.errors import InputError
from robotbrain.jetson.figures import Figure, Statement, Table, parse_table, read_table, read_text
from robotbrain.jetson.modes import PowerMode, read_modes
from robotbrain.jetson.module import CPU_UNIT, FAMILIES, PRECISIONS, Module
from robotbrain.jetson.paths import find_part, module_directory

__all__ = [
    "CPU_UNIT",
    "FAMILIES",
    "PRECISIONS",
    "CpuHost",
    "Module",
    "PowerMode",
    "list_modules",
    "load_cpu_hosts",
    "load_module",
    "read_module",
]

# key in the file: (unit, low, high, whole number, required)
_FIGURES: dict[str, tuple[str, float, float, bool, bool]] = {
    "gpu.sm_count": ("count", 1, 256, True, True),
    "gpu.cuda_cores": ("count", 1, 65536, True, True),
    "gpu.tensor_cores": ("count", 0, 4096, True, True),
    "gpu.max_mhz": ("MHz", 100, 5000, False, True),
    "peak.fp32_tflops": ("TFLOPS", 0.01, 1e4, False, True),
    "peak.tf32_tflops": ("TFLOPS", 0.01, 1e4, False, False),
    "peak.fp16_tflops": ("TFLOPS", 0.01, 1e4, False, True),
    "peak.int8_tops": ("TOPS", 0.01, 1e5, False, False),
    "memory.size_gb": ("GB", 0.5, 4096, False, True),
    "memory.bus_bits": ("bit", 16, 4096, True, True),
    "memory.emc_max_mhz": ("MHz", 100, 20000, False, True),
    "memory.bandwidth_gbs": ("GB/s", 1, 1e5, False, True),
    "cpu.cores": ("count", 1, 256, True, True),
    "cpu.max_mhz": ("MHz", 100, 10000, False, True),
    "cpu.single_thread": (CPU_UNIT, 100, 1e5, False, True),
    "cpu.single_thread_mhz": ("MHz", 100, 10000, False, True),
    "dla.count": ("count", 0, 16, True, True),
    "dla.max_mhz": ("MHz", 100, 5000, False, False),
    "dla.int8_tops": ("TOPS", 0.01, 1e4, False, False),
    "thermal.gpu_throttle_c": ("degC", 40, 150, False, True),
    "thermal.shutdown_c": ("degC", 40, 150, False, True),
    "power.max_w": ("W", 1, 1000, False, True),
    "power.idle_w": ("W", 0, 500, False, True),
    "power.carrier_w": ("W", 0, 500, False, True),
}

_STATEMENTS = ("headline", "gpu.architecture", "gpu.compute_capability", "cpu.model")


@dataclass(frozen=True, slots=True)
class CpuHost:
    """A computer on which work may have been timed, with the benchmark that the modules have too.

    Attributes:
        slug: short name.
        name: in words.
        single_thread: rating of one thread, CPU_UNIT.
    """

    slug: str
    name: str
    single_thread: Figure


def list_modules() -> list[str]:
    """Return the slugs of all modules, sorted by family, then by power, then by name."""
    return [module.slug for module in all_modules()]


def all_modules() -> list[Module]:
    """Return all modules in the order of :func:`list_modules`."""
    order = list(FAMILIES)
    modules = [read_module(path) for path in module_directory().glob("*.toml")]
    return sorted(modules, key=lambda m: (order.index(m.family), m.max_power_w, m.memory_gb, m.slug))


def load_module(slug: str) -> Module:
    """Return one module.

    Args:
        slug: e.g. ``orin-nano-8gb``, in any case.

    Raises:
        InputError: for an unknown slug, or a file that does not hold what it must.
    """
    directory = module_directory()
    wanted = str(slug).strip().lower()
    known = sorted(path.stem for path in directory.glob("*.toml"))
    if wanted not in known:
        near = difflib.get_close_matches(wanted, known, n=1, cutoff=0.4)
        raise InputError(
            "Jetson module",
            given=slug,
            expected="one of " + ", ".join(known),
            fix=f"Did you mean {near[0]!r}?" if near else "Choose one of these.",
        )
    return read_module(directory / f"{wanted}.toml")


def read_module(path: Path) -> Module:
    """Read one module's file and check all of it.

    Raises:
        InputError: that names the file, the table and the key at fault.
    """
    return _parse(path, read_text(path))


@functools.lru_cache(maxsize=64)
def _parse(path: Path, text: str) -> Module:
    """Parse a module's file; its text is part of the key, so that an edited file is never taken for the old one."""
    root = parse_table(path, text)
    root.only(("sources", "slug", "name", "family", "notes", "headline", "modes", *_sections()))
    if root.text("slug") != path.stem:
        raise root.fail("slug", path.stem, "A module is named like its file.")
    family = root.text("family")
    if family not in FAMILIES:
        raise root.fail("family", "one of " + ", ".join(FAMILIES), "Name the GPU's family.")
    figures, statements = _read_facts(root)

    def value(key: str) -> float:
        return figures[key].value

    def maybe(key: str) -> float | None:
        return figures[key].value if key in figures else None

    module = Module(
        slug=path.stem,
        name=root.text("name"),
        family=family,
        architecture=statements["gpu.architecture"].text,
        compute_capability=statements["gpu.compute_capability"].text,
        sm_count=int(value("gpu.sm_count")),
        cuda_cores=int(value("gpu.cuda_cores")),
        tensor_cores=int(value("gpu.tensor_cores")),
        gpu_max_mhz=value("gpu.max_mhz"),
        fp32_tflops=value("peak.fp32_tflops"),
        tf32_tflops=maybe("peak.tf32_tflops"),
        fp16_tflops=value("peak.fp16_tflops"),
        int8_tops=maybe("peak.int8_tops"),
        memory_gb=value("memory.size_gb"),
        memory_bus_bits=int(value("memory.bus_bits")),
        emc_max_mhz=value("memory.emc_max_mhz"),
        bandwidth_gbs=value("memory.bandwidth_gbs"),
        cpu=statements["cpu.model"].text,
        cpu_cores=int(value("cpu.cores")),
        cpu_max_mhz=value("cpu.max_mhz"),
        cpu_single_thread=figures["cpu.single_thread"],
        cpu_single_thread_mhz=value("cpu.single_thread_mhz"),
        dla_count=int(value("dla.count")),
        dla_max_mhz=maybe("dla.max_mhz"),
        dla_int8_tops=maybe("dla.int8_tops"),
        gpu_throttle_c=value("thermal.gpu_throttle_c"),
        shutdown_c=value("thermal.shutdown_c"),
        max_power_w=value("power.max_w"),
        idle_power_w=value("power.idle_w"),
        carrier_power_w=value("power.carrier_w"),
        headline=statements["headline"].text,
        figures=MappingProxyType(figures),
        statements=MappingProxyType(statements),
        modes=MappingProxyType(
            read_modes(
                root,
                cores=int(value("cpu.cores")),
                cpu_mhz=value("cpu.max_mhz"),
                gpu_mhz=value("gpu.max_mhz"),
                sms=int(value("gpu.sm_count")),
                emc_mhz=value("memory.emc_max_mhz"),
                dla_mhz=maybe("dla.max_mhz"),
            )
        ),
        notes=root.texts("notes", ()),
    )
    _check_consistent(root, module)
    return module


def load_cpu_hosts() -> dict[str, CpuHost]:
    """Return the computers whose single-thread benchmark is known, by slug (``cpu_hosts.toml``).

    Raises:
        InputError: for a file that does not hold what it must.
    """
    root = read_table(find_part("cpu_hosts.toml"))
    root.only(("sources", "hosts"))
    hosts: dict[str, CpuHost] = {}
    for slug, table in root.tables("hosts").items():
        table.only(("name", "single_thread"))
        hosts[slug] = CpuHost(slug, table.text("name"), table.figure("single_thread", CPU_UNIT, 100, 1e5))
    return hosts


def _sections() -> list[str]:
    return list(dict.fromkeys(key.partition(".")[0] for key in _FIGURES))


def _read_facts(root: Table) -> tuple[dict[str, Figure], dict[str, Statement]]:
    figures: dict[str, Figure] = {}
    statements = {"headline": root.statement("headline")}
    tables = {section: root.table(section) for section in _sections()}
    every = [*_FIGURES, *_STATEMENTS]
    for section, table in tables.items():
        table.only(key.partition(".")[2] for key in every if key.startswith(f"{section}."))
    for dotted in _STATEMENTS[1:]:
        section, _, key = dotted.partition(".")
        statements[dotted] = tables[section].statement(key)
    for dotted, (unit, low, high, whole, required) in _FIGURES.items():
        section, _, key = dotted.partition(".")
        if required or tables[section].has(key):
            figures[dotted] = tables[section].figure(key, unit, low, high, whole)
    return figures, statements


def _check_consistent(root: Table, module: Module) -> None:
    """Refuse figures that contradict one another: a slip of the pen in one of them."""

    def same(section: str, key: str, stated: float, computed: float, rule: str, within: float = 0.005) -> None:
        if abs(stated - computed) > within * computed:
            raise root.table(section).fail(key, f"{computed:.4g} ({rule})", "One of these figures is wrong.", stated)

    lanes = FAMILIES[module.family]
    same("gpu", "cuda_cores", module.cuda_cores, module.sm_count * lanes, f"{lanes} per SM in this family", 0)
    fp32 = 2e-6 * module.cuda_cores * module.gpu_max_mhz
    same("peak", "fp32_tflops", module.fp32_tflops, fp32, "2 x CUDA cores x clock")
    bandwidth = 2e-3 * module.emc_max_mhz * module.memory_bus_bits / 8
    # Data sheets round bandwidth to whole GB/s.
    same("memory", "bandwidth_gbs", module.bandwidth_gbs, bandwidth, "2 x clock x bus width", 0.01)
    if (module.int8_tops is not None) != (module.tensor_cores > 0):
        raise root.table("peak").fail("int8_tops", "a figure if there are tensor cores, else none", "Compare the two.")
    for key, figure in (("max_mhz", module.dla_max_mhz), ("int8_tops", module.dla_int8_tops)):
        if (figure is not None) != (module.dla_count > 0):
            raise root.table("dla").fail(key, "a figure if there are DLAs, else none", "Compare it with count.")
    if module.shutdown_c <= module.gpu_throttle_c:
        raise root.table("thermal").fail("shutdown_c", f"more than {module.gpu_throttle_c:g}", "Compare the two.")
