"""A meshcat scene as one HTML page, made in this process: no server, no socket, no network.

meshcat's own ``static_html`` asks a running server for the scene. Here its geometry and command classes write
the same messages straight into the page, with counted instead of random ids so that one scene is always the
same bytes. The page is the viewer's script (0.85 MB) and the messages.
"""

from __future__ import annotations

import base64
import html
import json
import struct
import uuid
import zlib
from pathlib import Path as FilePath
from typing import Any

import meshcat
import numpy as np
import umsgpack  # type: ignore[import-untyped]
from meshcat import geometry as g
from meshcat.animation import Animation, AnimationClip
from meshcat.commands import SetAnimation, SetObject, SetProperty, SetTransform
from meshcat.path import Path
from numpy.typing import NDArray

from robotbrain.sim.geometry import Array, Pose2D

_CAMERA = "/Cameras/default/rotated/<object>"


class MeshcatPage:
    """Collects drawing commands and writes the page.

    Args:
        title: of the page.
        caption: a line of text above the scene; none by default.
    """

    def __init__(self, title: str, caption: str = "") -> None:
        self.title, self.caption = title, caption
        self._commands: list[bytes] = []
        self._clips: dict[str, AnimationClip] = {}
        self._ids = 0

    def add(
        self,
        path: str,
        shape: g.Geometry,
        colour: tuple[float, float, float] = (1.0, 1.0, 1.0),
        *,
        opacity: float = 1.0,
        texture: NDArray[np.uint8] | None = None,
        transform: Array | None = None,
        glow: bool = False,
    ) -> None:
        """Draw ``shape`` at ``path`` with a plain colour or an image (height, width, 3); ``glow`` is unlit."""
        options: dict[str, Any] = {"color": _hex(colour), "opacity": opacity}
        if texture is not None:
            image = g.PngImage(png(texture))
            # 1003/1006: nearest pixel when near, linear when far (three.js constants)
            options["map"] = g.ImageTexture(image, wrap=[1001, 1001], repeat=[1, 1], magFilter=1003, minFilter=1006)
        material = (g.MeshBasicMaterial if glow else g.MeshLambertMaterial)(**options)
        mesh = g.Mesh(shape, material)
        parts = [mesh, shape, material]
        if texture is not None:
            parts += [options["map"], image]
        for part in parts:
            self._ids += 1
            part.uuid = str(uuid.UUID(int=self._ids))
        self._send(SetObject(mesh, path=_path(path)))
        if transform is not None:
            self.place(path, transform)

    def place(self, path: str, transform: Array) -> None:
        """Set the 4x4 transform of a node."""
        self._send(SetTransform(transform, _path(path)))

    def set_property(self, path: str, key: str, value: object) -> None:
        """Set a property of a node, as meshcat names it."""
        self._send(_Property(key, value, _path(path)))

    def look_from(self, eye: tuple[float, float, float], zoom: float) -> None:
        """Put the viewer's camera at ``eye`` (m, world frame), looking at the origin."""
        x, y, z = eye
        self.set_property(_CAMERA, "position", [x, z, -y])  # the camera node is turned: its y is up
        self.set_property(_CAMERA, "zoom", zoom)

    def animate_pose(self, path: str, times_s: Array, poses: list[Pose2D]) -> None:
        """Move a node through ``poses`` at ``times_s``."""
        clip = self._clip(path)
        for t, pose in zip(times_s.tolist(), poses, strict=True):
            turn = [0.0, 0.0, _short(np.sin(pose.yaw / 2)), _short(np.cos(pose.yaw / 2))]
            clip.set_property(t, "position", "vector3", [_short(pose.x), _short(pose.y), 0.0])
            clip.set_property(t, "quaternion", "quaternion", turn)

    def animate(self, path: str, times_s: Array, positions: Array, quaternions: Array) -> None:
        """Move a node through ``positions`` (n, 3), m, and ``quaternions`` (n, 4), xyzw, at ``times_s`` (n,)."""
        clip = self._clip(path)
        for t, place, turn in zip(times_s.tolist(), positions, quaternions, strict=True):
            clip.set_property(t, "position", "vector3", [_short(v) for v in place])
            clip.set_property(t, "quaternion", "quaternion", [_short(v) for v in turn])

    def animate_visible(self, path: str, changes: list[tuple[float, bool]]) -> None:
        """Show and hide a node at the given times (s)."""
        for t, shown in changes:
            self._clip(path).set_property(t, "visible", "boolean", shown)

    def html(self) -> str:
        """Return the page. The animation, if there is one, plays on load and repeats."""
        commands = list(self._commands)
        if self._clips:
            animation = Animation(clips={_path(path): clip for path, clip in self._clips.items()})
            commands.append(_pack(SetAnimation(animation, play=True, repetitions=10_000)))
        script = (FilePath(meshcat.viewer_assets_path()) / "dist" / "main.min.js").read_text(encoding="utf-8")
        data = json.dumps([base64.b64encode(command).decode("ascii") for command in commands])
        line = f'<p id="caption">{html.escape(self.caption)}</p>' if self.caption else ""
        page = _PAGE.replace("@TITLE@", html.escape(self.title)).replace("@CAPTION@", line)
        return page.replace("@DATA@", data).replace("@VIEWER@", script)

    def _clip(self, path: str) -> AnimationClip:
        # one frame a second: key times are then seconds
        return self._clips.setdefault(path, AnimationClip(fps=1))

    def _send(self, command: Any) -> None:
        self._commands.append(_pack(command))


class _Property(SetProperty):  # type: ignore[misc]
    """``SetProperty`` whose key is a plain string (the base class expects a path)."""

    def lower(self) -> dict[str, object]:
        return {"type": "set_property", "path": self.path.lower(), "property": self.key, "value": self.value}


def inline_frame(page: str, height: int) -> str:
    """HTML that shows ``page`` in a notebook cell ``height`` pixels high, without any server."""
    return (
        f'<div><iframe srcdoc="{html.escape(page)}" style="width:100%;height:{height}px;border:none" '
        'title="Interactive 3D view of the robot in its world"></iframe></div>'
    )


def pose_matrix(x: float, y: float, z: float, yaw: float = 0.0) -> Array:
    """4x4 transform: turned by ``yaw`` (rad) about z, then moved (m)."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0, x], [s, c, 0.0, y], [0.0, 0.0, 1.0, z], [0.0, 0.0, 0.0, 1.0]])


def upright_cylinder(x: float, y: float, z: float) -> Array:
    """Transform of a meshcat cylinder (whose axis is y) standing at a place (m)."""
    return np.array([[1.0, 0.0, 0.0, x], [0.0, 0.0, -1.0, y], [0.0, 1.0, 0.0, z], [0.0, 0.0, 0.0, 1.0]])


def ribbon(points: Array, width: float, z: float) -> g.Geometry:
    """A flat band along a polyline (n, 2), ``width`` wide at height ``z`` (m); n >= 2."""
    step = np.gradient(points, axis=0)
    length = np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-9)
    normal = np.stack([-step[:, 1], step[:, 0]], -1) / length * (width / 2)
    rim = np.concatenate([points + normal, points - normal])
    vertices = np.column_stack([rim, np.full(len(rim), z)])
    n = len(points)
    i = np.arange(n - 1)
    faces = np.concatenate([np.stack([i, i + n, i + 1], -1), np.stack([i + 1, i + n, i + n + 1], -1)])
    return g.TriangularMeshGeometry(vertices, faces.astype(np.uint32))


def png(rgb: NDArray[np.uint8]) -> bytes:
    """Encode an image, uint8 (height, width, 3), as PNG."""
    height, width, _ = rgb.shape
    rows = np.concatenate([np.zeros((height, 1), np.uint8), rgb.reshape(height, -1)], axis=1)

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    data = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows.tobytes(), 9)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + data


def _pack(command: Any) -> bytes:
    # single precision: what the viewer computes in, and half the bytes
    return bytes(umsgpack.packb(command.lower(), force_float_precision="single"))


def _path(path: str) -> Path:
    return Path(tuple(part for part in path.split("/") if part))


def _hex(colour: tuple[float, float, float]) -> int:
    r, g_, b = (round(255 * min(max(c, 0.0), 1.0)) for c in colour)
    return (r << 16) + (g_ << 8) + b


def _short(value: float) -> float:
    return round(float(value), 4)


_PAGE = """<!DOCTYPE html>
<html lang="en">
<head><meta charset="utf-8"><title>@TITLE@</title>
<style>body{margin:0}#view{width:100vw;height:100vh;overflow:hidden}
#caption{position:fixed;top:0;left:0;z-index:1;margin:0;padding:8px 14px;font:15px sans-serif;
background:rgba(255,255,255,.85);color:#1b1b1b}</style></head>
<body>@CAPTION@<div id="view"></div>
<script>@VIEWER@</script>
<script>
const viewer = new MeshCat.Viewer(document.getElementById("view"));
for (const text of @DATA@) {
  viewer.handle_command_bytearray(Uint8Array.from(atob(text), c => c.charCodeAt(0)));
}
</script></body></html>
"""
