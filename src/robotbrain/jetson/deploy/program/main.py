"""Check the bundle and the board, build the engine, check its numbers, time it, write the result."""

import argparse
import platform
import shutil
import signal
import sys
from pathlib import Path
from typing import Any

from . import engine, jetson, numerics, timing, trtexec
from .bundle import read_manifest, sha256_of
from .problem import Refused

BUNDLE = Path(__file__).resolve().parents[1]


def main(words: "list[str]") -> int:
    """Run one command; return 0, 2 for what is refused, 130 when interrupted."""
    arguments = _parser().parse_args(words)
    signal.signal(signal.SIGTERM, _interrupt)
    if hasattr(signal, "SIGHUP"):
        signal.signal(signal.SIGHUP, _interrupt)  # a closed ssh session
    try:
        return _main(arguments)
    except Refused as error:
        sys.stdout.flush()
        sys.stderr.write(f"error: {error}\n")
        return 2
    except OSError as error:
        sys.stdout.flush()
        sys.stderr.write(f"error: {error}. Is the disk full, or not yours? --work names another folder.\n")
        return 2
    except KeyboardInterrupt:
        sys.stdout.flush()
        sys.stderr.write("stopped; nothing half-done is left. Start it again to go on.\n")
        return 130


def _main(arguments: argparse.Namespace) -> int:
    manifest = read_manifest(BUNDLE)
    target = manifest["target"]
    print("bundle {}: {} files are as the manifest says".format(manifest["name"], len(manifest["files"])))
    board = jetson.read_board(arguments.root)
    notes = jetson.check_board(board, target)
    program = trtexec.find(arguments.trtexec)
    jetson.check_tensorrt(program.version, board["tensorrt_package"], target)
    mode = jetson.power_mode(target, arguments.mode)
    pinned = jetson.clocks_pinned()
    if not pinned:
        notes.append("clocks were not pinned" if pinned is False else "not known whether the clocks were pinned")
    print("board {}, TensorRT {}, mode {}".format(board["model"] or target["name"], program.version, mode))
    for note in notes:
        print("note: " + note)
    if arguments.command == "check":
        return 0
    work = (arguments.work or BUNDLE.with_name(BUNDLE.name + "-board")).resolve()
    if work == BUNDLE or BUNDLE in work.parents:
        raise Refused("--work", work, "a folder outside the bundle", "The bundle stays as it is: name another folder.")
    work.mkdir(parents=True, exist_ok=True)
    record = engine.get(program, manifest, BUNDLE, work, board)
    plan = work / "engines" / (record["key"] + ".engine")
    print("engine: {} ({:.1f} MB)".format(plan, record["bytes"] / 1e6))
    rows = numerics.check(program, manifest, BUNDLE, work, plan)
    worst = max((row["rms"] for row in rows), default=0.0)
    print(f"numerics: {len(rows)} outputs agree, relative error {worst:.2g} (rms, worst)")
    if arguments.command == "build":
        return 0
    folder = timing.scratch(work)
    try:
        logs = timing.measure(
            program,
            manifest,
            plan,
            folder,
            runs=arguments.runs,
            duration_s=arguments.duration,
            cuda_graph=arguments.cuda_graph,
        )
        facts = _facts(manifest, board, program, record, notes)
        facts.update(runs=logs, numerics=rows, clocks_pinned=pinned, cuda_graph=arguments.cuda_graph)
        result = timing.write_result(work, folder, facts)
    finally:
        shutil.rmtree(str(folder), ignore_errors=True)
    print(f"result: {result}")
    print("On a machine with the kit: robotbrain jetson measure --from-bundle RESULT")
    return 0


def _facts(
    manifest: "dict[str, Any]",
    board: "dict[str, Any]",
    program: trtexec.Trtexec,
    record: "dict[str, Any]",
    notes: "list[str]",
) -> "dict[str, Any]":
    network, target = manifest["network"], manifest["target"]
    return {
        "bundle_sha256": sha256_of(BUNDLE / "manifest.json"),
        "kit": manifest["kit"],
        "name": manifest["name"],
        "network_sha256": network["sha256"],
        "module": target["module"],
        "mode": target["mode"],
        "precision": manifest["parameters"]["precision"],
        "shapes": {tensor["name"]: tensor["shape"] for tensor in network["inputs"]},
        "jetpack": board["jetpack"] or target["jetpack"],
        "jetson_linux": board["jetson_linux"],
        "tensorrt": program.version,
        "board": {"model": board["model"], "parts": board["parts"], "memory_mb": board["memory_mb"]},
        "engine": {"key": record["key"], "sha256": record["sha256"], "bytes": record["bytes"], "flags": _flags(record)},
        "python": platform.python_version(),
        "notes": notes,
    }


def _flags(record: "dict[str, Any]") -> "list[str]":
    return list(record["made_of"]["flags"])


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="sh run.sh", description=__doc__)
    parser.add_argument("command", choices=["check", "build", "run"], help="how far to go")
    parser.add_argument("--work", type=Path, metavar="DIR", help="engines and results (default: beside the bundle)")
    parser.add_argument("--runs", type=_positive, default=3, help="how often to time it (default: 3)")
    parser.add_argument("--duration", type=_positive, default=10, metavar="S", help="of each (default: 10 s)")
    parser.add_argument("--cuda-graph", action="store_true", help="launch through a CUDA graph")
    parser.add_argument("--trtexec", metavar="FILE", help="default: on PATH, or where JetPack puts it")
    parser.add_argument("--mode", help="the power mode, where nvpmodel is missing (containers)")
    parser.add_argument("--root", type=Path, default=Path("/"), help="where the board's /proc and /etc are mounted")
    return parser


def _positive(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError("1 or more")
    return number


def _interrupt(_signal: int, _frame: "object | None") -> None:
    raise KeyboardInterrupt
