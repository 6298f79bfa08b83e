"""Running trtexec: which options this one has, and its lines with progress as they come."""

import queue
import re
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any, Generator, NamedTuple  # noqa: UP035  (3.6)

from .jetson import ask
from .problem import Refused

PLACES = ("/usr/src/tensorrt/bin/trtexec", "/usr/local/tensorrt/bin/trtexec", "/opt/tensorrt/bin/trtexec")
STAGES = (
    ("Start parsing", "reading the ONNX"),
    ("Finish parsing", "building the engine (this takes minutes)"),
    ("Finished parsing", "building the engine (this takes minutes)"),
    ("Engine built", "engine built"),
    ("Engine loaded", "engine loaded"),
    ("Starting inference", "running"),
    ("=== Performance summary", "done"),
)


class Trtexec(NamedTuple):
    """A trtexec: where it is, its version, its options without dashes, whether --percentile takes a list."""

    path: str
    version: str
    options: "frozenset[str]"
    percentiles: bool


def find(named: "str | None") -> Trtexec:
    """Return the trtexec that was named, the one on PATH, or where JetPack puts it.

    Raises:
        Refused: if there is none that answers.
    """
    candidates = [named] if named else ["trtexec", *PLACES]
    path = next((found for found in map(shutil.which, candidates) if found), None)
    if path is None:
        fix = "Install it with `sudo apt install libnvinfer-bin`, or name it with --trtexec."
        raise Refused("trtexec", "none", "trtexec on PATH or at " + PLACES[0], fix)
    text = ask([path, "--help"], timeout_s=120)
    body = "\n".join(line for line in text.splitlines() if not line.startswith("&&&&"))
    options = frozenset(re.findall(r"--([A-Za-z][A-Za-z0-9]*)", body))
    version = _version(text)
    if "onnx" not in options or version is None:
        raise Refused("trtexec --help", repr(text[:100]), "options and a version", "Is TensorRT 8 or later installed?")
    return Trtexec(path, version, options, "--percentile=P1" in text)


def precision_flags(options: "frozenset[str]", precision: str, network: "dict[str, Any]") -> "list[str]":
    """Return the flags that give a precision.

    Raises:
        Refused: if this trtexec cannot give it to this network.
    """
    if precision == "fp32":
        return []
    if network["half"] and "stronglyTyped" in options:
        return ["--stronglyTyped"]
    wanted = ["--fp16"] if precision == "fp16" else ["--int8", "--fp16"]  # else what is not quantised runs in FP32
    if all(word[2:] in options for word in wanted):
        return wanted
    if network["quantised"] or network["half"]:
        return []  # TensorRT 11 has only strong typing: the ONNX itself says
    fix = "Quantise the network, or export it in float16, and make the bundle again."
    raise Refused("precision", precision, "an ONNX that carries it: this trtexec has no " + " ".join(wanted), fix)


def shape_flags(network: "dict[str, Any]") -> "list[str]":
    """Return the flag for the shapes of inputs whose batch the ONNX leaves open."""
    if not network["dynamic"]:
        return []
    pairs = [quoted(i["name"]) + ":" + "x".join(map(str, i["shape"])) for i in network["inputs"]]
    return ["--shapes=" + ",".join(pairs)]


def build_flags(program: Trtexec, manifest: "dict[str, Any]") -> "list[str]":
    """Return what decides about the engine (not where files are)."""
    flags = precision_flags(program.options, manifest["parameters"]["precision"], manifest["network"])
    flags += shape_flags(manifest["network"])
    if "memPoolSize" not in program.options and "workspace" in program.options:
        flags.append("--workspace=1024")  # these versions default to 16 MiB, too little for most tactics
    return flags


def time_flags(program: Trtexec, manifest: "dict[str, Any]", duration_s: int, cuda_graph: bool) -> "list[str]":
    """Return how a finished engine is timed: as `robotbrain jetson measure` does.

    Raises:
        Refused: if a CUDA graph is asked for that this trtexec does not have.
    """
    flags = shape_flags(manifest["network"])
    flags += ["--iterations=100", f"--duration={duration_s}", "--warmUp=1000", "--avgRuns=100"]
    flags += [
        "--percentile=90,95,99" if program.percentiles else "--percentile=99",
        "--useSpinWait",
        "--noDataTransfers",
    ]
    if cuda_graph and "useCudaGraph" not in program.options:
        raise Refused("--cuda-graph", "TensorRT " + program.version, "a trtexec with --useCudaGraph", "Leave it out.")
    return flags + (["--useCudaGraph"] if cuda_graph else [])


def run(command: "list[str]", log: Path, title: str, folder: "Path | None" = None) -> str:
    """Run trtexec to its end, show what it is doing, and return (and keep) all that it printed.

    Args:
        command: of trtexec.
        log: file for its output.
        title: of the progress.
        folder: to run it in.

    Raises:
        Refused: if it fails; its own errors are named.
        KeyboardInterrupt: when interrupted; the process has ended then.
    """
    lines = []  # type: list[str]
    progress = _Progress(title)
    with log.open("w", encoding="utf-8") as file:
        child = subprocess.Popen(
            command,
            cwd=str(folder) if folder is not None else None,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        try:
            for line in _lines(child):
                progress(line or "")
                if line is not None:
                    lines.append(line)
                    file.write(line + "\n")
            code = child.wait()
        finally:
            stop(child)
            if child.stdout is not None:
                child.stdout.close()
            progress.end()
    text = "\n".join(lines) + "\n"
    if code != 0 or "&&&& PASSED" not in text:
        errors = [line for line in lines if "[E]" in line or "[F]" in line][:3] or lines[-1:]
        raise Refused("trtexec", f"exit code {code}: " + " | ".join(errors), "&&&& PASSED", f"All of it is in {log}.")
    return text


def stop(child: "subprocess.Popen[bytes]") -> None:
    """End a process that may have ended already: ask first, then insist."""
    if child.poll() is None:
        child.terminate()
        try:
            child.wait(timeout=5)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()


def _lines(child: "subprocess.Popen[bytes]") -> "Generator[str | None, None, None]":
    """Yield the lines of a process, and None twice a second while there is none."""
    found = queue.Queue()  # type: queue.Queue[str | None]
    stream = child.stdout
    assert stream is not None

    def read() -> None:
        for line in stream:
            found.put(line.decode("utf-8", "replace").rstrip("\r\n"))
        found.put(None)

    reader = threading.Thread(target=read)
    reader.daemon = True
    reader.start()
    while True:
        try:
            line = found.get(timeout=0.5)
        except queue.Empty:
            yield None
            continue
        if line is None:
            reader.join()
            return
        yield line


class _Progress:
    """What trtexec is doing, with the seconds it has been at it."""

    def __init__(self, title: str) -> None:
        self._title, self._stage = title, "starting"
        self._began = self._said = time.monotonic()
        self._terminal = sys.stdout.isatty()

    def __call__(self, line: str) -> None:
        stage = next((words for sign, words in STAGES if sign in line), self._stage)
        now = time.monotonic()
        # Into a file, a line for each stage and one a minute, so that nobody thinks that it hangs.
        if self._terminal or stage != self._stage or now - self._said > 60:
            self._stage, self._said = stage, now
            start, end = ("\r\x1b[K", "") if self._terminal else ("", "\n")
            sys.stdout.write(f"{start}  {now - self._began:5.0f} s  {self._title}: {stage}{end}")
            sys.stdout.flush()

    def end(self) -> None:
        if self._terminal:
            sys.stdout.write("\n")


def quoted(name: str) -> str:
    """Return a tensor's name as trtexec takes it before a colon."""
    return f"'{name}'" if ":" in name else name


def _version(text: str) -> "str | None":
    found = re.search(r"\[TensorRT v([\d.]{1,20})\]", text)
    if found is None:
        return None
    if "." in found.group(1):
        return found.group(1)
    number = int(found.group(1))
    step = 100 if number >= 100000 else 10  # 8201 is 8.2.1, 100300 is 10.3.0
    major, rest = divmod(number, 100 * step)
    return f"{major}.{rest // 100}.{rest % 100}"
