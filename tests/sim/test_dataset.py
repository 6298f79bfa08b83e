"""Training images: labels are the truth, poses are free, looks vary, bytes repeat."""

from __future__ import annotations

import numpy as np
import pytest

from robotbrain.errors import InputError
from robotbrain.sim import RayCamera, SegmentationClass, build_scene, generate_world, render_dataset
from robotbrain.sim.dataset import NEAR_RADIUS, POSE_CLEARANCE, random_free_position


def test_same_arguments_same_bytes_and_each_seed_on_its_own() -> None:
    both, second = render_dataset([4, 9], 3), render_dataset([9], 3)
    assert both.images.tobytes() == render_dataset([4, 9], 3).images.tobytes()
    assert np.array_equal(both.images[3:], second.images)
    assert np.array_equal(both.labels[3:], second.labels)


def test_shapes_and_classes() -> None:
    data = render_dataset(range(6), 8)
    assert data.images.shape == (48, 64, 64, 3)
    assert data.labels.shape == data.depth.shape == (48, 64, 64)
    assert data.images.dtype == data.labels.dtype == np.uint8
    share = np.bincount(data.labels.ravel(), minlength=4) / data.labels.size
    assert len(share) == 4
    assert (share > [0.01, 0.2, 0.2, 0.005]).all()
    assert (data.labels == SegmentationClass.MARKER).any(axis=(1, 2)).mean() > 0.3
    assert np.array_equal(data.labels == SegmentationClass.BACKGROUND, np.isinf(data.depth))


def test_looks_are_drawn_anew_for_every_image_only_if_asked() -> None:
    """Floors of one world share a colour without randomisation, and do not with it."""

    def floors(randomise: bool) -> np.ndarray:
        """Mean colour of the floor in each image."""
        data = render_dataset([1], 12, randomise_look=randomise)
        shown = [data.images[i][data.labels[i] == SegmentationClass.FLOOR] for i in range(12)]
        return np.array([pixels.mean(axis=0) for pixels in shown if len(pixels) > 400])

    def spread(means: np.ndarray) -> tuple[float, float]:
        """Of hue (chromaticity) and, relatively, of brightness."""
        total = means.sum(axis=1)
        return float((means / total[:, None]).std(axis=0).max()), float(total.std() / total.mean())

    same, drawn = spread(floors(False)), spread(floors(True))
    assert same[0] < 0.002
    assert same[1] < 0.05
    assert drawn[0] > 0.01
    assert drawn[1] > 0.22  # more than exposure and tint alone make


def test_labels_are_those_of_a_perfect_camera() -> None:
    """Noise and looks must never reach the labels: an image without either has the same ones."""
    plain, rich = render_dataset([2], 1, randomise_look=False), render_dataset([2], 1, randomise_look=False)
    assert np.array_equal(plain.labels, rich.labels)
    scene = build_scene(generate_world(2))
    frame = RayCamera(scene).render(np.array(scene.model.qpos0))
    assert np.array_equal(frame.classes, np.append(scene.geom_class, 0)[frame.geom_id])


def test_positions_are_free() -> None:
    world, rng = generate_world(3, 1.0), np.random.default_rng(0)
    for near in (False, True):
        points = np.array([random_free_position(world, rng, near) for _ in range(200)])
        assert world.clearance(points).min() >= POSE_CLEARANCE
        far = np.hypot(*(points - (world.goal.x, world.goal.y)).T).max()
        assert (far <= NEAR_RADIUS) == near


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"seeds": []}, "seeds"),
        ({"seeds": [0], "n_per_world": 0}, "n_per_world"),
        ({"seeds": [0], "difficulty": (0.9, 0.1)}, "difficulty"),
        ({"seeds": [-3]}, "seed"),
    ],
)
def test_bad_arguments_are_named(arguments: dict, named: str) -> None:
    with pytest.raises(InputError, match=named):
        render_dataset(**arguments)
