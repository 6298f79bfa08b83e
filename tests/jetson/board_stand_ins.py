"""A board that is none: device tree, version files and stand-ins for NVIDIA's programs, to run a bundle's program.

The stand-ins print what the genuine programs print (tests/data/jetson_logs) and compute nothing: what the "engine"
answers is what the bundle expects, plus an error on demand. No figure that comes out of them is a latency.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

LOGS = Path(__file__).resolve().parents[1] / "data" / "jetson_logs"

TRTEXEC = '''#!{python}
"""Stand-in for trtexec."""
import array, json, os, sys, time
from pathlib import Path
VERSION = os.environ.get("STAND_IN_TENSORRT", "100300")
GONE = os.environ.get("STAND_IN_GONE", "").split()
OPTIONS = ("onnx saveEngine loadEngine shapes fp16 int8 calib memPoolSize workspace skipInference timingCacheFile "
           "iterations duration warmUp avgRuns percentile useSpinWait noDataTransfers useCudaGraph loadInputs "
           "exportOutput stronglyTyped").split()
OPTIONS = [o for o in OPTIONS if o not in GONE]
banner = "TensorRT.trtexec [TensorRT v" + VERSION + "] # " + " ".join(sys.argv)
words = dict(w[2:].partition("=")[::2] for w in sys.argv[1:])
with open(os.environ["STAND_IN_CALLS"], "a") as calls:
    calls.write(json.dumps(sys.argv[1:]) + "\\n")
print("&&&& RUNNING " + banner, flush=True)
if "help" in words:
    for option in OPTIONS:
        print("  --" + option + ("=P1,P2,P3" if option == "percentile" else "=<value>"))
    sys.exit()
unknown = sorted(set(words) - set(OPTIONS))
if unknown:
    print("[E] Unknown option: --" + unknown[0]); print("&&&& FAILED " + banner); sys.exit(1)
if "onnx" in words:
    assert Path(words["onnx"]).is_file()
    print("[I] Start parsing network model.", flush=True)
    print("[I] Finished parsing network model.", flush=True)
    Path(words["saveEngine"]).write_bytes(b"half")
    if os.environ.get("STAND_IN_BUILD") == "hang":
        time.sleep(60)
    if os.environ.get("STAND_IN_BUILD") == "fail":
        print("[E] Error[2]: [builder.cpp] out of memory"); print("&&&& FAILED " + banner); sys.exit(1)
    Path(words["saveEngine"]).write_bytes(b"stand-in for an engine " + " ".join(sorted(words)).encode())
    print("[I] Engine built in 1.0 sec.")
elif "loadInputs" in words:
    assert Path(words["loadEngine"]).read_bytes().startswith(b"stand-in")
    given = dict(pair.split(":") for pair in words["loadInputs"].split(","))
    manifest = json.loads(Path("manifest.json").read_text())
    vector = next(v for v in manifest["numerics"]["vectors"] if v["inputs"] == given)
    entries = []
    for name, entry in vector["outputs"].items():
        values = array.array("f", Path(entry["file"]).read_bytes())
        error = float(os.environ.get("STAND_IN_ERROR", "0")) * max(map(abs, values))
        values = [value + error * (-1) ** index for index, value in enumerate(values)]
        text = ", ".join("%.6g" % v for v in values)
        if os.environ.get("STAND_IN_NAN"):
            text = "-nan" + text[text.index(","):]
        dims = "x".join(map(str, entry["shape"]))
        entries.append('{{ "name" : "%s"\\n  , "dimensions" : "%s"\\n  , "values" : [ %s ]\\n  }}' % (name, dims, text))
    Path(words["exportOutput"]).write_text("[\\n  " + ", ".join(entries) + "]\\n")
else:
    for line in open({log!r}, encoding="utf-8"):
        if not line.startswith("&&&&") and "[I] Model:" not in line:
            line = line.replace("[I] Load engine: ", "[I] Load engine: " + words["loadEngine"])
            line = line.replace("images=1x3x640x640", words["shapes"].replace(":", "="))
            line = line.replace("images with dimensions 1x3x640x640", words["shapes"].replace(":", " with dimensions "))
            print(line, end="", flush=True)
print("&&&& PASSED " + banner)
'''

NVPMODEL = '#!/bin/sh\n# stand-in\necho "NV Power Mode: ${STAND_IN_MODE:-15W}"\necho 0\n'
CLOCKS = "#!/bin/sh\n# stand-in\ncat '{log}'\n"
DPKG = (
    "#!/bin/sh\n# stand-in\nfor package do :; done\ncase $package in\n"
    'nvidia-jetpack) printf 6.2+b77 ;;\ntensorrt) printf %s "${STAND_IN_PACKAGE:-10.3.0.30-1+cuda12.5}" ;;\n'
    "*) echo 'no packages found' >&2; exit 1 ;;\nesac\n"
)
TEGRASTATS = '''#!{python}
"""Stand-in for tegrastats."""
import sys, time
log = open(sys.argv[sys.argv.index("--logfile") + 1], "w")
while True:
    log.write("RAM 1000/7620MB (lfb 1x4MB) CPU [1%@729,2%@729] GR3D_FREQ 99%@[612] cpu@50C VDD_IN 6000mW/6000mW\\n")
    log.flush()
    time.sleep(0.01)
'''


class StandInBoard:
    """A folder with stand-ins and a root, and a way to run a bundle's program there."""

    def __init__(self, folder: Path, parts: str = "p3768-0000+p3767-0005", release: str = "36, 4.3") -> None:
        self.folder, self.root, self.bin = folder, folder / "root", folder / "bin"
        tree = self.root / "proc" / "device-tree"
        tree.mkdir(parents=True)
        (self.root / "etc").mkdir()
        self.bin.mkdir()
        tree.joinpath("model").write_bytes(b"NVIDIA Jetson Orin Nano (stand-in)\0")
        tree.joinpath("compatible").write_bytes(f"nvidia,{parts}\0nvidia,tegra234\0".encode())
        major, revision = release.split(", ")
        self.root.joinpath("etc", "nv_tegra_release").write_text(
            f"# R{major} (release), REVISION: {revision}, GCID: 1\n"
        )
        log = str(LOGS / "trtexec_10_3_orin.log")
        for name, text in {
            "trtexec": TRTEXEC.format(python=sys.executable, log=log),
            "tegrastats": TEGRASTATS.format(python=sys.executable),
            "nvpmodel": NVPMODEL,
            "jetson_clocks": CLOCKS.format(log=LOGS / "jetson_clocks_orin_nano_pinned.txt"),
            "dpkg-query": DPKG,
        }.items():
            self.bin.joinpath(name).write_text(text, encoding="utf-8")
            self.bin.joinpath(name).chmod(0o755)
        self.calls = folder / "calls.jsonl"

    def environment(self, **changes: str) -> dict[str, str]:
        path = os.pathsep.join([str(self.bin), "/usr/bin", "/bin"])
        plain = {"PATH": path, "PYTHON": sys.executable, "PYTHONWARNINGS": "error", "STAND_IN_CALLS": str(self.calls)}
        return {**plain, "LC_ALL": "C", "HOME": str(self.folder), **changes}

    def command(self, bundle: Path, *words: str, script: str = "run.sh", shell: str = "sh") -> list[str]:
        return [shell, str(bundle / script), "--root", str(self.root), *words]

    def check(self, bundle: Path, *words: str, command: str = "check", **changes: str) -> str:
        """Run the program without the shell; return what it says when it refuses, else the empty string."""
        line = [sys.executable, "-B", str(bundle / "board.py"), command, "--root", str(self.root), *words]
        environment = self.environment(**changes)
        done = subprocess.run(line, env=environment, cwd=self.folder, capture_output=True, text=True, timeout=120)
        assert done.returncode in (0, 2) and "Traceback" not in done.stderr, done.stderr
        assert (done.returncode == 2) == done.stderr.startswith("error: "), done.stderr
        return done.stderr

    def run(
        self, bundle: Path, *words: str, script: str = "run.sh", shell: str = "sh", **changes: str
    ) -> subprocess.CompletedProcess[str]:
        command = self.command(bundle, *words, script=script, shell=shell)
        return subprocess.run(
            command, env=self.environment(**changes), cwd=self.folder, capture_output=True, text=True, timeout=120
        )

    def called(self, word: str) -> list[str]:
        """Return the calls of trtexec that have an option."""
        lines = self.calls.read_text().splitlines() if self.calls.exists() else []
        return [line for line in lines if f'"--{word}' in line]
