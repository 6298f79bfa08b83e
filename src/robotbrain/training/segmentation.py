"""Train the segmentation network on images from the simulator and export it as ONNX.

Run as ``robotbrain train segmentation``; the shipped checkpoint was made by exactly that command.
"""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robotbrain.errors import InputError
from robotbrain.files import atomic_path, write_text
from robotbrain.pipeline.segmentation import CLASSES, normalise

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


def confusion(labels: NDArray[Any], predicted: NDArray[Any], classes: int = len(CLASSES)) -> NDArray[np.int64]:
    """Return the (classes, classes) pixel counts, rows the truth, columns the prediction."""
    index = labels.astype(np.int64).ravel() * classes + predicted.astype(np.int64).ravel()
    return np.bincount(index, minlength=classes * classes).reshape(classes, classes)


def intersection_over_union(counts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the IoU of each class from a confusion matrix, over all pixels together."""
    hit = np.diag(counts).astype(float)
    union = counts.sum(axis=0) + counts.sum(axis=1) - np.diag(counts)
    return np.asarray(hit / np.maximum(union, 1))


def train(config: TrainConfig, output: Path, *, progress: bool = True) -> dict[str, Any]:
    """Train, export, measure, and write ``output`` (.onnx) with its provenance beside it (.json).

    Returns:
        The provenance: recipe, seconds, IoU per class on held-out worlds measured through ONNX Runtime.
    """
    import onnxruntime
    import torch
    from torch import nn
    from tqdm.auto import tqdm

    from robotbrain.sim.dataset import render_dataset

    if output.suffix != ".onnx":
        raise InputError("output", given=str(output), expected="a path ending in .onnx", fix="Add the suffix.")
    if not 0 < config.worlds <= HELD_OUT_SEED - TRAINING_SEED:
        limit = HELD_OUT_SEED - TRAINING_SEED
        raise InputError("worlds", given=config.worlds, expected=f"1 to {limit}", fix="Keep training and test apart.")
    begin = time.perf_counter()
    torch.manual_seed(config.seed)
    rng = np.random.default_rng(config.seed)
    images, labels, _ = render_dataset(range(TRAINING_SEED, TRAINING_SEED + config.worlds), config.images_per_world)
    rendered = time.perf_counter() - begin
    inputs, targets = torch.from_numpy(normalise(images)), torch.from_numpy(labels.astype(np.int64))
    network = build_network(config.width).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimiser = torch.optim.AdamW(network.parameters(), lr=config.learning_rate, weight_decay=1e-4)
    steps = config.epochs * (len(inputs) // config.batch_size)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, config.learning_rate, total_steps=steps)
    # The marker covers few pixels; without weight it would be the last to be learned.
    loss_of = nn.CrossEntropyLoss(weight=torch.tensor([1.0, 1.0, 1.0, 3.0]))
    network.train()
    with tqdm(total=steps, desc="training", unit="step", disable=not progress) as bar:
        for _ in range(config.epochs):
            order = rng.permutation(len(inputs))
            for k in range(len(inputs) // config.batch_size):
                chosen = torch.from_numpy(order[k * config.batch_size : (k + 1) * config.batch_size])
                batch, wanted = inputs[chosen], targets[chosen]
                if rng.random() < 0.5:
                    batch, wanted = batch.flip(-1), wanted.flip(-1)
                loss = loss_of(network(batch.contiguous(memory_format=torch.channels_last)), wanted)
                optimiser.zero_grad(set_to_none=True)
                loss.backward()
                optimiser.step()
                schedule.step()
                bar.update()
                if k % 20 == 0:
                    bar.set_postfix(loss=f"{loss.item():.3f}")
    export(network, output)
    held_images, held_labels, _ = render_dataset(range(HELD_OUT_SEED, HELD_OUT_SEED + config.held_out_worlds), 4)
    session = onnxruntime.InferenceSession(str(output), providers=["CPUExecutionProvider"])
    iou = evaluate(session, held_images, held_labels)
    parameters = sum(p.numel() for p in network.parameters())
    provenance: dict[str, Any] = {
        "made_by": "robotbrain train segmentation",
        "recipe": asdict(config),
        "parameters": int(parameters),
        "held_out_mean_iou": round(float(iou.mean()), 4),
        "held_out_iou": {name: round(float(value), 4) for name, value in zip(CLASSES, iou, strict=True)},
        "seconds": round(time.perf_counter() - begin, 1),
        "seconds_rendering": round(rendered, 1),
        "torch": torch.__version__,
    }
    write_text(output.with_suffix(".json"), json.dumps(provenance, indent=2) + "\n")
    return provenance


def export(network: nn.Module, output: Path) -> None:
    """Write the network as ONNX, batch axis dynamic, batch norm folded into the convolutions.

    Opset 13 is the newest that TensorRT 8.2 parses, with which JetPack ends on the Nano.
    """
    import copy

    import torch

    frozen = copy.deepcopy(network).eval().to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
    example = torch.zeros(1, 3, 64, 64)
    with atomic_path(output) as temporary:
        torch.onnx.export(
            frozen,
            (example,),
            str(temporary),
            dynamo=False,
            opset_version=13,
            input_names=["image"],
            output_names=["logits"],
            dynamic_axes={"image": {0: "batch"}, "logits": {0: "batch"}},
        )


def evaluate(session: Any, images: NDArray[np.uint8], labels: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return the IoU per class of an ONNX Runtime session over (N, H, W, 3) images and (N, H, W) labels."""
    counts = np.zeros((len(CLASSES), len(CLASSES)), dtype=np.int64)
    for first in range(0, len(images), 50):
        logits = session.run(None, {"image": normalise(images[first : first + 50])})[0]
        counts += confusion(labels[first : first + 50], logits.argmax(axis=1))
    return intersection_over_union(counts)
