"""What a bundle is pinned to: the module and its power mode, and the versions that one JetPack brings."""

from __future__ import annotations

from typing import Any

from robotbrain.errors import InputError
from robotbrain.jetson.catalogue import load_module
from robotbrain.jetson.kernels import PRECISIONS
from robotbrain.jetson.measure.board import BY_MEMORY, MODULES
from robotbrain.jetson.software import OLDEST_OPSET, JetPack, jetpacks_for


def target_of(module: str, mode: str | None, jetpack: str | None) -> dict[str, Any]:
    """Return the ``target`` section of a manifest.

    Args:
        module: slug.
        mode: power mode by name or alias; None for the module's default.
        jetpack: release; None for the newest of the module.

    Raises:
        InputError: for an unknown module or mode, or a JetPack that does not run on the module.
    """
    found = load_module(module)
    chosen = found.mode(mode)
    release = release_for(found.slug, jetpack)
    plain = found.slug.removesuffix("-super")
    return {
        "module": found.slug,
        "name": found.name,
        "mode": chosen.name,
        "mode_names": sorted({chosen.name, *chosen.aliases}),
        "parts": sorted(part for part, slug in MODULES.items() if slug == plain),
        "parts_by_memory_gib": {p: [low, high] for p, (low, high, slug) in BY_MEMORY.items() if slug == plain},
        "jetpack": release.version,
        "jetson_linux": release.l4t.text,
        "tensorrt": release.tensorrt.text,
        "cuda": release.cuda.text,
        "cudnn": None if release.cudnn is None else release.cudnn.text,
        "ubuntu": release.ubuntu.text,
        "python": release.python.text,
        "newest_opset": int(release.onnx_opset.value),
    }


def release_for(module: str, jetpack: str | None) -> JetPack:
    """Return a JetPack release that runs on a module.

    Raises:
        InputError: if this one does not.
    """
    releases = {release.version: release for release in jetpacks_for(module)}
    if jetpack is not None and jetpack not in releases:
        raise InputError(
            "JetPack",
            given=f"{jetpack} on {module}",
            expected="one of " + ", ".join(releases),
            fix="`robotbrain jetson jetpack` lists what runs where; point releases count as the one they follow.",
        )
    return releases[jetpack] if jetpack is not None else list(releases.values())[-1]


def check_precision(target: dict[str, Any], precision: str, *, quantised: bool, half: bool, calibrated: bool) -> None:
    """Refuse a precision that the module does not have, or that this ONNX cannot be built in.

    Args:
        target: see target_of.
        precision: wanted.
        quantised: the ONNX has QuantizeLinear and DequantizeLinear.
        half: it has float16 tensors.
        calibrated: there is a calibration cache.

    Raises:
        InputError: saying what to do instead.
    """
    module = load_module(target["module"])
    if precision not in PRECISIONS:
        raise _wrong(precision, "one of " + ", ".join(PRECISIONS), "Choose one.")
    if precision == "int8" and module.int8_tops is None:
        raise _wrong(
            f"int8 on {module.name}",
            "fp16 or fp32 (no INT8 there)",
            "Deploy the float network as fp16.",
        )
    strongly_typed = int(target["tensorrt"].partition(".")[0]) >= 11
    if quantised and precision != "int8":
        raise _wrong(
            f"{precision} for an ONNX with QuantizeLinear", "int8", "Say --precision int8, or give the float network."
        )
    if quantised and calibrated:
        raise InputError(
            "--calibration",
            given="ranges for an ONNX that carries its own scales (QDQ)",
            expected="none: TensorRT would ignore them",
            fix="Leave it out, or give the float network.",
        )
    if precision == "int8" and not quantised and not calibrated:
        raise _wrong(
            "int8 for a float ONNX without calibration",
            "QuantizeLinear and DequantizeLinear in the ONNX" + (", or ranges" if not strongly_typed else ""),
            "Quantise it first (`robotbrain optimise quantise`), or give --calibration.",
        )
    if strongly_typed and precision == "int8" and not quantised:
        raise _wrong(
            "int8 by calibration with TensorRT 11 or later",
            "QDQ: calibrators are gone",
            "Quantise it first (`robotbrain optimise quantise`).",
        )
    if half and precision == "fp32":
        raise _wrong("fp32 for an ONNX with float16 tensors", "fp16", "Say --precision fp16, or export in float32.")
    if strongly_typed and precision == "fp16" and not half:
        raise _wrong(
            "fp16 for a float32 ONNX with TensorRT 11 or later",
            "an ONNX in float16: networks are strongly typed there",
            "Export it in float16, or say --precision fp32.",
        )


def check_opset(target: dict[str, Any], opset: int) -> None:
    """Refuse an opset that the JetPack's parser does not take.

    Raises:
        InputError: saying how to export again.
    """
    newest = target["newest_opset"]
    if not OLDEST_OPSET <= opset <= newest:
        raise InputError(
            "opset",
            given=opset,
            expected=f"{OLDEST_OPSET} to {newest} (TensorRT {target['tensorrt']} of JetPack {target['jetpack']})",
            fix=f"Export again with opset_version={min(newest, 17)} (and dynamo=False), or choose a newer JetPack.",
        )


def _wrong(given: str, expected: str, fix: str) -> InputError:
    return InputError("precision", given=given, expected=expected, fix=fix)
