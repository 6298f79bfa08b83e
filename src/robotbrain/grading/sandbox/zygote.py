"""The warm process: imports once, then forks one child per job. ``python -P -m robotbrain.grading.sandbox.zygote FD``.

It has one client, the process that started it, on the stream socket ``FD``. Its first message says what to prepare;
each further one asks for a child: which function to call, with what, and the sockets that come along. The answer is a
pidfd of the child. It runs trusted code only and has one thread, as forking demands.
"""

from __future__ import annotations

import gc
import os
import resource
import signal
import socket
import sys
import time
import traceback
from pathlib import Path
from typing import Any, NoReturn

from robotbrain.grading.sandbox.channel import Channel, ChannelClosed
from robotbrain.grading.sandbox.heap import fill_holes
from robotbrain.grading.sandbox.linux import adopt_orphans, die_with_parent, set_dumpable
from robotbrain.grading.sandbox.names import import_all, resolve

LARGEST_JOB = 64 << 20
_REAP_S = 1.0
_DESCRIPTORS = 4096


def become(uid: int) -> None:
    """Be user ``uid`` from now on, with no way back."""
    os.setgroups([])
    os.setresgid(uid, uid, uid)
    os.setresuid(uid, uid, uid)
    set_dumpable(True)  # else /proc/self belongs to root, and no user namespace can be set up


def serve(channel: Channel) -> None:
    """Prepare, then fork children until the client is gone."""
    start = time.perf_counter()
    setup = channel.receive()
    assert setup is not None
    if setup["uid"] is not None:
        become(setup["uid"])
    os.umask(0o022)
    adopt_orphans()
    _open_more_files()
    failed = import_all(setup["preload"])
    if setup["prepare"]:
        resolve(setup["prepare"])(**setup["arguments"])
    entry = resolve(setup["entry"])
    gc.collect()
    fill_holes()
    gc.freeze()
    threads = len(list(Path("/proc/self/task").iterdir()))
    channel.send({"ready": time.perf_counter() - start, "threads": threads, "failed": failed, "pid": os.getpid()})
    children: set[int] = set()
    while True:
        request = channel.receive(_REAP_S)
        _reap(children)
        if request is None:
            continue
        fds = [channel.take_fd() for _ in range(request["fds"])]
        pid = os.fork()
        if pid == 0:
            channel.close()
            _child(entry, request["job"], fds)
        children.add(pid)
        for fd in fds:
            os.close(fd)
        handle = os.pidfd_open(pid)
        channel.send({"pid": pid}, [handle])
        os.close(handle)


def _open_more_files() -> None:
    """More descriptors than submissions may have on their way together: the kernel counts those per user."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _DESCRIPTORS if hard == resource.RLIM_INFINITY else min(_DESCRIPTORS, hard)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, wanted), hard))


def _child(entry: Any, job: dict[str, Any], fds: list[int]) -> NoReturn:
    code = 1
    try:
        die_with_parent(signal.SIGKILL)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        entry(job, [socket.socket(fileno=fd) for fd in fds])
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)


def _reap(children: set[int]) -> None:
    """Collect ended children, and end orphans: what a job without a pid namespace left behind."""
    while True:
        try:
            pid, _ = os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            return
        if pid == 0:
            break
        children.discard(pid)
    for line in _own_children():
        if line not in children:
            os.kill(line, signal.SIGKILL)


def _own_children() -> list[int]:
    try:
        return [
            int(p) for p in Path("/proc/self/task", str(os.getpid()), "children").read_text(encoding="utf-8").split()
        ]
    except OSError:  # a kernel without CONFIG_PROC_CHILDREN
        return []


def main(fd: int) -> None:
    """Serve the client on descriptor ``fd``."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a person's Ctrl-C is for the grader, which then ends us
    channel = Channel(socket.socket(fileno=fd), LARGEST_JOB, accept_fds=True)
    try:
        serve(channel)
    except ChannelClosed:
        return


if __name__ == "__main__":
    main(int(sys.argv[1]))
