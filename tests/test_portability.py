"""What can be said of Windows and macOS without them: names of files, line ends, imports, calls, constants."""

from __future__ import annotations

import ast
import functools
import json
import re
import subprocess
import sys
import textwrap
from collections import Counter
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

import pytest

from tests.conftest import REPO
from tests.test_offline import GUARD

RESERVED = {"con", "prn", "aux", "nul", *(f"{name}{n}" for name in ("com", "lpt") for n in "123456789")}
FORBIDDEN = re.compile(r'[<>:"\\|?*\x00-\x1f]')
LONGEST = 140
"""Windows allows 260 characters for a whole path; this leaves 120 for the folder that somebody clones into."""

CODE = ("src", "labs", "solutions", "course", "autograder", "book", "benchmarks")
"""What runs on a user's machine; the tests themselves may break things as a system can."""

_SANDBOX = ("bubblewrap", "cgroups", "child", "filter", "isolation", "linux", "monitor", "zygote")
LINUX_ONLY = (
    *(f"src/robotbrain/grading/sandbox/{name}.py" for name in _SANDBOX),  # elsewhere: plain processes (spawn.py)
    "src/robotbrain/jetson/deploy/program/",  # runs on a Jetson
    "autograder/jupyterhub/",  # JupyterHub itself is for Linux and macOS
    "benchmarks/grading_",
)
"""Starts of names of files that are read on Linux only."""

POSIX_MODULES = {"fcntl", "resource", "pwd", "grp", "termios", "pty", "tty", "syslog", "crypt", "pyseccomp"}
WINDOWS_MODULES = {"msvcrt", "winreg", "_winapi", "winsound"}
POSIX_NAMES = {
    "os": {
        *(
            "fork",
            "forkpty",
            "getuid",
            "geteuid",
            "getgid",
            "getegid",
            "getpgid",
            "setsid",
            "setpgid",
            "killpg",
            "uname",
        ),
        *("mkfifo", "chroot", "setuid", "setgid", "nice", "getloadavg", "wait3", "wait4", "sched_getaffinity"),
        *("sched_setaffinity", "sched_setscheduler", "sched_getscheduler", "posix_fadvise", "pipe2", "memfd_create"),
        *("pidfd_open", "statvfs", "sysconf", "chown", "getpriority", "setpriority", "O_NONBLOCK", "O_NOFOLLOW"),
        *("WIFSIGNALED", "WTERMSIG", "WEXITSTATUS", "WNOHANG"),
    },
    "signal": {
        "SIGKILL",
        "SIGHUP",
        "SIGUSR1",
        "SIGUSR2",
        "SIGALRM",
        "SIGXCPU",
        "SIGCHLD",
        "alarm",
        "setitimer",
        "pause",
    },
    "select": {"poll", "epoll", "kqueue"},
    "socket": {"AF_UNIX"},
    "time": {"tzset", "clock_gettime"},
}
_JITTER = "src/robotbrain/pipeline/patterns/jitter.py"
GUARDED: dict[str, dict[str, str]] = {
    "benchmarks/rl_reach.py": {"getloadavg": "hasattr"},
    "src/robotbrain/doctor/probes/storage.py": {"statvfs": "hasattr"},
    "src/robotbrain/grading/collecting.py": {"pwd": "ImportError is caught"},
    "src/robotbrain/grading/limits.py": dict.fromkeys(("setitimer", "SIGALRM"), "hasattr(signal, 'setitimer')"),
    "src/robotbrain/grading/lock.py": {"fcntl": "unless os.name is nt", "msvcrt": "if os.name is nt"},
    "src/robotbrain/grading/sandbox/channel.py": {"poll": "hasattr"},
    "src/robotbrain/grading/sandbox/handle.py": {
        "poll": "if there is a pidfd",
        "SIGKILL": "if there is a pidfd, or os.name is posix",
        **dict.fromkeys(("getpgid", "killpg"), "if os.name is posix"),
    },
    "src/robotbrain/grading/sandbox/process.py": {"pidfd_open": "in snapshots of a fork server"},
    "src/robotbrain/grading/sandbox/recipes.py": {"geteuid": "if bubblewrap is there"},
    "src/robotbrain/grading/scheduler.py": {"sched_getaffinity": "hasattr"},
    "src/robotbrain/grading/tester/process.py": {"resource": "ImportError is caught"},
    _JITTER: {
        "resource": "if the kernel is Linux",
        **dict.fromkeys(("sched_setscheduler", "sched_getscheduler", "uname"), "if the kernel is Linux"),
    },
}
"""Names that are reached on their own system only, by file, and how that is made sure."""

ABSOLUTE = re.compile(r"^/(tmp|var|usr|etc|proc|sys|dev|home|root|opt|run|bin|lib)(/|$)")


def tracked(*folders: str) -> list[str]:
    """Names of the files that are, or are about to be, in the repository."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", "--", *folders]
    done = subprocess.run(command, cwd=REPO, capture_output=True, check=False)
    if done.returncode:
        pytest.skip("not a git checkout")
    return [name for name in done.stdout.decode().split("\0") if name and (REPO / name).is_file()]


@functools.cache
def code() -> dict[str, str]:
    """Text of the Python files that users run."""
    return {name: (REPO / name).read_text(encoding="utf-8") for name in tracked(*CODE) if name.endswith(".py")}


def syntax(words: str) -> Iterator[tuple[str, ast.AST]]:
    """Every node of the files in which the pattern ``words`` occurs at all (parsing everything takes its time)."""
    pattern = re.compile(words)
    for name, text in code().items():
        if pattern.search(text):
            for node in ast.walk(ast.parse(text, name)):
                yield name, node


def test_every_name_of_a_file_is_legal_on_windows() -> None:
    for name in tracked():
        for part in PurePosixPath(name).parts:
            assert not FORBIDDEN.search(part), name
            assert not part.endswith((" ", ".")), name
            assert part.partition(".")[0].lower() not in RESERVED, name
        assert len(name) <= LONGEST, f"{len(name)} characters: {name}"
        assert name.isascii(), name  # macOS stores accents in another form than it was given


def test_no_two_names_differ_by_case_only() -> None:
    names = tracked()
    folders = {str(parent) for name in names for parent in PurePosixPath(name).parents}
    counts = Counter(entry.lower() for entry in {*names, *folders})
    assert not [entry for entry, count in counts.items() if count > 1]


def test_text_is_stored_and_checked_out_with_lf() -> None:
    done = subprocess.run(["git", "ls-files", "--eol", "-z"], cwd=REPO, capture_output=True, check=False)
    if done.returncode:
        pytest.skip("not a git checkout")
    for line in done.stdout.decode().split("\0"):
        if not line:
            continue
        form, _, name = line.partition("\t")
        stored, _, attributes = form.partition("attr/")
        assert "i/crlf" not in stored and "i/mixed" not in stored, f"{name} is stored with CRLF"
        if "i/-text" in stored:
            continue  # binary, git found
        wanted = "crlf" if name.endswith((".bat", ".cmd", ".ps1")) else "lf"
        assert f"eol={wanted}" in attributes or "-text" in attributes, f"{name} may get other line ends ({attributes})"


def test_what_only_one_system_has_is_not_used_by_all() -> None:
    """Modules and names that Windows (or everything but Windows) lacks; :data:`GUARDED` are reached on theirs only."""
    modules = POSIX_MODULES | WINDOWS_MODULES
    found = set()
    for name, node in syntax(rf"\b({'|'.join(sorted(modules.union(*POSIX_NAMES.values())))})\b"):
        used: set[str] = set()
        if isinstance(node, ast.Import):
            used = {alias.name.partition(".")[0] for alias in node.names} & modules
        elif isinstance(node, ast.ImportFrom) and node.module:
            package = node.module.partition(".")[0]
            used = {package} & modules | {alias.name for alias in node.names} & POSIX_NAMES.get(package, set())
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            used = {node.attr} & POSIX_NAMES.get(node.value.id, set())
        if not name.startswith(LINUX_ONLY):
            found |= {(name, word) for word in used}
    guarded = {(name, word) for name, words in GUARDED.items() for word in words}
    assert found - guarded == set()
    assert guarded - found == set(), "these are no longer there: take them out of the list"


SYSTEM_PATHS: dict[str, tuple[str, ...]] = {
    "benchmarks/cpu_work.py": ("/proc/cpuinfo",),
    "benchmarks/rl_shipping.py": ("/proc/cpuinfo",),
    "src/robotbrain/doctor/probes/machine.py": ("/sys/fs/cgroup",),
    "src/robotbrain/doctor/probes/ros.py": ("/opt/ros",),
    "src/robotbrain/exchange.py": ("/usr/local/share/nbgrader/exchange",),
    "src/robotbrain/grading/sandbox/forkserver.py": ("/usr/local/bin", "/usr/bin", "/bin", "/proc/self/fdinfo/"),
    "src/robotbrain/grading/sandbox/process.py": ("/proc/",),
    "src/robotbrain/grading/sandbox/recipes.py": ("/tmp/server",),  # inside of bubblewrap
    "src/robotbrain/jetson/engine/cuda.py": ("/usr/local/cuda/lib64/",),
    "src/robotbrain/jetson/measure/run.py": tuple(
        f"/{folder}/tensorrt/bin/trtexec" for folder in ("usr/src", "usr/local", "opt")
    ),
    "src/robotbrain/jetson/measure_command.py": (
        "/proc/device-tree/compatible with nvidia,tegra",
        "/etc/nv_tegra_release",
    ),
    "src/robotbrain/optimisation/cpu.py": ("/proc/cpuinfo",),
    _JITTER: ("/sys/kernel/realtime",),
}
"""Absolute paths by file: all of them are looked at where they exist, and nothing is written there."""


def test_no_path_of_one_system_is_written_into_the_code() -> None:
    found: set[tuple[str, str]] = set()
    documentation: set[ast.AST] = set()
    for name, node in syntax(ABSOLUTE.pattern.replace("^", "[\"']")):
        if isinstance(node, ast.Expr):  # comes before what is in it
            documentation.add(node.value)
        elif isinstance(node, ast.Constant) and node not in documentation and not name.startswith(LINUX_ONLY):
            found |= {(name, node.value)} if ABSOLUTE.match(str(node.value)) else set()
    listed = {(name, path) for name, paths in SYSTEM_PATHS.items() for path in paths}
    assert found - listed == set()
    assert listed - found == set(), "these are no longer there: take them out of the list"


def test_python_is_called_by_its_own_path() -> None:
    """``python`` may be another one, or a shop window on Windows; ``python3`` does not exist there."""
    for name, node in syntax(r"subprocess|os\.(exec|spawn)"):
        if not isinstance(node, ast.Call) or not re.match(r"subprocess\.|os\.(exec|spawn)", ast.unparse(node.func)):
            continue
        first = node.args[0] if node.args else None
        if isinstance(first, ast.List | ast.Tuple) and first.elts:
            first = first.elts[0]
        if isinstance(first, ast.Constant) and isinstance(first.value, str):
            program = re.match(r"(python[\d.]*|pip|jupyter|nbgrader|robotbrain)\b", first.value)
            assert program is None, f"{name}:{node.lineno}: {first.value}"


def test_text_files_are_opened_with_their_encoding_and_no_shell_is_used() -> None:
    """By ruff: PLW1514 (an encoding that depends on the system), S602, S604, S605 (a shell, which differs)."""
    shell = "src/robotbrain/grading/sandbox/shell.py"  # `!ls` in a notebook on Linux, inside of the sandbox
    done = subprocess.run(
        [
            *(sys.executable, "-m", "ruff", "check", "--isolated", "--preview", "--no-cache"),
            *("--select=PLW1514,S602,S604,S605", f"--per-file-ignores={shell}:S602", "--exclude=book/_build"),
            *(folder for folder in (*CODE, "tests") if (REPO / folder).is_dir()),
        ],
        cwd=REPO, capture_output=True, text=True, encoding="utf-8", check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr


def test_notebooks_call_no_shell() -> None:
    """``!ls`` and ``%%bash`` do not work on Windows; a line of text (``# !pip …``) is no call."""
    for name in tracked("course", "labs", "solutions"):
        if not name.endswith(".ipynb"):
            continue
        for cell in json.loads((REPO / name).read_text(encoding="utf-8"))["cells"]:
            if cell["cell_type"] == "code":
                source = "".join(cell["source"])
                lines = source.splitlines()
                assert not [line for line in lines if re.match(r"\s*(!|%%?(bash|sh|system|sx)\b)", line)], (
                    f"{name}: {source}"
                )


IMPORT_EVERYTHING = """
    import importlib, os, pkgutil, select, signal, sys, types
    import robotbrain

    SKIP = {"robotbrain.grading.sandbox.zygote", "robotbrain.grading.sandbox.child"}  # started on Linux only

    def names():
        for module in pkgutil.walk_packages(robotbrain.__path__, "robotbrain.", onerror=lambda name: None):
            if not module.name.endswith("__main__"):
                yield module.name

    def everything():
        failed = {}
        for name in names():
            try:
                importlib.import_module(name)
            except BaseException as error:
                failed[name] = f"{type(error).__name__}: {error}"
        return failed

    # Other people's packages are imported here as they are; the kit is then imported again on the pretended system.
    here = everything()

    class Absent:
        def find_spec(self, name, path=None, target=None):
            if name.partition(".")[0] in blocked:
                raise ModuleNotFoundError(f"No module named {name!r} (not on {sys.platform})", name=name)

    sys.meta_path.insert(0, Absent())
    posix = {"fcntl", "resource", "pwd", "grp", "termios", "pty", "tty", "syslog", "pyseccomp"}
    for system, blocked in (("darwin", {"pyseccomp"}), ("win32", posix)):
        for name in [m for m in sys.modules if m.partition(".")[0] in {"robotbrain", *blocked}]:
            del sys.modules[name]
        robotbrain = importlib.import_module("robotbrain")
        sys.platform = system
        if system == "win32":
            for module, lacking in LACKING.items():
                for name in lacking:
                    vars(sys.modules[module]).pop(name, None)
            sys.modules["msvcrt"] = types.ModuleType("msvcrt")
        failed = {name: why for name, why in everything().items() if name not in here and name not in SKIP}
        sys.stderr.write("".join(f"{system}: {name}: {why}\\n" for name, why in failed.items()))
    sys.stderr.write("".join(f"network: {asked}\\n" for asked in ASKED))
    sys.stderr.flush()
    # Packages that think they are on Windows now must not get to clean up.
    os._exit(0)
"""


def test_every_module_can_be_imported_on_windows_and_macos_without_a_network() -> None:
    """With the names that these systems lack taken away; packages of others are left as they are."""
    names = {module: sorted(lacking) for module, lacking in POSIX_NAMES.items()}
    program = f"{GUARD}\nLACKING = {names!r}\n" + textwrap.dedent(IMPORT_EVERYTHING)
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, encoding="utf-8", timeout=300, check=False
    )
    told = [line for line in done.stderr.splitlines() if line.startswith(("darwin: ", "win32: ", "network: "))]
    assert done.returncode == 0 and not told, done.stderr


@pytest.mark.parametrize("file", ["run.sh", "measure.sh"])
def test_scripts_for_the_board_have_no_carriage_returns(file: str) -> None:
    assert b"\r" not in Path(REPO, "src/robotbrain/jetson/deploy/scripts", file).read_bytes()
