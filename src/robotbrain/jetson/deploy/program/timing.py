"""Timing the engine, with the sensors' readings, and writing what `robotbrain jetson measure --from-bundle` reads."""

import hashlib
import os
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

from . import trtexec
from .bundle import sha256_of
from .engine import write_json

INTERVAL_MS = 200


def measure(
    program: trtexec.Trtexec,
    manifest: "dict[str, Any]",
    engine: Path,
    folder: Path,
    *,
    runs: int,
    duration_s: int,
    cuda_graph: bool,
) -> "list[dict[str, str | None]]":
    """Time the engine several times; return the names of the logs that it left in ``folder``, by run."""
    logs = []  # type: list[dict[str, str | None]]
    flags = trtexec.time_flags(program, manifest, duration_s, cuda_graph)
    for index in range(1, runs + 1):
        sensors = folder / f"run_{index}.tegrastats.log"
        sampler = _start_sensors(sensors)
        try:
            command = [program.path, "--loadEngine=" + str(engine), *flags]
            trtexec.run(command, folder / f"run_{index}.trtexec.log", f"run {index} of {runs}")
        finally:
            if sampler is not None:
                trtexec.stop(sampler)
        there = sensors.is_file() and sensors.stat().st_size > 0
        logs.append({"trtexec": f"run_{index}.trtexec.log", "tegrastats": sensors.name if there else None})
    return logs


def write_result(work: Path, folder: Path, facts: "dict[str, Any]") -> Path:
    """Put a finished measurement where results are (``work/result``) and return that folder.

    Args:
        work: beside the bundle.
        folder: with the logs; it is moved.
        facts: for result.json; the checksums of the logs are added.
    """
    names = sorted(path.name for path in folder.iterdir())
    files = {n: {"bytes": (folder / n).stat().st_size, "sha256": sha256_of(folder / n)} for n in names}
    date = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    write_json(folder / "result.json", dict(facts, schema="robotbrain-result", version=1, date=date, files=files))
    digest = hashlib.sha256((folder / "result.json").read_bytes()).hexdigest()
    (folder / "result.sha256").write_text(digest + "  result.json\n", encoding="ascii")
    final = work / "result"
    old = work / f"result.{os.getpid()}.old"
    if final.exists():
        final.rename(old)
    folder.rename(final)
    final.chmod(0o755)
    shutil.rmtree(str(old), ignore_errors=True)
    return final


def scratch(work: Path) -> Path:
    """Return a fresh folder for logs."""
    return Path(tempfile.mkdtemp(dir=str(work), prefix=".result-"))


def _start_sensors(log: Path) -> "subprocess.Popen[bytes] | None":
    program = shutil.which("tegrastats")
    if program is None:
        return None
    command = [program, "--interval", str(INTERVAL_MS), "--logfile", str(log)]
    return subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
