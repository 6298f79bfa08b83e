"""What can draw: OpenGL, which the kit does not need, and web browsers, which show everything."""

from __future__ import annotations

import ctypes.util
import os
import shutil
import sys
import webbrowser

from robotbrain.doctor.finding import (
    Cure,
    Finding,
    Situation,
    everywhere,
    fault,
    note,
    ok,
    set_variable,
    unset_variable,
)

_OFF = ("disable", "disabled", "off", "false", "0")
_ON = ("", "enable", "enabled", "on", "true", "1", "glfw")
_BY_SYSTEM = {"linux": ("glx", "egl", "osmesa"), "win32": ("wgl",), "darwin": ("cgl",)}
_LIBRARIES = {
    "egl": ("EGL", "libegl1"),
    "osmesa": ("OSMesa", "libosmesa6"),
    "glx": ("GL", "libgl1"),
    "glfw": ("GL", "libgl1"),
}
_CHROMIUM = ("chromium", "chromium-browser", "google-chrome", "chrome", "msedge")


def opengl(_: Situation) -> list[Finding]:
    """Which OpenGL MuJoCo would draw with. The kit's cameras compute without it; pretty pictures of MuJoCo need it."""
    asked = os.environ.get("MUJOCO_GL", "").lower().strip()
    if asked in _OFF:
        return [ok("OpenGL is turned off (MUJOCO_GL); the kit does not need it")]
    known = _ON + _BY_SYSTEM.get(sys.platform, ())
    if asked not in known:
        return [
            fault(
                f"MUJOCO_GL={asked} is not known on this system: `import mujoco` fails (known: "
                f"{', '.join(filter(None, known))})",
                unset_variable("MUJOCO_GL"),
            )
        ]
    if sys.platform != "linux":
        return [ok("OpenGL comes with the system; the kit does not need it")]
    there = [name for name in ("egl", "osmesa", "glx") if ctypes.util.find_library(_LIBRARIES[name][0])]
    if asked in _LIBRARIES and not ctypes.util.find_library(_LIBRARIES[asked][0]):
        library, package = _LIBRARIES[asked]
        return [
            fault(
                f"MUJOCO_GL={asked} asks for lib{library}, which is missing: mujoco.Renderer fails",
                Cure(f"unset MUJOCO_GL (the kit does not need it), or sudo apt install {package}"),
            )
        ]
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if not there:
        return [
            note(
                "no OpenGL (EGL, OSMesa, GLX): cameras, lidar and 3D replays of the kit work without it; only "
                "mujoco.Renderer and MuJoCo's own viewer need it",
                Cure("sudo apt install libegl1 libgl1 (or libosmesa6 for a machine without a graphics driver)"),
            )
        ]
    if not display and not asked and "egl" in there:
        return [note("OpenGL without a screen: mujoco.Renderer works with EGL", set_variable("MUJOCO_GL", "egl"))]
    return [ok(f"OpenGL: {', '.join(there)} (for mujoco.Renderer only; the kit does not need it)")]


def browsers(_: Situation) -> list[Finding]:
    """A browser that `robotbrain lab` can open, and one that the browser tests can drive."""
    found = []
    try:
        webbrowser.get()
    except webbrowser.Error:
        found.append(
            note(
                "no web browser can be opened from here (a server, a container?)",
                everywhere(
                    "robotbrain lab --no-browser, then open the address that it prints; from another computer first: "
                    "ssh -L 8888:127.0.0.1:8888 USER@HOST"
                ),
            )
        )
    browser = next((name for name in _CHROMIUM if shutil.which(name)), None)
    if browser is None and sys.platform == "linux":
        found.append(
            note(
                "no Chromium on PATH; only the browser tests of developers need it",
                Cure("sudo apt install chromium"),
            )
        )
    return found or [ok(f"a web browser{f' ({browser})' if browser else ''}")]
