"""Starts one job in a fresh Python process, where forking a warm one is not possible (Windows, macOS).

``python -P -m robotbrain.grading.sandbox.spawn``: the job comes as one line of JSON on standard input, with its
sockets as inherited descriptors (POSIX) or as shared handles (Windows).
"""

from __future__ import annotations

import base64
import json
import os
import socket
import sys
from typing import Any

from robotbrain.grading.sandbox.names import import_all, resolve


def share(sock: socket.socket, pid: int) -> Any:
    """What process ``pid`` needs to open ``sock`` for itself."""
    if sys.platform == "win32":
        return base64.b64encode(sock.share(pid)).decode()
    return sock.fileno()


def _open(shared: Any) -> socket.socket:
    if sys.platform == "win32":
        return socket.fromshare(base64.b64decode(shared))
    return socket.socket(fileno=shared)


def main() -> None:
    """Do the job on standard input."""
    setup = json.loads(sys.stdin.buffer.readline())
    sockets = [_open(s) for s in setup["sockets"]]
    if setup["prepare"]:
        resolve(setup["prepare"])(**setup["arguments"])
    entry = resolve(setup["entry"])
    import_all(setup["preload"])
    entry(setup["job"], sockets)


if __name__ == "__main__":
    try:
        main()
    finally:
        os._exit(0)
