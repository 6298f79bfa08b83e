"""``robotbrain jetson list``, ``show`` and ``jetpack``: the catalogue, each number with its origin."""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Iterable
from typing import Any

from robotbrain.jetson.catalogue import Module, all_modules, list_modules, load_module
from robotbrain.jetson.figures import Figure, Statement
from robotbrain.jetson.modes import PowerMode
from robotbrain.jetson.software import Headline, JetPack, compatible, jetpacks_for, load_headlines, load_jetpacks
from robotbrain.jetson.tables import format_table, wrap


def list_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``robotbrain jetson list``."""
    parser.add_argument("--json", action="store_true", help="one JSON object instead of a table")


def list_main(arguments: argparse.Namespace) -> int:
    """Print all modules."""
    modules = all_modules()
    if arguments.json:
        _print_json({"modules": [_summary(module) for module in modules]})
        return 0
    head = ("module", "name", "GPU", "SMs", "memory (GB)", "GB/s", "FP16 (TFLOPS)", "INT8 (TOPS)", "default mode")
    rows = [
        (
            m.slug,
            m.name.removeprefix("Jetson "),
            m.architecture,
            m.sm_count,
            f"{m.memory_gb:g}",
            f"{m.bandwidth_gbs:g}",
            f"{m.fp16_tflops:.3g}",
            "-" if m.int8_tops is None else f"{m.int8_tops:.3g}",
            m.default_mode.name,
            m.headline,
        )
        for m in modules
    ]
    print(format_table((*head, "advertised"), rows, left=(0, 1, 2, 8, 9)))
    print(
        "\nFP16 and INT8: dense peaks of the GPU at its highest clock. What is advertised often counts sparsity and the"
        "\nDLAs too; `robotbrain jetson show MODULE` has the origin of each number and says what differs."
    )
    return 0


def _summary(module: Module) -> dict[str, Any]:
    return {
        "slug": module.slug,
        "name": module.name,
        "gpu": module.architecture,
        "family": module.family,
        "sm_count": module.sm_count,
        "memory_gb": module.memory_gb,
        "bandwidth_gbs": module.bandwidth_gbs,
        "fp32_tflops": module.fp32_tflops,
        "fp16_tflops": module.fp16_tflops,
        "int8_tops": module.int8_tops,
        "dla_count": module.dla_count,
        "default_mode": module.default_mode.name,
        "modes": list(module.modes),
        "headline": module.headline,
    }


def show_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``robotbrain jetson show``."""
    parser.add_argument("module", metavar="MODULE", help="for example orin-nano-8gb; `robotbrain jetson list` has all")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of tables")


class _Sources:
    """Numbers sources in the order in which they are named."""

    def __init__(self) -> None:
        self.numbers: dict[str, int] = {}

    def __call__(self, source: str) -> str:
        return f"[{self.numbers.setdefault(source, len(self.numbers) + 1)}]"

    def lines(self) -> Iterable[str]:
        for source, number in self.numbers.items():
            yield wrap(source, indent="       ", first=f"{f'[{number}]':>6} ")


def show_main(arguments: argparse.Namespace) -> int:
    """Print one module."""
    module = load_module(arguments.module)
    headline = next((h for h in load_headlines() if h.module.slug == module.slug), None)
    jetpacks = jetpacks_for(module.slug)
    if arguments.json:
        _print_json(_module_json(module, headline, jetpacks))
        return 0
    cite = _Sources()
    facts: list[tuple[str, str, str, Figure | Statement]] = [
        *((key, statement.text, "", statement) for key, statement in module.statements.items()),
        *((key, f"{figure.value:g}", figure.unit, figure) for key, figure in module.figures.items()),
    ]
    sections = ["headline", *dict.fromkeys(key.partition(".")[0] for key in module.figures)]
    facts.sort(key=lambda fact: sections.index(fact[0].partition(".")[0]))
    print(f"{module.name} ({module.slug})\n")
    rows = [(key, value, unit, o.provenance, cite(o.source), o.note) for key, value, unit, o in facts]
    print(format_table(("what", "value", "unit", "provenance", "source", "note"), rows, left=(0, 2, 3, 4, 5)))
    print("\nPeaks are dense: two operations for each multiply-accumulate, no structured sparsity.")
    print(f"\nPower modes ({module.default_mode.name} is the default)\n")
    print(_mode_table(module, cite))
    start = module.default_mode
    names = f"{start.id}, {start.name}, {start.name.removeprefix('MODE_').lower()}"
    print(f"\nAny of them can be named by its number, in either case, without MODE_, or by its beginning: {names}.")
    print("\nJetPack releases that support it, oldest first\n")
    print(_jetpack_table(jetpacks, cite))
    if headline is not None:
        print("\n" + _headline_text(headline, cite))
    for note in module.notes:
        print("\n" + wrap(note))
    print("\nSources")
    print("\n".join(cite.lines()))
    return 0


def _mode_table(module: Module, cite: _Sources) -> str:
    head = ("id", "mode", "W", "CPU", "GPU (MHz)", "SMs", "memory (MHz)", "DLA (MHz)", "FP16 (TFLOPS)", "GB/s")
    rows = [
        (
            mode.id,
            mode.name + ("*" if mode.default else ""),
            "-" if mode.watts is None else f"{mode.watts:g}",
            f"{mode.cpu_online} x {mode.cpu_mhz:.0f} MHz",
            f"{mode.gpu_mhz:g}",
            mode.sms_on,
            f"{mode.emc_mhz:g}",
            "-" if mode.dla_mhz is None else f"{mode.dla_mhz:g}",
            f"{module.peak_flops('fp16', mode) / 1e12:.3g}",
            f"{module.bandwidth(mode) / 1e9:.3g}",
            mode.provenance,
            cite(mode.source),
            ", ".join(mode.aliases) or "-",
        )
        for mode in module.modes.values()
    ]
    return format_table((*head, "provenance", "source", "aliases"), rows, left=(1, 10, 11, 12))


def _jetpack_table(releases: Iterable[JetPack], cite: _Sources | None = None) -> str:
    head = ["JetPack", "L4T", "Ubuntu", "Python", "CUDA", "cuDNN", "TensorRT", "ONNX opset up to"]
    rows = []
    for release in releases:
        parts = (release.l4t, release.ubuntu, release.python, release.cuda, release.cudnn, release.tensorrt)
        row = [release.version, *(_marked(part) for part in parts)]
        row.append(f"{release.onnx_opset.value:g}" + ("?" if release.onnx_opset.provenance == "assumed" else ""))
        if cite is not None:
            origins = [release.onnx_opset.source, *(part.source for part in parts if part is not None), release.source]
            row.append("".join(dict.fromkeys(cite(origin) for origin in origins)))
        rows.append(row)
    if cite is not None:
        head.append("sources")
    return format_table(head, rows, left=range(len(head))) + "\n? assumed: no document at hand says so"


def _marked(part: Statement | None) -> str:
    return "-" if part is None else part.text + ("?" if part.provenance == "assumed" else "")


def _headline_text(headline: Headline, cite: _Sources) -> str:
    like = ", ".join(
        f"{name.upper()} {figure.value:.3g} {figure.unit}" for name, figure in headline.like_for_like.items()
    )
    said = [
        f"The course outline's headline: {headline.outline.text} {cite(headline.outline.source)}",
        f"  the data sheet's: {headline.datasheet.text} {cite(headline.datasheet.source)}",
        f"  it counts: {headline.counts}",
        f"  like for like (dense, GPU alone): {like}",
    ]
    return "\n".join([*said, wrap(headline.why, indent="    ", first="  why: ")])


def _module_json(module: Module, headline: Headline | None, jetpacks: Iterable[JetPack]) -> dict[str, Any]:
    return {
        **_summary(module),
        "figures": {key: dataclasses.asdict(figure) for key, figure in module.figures.items()},
        "statements": {key: dataclasses.asdict(statement) for key, statement in module.statements.items()},
        "modes": [_mode_json(module, mode) for mode in module.modes.values()],
        "jetpacks": [_jetpack_json(release) for release in jetpacks],
        "outline_headline": None
        if headline is None
        else {
            "outline": dataclasses.asdict(headline.outline),
            "datasheet": dataclasses.asdict(headline.datasheet),
            "counts": headline.counts,
            "why": headline.why,
        },
        "notes": list(module.notes),
    }


def _mode_json(module: Module, mode: PowerMode) -> dict[str, Any]:
    return {
        **dataclasses.asdict(mode),
        "fp16_tflops": module.peak_flops("fp16", mode) / 1e12,
        "bandwidth_gbs": module.bandwidth(mode) / 1e9,
    }


def _jetpack_json(release: JetPack) -> dict[str, Any]:
    return dataclasses.asdict(release)


def jetpack_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``robotbrain jetson jetpack``."""
    parser.add_argument("--opset", type=int, metavar="N", help="say for each module whether it can parse this opset")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of a table")


def jetpack_main(arguments: argparse.Namespace) -> int:
    """Print the compatibility table."""
    if arguments.opset is not None:
        verdicts = {slug: compatible(arguments.opset, slug) for slug in list_modules()}
        if arguments.json:
            _print_json({"opset": arguments.opset, "modules": {s: dataclasses.asdict(v) for s, v in verdicts.items()}})
            return 0
        rows = [
            (slug, "yes" if v.ok else "NO", v.jetpack, v.tensorrt, v.max_opset, v.advice)
            for slug, v in verdicts.items()
        ]
        head = ("module", f"parses opset {arguments.opset}", "newest JetPack", "TensorRT", "up to")
        print(format_table(head, [row[:-1] for row in rows], left=(0, 1, 2, 3)))
        for advice in dict.fromkeys(row[-1] for row in rows if row[1] == "NO"):
            print("\n" + wrap(advice))
        return 0
    releases = load_jetpacks()
    if arguments.json:
        _print_json({"jetpacks": [_jetpack_json(release) for release in releases]})
        return 0
    print(_jetpack_table(releases))
    print("\nModules that each supports")
    for release in releases:
        print(wrap(" ".join(release.modules), indent=" " * 9, first=f"{release.version:7}  "))
        if release.note:
            print(wrap(release.note, indent=" " * 9))
    return 0


def _print_json(data: object) -> None:
    print(json.dumps(data, indent=1))
