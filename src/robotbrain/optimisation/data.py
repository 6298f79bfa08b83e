"""Labelled camera images in splits that no world belongs to twice, rendered once and kept in the user's cache."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import sys
import zipfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from robotbrain.errors import InputError
from robotbrain.files import atomic_path

IGNORE = 255
"""Label of a pixel whose class is not known: neither trained on nor counted."""


class Split(NamedTuple):
    """Where a split's worlds lie: seeds ``first`` to ``first + worlds - 1``, ``per_world`` images of each."""

    first: int
    worlds: int
    per_world: int


SPLITS = {
    "train": Split(2_000_000, 100_000, 12),
    "unlabelled": Split(2_200_000, 100_000, 12),
    "calibration": Split(2_400_000, 100_000, 4),
    "validation": Split(2_600_000, 100_000, 4),
    "test": Split(2_800_000, 100_000, 4),
}
"""``unlabelled`` has labels, too (the simulator knows them): whoever uses it leaves them alone. Choices are made on
``validation``; ``test`` is for the figure at the end."""

_CHUNK_WORLDS = 10  # of a file of the cache


@dataclass(frozen=True)
class Scenes:
    """Images with the class of each pixel.

    Attributes:
        images: (N, 64, 64, 3) uint8, RGB.
        labels: (N, 64, 64) uint8, class ids 0 to 3, or IGNORE.
    """

    images: NDArray[np.uint8]
    labels: NDArray[np.uint8]

    def __post_init__(self) -> None:
        images, labels = self.images, self.labels
        good = images.ndim == 4 and images.shape[3] == 3 and images.dtype == labels.dtype == np.uint8
        if not good or labels.shape != images.shape[:3]:
            raise InputError(
                "scenes",
                given=f"images {images.dtype} {images.shape}, labels {labels.dtype} {labels.shape}",
                expected="uint8 (N, H, W, 3) and uint8 (N, H, W)",
                fix="Take them from robotbrain.optimisation.data.scenes().",
            )

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, which: slice | NDArray[np.intp]) -> Scenes:
        return Scenes(self.images[which], self.labels[which])

    def inputs(self) -> NDArray[np.float32]:
        """Return the network's input (N, 3, 64, 64), normalised."""
        from robotbrain.pipeline.segmentation import normalise

        return normalise(self.images)

    def without_labels(self) -> Scenes:
        """Return the same images with every label IGNORE."""
        return Scenes(self.images, np.full_like(self.labels, IGNORE))


def join(*parts: Scenes) -> Scenes:
    """Return the scenes of all parts, one after the other."""
    return Scenes(np.concatenate([p.images for p in parts]), np.concatenate([p.labels for p in parts]))


def scenes(split: str, count: int, *, cache: Path | None = None, progress: bool = False) -> Scenes:
    """Return the first ``count`` scenes of a split; ``scenes(s, 10)`` are the first ten of ``scenes(s, 100)``.

    Looks, light and camera noise are drawn anew for each image, as for the network that the brain ships with.

    Args:
        split: one of :data:`SPLITS`.
        count: how many, at least 1.
        cache: folder of rendered images; None: :func:`default_cache`. One that cannot be written is done without.
        progress: show a bar while rendering (about 8 ms an image, once).

    Raises:
        InputError: for an unknown split, or more images than it has.
    """
    if split not in SPLITS:
        raise InputError("split", given=split, expected=f"one of {', '.join(SPLITS)}", fix="Check the spelling.")
    first, worlds, per_world = SPLITS[split]
    if not isinstance(count, int | np.integer) or not 1 <= count <= worlds * per_world:
        limit = worlds * per_world
        raise InputError("count", given=count, expected=f"a whole number, 1 to {limit}", fix="Ask for fewer images.")
    folder = (default_cache() if cache is None else Path(cache)) / "scenes" / f"{split}-{_fingerprint()}"
    from tqdm.auto import tqdm

    images: list[NDArray[np.uint8]] = []
    labels: list[NDArray[np.uint8]] = []
    per_chunk = _CHUNK_WORLDS * per_world
    chunks = -(-int(count) // per_chunk)
    for index in tqdm(range(chunks), desc=f"images ({split})", unit="chunk", disable=not progress):
        begin = first + index * _CHUNK_WORLDS
        part = _chunk(folder / f"{begin}.npz", range(begin, begin + _CHUNK_WORLDS), per_world)
        images.append(part.images)
        labels.append(part.labels)
    return Scenes(np.concatenate(images)[:count], np.concatenate(labels)[:count])


def scenes_of(worlds: Iterable[int], per_world: int = 4) -> Scenes:
    """Render ``per_world`` images in the world of each seed, without a cache: a grader's hidden scenes."""
    from robotbrain.sim.dataset import render_dataset

    images, labels, _ = render_dataset(worlds, per_world)
    return Scenes(images, labels)


def default_cache() -> Path:
    """Return the folder for what can be computed again: ``ROBOTBRAIN_CACHE``, or the system's place for a user's."""
    if chosen := os.environ.get("ROBOTBRAIN_CACHE"):
        return Path(chosen)
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local") / "robotbrain" / "Cache"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "robotbrain"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "robotbrain"


def _chunk(file: Path, worlds: Sequence[int], per_world: int) -> Scenes:
    """Return the scenes of a few worlds from ``file``, or render them and try to keep them there."""
    if file.is_file():
        # A damaged file is rendered again.
        with contextlib.suppress(OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            with np.load(file, allow_pickle=False) as stored:
                part = Scenes(stored["images"], stored["labels"])
            if len(part) == len(worlds) * per_world:
                return part
    part = scenes_of(worlds, per_world)
    with contextlib.suppress(OSError), atomic_path(file) as temporary, temporary.open("wb") as handle:
        np.savez(handle, images=part.images, labels=part.labels)
    return part


@functools.cache
def _fingerprint() -> str:
    """Name what the simulator renders today: images of another version of it are not mixed with these."""
    probe = scenes_of([7, 8], 2)
    return hashlib.sha256(probe.images.tobytes() + probe.labels.tobytes()).hexdigest()[:12]
