"""JetPack releases and what they can parse, and the course outline's headline figures put into perspective."""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from robotbrain.errors import InputError
from robotbrain.jetson.catalogue import Module, list_modules, load_module
from robotbrain.jetson.figures import Figure, Statement, read_table
from robotbrain.jetson.paths import find_part

OLDEST_OPSET = 9
"""Older opsets are converted first: the parsers of TensorRT 10 begin with it."""


@dataclass(frozen=True, slots=True)
class JetPack:
    """One release of NVIDIA's software for Jetson modules.

    Attributes:
        version: e.g. ``"6.2"``.
        l4t, cuda, cudnn, tensorrt, ubuntu, python: versions of its parts; cudnn is None where not known.
        onnx_opset: newest opset that its TensorRT can parse.
        modules: slugs of the modules it supports.
        provenance, source: of the list of modules.
        note: what to beware of.
    """

    version: str
    l4t: Statement
    cuda: Statement
    cudnn: Statement | None
    tensorrt: Statement
    ubuntu: Statement
    python: Statement
    onnx_opset: Figure
    modules: tuple[str, ...]
    provenance: str
    source: str
    note: str = ""


@dataclass(frozen=True, slots=True)
class Compatibility:
    """Whether an ONNX file can be parsed on a module.

    Attributes:
        ok: whether the newest JetPack of the module parses the opset.
        opset: that was asked for.
        max_opset: newest that this JetPack parses.
        jetpack, tensorrt: versions.
        advice: what to do; for a reader.
    """

    ok: bool
    opset: int
    max_opset: int
    jetpack: str
    tensorrt: str
    advice: str


@dataclass(frozen=True, slots=True)
class Headline:
    """A performance figure of the course outline beside what can be compared.

    Attributes:
        module: the module it is about; its peaks are the like-for-like figures.
        outline: the figure as the outline has it.
        datasheet: the figure as the maker has it.
        counts: what the outline's figure counts.
        why: why the two differ, or what the figure hides.
    """

    module: Module
    outline: Statement
    datasheet: Statement
    counts: str
    why: str

    @property
    def like_for_like(self) -> Mapping[str, Figure]:
        """Dense peaks of the GPU at the highest clock: ``fp32``, ``fp16`` (TFLOPS) and ``int8`` (TOPS, if any)."""
        keys = {"fp32": "peak.fp32_tflops", "fp16": "peak.fp16_tflops", "int8": "peak.int8_tops"}
        return {name: self.module.figures[key] for name, key in keys.items() if key in self.module.figures}


def _order(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in version.split("."))


def load_jetpacks() -> tuple[JetPack, ...]:
    """Return all JetPack releases in the table, oldest first.

    Raises:
        InputError: for a table that does not hold what it must.
    """
    path = find_part("jetpack.toml")
    return _load_jetpacks(path, path.stat().st_mtime_ns)


@functools.lru_cache(maxsize=8)
def _load_jetpacks(path: Path, _changed: int) -> tuple[JetPack, ...]:
    root = read_table(path)
    root.only(("sources", "releases"))
    known = list_modules()
    parts = ("l4t", "cuda", "tensorrt", "ubuntu", "python")
    releases: list[JetPack] = []
    for version, table in root.tables("releases").items():
        if not re.fullmatch(r"\d+(\.\d+)+", version):
            raise table.fail("", "a version like 6.2", "Name the table after the release.", given=version)
        table.only((*parts, "cudnn", "onnx_opset", "modules", "provenance", "source", "note"))
        provenance, source = table.origin("modules")
        modules = table.texts("modules")
        for slug in modules:
            if slug not in known:
                raise table.fail("modules", "slugs of modules: " + ", ".join(known), "Correct the slug.", given=slug)
        said = {part: table.statement(part) for part in parts}
        releases.append(
            JetPack(
                version=version,
                cudnn=table.statement("cudnn") if table.has("cudnn") else None,
                onnx_opset=table.figure("onnx_opset", "opset", 7, 99, whole=True),
                modules=modules,
                provenance=provenance,
                source=source,
                note=table.text("note", ""),
                **said,
            )
        )
    return tuple(sorted(releases, key=lambda release: _order(release.version)))


def jetpacks_for(slug: str) -> tuple[JetPack, ...]:
    """Return the JetPack releases that support a module, oldest first.

    Raises:
        InputError: for an unknown module, or one that no release supports.
    """
    module = load_module(slug)
    found = tuple(release for release in load_jetpacks() if module.slug in release.modules)
    if not found:
        raise InputError(
            f"JetPack for {module.name}",
            given="no release in jetpack.toml",
            expected="at least one",
            fix="Add the module to a release it runs.",
        )
    return found


def newest_jetpack(slug: str) -> JetPack:
    """Return the newest JetPack release that supports a module (see jetpacks_for)."""
    return jetpacks_for(slug)[-1]


def compatible(opset: int, slug: str) -> Compatibility:
    """Return whether an ONNX file with this opset can be parsed on the newest JetPack of a module.

    Args:
        opset: version of the default operator set that the file imports.
        slug: of the module.

    Raises:
        InputError: for an unknown module, or an opset that is not a whole number of at least 1.
    """
    if isinstance(opset, bool) or not isinstance(opset, int) or opset < 1:
        raise InputError(
            "opset",
            given=opset,
            expected="a whole number, 1 or more",
            fix="Read it from the model: onnx.load(path).opset_import[0].version.",
        )
    module, release = load_module(slug), newest_jetpack(slug)
    newest = int(release.onnx_opset.value)
    stack = f"JetPack {release.version} (TensorRT {release.tensorrt})"
    if opset > newest:
        ok = False
        # The exporter that torch uses by default writes opset 18 and later only.
        how = f"opset_version={newest}" + (", dynamo=False" if newest < 18 else "")
        advice = (
            f"{stack} is the newest for the {module.name} and parses opsets up to {newest}. Export again with "
            f"torch.onnx.export(..., {how}); operators that came later must be written with older ones."
        )
    elif opset < OLDEST_OPSET:
        ok = False
        advice = (
            f"{stack} parses opsets from {OLDEST_OPSET}. Convert the file with "
            f"onnx.version_converter.convert_version(model, {min(13, newest)})."
        )
    else:
        ok, advice = True, f"{stack} of the {module.name} parses opset {opset} (up to {newest})."
        older = [r for r in jetpacks_for(slug) if r.onnx_opset.value < opset]
        if older:
            advice += f" JetPack {older[-1].version} and older do not."
    return Compatibility(ok, opset, newest, release.version, release.tensorrt.text, advice)


def load_headlines() -> tuple[Headline, ...]:
    """Return the headline figures of the course outline, from the smallest module to the largest.

    Raises:
        InputError: for a table that does not hold what it must.
    """
    root = read_table(find_part("headlines.toml"))
    root.only(("sources", "headlines"))
    headlines: list[Headline] = []
    for slug, table in root.tables("headlines").items():
        table.only(("outline", "datasheet", "counts", "why"))
        headlines.append(
            Headline(
                module=load_module(slug),
                outline=table.statement("outline"),
                datasheet=table.statement("datasheet"),
                counts=table.text("counts"),
                why=table.text("why"),
            )
        )
    return tuple(sorted(headlines, key=lambda headline: headline.module.fp32_tflops))
