"""The probes, in the order in which a person would look: what stands below comes first."""

from __future__ import annotations

from robotbrain.doctor.probes.course import course, shadowing, shipped_files
from robotbrain.doctor.probes.gpu import gpu
from robotbrain.doctor.probes.graphics import browsers, opengl
from robotbrain.doctor.probes.interpreter import encoding, environment, interpreter
from robotbrain.doctor.probes.jupyter import extensions, jupyter, kernels
from robotbrain.doctor.probes.libraries import jupyter_libraries, libraries, torch
from robotbrain.doctor.probes.machine import machine, threads
from robotbrain.doctor.probes.nbgrader import gradebook, nbgrader
from robotbrain.doctor.probes.network import loopback, ports, proxies
from robotbrain.doctor.probes.packages import packages
from robotbrain.doctor.probes.ros import ros
from robotbrain.doctor.probes.sandbox import sandbox
from robotbrain.doctor.probes.storage import disk, folders
from robotbrain.doctor.running import Probe

PROBES: dict[str, Probe] = {
    "python": interpreter,
    "environment": environment,
    "encoding": encoding,
    "packages": packages,
    "libraries": libraries,
    "torch": torch,
    "jupyter-libraries": jupyter_libraries,
    "shadowing": shadowing,
    "files": shipped_files,
    "course": course,
    "disk": disk,
    "folders": folders,
    "machine": machine,
    "threads": threads,
    "loopback": loopback,
    "ports": ports,
    "proxies": proxies,
    "jupyter": jupyter,
    "kernels": kernels,
    "extensions": extensions,
    "nbgrader": nbgrader,
    "gradebook": gradebook,
    "gpu": gpu,
    "opengl": opengl,
    "ros": ros,
    "browsers": browsers,
    "sandbox": sandbox,
}
"""Probe by the name that ``--only`` takes."""
