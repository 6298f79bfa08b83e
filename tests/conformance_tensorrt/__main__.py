"""``python -m tests.conformance_tensorrt``: read the names of the genuine TensorRT bindings and compare.

Linux x86-64 with gcc and nm. The bindings (about 1 MB each, from PyPI) are loaded without TensorRT itself: an empty
library stands in for what they link to, which is enough to list classes, methods and enumerations, and for nothing
else. The result is ``genuine_names.json``, which ``tests/jetson/test_engine_names.py`` holds the typing stub and the
simulated runtime to. Bindings for another Python than this one are skipped and keep their stored names.
"""

from __future__ import annotations

import ast
import json
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

REPO = Path(__file__).resolve().parents[2]
NAMES = Path(__file__).with_name("genuine_names.json")
STUB = REPO / "stubs" / "tensorrt" / "__init__.pyi"
# What is simulated as 11.0 is held against 11.4 too, the newest.
PACKAGES = {
    "8.6": ("tensorrt-bindings", "8.6.1", "8"),
    "10.3": ("tensorrt-cu12-bindings", "10.3.0", "10"),
    "10.13": ("tensorrt-cu12-bindings", "10.13.0.35", "10"),
    "11.0": ("tensorrt-cu13-bindings", "11.0.0.114", "11"),
    "11.4": ("tensorrt-cu13-bindings", "11.4.0.106", "11"),
}
LIBRARIES = ("nvinfer", "nvonnxparser", "nvinfer_plugin", "nvparsers")
READ = """
import importlib.machinery, importlib.util, json, os, sys
sys.setdlopenflags(os.RTLD_LAZY)
loader = importlib.machinery.ExtensionFileLoader("tensorrt", sys.argv[1])
spec = importlib.util.spec_from_file_location("tensorrt", sys.argv[1], loader=loader)
module = importlib.util.module_from_spec(spec)
loader.exec_module(module)
found = {}
for name in sys.argv[2].split(","):
    kind = getattr(module, name, None)
    if kind is not None:
        if hasattr(kind, "__members__"):
            found[name] = {member: int(value) for member, value in kind.__members__.items()}
        else:
            found[name] = " ".join(member for member in dir(kind) if not member.startswith("_"))
print(json.dumps(found))
"""


def stub_classes() -> dict[str, set[str]]:
    """Return the public names of the classes in the typing stub."""
    classes: dict[str, set[str]] = {}
    for node in ast.parse(STUB.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            members = {
                part.target.id if isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name) else part.name
                for part in node.body
                if isinstance(part, (ast.AnnAssign, ast.FunctionDef, ast.ClassDef))
            }
            classes[node.name] = {member for member in members if not member.startswith("_")}
    return classes


def read_names(package: str, version: str, major: str, folder: Path) -> dict[str, object] | None:
    """Download bindings and return their names by class; None if there are none for this Python."""
    pip = [
        sys.executable,
        "-m",
        "pip",
        "download",
        "--quiet",
        "--no-deps",
        "--only-binary=:all:",
        "--dest",
        str(folder),
    ]
    if subprocess.run([*pip, f"{package}=={version}"], check=False).returncode:
        return None
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    (binding,) = folder.rglob("tensorrt.so")
    listed = subprocess.run(
        ["nm", "-D", "--undefined-only", str(binding)], check=True, capture_output=True, text=True
    ).stdout.split("\n")
    symbols = [line.split()[1] for line in listed if line.split()[:1] == ["U"] and "@" not in line]
    ours = [symbol for symbol in symbols if not symbol.startswith(("Py", "_Py", "_Unwind"))]
    source = folder / "empty.c"
    source.write_text("\n".join(f"void *{symbol}(void) {{ return 0; }}" for symbol in ours))
    for library in LIBRARIES:
        target = folder / f"lib{library}.so.{major}"
        subprocess.run(["gcc", "-w", "-shared", "-fPIC", "-o", str(target), str(source)], check=True)
    read = subprocess.run(
        [sys.executable, "-c", READ, str(binding), ",".join(stub_classes())],
        check=True,
        capture_output=True,
        text=True,
        env={"LD_LIBRARY_PATH": str(folder), "PATH": "/usr/bin:/bin"},
    )
    found: dict[str, object] = json.loads(read.stdout)
    return found


def main() -> int:
    """Update the names and say what changed."""
    stored = json.loads(NAMES.read_text(encoding="utf-8")) if NAMES.is_file() else {}
    changed = 0
    for simulated, (package, version, major) in PACKAGES.items():
        with tempfile.TemporaryDirectory() as folder:
            found = read_names(package, version, major, Path(folder))
        if found is None:
            print(f"{package} {version}: cannot be had for this Python; the stored names stay")
            continue
        same = stored.get(simulated) == found
        changed += not same
        stored[simulated] = found
        print(f"{package} {version}: {len(found)} classes, {'as stored' if same else 'CHANGED'}")
    NAMES.write_text(json.dumps(stored, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    return 1 if changed else 0


if __name__ == "__main__":
    sys.exit(main())
