"""Lint of Q/DQ models for TensorRT: what it would refuse, what would cost time, and what to do about it.

TensorRT's own messages come late (on the board, after minutes) and name internals. This reads the file anywhere. It
knows the rules in :mod:`robotbrain.optimisation.qdq_rules` and :mod:`robotbrain.optimisation.qdq_placement`, which
quote their sources; a file without findings has still not been built by TensorRT.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from robotbrain.errors import InputError
from robotbrain.jetson.software import JetPack, load_jetpacks
from robotbrain.optimisation.onnx_files import read_model
from robotbrain.optimisation.qdq_context import Context, Finding
from robotbrain.optimisation.qdq_placement import PLACEMENT_RULES, dla
from robotbrain.optimisation.qdq_rules import RULES

if TYPE_CHECKING:
    import onnx

__all__ = ["Finding", "check", "explain", "lint"]


def lint(model: str | Path | onnx.ModelProto, *, jetpack: str | None = None, dla: bool = False) -> list[Finding]:
    """Return what is wrong with a Q/DQ model for TensorRT: errors first, then warnings, each in the order of the rules.

    Args:
        model: path of an ONNX file, or a parsed one.
        jetpack: release that is to build it, e.g. ``"6.2"``; None for whatever any from 5.0.2 on accepts.
        dla: also say what a deep learning accelerator would not run.

    Raises:
        InputError: for a missing or damaged file, or an unknown JetPack.
    """
    proto = read_model(model, check_weights=False) if isinstance(model, (str, Path)) else model
    context = Context(proto, _release(jetpack))
    rules = (*RULES, *PLACEMENT_RULES, *((_dla,) if dla else ()))
    findings = [finding for rule in rules for finding in rule(context)]
    return sorted(findings, key=lambda finding: finding.severity != "error")


def check(model: str | Path | onnx.ModelProto, *, jetpack: str | None = None, dla: bool = False) -> list[Finding]:
    """Return the warnings of :func:`lint`, if there are no errors.

    Raises:
        InputError: with the first error; or for a missing or damaged file, or an unknown JetPack.
    """
    findings = lint(model, jetpack=jetpack, dla=dla)
    errors = [finding for finding in findings if finding.severity == "error"]
    if errors:
        first = errors[0]
        kinds = ", ".join(dict.fromkeys(finding.code for finding in errors))
        name = Path(model).name if isinstance(model, (str, Path)) else "model"
        raise InputError(
            name + (f", at {first.node}" if first.node else ""),
            given=f"{first.code}: {first.message}",
            expected=f"a Q/DQ model that TensorRT takes; {len(errors)} errors in all ({kinds})",
            fix=first.fix,
        )
    return findings


def explain(findings: Iterable[Finding], *, width: int = 100) -> str:
    """Return findings as text: one paragraph for each code, with the number of places and the first of them.

    Args:
        findings: from :func:`lint`.
        width: of a line, characters.
    """
    groups: dict[tuple[str, str], list[Finding]] = {}
    for finding in findings:
        groups.setdefault((finding.severity, finding.code), []).append(finding)
    if not groups:
        return "No findings: nothing here that TensorRT is known to refuse."
    lines: list[str] = []
    for (severity, code), group in groups.items():
        first = group[0]
        places = f"{len(group)} places, first: {first.node}" if len(group) > 1 else first.node or "the whole file"
        lines.append(f"{severity:<8}{code:<18}{places}")
        for text in (first.message, "Fix: " + first.fix):
            lines += textwrap.wrap(text, width, initial_indent=" " * 8, subsequent_indent=" " * 8)
    count = {kind: sum(len(group) for (severity, _), group in groups.items() if severity == kind) for kind in _KINDS}
    lines.append(", ".join(f"{number} {kind}{'s' * (number != 1)}" for kind, number in count.items()))
    return "\n".join(lines)


_KINDS = ("error", "warning")
_dla = dla  # the function's option of the same name hides it


def _release(version: str | None) -> JetPack | None:
    if version is None:
        return None
    releases = {release.version: release for release in load_jetpacks()}
    if version not in releases:
        raise InputError(
            "jetpack", given=version, expected=", ".join(releases), fix="On a board: cat /etc/nv_tegra_release."
        )
    return releases[version]
