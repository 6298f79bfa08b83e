"""``python -m tests.hub``: a class on a genuine JupyterHub, from release to feedback.

Needs Linux, root and node with npm; jupyterhub itself is the extra ``hub``. Nothing is left on the machine: users,
homes, exchange and all processes exist in namespaces of their own, which end with this command.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

REPO = Path(__file__).resolve().parents[2]
PROXY_VERSION = "5.3.0"


def missing() -> str:
    """Return why this machine cannot run it, or ``""``."""
    if sys.platform != "linux" or os.geteuid() != 0:
        return "it needs root on Linux: the hub starts servers as other users"
    if find_spec("jupyterhub") is None:
        return 'JupyterHub is not installed: pip install -e ".[hub]"'
    programs = [name for name in ("unshare", "setpriv", "mount", "node", "npm", "bwrap") if not shutil.which(name)]
    return f"not installed: {', '.join(programs)}" if programs else ""


def proxy() -> Path:
    """Return the hub's proxy, which is a node program, installed into ``build/hub`` on first use."""
    script = REPO / "build" / "hub" / "node_modules" / "configurable-http-proxy" / "bin" / "configurable-http-proxy"
    if not script.is_file():
        script.parents[3].mkdir(parents=True, exist_ok=True)
        package = f"configurable-http-proxy@{PROXY_VERSION}"
        command = ["npm", "install", "--no-audit", "--no-fund", "--prefix", str(script.parents[3]), package]
        subprocess.run(command, check=True)
    return script


def main() -> int:
    """Run the scenario in a machine of its own; return its exit code."""
    if why := missing():
        print(f"tests.hub: {why}", file=sys.stderr)
        return 2
    private = ["unshare", "--mount", "--pid", "--fork", "--kill-child", "--mount-proc", "--net", "--ipc", "--uts"]
    command = [*private, sys.executable, "-m", "tests.hub.machine", str(proxy())]
    return subprocess.run(command, cwd=REPO, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
