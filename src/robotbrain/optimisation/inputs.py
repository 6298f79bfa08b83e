"""Reading a network's inputs from a file: to calibrate with, or to check an engine with."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from robotbrain.errors import InputError
from robotbrain.pipeline.segmentation import MEAN, STD

_NAMES = ("images", "inputs")


def read_inputs(path: str | Path, mean: Sequence[float] = MEAN, std: Sequence[float] = STD) -> Any:
    """Return the array in a file as the network takes it; only images in uint8 are changed.

    Args:
        path: a ``.npy``, or a ``.npz`` with one array or one called ``images`` or ``inputs``.
        mean, std: by channel, of values scaled to 0..1, for images: uint8 (N, H, W, channels).

    Returns:
        Images: float32 (N, channels, H, W), ``(pixel / 255 - mean) / std``. Anything else: as it is.

    Raises:
        InputError: for a file that is missing, damaged or none of these, or images of another layout.
    """
    try:
        loaded: Any = np.load(path, allow_pickle=False)
        if not isinstance(loaded, np.ndarray):
            with loaded:
                names = loaded.files
                loaded = loaded[next((n for n in _NAMES if n in names), names[0] if len(names) == 1 else _NAMES[0])]
    except Exception as error:  # numpy, zipfile, zlib and the file system each have errors of their own
        raise InputError(
            f"inputs {path}",
            given=str(error)[:100],
            expected="a .npy, or a .npz with an array called images or inputs",
            fix="Save them with numpy.savez(FILE, images=images).",
        ) from error
    if loaded.dtype != np.uint8:
        return loaded
    if loaded.ndim != 4 or loaded.shape[3] != len(mean):
        raise InputError(
            f"inputs {path}", given=loaded.shape, expected=f"images (N, H, W, {len(mean)})", fix="Check the layout."
        )
    middle, spread = np.asarray(mean, np.float32), np.asarray(std, np.float32)
    scaled = (loaded.astype(np.float32) / np.float32(255) - middle) / spread
    return np.ascontiguousarray(scaled.transpose(0, 3, 1, 2))
