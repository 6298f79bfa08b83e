# ruff: noqa: E501 - payloads are one-line texts
"""System calls that lead out of a sandbox, and the network."""

from __future__ import annotations

from tests.grading.attacks.attack import PRELUDE, Attack

KIND = "system calls"

_CALL = """
import ctypes, os, sys
libc = ctypes.CDLL(None, use_errno=True)
def call(what, number, *arguments, good=lambda r: r >= 0):
    result = libc.syscall(number, *arguments)
    if good(result):
        breach(f"{what} gave {result}")
    return result
buffer = ctypes.create_string_buffer(4096)
"""

# Numbers of x86-64; elsewhere the harness leaves these out.
_SYSTEM_CALLS = {
    "unshare": "for flag in (0x10000000, 0x20000, 0x40000000, 0x20000000, 0x08000000, 0x04000000, 0x02000000):\n"
    "    call(f'unshare {flag:x}', 272, flag)",
    "clone into namespaces": "for flag in (0x10000000, 0x20000, 0x40000000, 0x20000000):\n"
    "    pid = libc.syscall(56, flag | 17, 0, 0, 0, 0)\n    if pid == 0:\n        os._exit(0)\n    if pid > 0:\n"
    "        breach(f'clone {flag:x}')",
    "clone3 into namespaces": "import struct\nargs = ctypes.create_string_buffer(struct.pack('<11Q', 0x10000000, 0, 0, 0, 17,"
    " 0, 0, 0, 0, 0, 0))\npid = libc.syscall(435, args, 88)\nif pid == 0:\n    os._exit(0)\nif pid > 0:\n"
    "    breach('clone3')",
    "setns": "for pid in ('1', '2', 'self', str(os.getppid())):\n    for kind in ('mnt', 'net', 'pid', 'user', 'ipc'):\n"
    "        try:\n            fd = os.open(f'/proc/{pid}/ns/{kind}', os.O_RDONLY)\n        except OSError:\n            continue\n"
    "        call(f'setns {pid} {kind}', 308, fd, 0)",
    "mount": "call('mount tmpfs', 165, b'none', b'/tmp', b'tmpfs', 0, None)\n"
    "call('mount proc', 165, b'proc', b'/tmp', b'proc', 0, None)\n"
    "call('bind', 165, b'/', b'/tmp', None, 4096, None)\n"
    "call('remount', 165, None, b'/', None, 32 | 4096, None)\n"
    "call('umount', 166, b'/tmp', 2)\ncall('umount proc', 166, b'/proc', 2)\n"
    "call('fsopen', 430, b'tmpfs', 0)\ncall('open_tree', 428, -100, b'/', 1)\n"
    "call('move_mount', 429, -100, b'/', -100, b'/tmp', 0)\ncall('mount_setattr', 442, -100, b'/', 0, buffer, 32)",
    "pivot_root and chroot": "call('pivot_root', 155, b'.', b'.')\nos.makedirs('root', exist_ok=True)\n"
    "call('chroot', 161, b'root')",
    "ptrace": "for pid in (os.getppid(), 1, 2, 3):\n    if pid not in (0, os.getpid()):\n"
    "        call(f'ptrace attach {pid}', 101, 16, pid, 0, 0)\n        call(f'ptrace seize {pid}', 101, 0x4206, pid, 0, 0)",
    "other processes' memory": "import struct\niov = struct.pack('<QQ', ctypes.addressof(buffer), 64)\n"
    "local = ctypes.create_string_buffer(iov)\nremote = ctypes.create_string_buffer(struct.pack('<QQ', 0x400000, 64))\n"
    "for pid in (os.getppid(), 1, 2, 3):\n    if pid != os.getpid():\n"
    "        call(f'process_vm_readv {pid}', 310, pid, local, 1, remote, 1, 0, good=lambda r: r > 0)\n"
    "        call(f'process_vm_writev {pid}', 311, pid, local, 1, remote, 1, 0, good=lambda r: r > 0)\n"
    "        call(f'kcmp {pid}', 312, os.getpid(), pid, 0, 0, 0)",
    "descriptors of other processes": "for pid in (1, 2, os.getppid()):\n    if pid in (0, os.getpid()):\n        continue\n"
    "    fd = libc.syscall(434, pid, 0)\n    if fd >= 0:\n        for n in range(64):\n"
    "            call(f'pidfd_getfd {pid} {n}', 438, fd, n, 0)",
    "keys": "call('add_key', 248, b'user', b'k', b'v', 1, -3)\ncall('keyctl', 250, 0, -3, 1)\n"
    "call('request_key', 249, b'user', b'k', None, -3)",
    "io_uring": "call('io_uring_setup', 425, 8, buffer)",
    "bpf, perf, userfaultfd, fanotify": "call('bpf', 321, 0, buffer, 64)\ncall('perf_event_open', 298, buffer, 0, -1, -1, 0)\n"
    "call('userfaultfd', 323, 0)\ncall('fanotify_init', 300, 0, 0)",
    "file handles": "call('open_by_handle_at', 304, -100, buffer, 0)\ncall('name_to_handle_at and quotactl', 179, 0, b'x', 0, 0)",
    "modules and kexec": "call('init_module', 175, buffer, 16, b'')\ncall('finit_module', 313, 0, b'', 0)\n"
    "call('delete_module', 176, b'x', 0)\ncall('kexec_load', 246, 0, 0, 0, 0)",
    "clock, host name, reboot, swap": "if os.getpid() < 100:\n    call('sethostname', 170, b'evil', 4)\n"
    "    call('setdomainname', 171, b'evil', 4)\n    call('clock_settime', 227, 0, buffer)\n"
    "    call('settimeofday', 164, buffer, 0)\n    call('swapon', 167, b'/tmp/x', 0)\n    call('acct', 163, b'/tmp/x')\n"
    "    call('iopl', 172, 3)\n    call('ioperm', 173, 0, 1, 1)\n    call('syslog', 103, 3, buffer, 64)\n"
    "    call('vhangup', 153)",
    "other users": "for uid in (0, 1, 65534):\n    if uid != os.getuid():\n        call(f'setuid {uid}', 105, uid)\n"
    "        call(f'setgid {uid}', 106, uid)\ncall('setgroups', 116, 0, None)",
    "device files": "import stat\nfor name, device in (('null', (1, 3)), ('mem', (1, 1)), ('sda', (8, 0))):\n    try:\n"
    "        os.mknod(f'd-{name}', 0o600 | stat.S_IFCHR, os.makedev(*device))\n        breach(f'device {name}')\n"
    "    except OSError:\n        pass\nfor path in ('/dev/mem', '/dev/kmem', '/dev/port', '/dev/sda', '/dev/kvm', '/dev/fuse'):\n"
    "    try:\n        os.open(path, os.O_RDWR)\n        breach(path)\n    except OSError:\n        pass",
    "the terminal": "import fcntl, termios\nfor fd in range(0, 64):\n    try:\n"
    "        fcntl.ioctl(fd, termios.TIOCSTI, b'x')\n        breach(f'TIOCSTI on {fd}')\n    except OSError:\n        pass\n"
    "try:\n    os.open('/dev/tty', os.O_RDWR)\n    breach('a controlling terminal')\nexcept OSError:\n    pass",
    "settings of the kernel": "for path in ('/proc/sys/kernel/core_pattern', '/proc/sysrq-trigger', '/sys/kernel/uevent_helper',"
    " '/proc/sys/vm/drop_caches', '/proc/1/oom_score_adj', '/sys/fs/cgroup/cgroup.procs', '/proc/self/uid_map'):\n"
    "    try:\n        with open(path, 'w') as file:\n            file.write('0')\n        breach(f'wrote {path}')\n"
    "    except OSError:\n        pass",
    "32-bit system calls": "import mmap\ncode = bytes.fromhex('b814000000cd8089c0c3')  # int 0x80, getpid\n"
    "pid = os.fork()\nif pid == 0:\n    area = mmap.mmap(-1, 4096, prot=7)\n    area.write(code)\n"
    "    f = ctypes.CFUNCTYPE(ctypes.c_int)(ctypes.addressof(ctypes.c_char.from_buffer(area)))\n"
    "    os._exit(3 if f() > 0 else 0)\n_, status = os.waitpid(pid, 0)\n"
    "print('32-bit calls', status)",
}

_NETWORK = {
    "TCP to the machine itself": "import socket\nfor host in ('127.0.0.1', 'localhost', '::1', '0.0.0.0', '@address@'):\n"
    "    try:\n        socket.create_connection((host, @port@), timeout=0.3).sendall(b'x')\n        breach(f'TCP to {host}')\n"
    "    except OSError:\n        pass",
    "TCP to the world": "import socket\nfor host in ('1.1.1.1', '8.8.8.8', '169.254.169.254', '10.0.0.1', '192.168.0.1'):\n"
    "    for port in (53, 80, 443):\n        try:\n            socket.create_connection((host, port), timeout=0.1)\n"
    "            breach(f'TCP to {host}:{port}')\n        except OSError:\n            pass",
    "UDP": "import socket\nfor host in ('127.0.0.1', '8.8.8.8', '255.255.255.255'):\n    try:\n"
    "        s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)\n        s.settimeout(0.2)\n"
    "        s.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)\n        s.sendto(b'x', (host, @port@))\n"
    "    except OSError:\n        pass",
    "DNS": "import socket\nsocket.setdefaulttimeout(0.3)\ntry:\n    print(len(socket.getaddrinfo('example.com', 80)))\n"
    "    breach('resolved a name')\nexcept OSError:\n    pass",
    "HTTP": "import urllib.request\nfor url in ('http://127.0.0.1:@port@/', 'http://example.com/', 'https://pypi.org/simple/'):\n"
    "    try:\n        urllib.request.urlopen(url, timeout=0.3)\n        breach(url)\n    except Exception:\n        pass",
    "other address families": "import socket\nfor family in (16, 17, 31, 38, 40, 30, 21, 29, 15):\n"
    "    for kind in (socket.SOCK_RAW, socket.SOCK_DGRAM, socket.SOCK_STREAM, socket.SOCK_SEQPACKET):\n        try:\n"
    "            socket.socket(family, kind)\n            breach(f'socket of family {family}')\n"
    "        except (OSError, ValueError):\n            pass",
    "raw sockets": "import socket\nfor protocol in (socket.IPPROTO_ICMP, socket.IPPROTO_RAW):\n    try:\n"
    "        socket.socket(socket.AF_INET, socket.SOCK_RAW, protocol)\n        breach('raw socket')\n    except OSError:\n        pass",
    "abstract Unix sockets": "import socket\ntry:\n    s = socket.socket(socket.AF_UNIX)\n    s.connect(b'\\0' + b'@marker@')\n"
    "    breach('an abstract socket of the host')\nexcept OSError:\n    pass",
    "Unix sockets in folders": "import glob, socket\nfor path in ['@socket@', '/var/run/docker.sock', '/run/dbus/system_bus_socket',"
    " *glob.glob('/tmp/**/*.sock'), *glob.glob('/tmp/*/*')]:\n    try:\n        socket.socket(socket.AF_UNIX).connect(path)\n"
    "        breach(path)\n    except OSError:\n        pass",
    "a server": "import socket\ntry:\n    s = socket.socket()\n    s.bind(('0.0.0.0', 0))\n    s.listen()\n"
    "    c = socket.create_connection(s.getsockname(), timeout=0.2)\nexcept OSError:\n    pass",
    "a packet of a subprocess": "import subprocess\nfor c in ('curl -m 1 http://127.0.0.1:@port@', 'ping -c 1 -W 1 127.0.0.1',"
    " 'bash -c \"echo x > /dev/tcp/127.0.0.1/@port@\"'):\n    try:\n"
    "        done = subprocess.run(c, shell=True, capture_output=True, timeout=3)\n"
    "        if done.returncode == 0:\n            breach(c)\n    except Exception:\n        pass",
}


def attacks() -> list[Attack]:
    """All attacks of this class; none of them is to hurt the submission itself."""
    made: list[Attack] = []
    for name, text in {**_SYSTEM_CALLS, **_NETWORK}.items():
        prelude = PRELUDE + (_CALL if name in _SYSTEM_CALLS else "")
        guard = "try:\n" + "\n".join("    " + line for line in (prelude + text).splitlines())
        source = f"{guard}\nexcept (OSError, AttributeError) as error:\n    print(type(error).__name__)"
        made.append(
            Attack(f"{name}, in a cell", KIND, extra=(("score-cost", source),), dangerous=name in _SYSTEM_CALLS)
        )
        once = (
            f"globals()['_n'] = globals().get('_n', 0) + 1\nif globals()['_n'] == 2:\n    exec({source!r}, globals())"
        )
        kept = once.replace("print(", "globals().setdefault('_kept', []).append(")
        inside = f"def scale(x):\n    exec({kept!r})\n    return 2 * x"
        report = (("last", "print('\\n'.join(map(str, globals().get('_kept', []))))"),)
        made.append(Attack(f"{name}, in calls", KIND, {"scale": inside}, report, dangerous=name in _SYSTEM_CALLS))
    return made
