"""Train the segmentation network on images from the simulator and export it as ONNX.

Run as ``robotbrain train segmentation``; the shipped checkpoint was made by exactly that command.
"""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotbrain.errors import InputError
from robotbrain.files import write_text
from robotbrain.pipeline.segmentation import CLASSES

if TYPE_CHECKING:
    import torch
    from torch import nn

TRAINING_SEED, HELD_OUT_SEED = 500_000, 1_000_000
"""First world of training and of the final figure; the worlds of lessons, labs and benchmarks lie below both."""


@dataclass(frozen=True)
class TrainConfig:
    """The recipe.

    Attributes:
        seed: of the weights and the data order.
        worlds: training worlds, from TRAINING_SEED on.
        images_per_world: robot poses imaged in each.
        held_out_worlds: worlds kept for the final figure.
        epochs: passes over the data.
        batch_size: images per step.
        learning_rate: peak of the one-cycle schedule.
        width: channels of the first stage.
    """

    seed: int = 0
    worlds: int = 300
    images_per_world: int = 12
    held_out_worlds: int = 100
    epochs: int = 6
    batch_size: int = 32
    learning_rate: float = 6e-3
    width: int = 8


def build_network(width: int = 8, classes: int = len(CLASSES)) -> nn.Module:
    """Return a small U-Net: three stages, skip connections, no operator that TensorRT would not fuse.

    Input (N, 3, H, W) float32 normalised, H and W divisible by 4; output (N, classes, H, W) logits.
    Source of the shape: Ronneberger, Fischer and Brox, "U-Net", MICCAI 2015.
    """
    import torch
    from torch import nn

    def block(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
        return nn.Sequential(
            nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False),
            nn.BatchNorm2d(outputs),
            nn.ReLU(inplace=True),
        )

    class SmallUNet(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            a, b, c = width, 2 * width, 4 * width
            self.stage1 = block(3, a)
            self.stage2 = nn.Sequential(block(a, b, 2), block(b, b))
            self.stage3 = nn.Sequential(block(b, c, 2), block(c, c), block(c, c))
            self.up2 = nn.Sequential(nn.Upsample(scale_factor=2, mode="nearest"), block(c, b))
            self.merge2 = block(2 * b, b)
            self.up1 = nn.Sequential(nn.Upsample(scale_factor=2, mode="nearest"), block(b, a))
            self.merge1 = block(2 * a, a)
            self.head = nn.Conv2d(a, classes, 1)

        def forward(self, image: torch.Tensor) -> torch.Tensor:
            one = self.stage1(image)
            two = self.stage2(one)
            three = self.stage3(two)
            two = self.merge2(torch.cat([self.up2(three), two], dim=1))
            one = self.merge1(torch.cat([self.up1(two), one], dim=1))
            return self.head(one)  # type: ignore[no-any-return]

    return SmallUNet()


def train(config: TrainConfig, output: Path, *, run_dir: Path | None = None, progress: bool = True) -> dict[str, Any]:
    """Train, export, measure, and write ``output`` (.onnx) with its provenance beside it (.json).

    Args:
        config: the recipe.
        output: of the network.
        run_dir: folder of a checkpoint to go on from after an interrupt.
        progress: show a bar.

    Returns:
        The provenance: recipe, seconds, IoU per class on held-out worlds measured through ONNX Runtime.
    """
    import torch

    from robotbrain.optimisation.data import scenes_of
    from robotbrain.optimisation.evaluate import mean_iou
    from robotbrain.optimisation.training import FitConfig, fit

    if output.suffix != ".onnx":
        raise InputError("output", given=str(output), expected="a path ending in .onnx", fix="Add the suffix.")
    if not 0 < config.worlds <= HELD_OUT_SEED - TRAINING_SEED:
        limit = HELD_OUT_SEED - TRAINING_SEED
        raise InputError("worlds", given=config.worlds, expected=f"1 to {limit}", fix="Keep training and test apart.")
    begin = time.perf_counter()
    torch.manual_seed(config.seed)
    scenes = scenes_of(range(TRAINING_SEED, TRAINING_SEED + config.worlds), config.images_per_world)
    rendered = time.perf_counter() - begin
    network = build_network(config.width)
    recipe = FitConfig(config.epochs, config.batch_size, config.learning_rate, config.seed)
    fit(network, scenes, recipe, run_dir=run_dir, progress=progress)
    export(network, output)
    iou = mean_iou(output, scenes_of(range(HELD_OUT_SEED, HELD_OUT_SEED + config.held_out_worlds), 4))
    provenance: dict[str, Any] = {
        "made_by": "robotbrain train segmentation",
        "recipe": asdict(config),
        "parameters": sum(p.numel() for p in network.parameters()),
        "held_out_mean_iou": round(iou.mean, 4),
        "held_out_iou": {name: round(value, 4) for name, value in iou.per_class.items()},
        "seconds": round(time.perf_counter() - begin, 1),
        "seconds_rendering": round(rendered, 1),
        "torch": torch.__version__,
    }
    write_text(output.with_suffix(".json"), json.dumps(provenance, indent=2) + "\n")
    return provenance


def export(network: nn.Module, output: Path) -> Path:
    """Write the network as ONNX in opset 13, the newest that the Nano's TensorRT 8.2 parses (JetPack 4)."""
    from robotbrain.optimisation.export import export_onnx

    return export_onnx(network, output, opset=13)
