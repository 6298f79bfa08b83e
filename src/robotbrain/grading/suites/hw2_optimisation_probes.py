"""What the tests of `hw2_optimisation` do where the student's objects live: while grading, not in the tests' process.

A probe makes networks of plain arrays, lets the student's code work on them, and returns what became of them as plain
arrays again. It knows inputs only: what is right is computed by the test, in a process of its own.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

Array = NDArray[Any]
State = Mapping[str, Tensor]
"""A network's parameters and statistics by name."""
CLASSES = 4


class SmallScenes(NamedTuple):
    """What `robotbrain.optimisation.data.Scenes` looks like, of any image size."""

    images: NDArray[np.uint8]
    labels: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.images)

    def inputs(self) -> NDArray[np.float32]:
        """Return the network's input (N, 3, H, W), normalised."""
        from robotbrain.pipeline.segmentation import normalise

        return normalise(self.images)


# ---------------------------------------------------------------- networks


def small_network(state: State, dropout: float = 0.0) -> nn.Sequential:
    """Return a network of every kind of layer that a mode could be forgotten in; (N, 3, H, W) to (N, 4, H, W)."""
    width = len(state["0.bias"])
    with torch.random.fork_rng(devices=[]):
        network = nn.Sequential(
            nn.Conv2d(3, width, 3, padding=1),
            nn.BatchNorm2d(width),
            nn.ReLU(),
            nn.Dropout(dropout),
            nn.Conv2d(width, CLASSES, 1),
        )
    network.load_state_dict(dict(state))
    return network


class Mixed(nn.Module):
    """Convolutions with and without bias, batch norms, a linear layer: what to prune, and what to leave alone."""

    def __init__(self, state: State | None = None) -> None:
        super().__init__()
        with torch.random.fork_rng(devices=[]):
            self.body = nn.Sequential(
                nn.Conv2d(3, 8, 3, bias=False), nn.BatchNorm2d(8), nn.ReLU(), nn.Conv2d(8, 12, 1), nn.ReLU()
            )
            self.head = nn.Linear(12, 5)
        if state is not None:
            self.load_state_dict(dict(state))

    def forward(self, image: Tensor) -> Tensor:
        """Return (N, 5) for (N, 3, H, W)."""
        return self.head(self.body(image).mean(dim=(2, 3)))  # type: ignore[no-any-return]


def state_of(network: nn.Module) -> dict[str, Tensor]:
    """Return copies of all parameters and buffers by name."""
    return {name: value.detach().clone() for name, value in network.state_dict().items()}


def prunable(network: nn.Module) -> dict[str, Tensor]:
    """Return the weights of all convolutions and linear layers by parameter name."""
    return {
        f"{name}.weight" if name else "weight": module.weight
        for name, module in network.named_modules()
        if isinstance(module, (nn.Conv2d, nn.Linear))
    }


def _looked_at(network: nn.Module, answer: Any) -> dict[str, Any]:
    """Return an answer with what became of the network: its numbers, modes, and hooks."""
    return {
        "answer": answer,
        "state": state_of(network),
        "training": [module.training for module in network.modules()],
        "hooks": sum(len(m._forward_hooks) + len(m._forward_pre_hooks) for m in network.modules()),
    }


def _scenes(splits: Mapping[str, Sequence[Array]]) -> dict[str, SmallScenes]:
    return {name: SmallScenes(images.copy(), labels.copy()) for name, (images, labels) in splits.items()}


# ---------------------------------------------------------------- ranges


class OnePass:
    """Copies of the batches, to be walked through once as a generator is; it counts how often that is tried."""

    def __init__(self, batches: Sequence[Array]) -> None:
        self._rest = [batch.copy() for batch in reversed(batches)]
        self.walks = 0

    def __iter__(self) -> Iterator[Array]:
        return self

    def __next__(self) -> Array:
        if not self._rest:
            self.walks += 1
            raise StopIteration
        return self._rest.pop()


def walked(student: Any, batches: Sequence[Array], percentile: float | None) -> dict[str, Any]:
    """Return the range of batches that can be walked through once, or why a second walk got no answer."""
    source = OnePass(batches)
    try:
        return {"answer": student.activation_range(source, percentile=percentile)}
    except (TypeError, ValueError) as error:
        if source.walks < 2:
            raise
        return {"again": str(error)[:200]}


def calibrated(
    student: Any,
    state: State,
    training: bool,
    splits: Mapping[str, Sequence[Array]],
    layers: Sequence[str],
    percentile: float | None,
) -> dict[str, Any]:
    """Return the student's table of ranges, and what became of the network."""
    network = small_network(state).train(training)
    return _looked_at(network, student.calibrate(network, _scenes(splits), list(layers), percentile=percentile))


# ---------------------------------------------------------------- pruning


def pruned(student: Any, state: State, sparsity: float) -> dict[str, Any]:
    """Return the student's masks, what became of the network, and whether its parameters are still the same."""
    network = Mixed(state)
    leaves = dict(network.named_parameters())
    found = _looked_at(network, student.prune(network, sparsity))
    now = dict(network.named_parameters())
    return found | {"names": list(now), "kept": all(now.get(name) is leaf for name, leaf in leaves.items())}


def _optimiser(kind: str, network: nn.Module) -> torch.optim.Optimizer:
    if kind == "Adam":
        return torch.optim.Adam(network.parameters(), lr=1e-2)
    return torch.optim.SGD(network.parameters(), lr=1e-2, momentum=0.9)


def loss_of(network: nn.Module, images: Tensor, wanted: Tensor) -> Tensor:
    """Return the loss that the pruned network is trained on."""
    return functional.mse_loss(network(images), wanted)


def trained(
    state: State, kind: str, images: Tensor, wanted: Tensor, steps: int = 3
) -> tuple[Mixed, torch.optim.Optimizer]:
    """Return a network after some dense steps, and the optimiser that remembers them."""
    network = Mixed(state)
    optimiser = _optimiser(kind, network)
    for _ in range(steps):
        optimiser.zero_grad()
        loss_of(network, images, wanted).backward()  # type: ignore[no-untyped-call]
        optimiser.step()
    optimiser.zero_grad()
    return network, optimiser


def apply_masks(network: nn.Module, masks: Mapping[str, Tensor]) -> None:
    """Set to zero what the masks say."""
    with torch.no_grad():
        for name, weight in prunable(network).items():
            weight.mul_(masks[name])


def pruned_steps(
    student: Any, state: State, kind: str, masks: Mapping[str, Tensor], images: Tensor, wanted: Tensor, steps: int
) -> list[dict[str, Tensor]]:
    """Prune a network that was trained densely, and return its numbers after each of the student's steps."""
    network, optimiser = trained(state, kind, images, wanted)
    apply_masks(network, masks)
    found = []
    for _ in range(steps):
        student.pruned_step(network, masks, optimiser, loss_of(network, images, wanted))
        found.append(state_of(network))
    return found


# ---------------------------------------------------------------- distillation


def distilled(
    student: Any,
    logits: Tensor,
    teacher_logits: Tensor,
    labels: Tensor,
    temperature: float,
    alpha: float,
    teacher_learns: bool = False,
) -> dict[str, Any]:
    """Return the student's loss, and the gradients that it leaves in the logits, None where there is no way back."""
    leaf = logits.clone().requires_grad_(True)
    teacher = teacher_logits.clone().requires_grad_(teacher_learns)
    answer = student.distillation_loss(leaf, teacher, labels.clone(), temperature=temperature, alpha=alpha)
    connected = isinstance(answer, Tensor) and answer.requires_grad and answer.dim() == 0
    if connected:
        answer.backward()
    return {"loss": answer, "connected": connected, "gradient": leaf.grad, "teacher": teacher.grad}


def asked(student: Any, state: State, images: Tensor, dropout: float, seed: int) -> dict[str, Any]:
    """Return what the student's function says a teacher says that comes in train mode, and how it was asked."""
    teacher = small_network(state, dropout).train()
    sizes: list[int] = []
    counter = teacher[0].register_forward_pre_hook(lambda _, given: sizes.append(len(given[0])))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        answer = student.teacher_logits(teacher, images.clone())
    counter.remove()
    connected = bool(getattr(answer, "requires_grad", False))
    return _looked_at(teacher, answer) | {"connected": connected, "sizes": sizes}


def stepped(
    student: Any,
    state: State,
    batches: Sequence[Sequence[Tensor]],
    temperature: float,
    alpha: float,
    rate: float,
) -> dict[str, Any]:
    """Return a network after a step of the student's with each batch, and the losses that came back."""
    learner = small_network(state).eval()
    optimiser = torch.optim.SGD(learner.parameters(), lr=rate)
    losses = [
        student.distil_step(learner, optimiser, *(part.clone() for part in batch), temperature=temperature, alpha=alpha)
        for batch in batches
    ]
    return _looked_at(learner, losses)


# ---------------------------------------------------------------- evaluation


def scored(student: Any, state: State, training: bool, splits: Mapping[str, Sequence[Array]]) -> dict[str, Any]:
    """Return the student's mean IoU, and what became of the network."""
    network = small_network(state).train(training)
    return _looked_at(network, student.mean_iou(network, _scenes(splits)))


def read(student: Any, content: bytes, iou: float, teacher_iou: float, budget: Mapping[str, Any]) -> Any:
    """Return the student's readings of a network that is written to a file for them."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "network.onnx"
        path.write_bytes(content)
        return student.readings(str(path), iou, teacher_iou, dict(budget))
