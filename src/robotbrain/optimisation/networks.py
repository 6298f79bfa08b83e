"""Teacher and students: small U-Nets of operators that ONNX Runtime and TensorRT fuse, and their shipped weights.

All take ``image`` (N, 3, H, W) float32, normalised by :func:`robotbrain.pipeline.segmentation.normalise`, H and W
divisible by 8, and return logits (N, 4, H, W). Teacher and students work at the same 64x64 pixels.
"""

from __future__ import annotations

import json
import pickle
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import nn

from robotbrain.errors import InputError
from robotbrain.pipeline.segmentation import CLASSES

NAMES = ("teacher", "student", "student_plain")
"""Networks shipped with weights; ``student_plain`` is the student that never met the teacher."""

WEIGHTS = Path(__file__).with_name("weights")


def conv_block(inputs: int, outputs: int, stride: int = 1, kernel: int = 3) -> nn.Sequential:
    """Return convolution, batch norm and ReLU: one kernel after fusion."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


def depthwise_block(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    """Return a depthwise-separable convolution: 3x3 for each channel alone, then 1x1 across channels.

    Source: Howard et al., "MobileNets", 2017.
    """
    return nn.Sequential(
        nn.Conv2d(inputs, inputs, 3, stride, 1, groups=inputs, bias=False),
        nn.BatchNorm2d(inputs),
        nn.ReLU(inplace=True),
        *conv_block(inputs, outputs, kernel=1),
    )


class UNet(nn.Module):
    """Encoder and decoder with skip connections (Ronneberger, Fischer and Brox, "U-Net", MICCAI 2015).

    Each stage after the first halves the resolution. The way up narrows by a convolution *before* it upsamples, when
    there are four times fewer pixels to work on.

    Args:
        widths: channels of the stages, from fine to coarse.
        depths: convolution blocks of each stage.
        stem_stride: 1, or 2 to work at half the resolution throughout; the head then makes up for it.
        up_kernel: size of the convolutions on the way up, 1 or 3.
        depthwise: blocks of depthwise-separable convolutions after the first.
    """

    def __init__(
        self,
        widths: Sequence[int],
        depths: Sequence[int],
        *,
        stem_stride: int = 1,
        up_kernel: int = 1,
        depthwise: bool = False,
    ) -> None:
        super().__init__()
        block = depthwise_block if depthwise else conv_block
        stages = []
        before = 3
        for level, (width, depth) in enumerate(zip(widths, depths, strict=True)):
            first = conv_block(before, width, stem_stride) if level == 0 else block(before, width, 2)
            stages.append(nn.Sequential(first, *(block(width, width) for _ in range(depth - 1))))
            before = width
        self.down = nn.ModuleList(stages)
        pairs = list(zip(widths[:0:-1], widths[-2::-1], strict=True))
        self.up = nn.ModuleList(
            nn.Sequential(conv_block(a, b, kernel=up_kernel), nn.Upsample(scale_factor=2)) for a, b in pairs
        )
        self.merge = nn.ModuleList(block(2 * fine, fine) for _, fine in pairs)
        head: list[nn.Module] = [nn.Upsample(scale_factor=2)] if stem_stride == 2 else []
        self.head = nn.Sequential(*head, nn.Conv2d(widths[0], len(CLASSES), 3, padding=1))

    def encode(self, image: torch.Tensor) -> list[torch.Tensor]:
        """Return the output of every stage, from fine to coarse."""
        outputs = []
        for stage in self.down:
            image = stage(image)
            outputs.append(image)
        return outputs

    def features(self, image: torch.Tensor) -> torch.Tensor:
        """Return the coarsest features, (N, widths[-1], H/8, W/8) for the networks of this module."""
        return self.encode(image)[-1]

    def decode(self, stages: list[torch.Tensor]) -> torch.Tensor:
        """Return the logits for the outputs of :meth:`encode`."""
        value = stages[-1]
        for up, merge, skip in zip(self.up, self.merge, stages[-2::-1], strict=True):
            value = merge(torch.cat([up(value), skip], dim=1))
        return self.head(value)  # type: ignore[no-any-return]

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return logits (N, 4, H, W)."""
        return self.decode(self.encode(image))


def build_teacher() -> UNet:
    """Return the teacher, untrained: about 1 M parameters, most of them where the image is 8x8 or 16x16."""
    return UNet((24, 48, 96, 192), (2, 2, 2, 2))


def build_student(width: int = 8) -> UNet:
    """Return the student, untrained: 58 k parameters for ``width`` 8, all but 2 k of them below full resolution.

    Args:
        width: channels of the first stage, 4 to 64. Multiples of 8 fill the registers of a CPU.
    """
    _check_width(width)
    return UNet((width, 2 * width, 4 * width, 4 * width), (2, 2, 1, 1), up_kernel=3)


def build_depthwise(width: int = 16) -> UNet:
    """Return a depthwise-separable student: fewer multiplications, but weights whose ranges differ by channel.

    One scale for a whole tensor serves such weights badly, which makes it the network to try quantisation-aware
    training on.
    """
    _check_width(width)
    return UNet((width, 2 * width, 4 * width), (2, 2, 2), stem_stride=2, depthwise=True)


def parameter_count(module: nn.Module) -> int:
    """Return how many trainable numbers a module has."""
    return sum(p.numel() for p in module.parameters())


def network_path(name: str) -> Path:
    """Return the shipped ONNX file of a network (opset 17, dynamic batch)."""
    return _shipped(name, ".onnx")


def provenance(name: str) -> dict[str, Any]:
    """Return how a shipped network was made: command, seed, data, minutes, figures."""
    content: dict[str, Any] = json.loads(_shipped(name, ".json").read_text(encoding="utf-8"))
    return content


def load_network(name: str) -> UNet:
    """Return a shipped network with its weights, in eval mode.

    Args:
        name: one of :data:`NAMES`.
    """
    network = build_teacher() if name == "teacher" else build_student()
    return load_weights(network, _shipped(name, ".pt"))


def load_weights(network: UNet, path: Path) -> UNet:
    """Load a state dict of tensors into ``network`` and return it in eval mode; no code of the file is run.

    Raises:
        InputError: for a file that is missing, damaged, or of another network.
    """
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        network.load_state_dict(state)
    except (OSError, RuntimeError, EOFError, ValueError, KeyError, TypeError, pickle.UnpicklingError) as error:
        raise InputError(
            "weights",
            given=str(path),
            expected="the state dict of this network",
            fix=f"Train it again with `robotbrain train`. torch says: {str(error).splitlines()[0][:150]}",
        ) from error
    return network.eval()


def _shipped(name: str, suffix: str) -> Path:
    if name not in NAMES:
        raise InputError("network", given=name, expected=f"one of {', '.join(NAMES)}", fix="Check the spelling.")
    return WEIGHTS / f"{name}{suffix}"


def _check_width(width: int) -> None:
    if not isinstance(width, int) or not 4 <= width <= 64:
        raise InputError("width", given=width, expected="a whole number, 4 to 64", fix="Multiples of 8 are fastest.")
