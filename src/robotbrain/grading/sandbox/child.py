"""What a forked child of the student's fork server does: shut itself in, then run what the grader asks for.

Two processes come of it: the *monitor* (this one, trusted code only) and below it, in namespaces of its own, the
student's process. The grader's messages to the latter: ``file`` (put a file into the working directory), ``run`` (a
cell), ``snapshot`` (fork yourself; the copy answers tests on the socket that comes along), ``serve`` (answer them
without forking). Its answers: ``ready``, a cell's outputs, ``done``, ``forked``, ``served``, ``failed``.
"""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
import signal
import socket
import sys
import tempfile
import traceback
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from robotbrain.grading.sandbox import isolation, shell
from robotbrain.grading.sandbox.bubblewrap import HOME
from robotbrain.grading.sandbox.channel import Channel, ChannelClosed

_LARGEST = 64 << 20
_seccomp: bytes | None = None
_shell: shell.Shell | None = None


def prepare(seccomp: bytes | None = None) -> None:
    """Before forking: keep the filter of system calls, make the shell, and see that torch has no thread pool."""
    global _seccomp, _shell
    _seccomp = seccomp
    _shell = shell.make_shell()
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.set_num_threads(1)  # a pool used before the fork would hang the child
    _warm_up()


def _warm_up() -> None:
    """Do for the first time what the labs' tests will ask of every copy."""
    from robotbrain.grading.remote import rehearse
    from robotbrain.grading.suite import Suite

    for module in list(sys.modules.values()):
        suite = vars(module).get("suite")
        if not isinstance(suite, Suite) or not module.__name__.startswith("robotbrain.grading.suites."):
            continue
        warmers: list[Callable[[], object]] = [*suite.student_warmers, functools.partial(rehearse, suite)]
        for warm in warmers:
            try:
                warm()
            except Exception:  # whoever needs it meets the error itself
                traceback.print_exc()


def main(job: Mapping[str, Any], sockets: Sequence[socket.socket]) -> None:
    """Entry of a child: be the monitor of a new student's process until it has ended.

    Args:
        job: ``environment``, ``folder`` (working directory where no private one can be made), ``bounds``,
            ``output_bytes``.
        sockets: the conversation with the grader; the monitor's line to the grader.
    """
    control, line = sockets
    from robotbrain.grading.sandbox import monitor

    os.setsid()
    if not monitor.wait_for_go(line):
        return
    with contextlib.suppress(OSError):  # if the host runs out of memory, this is to go first
        Path("/proc/self/oom_score_adj").write_text("1000", encoding="utf-8")
    contained = isolation.enter_namespaces()
    if not contained:
        from robotbrain.grading.sandbox import linux

        linux.adopt_orphans()
    # Inside bubblewrap, but without namespaces of its own: then its folder lies among those of the others.
    shared = tempfile.mkdtemp() if not contained and not job["folder"] else ""
    pid = os.fork()
    if pid == 0:
        _be_the_student({**job, "folder": job["folder"] or shared}, control, contained)
    control.close()
    monitor.watch(pid, line, contained=contained)
    if shared:
        shutil.rmtree(shared, ignore_errors=True)


def main_alone(job: Mapping[str, Any], sockets: Sequence[socket.socket]) -> None:
    """Entry where there is neither a fork server nor a monitor: be the student's process.

    Args:
        sockets: the conversation with the grader; one end of a pair that ends with the grader; the tests' socket.
    """
    global _shell
    _shell = shell.make_shell()
    _be_the_student(job, sockets[0], False, sockets[2])


def _be_the_student(
    job: Mapping[str, Any], control: socket.socket, contained: bool, rpc: socket.socket | None = None
) -> NoReturn:
    code = 1
    try:
        layers = _shut_in(job, [control] if rpc is None else [control, rpc], contained)
        assert _shell is not None
        channel = Channel(control, _LARGEST, accept_fds=True)
        shell.attach(_shell, channel.send, int(job["output_bytes"]))
        channel.send({"op": "ready", "layers": layers})
        _obey(channel, _shell, rpc)
        code = 0
    finally:
        os._exit(code)


def _shut_in(job: Mapping[str, Any], keep: Sequence[socket.socket], contained: bool) -> list[str]:
    """Every layer that can be had, in the order that lets them be had; return those that hold."""
    layers = []
    private = False
    if sys.platform == "linux":
        from robotbrain.grading.sandbox import linux

        linux.die_with_parent(signal.SIGKILL)
        linux.close_all_but({0, 1, 2, *(s.fileno() for s in keep)})
        with contextlib.suppress(PermissionError):  # it leads a session already
            os.setsid()
        isolation.set_limits(job["bounds"], contained)
        layers.append("limits")
        if contained:
            private = isolation.mount_private_folders(job["bounds"]["disk_bytes"], job["bounds"]["files"])
            layers.append("namespaces")
    null = os.open(os.devnull, os.O_RDWR)
    for number in (0, 1, 2):
        os.dup2(null, number)
    os.close(null)
    folder = isolation.WORK if private else job["folder"]
    home = HOME if private else folder
    os.chdir(folder)
    own = {"HOME": home, "PWD": folder, "IPYTHONDIR": f"{home}/.ipython", "MPLCONFIGDIR": f"{home}/.matplotlib"}
    if private:
        own["TMPDIR"] = "/tmp"
    os.environ.clear()
    os.environ.update({**job["environment"], **own})
    sys.path.insert(0, "")  # a notebook imports files beside it
    sys.argv = [""]
    if sys.platform == "linux":
        isolation.give_up_rights(_seccomp)
        if _seccomp:
            layers.append("seccomp")
    return layers


def _obey(channel: Channel, ipython: shell.Shell, own_rpc: socket.socket | None) -> None:
    """Do what the grader says until it is gone; ``own_rpc`` serves tests where descriptors cannot be sent."""
    while True:
        try:
            message = channel.receive()
        except ChannelClosed:
            return
        assert message is not None
        operation = message["op"]
        if operation == "file":
            _put_file(message["name"], message["data"])
        elif operation == "run":
            ok = shell.run_cell(ipython, message["source"], message["number"])
            channel.send({"op": "done", "ok": ok})
        elif operation == "snapshot":
            _snapshot(channel, ipython)
        elif operation == "serve":
            rpc = own_rpc or socket.socket(fileno=channel.take_fd())
            shell.mute()
            _serve(rpc, ipython, channel)
            rpc.close()
            channel.send({"op": "served"})


def _put_file(name: str, data: bytes) -> None:
    path = Path(name)
    if path.is_absolute() or ".." in path.parts:
        return
    with contextlib.suppress(OSError):  # too large for this submission's disk: the student's code meets it missing
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)


def _snapshot(channel: Channel, ipython: shell.Shell) -> None:
    """Fork; the copy serves the tests' socket and never returns."""
    fd = channel.take_fd()
    try:
        pid = os.fork()
    except OSError as error:  # the limit on processes
        os.close(fd)
        channel.send({"op": "failed", "why": str(error)})
        return
    if pid == 0:
        try:
            channel.close()
            shell.mute()
            _serve(socket.socket(fileno=fd), ipython, None)
        finally:
            os._exit(0)
    os.close(fd)
    channel.send({"op": "forked", "pid": pid})


def _serve(rpc: socket.socket, ipython: shell.Shell, stop: Channel | None) -> None:
    from robotbrain.grading.remote.serve import serve

    serve(rpc, ipython.user_ns, stop)
