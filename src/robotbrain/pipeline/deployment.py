"""How the brain is put onto a Jetson: for which sensors it pays, and how its nodes share threads."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from robotbrain.errors import InputError
from robotbrain.jetson.kernels import PRECISIONS
from robotbrain.jetson.profiles import PRECISION
from robotbrain.jetson.resize import check_image_size


@dataclass(frozen=True)
class Deployment:
    """A way to run the brain. It changes what work costs and who waits for whom, never what the sensors see.

    The simulator's camera and lidar are small, so that it stays fast on a laptop. A deployment may charge for sensors
    of a real robot's size: the network is then predicted at that image size, and all work that goes by the pixel, by
    the camera point or by the beam is charged in proportion (messages are not: about 2 % of it).

    Attributes:
        image_size: (width, height) that the camera is charged for, e.g. (640, 480); None: what the simulator renders.
        network: ONNX file of a network (of one image input) whose latency is charged for each image; None: that of the
            network that runs. The shipped one is tiny, because its world is; real images take a larger one.
        scan_rays: beams per scan that the lidar is charged for; None: what the simulator casts.
        one_thread: all brain nodes share one single-threaded executor, as with one ``rclpy.spin`` in one process:
            each callback, inference included, delays all others. Otherwise each node is a process of its own.
        precision: ``fp32``, ``fp16`` or ``int8``: what the network's latency is predicted for. The kit's network itself
            computes in float32 here.
        camera_queue: images that may wait for perception; None: as many as come (KEEP_ALL).
    """

    image_size: tuple[int, int] | None = None
    network: str | Path | None = None
    scan_rays: int | None = None
    one_thread: bool = False
    precision: str = PRECISION
    camera_queue: int | None = 1

    def __post_init__(self) -> None:
        if self.image_size is not None:
            check_image_size(self.image_size)
        if self.network is not None and not Path(self.network).is_file():
            raise InputError(
                "network", given=str(self.network), expected="the path of an ONNX file", fix="Check the path."
            )
        if self.precision not in PRECISIONS:
            raise InputError(
                "precision",
                given=self.precision,
                expected="one of " + ", ".join(PRECISIONS),
                fix="Choose one of these.",
            )
        queue = self.camera_queue
        if queue is not None and (isinstance(queue, bool) or not isinstance(queue, int) or queue < 1):
            raise InputError(
                "camera_queue", given=queue, expected="a whole number >= 1, or None", fix="1 keeps the newest image."
            )
        rays = self.scan_rays
        if rays is not None and (isinstance(rays, bool) or not isinstance(rays, int) or not 1 <= rays <= 100_000):
            raise InputError(
                "scan_rays", given=rays, expected="a whole number from 1 to 100000", fix="Beams of one scan, e.g. 360."
            )

    def scales(self, pixels: int, rays: int) -> dict[str, float]:
        """Return how many times more image and scan work is charged than is done.

        Args:
            pixels: of an image as simulated.
            rays: of a scan as simulated.
        """
        width, height = self.image_size or (pixels, 1)
        return {"image": width * height / pixels, "scan": (self.scan_rays or rays) / rays}
