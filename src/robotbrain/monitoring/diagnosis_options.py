"""What could be done to the kit's brain on a Jetson: the changes that a deployment leaves open, with their factors."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING

from robotbrain.monitoring.whatif_changes import Change, Device, Faster, OwnExecutor, QueueDepth, Together

if TYPE_CHECKING:
    from robotbrain.jetson.profiles import JetsonProfile
    from robotbrain.pipeline.deployment import Deployment

IMAGE_CALLBACKS: Mapping[str, tuple[str, str, str]] = {
    "perception": ("/perception", "subscription", "/camera/image"),
    "mapper": ("/mapper", "subscription", "/odometry/filtered"),
    "controller_points": ("/controller", "subscription", "/perception/points"),
}
"""Callbacks whose work goes by the size of the image: name in the work table, and (node, kind, topic)."""

SMALLEST = 64
"""No image narrower or lower than this is proposed, pixels."""


def brain_options(profile: str | JetsonProfile, deployment: Deployment | None = None) -> list[Change]:
    """Return the changes that could be made to the kit's brain, for ``diagnose(..., options=...)``.

    Their factors are the twin's and the work table's, not guesses: INT8 where the network runs in more, an image of
    half the width and height, a queue of one image, an executor for each node, the module's fastest power mode.

    Args:
        profile: Jetson, as ``slug``, ``slug:mode`` or a profile.
        deployment: how the brain was run.

    Raises:
        InputError: for an unknown module or mode.
    """
    from robotbrain.jetson.profiles import default_network, load_profile
    from robotbrain.pipeline.deployment import Deployment

    chosen = load_profile(profile) if isinstance(profile, str) else profile
    deployed = deployment or Deployment()
    network = deployed.network or default_network()
    now_ms = chosen.network_ms(network, deployed.precision, deployed.image_size)
    found: list[Change] = []
    if deployed.precision != "int8":
        quick_ms = chosen.network_ms(network, "int8", deployed.image_size)
        if quick_ms < now_ms:
            how = f"INT8 instead of {deployed.precision.upper()}"
            found.append(Faster("/perception", now_ms / quick_ms, "gpu", how=how))
    if deployed.image_size is not None:
        width, height = (side // 2 for side in deployed.image_size)
        if min(width, height) >= SMALLEST:
            found.append(smaller_image(chosen, deployed, (width, height)))
    if deployed.camera_queue != 1:
        found.append(QueueDepth("/perception", "/camera/image", 1))
    if deployed.one_thread:
        found.append(OwnExecutor())
    mode = _fastest(chosen, now_ms, deployed)
    if mode is not None:
        found.append(mode)
    return found


def smaller_image(
    profile: JetsonProfile,
    deployment: Deployment,
    size: tuple[int, int],
) -> Together:
    """Return the change to another image size, with the network's latency and the work by the pixel.

    Args:
        profile: Jetson.
        deployment: as it is, with an image size.
        size: (width, height) to change to.
    """
    from robotbrain.jetson.profiles import default_network

    network = deployment.network or default_network()
    before = profile.network_ms(network, deployment.precision, deployment.image_size)
    after = profile.network_ms(network, deployment.precision, size)
    # The work table was timed with the simulated camera, so that is what image work is in proportion to.
    pixels = round(profile.work.callbacks["perception"].work["preprocess"][1])
    scale_now = deployment.scales(pixels, 1)["image"]
    scale_then = dataclasses.replace(deployment, image_size=size).scales(pixels, 1)["image"]
    parts: list[Change] = [Faster("/perception", before / after, "gpu")]
    for name, (node, kind, topic) in IMAGE_CALLBACKS.items():
        factor = _callback_ns(profile, name, scale_now) / _callback_ns(profile, name, scale_then)
        parts.append(Faster(node, factor, "cpu", kind, topic))
    width, height = size
    return Together(tuple(parts), name=f"images of {width} x {height} pixels")


def _callback_ns(profile: JetsonProfile, callback: str, image_scale: float) -> float:
    from robotbrain.pipeline.costs import SCALES_WITH

    total = 0.0
    for kind, (calls, units) in profile.work.callbacks[callback].work.items():
        call, unit = profile.work_cost(kind)
        total += calls * call + units * unit * (image_scale if SCALES_WITH.get(kind) == "image" else 1.0)
    return total


def _fastest(profile: JetsonProfile, now_ms: float, deployment: Deployment) -> Device | None:
    """Return the module's power mode with the quickest network; None if it is the one in use."""
    from robotbrain.jetson.catalogue import load_module
    from robotbrain.jetson.profiles import default_network, load_profile

    network = deployment.network or default_network()
    best: tuple[float, JetsonProfile] | None = None
    for mode in load_module(profile.slug).modes:
        other = load_profile(profile.slug, mode)
        latency = other.network_ms(network, deployment.precision, deployment.image_size)
        if best is None or latency < best[0]:
            best = latency, other
    if best is None or best[0] > 0.97 * now_ms:
        return None
    other = best[1]
    return Device(
        cores=other.cpu_cores,
        cpu=profile.cpu_factor / other.cpu_factor,
        gpu=now_ms / best[0],
        name=f"power mode {other.power_mode}",
    )
