"""The engine: built once, kept under a name that says what it was made of, checked before it is used again."""

import contextlib
import hashlib
import json
import os
import time
from pathlib import Path
from typing import Any

from .bundle import sha256_of
from .problem import Refused
from .trtexec import Trtexec, build_flags, run


def made_of(program: Trtexec, manifest: "dict[str, Any]", board: "dict[str, Any]") -> "dict[str, Any]":
    """Return all that an engine depends on; one of another GPU, TensorRT or network must never be used."""
    calibration = manifest["calibration"]
    return {
        "onnx": manifest["network"]["sha256"],
        "calibration": None if calibration is None else manifest["files"][calibration["file"]]["sha256"],
        "tensorrt": program.version,
        "tensorrt_package": board["tensorrt_package"],
        "jetson_linux": board["jetson_linux"],
        "module": manifest["target"]["module"],
        "part": next(iter(board["parts"]), None),
        "mode": manifest["target"]["mode"],
        "flags": build_flags(program, manifest),
    }


def key_of(ingredients: "dict[str, Any]") -> str:
    """Return the name of the engine made of these."""
    return hashlib.sha256(json.dumps(ingredients, sort_keys=True).encode("ascii")).hexdigest()[:32]


def cached(folder: Path, key: str) -> "dict[str, Any] | None":
    """Return the record of a finished engine, or None if there is none that is whole."""
    try:
        record = json.loads((folder / (key + ".json")).read_text(encoding="ascii"))
        whole = record["key"] == key and sha256_of(folder / (key + ".engine")) == record["sha256"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return dict(record) if whole else None


def get(
    program: Trtexec, manifest: "dict[str, Any]", folder: Path, work: Path, board: "dict[str, Any]"
) -> "dict[str, Any]":
    """Return the record of the engine, building it if need be; ``built`` says whether it was built now.

    Raises:
        Refused: if trtexec fails.
        KeyboardInterrupt: when interrupted; no half engine stays.
    """
    engines = work / "engines"
    engines.mkdir(parents=True, exist_ok=True)
    _sweep(engines)
    ingredients = made_of(program, manifest, board)
    key = key_of(ingredients)
    record = cached(engines, key)
    if record is not None:
        print(f"engine {key} is there already: not built again")
        return dict(record, built=False)
    partial = engines / f"{key}.{os.getpid()}.part"
    command = [program.path, "--onnx=" + str(folder / manifest["network"]["file"])]
    command += build_flags(program, manifest)
    if manifest["calibration"] is not None:
        cache = _calibration(program, folder / manifest["calibration"]["file"], engines / (key + ".calibration"))
        command.append("--calib=" + str(cache))
    if "timingCacheFile" in program.options:
        command.append("--timingCacheFile=" + str(engines / "timing.cache"))
    # Without such an option it is run once; 8.5 and earlier call it --buildOnly.
    alone = [name for name in ("skipInference", "buildOnly") if name in program.options][:1]
    command += ["--" + alone[0]] if alone else ["--iterations=1", "--duration=0", "--warmUp=0"]
    command.append("--saveEngine=" + str(partial))
    began = time.monotonic()
    try:
        run(command, work / "build.log", "engine")
        if not partial.is_file() or not partial.stat().st_size:
            raise Refused("trtexec", "no engine", "a file from --saveEngine", "See build.log beside the result.")
        record = {
            "key": key,
            "sha256": sha256_of(partial),
            "bytes": partial.stat().st_size,
            "build_s": round(time.monotonic() - began, 1),
            "made_of": ingredients,
        }
        with partial.open("rb+") as file:
            os.fsync(file.fileno())
        partial.replace(engines / (key + ".engine"))
        write_json(engines / (key + ".json"), record)  # last: without it the engine does not count
    finally:
        with contextlib.suppress(OSError):
            partial.unlink()
    return dict(record, built=True)


def write_json(path: Path, data: "dict[str, Any]") -> None:
    """Write a JSON file whole or not at all."""
    partial = path.with_name(f"{path.name}.{os.getpid()}.part")
    with partial.open("w", encoding="ascii", newline="\n") as file:
        file.write(json.dumps(data, indent=1, sort_keys=True) + "\n")
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)


def _calibration(program: Trtexec, cache: Path, target: Path) -> Path:
    """Write the cache with a first line for this very TensorRT: it ignores those of other versions and calibrators."""
    lines = cache.read_text(encoding="utf-8").splitlines()
    major, minor, patch = (int(part) for part in program.version.split(".")[:3])
    number = (major * 100 + minor) * 100 + patch if major >= 10 else major * 1000 + minor * 100 + patch
    lines[0] = f"TRT-{number}-EntropyCalibration2"  # the calibrator of trtexec, whatever found the ranges
    target.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return target


def _sweep(folder: Path) -> None:
    """Remove what a killed run left behind."""
    for path in folder.glob("*.part"):
        owner = path.name.split(".")[-2]
        if not (owner.isdigit() and Path("/proc/" + owner).exists()):
            with contextlib.suppress(OSError):
                path.unlink()
