"""Ports and proxies: a notebook is a web page that talks to servers on this computer."""

from __future__ import annotations

import errno
import os
import socket
import urllib.request
from collections.abc import Iterable
from typing import Any

from robotbrain.doctor.finding import Cure, Finding, Situation, everywhere, fault, ok, posix_or_windows, warning

HOST = "127.0.0.1"
JUPYTER_PORT = 8888
JUPYTER_TRIES = 50


def loopback(situation: Situation) -> list[Finding]:
    """Whether processes of this computer can talk to one another: kernels, the robot, the views in 3D need it."""
    limit_s = min(5.0, situation.limit_s)
    try:
        with socket.create_server((HOST, 0)) as server:
            server.settimeout(limit_s)
            with socket.create_connection(server.getsockname(), timeout=limit_s) as client:
                other, _ = server.accept()
                with other:
                    client.sendall(b"robotbrain")
                    other.settimeout(limit_s)
                    if other.recv(16) != b"robotbrain":
                        raise OSError("what was sent did not arrive")
    except OSError as error:
        return [
            fault(
                f"programs on this computer cannot talk to one another over {HOST}: {error}",
                Cure(
                    "sudo ip link set lo up; and in the firewall: sudo iptables -I INPUT -i lo -j ACCEPT",
                    "sudo ifconfig lo0 up; then allow Python in the firewall or security program",
                    "Allow Python in Windows Security > Firewall > Allow an app, and in any other security program",
                ),
            )
        ]
    try:
        addresses = {info[4][0] for info in socket.getaddrinfo("localhost", None, type=socket.SOCK_STREAM)}
    except OSError as error:
        addresses, reason = set(), str(error)
    else:
        reason = "it means " + ", ".join(sorted(map(str, addresses)))
    if HOST not in addresses:
        return [
            warning(
                f"the name localhost does not lead to {HOST} ({reason}): addresses that Jupyter prints may not open",
                posix_or_windows(
                    f"echo '{HOST} localhost' | sudo tee -a /etc/hosts",
                    f'As administrator: Add-Content $env:SystemRoot\\System32\\drivers\\etc\\hosts "{HOST} localhost"',
                ),
            )
        ]
    return [ok(f"programs on this computer can talk to one another over {HOST}")]


def ports(_: Situation) -> list[Finding]:
    """Ports that the course's programs ask for first."""
    from robotbrain.link.handshake import DEFAULT_PORT

    found = []
    if taken := _taken(JUPYTER_PORT):
        free = next((p for p in range(JUPYTER_PORT + 1, JUPYTER_PORT + JUPYTER_TRIES) if not _taken(p)), None)
        what = f"port {JUPYTER_PORT}, where JupyterLab is usually found, is taken by {_holder(JUPYTER_PORT)}"
        if free is None:
            found.append(
                fault(f"{what}, and so are the next {JUPYTER_TRIES}: JupyterLab cannot start", _stop(), detail=taken)
            )
        else:
            found.append(
                warning(
                    f"{what}: a bookmark of localhost:{JUPYTER_PORT} asks there for a token that does not fit",
                    everywhere(
                        f"robotbrain lab --port {free} (or without --port: open the address that it prints); "
                        f"{_stop().here()}"
                    ),
                    detail=taken,
                )
            )
    if taken := _taken(DEFAULT_PORT):
        found.append(
            warning(
                f"port {DEFAULT_PORT}, where `robotbrain robot` waits for a brain, is taken by {_holder(DEFAULT_PORT)}",
                everywhere(
                    f"End the robot that runs already (Ctrl-C in its terminal), or use another port: robotbrain robot "
                    f"--port {DEFAULT_PORT + 1}, robotbrain drive --robot ros --address {HOST}:{DEFAULT_PORT + 1}"
                ),
                detail=taken,
            )
        )
    return found or [ok(f"ports {JUPYTER_PORT} (JupyterLab) and {DEFAULT_PORT} (robot) are free")]


def _stop() -> Cure:
    return Cure(
        f"`jupyter server list` shows servers that still run, `jupyter server stop {JUPYTER_PORT}` ends one; "
        f"`ss -ltnp 'sport = :{JUPYTER_PORT}'` names any other program",
        f"`jupyter server list` shows servers that still run, `jupyter server stop {JUPYTER_PORT}` ends one; "
        f"`lsof -nP -iTCP:{JUPYTER_PORT} -sTCP:LISTEN` names any other program",
        f"`jupyter server list` shows servers that still run, `jupyter server stop {JUPYTER_PORT}` ends one; "
        f"`Get-NetTCPConnection -LocalPort {JUPYTER_PORT} | Select OwningProcess` names any other program",
    )


def _taken(port: int) -> str:
    """Return why a server cannot listen on ``port``; empty if it can."""
    try:
        # create_server lets Linux and macOS reuse a port whose last owner has just gone, and no other.
        socket.create_server((HOST, port)).close()
    except OSError as error:
        if error.errno in (errno.EADDRINUSE, errno.EACCES):
            return error.strerror or str(error)
    return ""


def _holder(port: int) -> str:
    """Name the program that listens on ``port``, as far as the system tells."""
    try:
        import psutil

        connections: Iterable[Any] = psutil.net_connections("tcp")
        for connection in connections:
            if connection.status == psutil.CONN_LISTEN and connection.laddr.port == port and connection.pid:
                process = psutil.Process(connection.pid)
                return f"{process.name()} (process {connection.pid})"
    except Exception:  # other users' processes are not shown, and psutil may be missing
        pass
    return "another program"


def proxies(_: Situation) -> list[Finding]:
    """A proxy that is asked for this computer's own addresses answers that they do not exist."""
    named = {scheme: url for scheme, url in urllib.request.getproxies().items() if scheme in ("http", "https", "all")}
    if not named:
        return [ok("no proxy is set")]
    if all(urllib.request.proxy_bypass(host) for host in ("localhost", HOST)):
        return [ok("a proxy is set, and passed over for this computer's own addresses")]
    variables = sorted({name for name in os.environ if name.lower() in ("http_proxy", "https_proxy", "all_proxy")})
    exceptions = ",".join(filter(None, (os.environ.get("NO_PROXY") or os.environ.get("no_proxy"), "localhost", HOST)))
    who = " and ".join(variables) or "the system settings"
    where = ", ".join(sorted(set(named.values())))
    return [
        fault(
            f"{who} name a proxy ({where}) and NO_PROXY does not except this computer: Jupyter would be "
            "looked for behind it",
            posix_or_windows(
                f"export NO_PROXY={exceptions},::1 no_proxy={exceptions},::1 (in ~/.profile to keep it)",
                f'setx NO_PROXY "{exceptions},::1" (then open a new terminal; for the browser: Settings > Network > '
                "Proxy > do not use it for local addresses)",
            ),
        )
    ]
