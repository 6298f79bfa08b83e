"""``robotbrain doctor``: what is installed, what is missing, and how to get it."""

from __future__ import annotations

import argparse
import importlib.metadata
import shutil
import sys
from pathlib import Path

_PACKAGES = ("numpy", "mujoco-core", "onnxruntime", "torch", "jupyterlab", "nbgrader", "nbclient", "rosbags", "meshcat")
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """``robotbrain doctor`` takes no arguments."""


def findings() -> list[tuple[bool, bool, str]]:
    """(fine, needed, text) for everything looked at."""
    found = [(sys.version_info >= (3, 11), True, f"Python {sys.version.split()[0]}")]
    for name in _PACKAGES:
        try:
            found.append((True, True, f"{name} {importlib.metadata.version(name)}"))
        except importlib.metadata.PackageNotFoundError:
            found.append((False, True, f"{name} is missing. Run: python -m pip install {name}"))
    scripts = Path(sys.executable).parent
    alembic = shutil.which("alembic") or shutil.which("alembic", path=str(scripts))
    found.append((alembic is not None, True, "alembic, which nbgrader calls for its gradebook"))
    kernel = Path(sys.prefix) / "share" / "jupyter" / "kernels" / "python3"
    found.append((kernel.is_dir(), False, "a python3 Jupyter kernel in this environment"))
    extensions = Path(sys.prefix) / "share" / "jupyter" / "labextensions" / "@jupyter" / "nbgrader"
    found.append((extensions.is_dir(), False, "nbgrader's JupyterLab extension (Validate button, formgrader)"))
    browser = next((b for b in _BROWSERS if shutil.which(b)), None)
    found.append((browser is not None, False, f"a Chromium browser for the browser tests ({browser or 'none found'})"))
    return found + sandbox_findings()


def sandbox_findings() -> list[tuple[bool, bool, str]]:
    """What shuts student code in while grading on this host; only teachers need it."""
    from robotbrain.grading.bench import host_layers

    return [(layer.active, False, f"grading sandbox, {layer.name}: {layer.note}") for layer in host_layers()]


def main(arguments: argparse.Namespace) -> int:
    """Run ``robotbrain doctor``; 1 if something needed is missing."""
    del arguments
    for fine, needed, text in findings():
        print(f"{'ok      ' if fine else 'MISSING ' if needed else 'optional'}  {text}")
    return 0 if all(fine for fine, needed, _ in findings() if needed) else 1
