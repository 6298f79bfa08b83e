"""``robotbrain doctor`` on hosts with a fault: disks, folders, ports, proxies, locale, GPU, ROS 2."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.conftest import need
from tests.doctor.patient import Patient, linux, posix


@linux
def test_a_full_disk_and_a_read_only_course(patient: Patient) -> None:
    """A small disk for temporary files, and a course that even root cannot write to."""
    bwrap = shutil.which("bwrap")
    need(bwrap, "bubblewrap is not installed")
    assert bwrap is not None
    small = patient.folder / "small"
    small.mkdir()
    patient.environment["TMPDIR"] = str(small)
    course = str(patient.course)
    patient.wrapper = [bwrap, "--dev-bind", "/", "/", "--size", "2000000", "--tmpfs", str(small)]
    patient.wrapper += ["--ro-bind", course, course, "--"]
    answer = patient.ask("disk", "folders")
    room = answer.one("fault", "2 MB are free for temporary files", str(small))
    assert "pip cache purge" in room["cure"] and "export TMPDIR=" in room["cure"]
    shut = answer.one("fault", f"the course folder {course} cannot be written to")
    assert "chown" in shut["cure"] and "cp -r" in shut["cure"]


@linux
def test_a_home_that_cannot_be_written_to(patient: Patient) -> None:
    patient.environment |= {"HOME": "/proc", "TMPDIR": str(patient.folder)}
    answer = patient.ask("folders")
    assert "export HOME=" in answer.one("fault", "the home folder /proc cannot be written to")["cure"]
    assert "JUPYTER_DATA_DIR" in answer.one("fault", "the Jupyter data folder")["cure"]


def namespace(*kinds: str) -> list[str]:
    """The command that starts another one in new namespaces, as their root."""
    unshare = shutil.which("unshare")
    need(unshare, "util-linux is not installed")
    command = [str(unshare), "--user", "--map-root-user", *kinds]
    tried = subprocess.run([*command, "true"], capture_output=True, check=False)
    need(tried.returncode == 0, "this host lets nobody make namespaces")
    return command


@linux
def test_no_loopback(patient: Patient) -> None:
    """A network namespace whose loopback interface is down."""
    patient.wrapper = namespace("--net")
    assert "ip link set lo up" in patient.ask("loopback").one("fault", "cannot talk to one another")["cure"]


@linux
def test_a_temporary_folder_from_which_nothing_runs(patient: Patient) -> None:
    mounted = patient.folder / "mounted"
    mounted.mkdir()
    patient.environment["TMPDIR"] = str(mounted)
    mount = 'mount -t tmpfs -o noexec none "$0" && exec "$@"'
    patient.wrapper = [*namespace("--mount"), "sh", "-c", mount, str(mounted)]
    finding = patient.ask("folders").one("warning", str(mounted), "noexec")
    assert "export TMPDIR=" in finding["cure"] and "mkdir" in finding["cure"]


@pytest.fixture
def taken() -> Iterator[int]:
    """JupyterLab's port, taken by this process (or by somebody else already)."""
    with socket.socket() as server:
        try:
            server.bind(("127.0.0.1", 8888))
            server.listen()
        except OSError:
            pass
        yield 8888


def test_a_port_that_is_taken(patient: Patient, taken: int) -> None:
    finding = patient.ask("ports").one("warning", f"port {taken}", "is taken by")
    assert "robotbrain lab --port 88" in finding["cure"] and f"jupyter server stop {taken}" in finding["cure"]


def test_a_proxy_that_is_asked_for_this_computer(patient: Patient) -> None:
    patient.environment |= {"HTTP_PROXY": "http://proxy.example:3128", "NO_PROXY": "example.org"}
    finding = patient.ask("proxies").one("fault", "HTTP_PROXY", "http://proxy.example:3128")
    assert "NO_PROXY=example.org,localhost,127.0.0.1,::1" in finding["cure"] or sys.platform == "win32"
    patient.environment["NO_PROXY"] = "example.org,localhost,127.0.0.1,::1"  # the cure
    assert patient.ask("proxies").code == 0


@posix
def test_an_ascii_locale(patient: Patient) -> None:
    patient.environment |= {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "PYTHONIOENCODING": "ascii"}
    finding = patient.ask("encoding").one("fault", "file names are read as ascii")
    assert "LC_ALL=" in finding["cure"] and "UTF-8" in finding["cure"]
    table = patient.ask("encoding", words=())
    assert "FAULT" in table.errors and "cure: export LC_ALL=" in table.errors


def ros_tree(folder: Path, version: str, body: str) -> Path:
    """Make what a ROS 2 installation looks like to Python."""
    package = folder / "lib" / f"python{version}" / "site-packages" / "rclpy"
    (package / "impl").mkdir(parents=True)
    (package / "__init__.py").write_text("", encoding="utf-8")
    (package / "impl" / "__init__.py").write_text("", encoding="utf-8")
    (package / "impl" / "implementation_singleton.py").write_text(body, encoding="utf-8")
    return package.parent


MINE = f"3.{sys.version_info[1]}"
OTHER = f"3.{sys.version_info[1] + 1}"


def test_ros_for_another_python(patient: Patient) -> None:
    site = ros_tree(patient.folder / "opt" / "ros" / "jazzy", OTHER, "")
    prefix = patient.folder / "opt" / "ros" / "jazzy"
    patient.environment |= {"AMENT_PREFIX_PATH": str(prefix), "ROS_DISTRO": "jazzy", "PYTHONPATH": str(site)}
    finding = patient.ask("ros").one("fault", f"is for Python {OTHER}; this is Python {MINE}")
    assert "ROBOTBRAIN_ROS_BACKEND" in finding["cure"] and (
        sys.platform == "win32" or f"python{OTHER}" in finding["cure"]
    )
    patient.environment["ROBOTBRAIN_ROS_BACKEND"] = "kit"  # the cure
    assert patient.ask("ros").code == 0


def test_ros_that_is_sourced_by_half_mixed_or_misconfigured(patient: Patient) -> None:
    base = patient.folder / "opt" / "ros"
    site = ros_tree(base / "jazzy", MINE, "raise ImportError('librcl.so: cannot open shared object file')")
    (base / "humble").mkdir()
    prefixes = [str(base / name) for name in ("jazzy", "humble", "foxy")]
    patient.environment |= {
        "AMENT_PREFIX_PATH": os.pathsep.join(prefixes),
        "ROS_DISTRO": "jazzy",
        "PYTHONPATH": str(site),
        "ROS_DOMAIN_ID": "500",
        "RMW_IMPLEMENTATION": "rmw_zenoh_cpp",
    }
    answer = patient.ask("ros")
    assert "one setup" in answer.one("fault", "two ROS 2 distributions are mixed", "humble, jazzy")["cure"]
    assert "new terminal" in answer.one("fault", "foxy", "does not exist")["cure"]
    assert "ROS_DOMAIN_ID" in answer.one("fault", "ROS_DOMAIN_ID=500")["cure"]
    assert "RMW_IMPLEMENTATION" in answer.one("fault", "RMW_IMPLEMENTATION=rmw_zenoh_cpp is not installed")["cure"]
    broken = answer.one("fault", "cannot be imported")
    assert "librcl.so" in broken["detail"] and "setup" in broken["cure"]


@posix
def test_a_gpu_whose_driver_is_too_old_for_torch(patient: Patient) -> None:
    programs = patient.folder / "programs"
    programs.mkdir()
    smi = programs / "nvidia-smi"
    smi.write_text("#!/bin/sh\necho 'NVIDIA GeForce GTX 1080, 470.82.01'\n", encoding="utf-8")
    smi.chmod(0o755)
    patient.environment["PATH"] = f"{programs}{os.pathsep}{patient.environment['PATH']}"
    torch = patient.path_first("site") / "torch"
    torch.mkdir()
    (torch / "__init__.py").write_text("", encoding="utf-8")
    (torch / "version.py").write_text("__version__ = '2.9.0'\ncuda: str = '13.0'\n", encoding="utf-8")
    finding = patient.ask("gpu").one("warning", "driver 470.82.01", "CUDA 13.0 needs 580.0")
    assert sys.platform != "linux" or "ubuntu-drivers install" in finding["cure"]
    smi.write_text("#!/bin/sh\necho 'NVML: Driver/library version mismatch' >&2; exit 18\n", encoding="utf-8")
    broken = patient.ask("gpu").one("warning", "does not reach a GPU")
    assert "mismatch" in broken["detail"] and broken["cure"]


def test_settings_of_opengl_and_threads_that_do_not_exist(patient: Patient) -> None:
    patient.environment |= {"MUJOCO_GL": "vulkan", "OMP_NUM_THREADS": "many", "MKL_NUM_THREADS": "4096"}
    answer = patient.ask("opengl", "threads")
    assert "MUJOCO_GL" in answer.one("fault", "MUJOCO_GL=vulkan")["cure"]
    assert "OMP_NUM_THREADS" in answer.one("warning", "OMP_NUM_THREADS='many'")["cure"]
    assert "MKL_NUM_THREADS" in answer.one("warning", "MKL_NUM_THREADS=4096")["cure"]


@linux
def test_a_jetson_without_jetpack_and_with_a_torch_for_processors(patient: Patient) -> None:
    """In a view of this host whose /etc says that it is a Jetson."""
    bwrap = shutil.which("bwrap")
    need(bwrap, "bubblewrap is not installed")
    assert bwrap is not None
    release = patient.folder / "release"
    release.write_text("# R36 (release), REVISION: 4.3, GCID: 1, BOARD: generic\n", encoding="utf-8")
    programs = patient.folder / "programs"
    programs.mkdir()
    for name, says in (("nvpmodel", "NV Power Mode: 25W"), ("dpkg-query", "")):
        (programs / name).write_text(f"#!/bin/sh\necho '{says}'\n", encoding="utf-8")
        (programs / name).chmod(0o755)
    patient.environment["PATH"] = f"{programs}{os.pathsep}{patient.environment['PATH']}"
    torch = patient.path_first("site") / "torch"
    torch.mkdir()
    (torch / "__init__.py").write_text("", encoding="utf-8")
    (torch / "version.py").write_text("__version__ = '2.9.0'\ncuda = None\n", encoding="utf-8")
    patient.wrapper = [bwrap, "--dev-bind", "/", "/", "--tmpfs", "/etc"]
    for entry in sorted(Path("/etc").iterdir()):
        patient.wrapper += ["--ro-bind-try", str(entry), str(entry)]
    patient.wrapper += ["--ro-bind", str(release), "/etc/nv_tegra_release", "--"]
    answer = patient.ask("gpu")
    assert "Jetson Linux 36.4.3" in answer.one("ok", "Jetson")["what"]
    assert "apt install nvidia-jetpack" in answer.one("warning", "nvidia-jetpack is not installed")["cure"]
    assert "install-pytorch-jetson" in answer.one("warning", "torch 2.9.0 is the build without CUDA")["cure"]
    assert "nvpmodel -m" in answer.one("note", "power mode: 25W")["cure"]
