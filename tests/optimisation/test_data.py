"""Splits share no world, prefixes agree, and the cache is never trusted further than it deserves."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

import robotbrain.optimisation.data as data
from robotbrain.errors import InputError
from robotbrain.optimisation.data import IGNORE, SPLITS, Scenes, default_cache, join, scenes, scenes_of
from robotbrain.training.segmentation import HELD_OUT_SEED, TRAINING_SEED


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


def test_no_world_is_in_two_splits() -> None:
    ranges = {name: range(s.first, s.first + s.worlds) for name, s in SPLITS.items()}
    ranges["shipped training"] = range(TRAINING_SEED, TRAINING_SEED + 300)
    ranges["shipped test"] = range(HELD_OUT_SEED, HELD_OUT_SEED + 100)
    for (a, left), (b, right) in itertools.combinations(ranges.items(), 2):
        assert left.stop <= right.start or right.stop <= left.start, (a, b)


def test_scenes_are_those_of_the_worlds_and_prefixes_agree(cache: Path) -> None:
    few, more = scenes("calibration", 3, cache=cache), scenes("calibration", 41, cache=cache)
    assert len(few) == 3 and len(more) == 41
    np.testing.assert_array_equal(few.images, more.images[:3])
    np.testing.assert_array_equal(few.labels, more.labels[:3])
    first, _, per_world = SPLITS["calibration"]
    direct = scenes_of([first, first + 1], per_world)
    np.testing.assert_array_equal(direct.images, more.images[:8])
    np.testing.assert_array_equal(direct.labels, more.labels[:8])
    assert set(np.unique(more.labels)) == {0, 1, 2, 3}


def test_the_second_call_renders_nothing(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = scenes("calibration", 5, cache=cache)
    monkeypatch.setattr(data, "scenes_of", lambda *_: pytest.fail("rendered again"))
    np.testing.assert_array_equal(scenes("calibration", 5, cache=cache).images, before.images)


@pytest.mark.parametrize("damage", [b"", b"PK\x03\x04 cut short", None])
def test_a_damaged_file_is_rendered_again(cache: Path, damage: bytes | None) -> None:
    good = scenes("calibration", 2, cache=cache)
    file = next(iter(sorted((cache / "scenes").rglob("*.npz"))))
    if damage is None:
        np.savez(file, images=good.images, labels=good.labels)  # a valid file, but of too few scenes
    else:
        file.write_bytes(damage)
    np.testing.assert_array_equal(scenes("calibration", 2, cache=cache).images, good.images)
    with np.load(file) as stored:
        assert len(stored["images"]) == 40


def test_a_cache_that_cannot_be_written_is_done_without(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    monkeypatch.setattr(data, "_CHUNK_WORLDS", 1)
    assert len(scenes("test", 2, cache=blocked)) == 2


def test_images_of_another_simulator_are_not_mixed_in(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(data, "_CHUNK_WORLDS", 1)
    scenes("validation", 1, cache=cache)
    monkeypatch.setattr(data, "_fingerprint", lambda: "another")
    scenes("validation", 1, cache=cache)
    assert len(list((cache / "scenes").glob("validation-*"))) == 2


def test_scenes_can_be_cut_joined_and_stripped_of_labels() -> None:
    part = Scenes(np.arange(4 * 12, dtype=np.uint8).reshape(4, 2, 2, 3), np.ones((4, 2, 2), np.uint8))
    both = join(part[:1], part[np.array([3, 2])].without_labels())
    assert len(both) == 3
    np.testing.assert_array_equal(both.images, part.images[[0, 3, 2]])
    assert (both.labels[0] == 1).all() and (both.labels[1:] == IGNORE).all()
    inputs = part.inputs()
    assert inputs.shape == (4, 3, 2, 2) and inputs.dtype == np.float32
    assert inputs[0, 1, 0, 0] == pytest.approx((1 / 255 - 0.45) / 0.25)


def test_mistakes_are_named(cache: Path) -> None:
    with pytest.raises(InputError, match="validation"):
        scenes("tset", 1, cache=cache)
    for count in (0, -1, 10**9, 1.5):
        with pytest.raises(InputError, match="count"):
            scenes("test", count, cache=cache)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="uint8"):
        Scenes(np.zeros((2, 4, 4, 3), np.float32), np.zeros((2, 4, 4), np.uint8))  # type: ignore[arg-type]
    with pytest.raises(InputError, match="scenes"):
        Scenes(np.zeros((2, 4, 4, 3), np.uint8), np.zeros((1, 4, 4), np.uint8))


def test_the_cache_is_where_the_user_says(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("ROBOTBRAIN_CACHE", str(tmp_path))
    assert default_cache() == tmp_path
    monkeypatch.delenv("ROBOTBRAIN_CACHE")
    assert default_cache().is_absolute()
