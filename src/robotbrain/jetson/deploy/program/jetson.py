"""Which board this is, what is installed on it, and whether that is what the bundle was made for."""

import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

from .problem import Refused

PART = re.compile(r"(?<!\d)p?(\d{4})-(\d{4})(?!\d)")
RELEASE = re.compile(r"R(\d+) \(release\), REVISION: (\d+(?:\.\d+)*)")
MODE = re.compile(r"NV Power Mode:\s*([A-Za-z0-9_.+-]+)\s*$", re.MULTILINE)
FAMILIES = ("2888", "3310", "3448", "3668", "3701", "3767", "3834")
PACKAGES = ("libnvinfer-bin", "tensorrt", "libnvinfer11", "libnvinfer10", "libnvinfer8")


def ask(command: "list[str]", timeout_s: float = 20) -> str:
    """Return what a short command prints; the empty string if it cannot be run."""
    program = shutil.which(command[0])
    if program is None:
        return ""
    try:
        done = subprocess.run(
            [program, *command[1:]],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=timeout_s,
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout.decode("utf-8", "replace")


def read_board(root: Path) -> "dict[str, Any]":
    """Return what the board says about itself: model, part numbers, Jetson Linux, memory, package versions."""
    tree = root / "proc" / "device-tree"
    ids = tree / "chosen" / "plugin-manager" / "ids"
    texts = sorted(path.name for path in ids.iterdir()) if ids.is_dir() else []
    texts += [_text(tree / "chosen" / "ids"), _text(tree / "nvidia,dtsfilename"), _text(tree / "compatible")]
    parts = [f"{board}-{sku}" for text in texts for board, sku in PART.findall(text) if board in FAMILIES]
    release = RELEASE.search(_text(root / "etc" / "nv_tegra_release"))
    memory = re.search(r"MemTotal:\s+(\d+) kB", _text(root / "proc" / "meminfo"))
    return {
        "model": _text(tree / "model"),
        "parts": sorted(set(parts), key=parts.index),
        "jetson_linux": ".".join(release.groups()) if release else None,
        "memory_mb": int(memory.group(1)) // 1024 if memory else None,
        "jetpack": _package("nvidia-jetpack"),
        "tensorrt_package": next((v for v in map(_package, PACKAGES) if v), None),
    }


def check_board(board: "dict[str, Any]", target: "dict[str, Any]") -> "list[str]":
    """Return notes on small differences.

    Raises:
        Refused: if the module or its software is another one.
    """
    wanted = "{} ({})".format(target["name"], target["module"])
    if not board["parts"] and not board["jetson_linux"] and "jetson" not in board["model"].lower():
        raise Refused("this machine", board["model"] or "no Jetson", wanted, "Run the bundle on the board.")
    part = next(iter(board["parts"]), None)
    low, high = target["parts_by_memory_gib"].get(part, (0, 0))
    fits = part in target["parts"] or low < (board["memory_mb"] or 0) / 1024 < high
    if part is not None and not fits:
        what = "{} with part number {}".format(board["model"] or "a board", part)
        fix = "Make a bundle for this module: `robotbrain jetson deploy ... --module`."
        raise Refused("module", what, "{}, part {}".format(wanted, " or ".join(_parts(target))), fix)
    notes = [] if part is not None else ["the board names no part number: its module was not checked"]
    found, pinned = board["jetson_linux"], target["jetson_linux"]
    if found is None:
        notes.append("no /etc/nv_tegra_release (a container?): Jetson Linux was not checked")
    elif found.split(".")[0] != pinned.split(".")[0]:
        fix = "Make a bundle with the board's --jetpack, or flash JetPack {}.".format(target["jetpack"])
        raise Refused("Jetson Linux", found, "{} of JetPack {}".format(pinned, target["jetpack"]), fix)
    elif found != pinned:
        notes.append(f"Jetson Linux {found} instead of {pinned}")
    return notes


def check_tensorrt(version: str, package: "str | None", target: "dict[str, Any]") -> None:
    """Check the versions that trtexec and the package manager name.

    Raises:
        Refused: if they are not the bundle's, or differ from each other.
    """
    wanted = target["tensorrt"].split(".")
    if version.split(".")[: len(wanted)] != wanted:
        fix = "Make a bundle with the board's --jetpack (`robotbrain jetson jetpack` lists them)."
        raise Refused("TensorRT", version, "{} of JetPack {}".format(target["tensorrt"], target["jetpack"]), fix)
    if package is not None and package.split("-")[0].split(".")[:3] != version.split(".")[:3]:
        fix = "Two versions are installed: name the right trtexec with --trtexec, or reinstall the package tensorrt."
        raise Refused("TensorRT", f"trtexec {version} beside package {package}", "one version", fix)


def power_mode(target: "dict[str, Any]", said: "str | None") -> str:
    """Return the power mode that the board is in.

    Args:
        target: of the bundle.
        said: by the person at the board, for containers without nvpmodel.

    Raises:
        Refused: if it is not the bundle's, or not known.
    """
    found = MODE.search(ask(["nvpmodel", "-q"]))
    mode = found.group(1) if found else said
    fix = "Set it: `sudo nvpmodel -p --verbose` lists the modes, `sudo nvpmodel -m NUMBER` sets one."
    if mode is None:
        raise Refused("nvpmodel -q", "no answer", "a power mode", "Run with sudo, or in a container say --mode NAME.")
    if mode.lower() not in [name.lower() for name in target["mode_names"]]:
        raise Refused("power mode", mode, "{}, which the bundle is for".format(target["mode"]), fix)
    return str(target["mode"])


def clocks_pinned() -> "bool | None":
    """Return whether jetson_clocks holds the clocks; None if it does not say (it needs root)."""
    shown = ask(["jetson_clocks", "--show"])
    gpu = re.search(r"^GPU MinFreq=(\d+)\s+MaxFreq=(\d+)", shown, re.MULTILINE)
    cpus = re.findall(r"^cpu\d+:\s+(?:Online=(\d)\s+)?.*?MinFreq=(\d+)\s+MaxFreq=(\d+)", shown, re.MULTILINE)
    if gpu is None:
        return None
    return gpu.group(1) == gpu.group(2) and all(low == high for online, low, high in cpus if online != "0")


def _parts(target: "dict[str, Any]") -> "list[str]":
    return list(target["parts"]) + sorted(target["parts_by_memory_gib"])


def _text(path: Path) -> str:
    try:
        return path.read_bytes().decode("utf-8", "replace").replace("\0", " ").strip()
    except OSError:
        return ""


def _package(name: str) -> "str | None":
    found = ask(["dpkg-query", "--show", "--showformat=${Version}", name]).strip()
    return found if re.match(r"\d[\w.+~:-]*$", found) else None
