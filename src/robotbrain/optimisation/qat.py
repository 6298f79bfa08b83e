"""Quantisation-aware training: train a network while it sees its own rounding, then export it for TensorRT.

``prepare`` captures a trained network with ``torch.export`` and puts a *fake quantiser* (quantise, then dequantise) at
the input and weight of every convolution and linear layer, on the integer grid that TensorRT takes: symmetric, zero
point 0. Rounding has no useful gradient; the straight-through estimator passes the gradient on as if it were not there
(Bengio et al., 2013, https://arxiv.org/abs/1308.3432).

Batch norms are folded into the convolutions *before* training, so that the weight that is rounded is the one that is
shipped, and no statistics move that would change it. This static folding trains as well as keeping them, says Nagel
et al., "A White Paper on Neural Network Quantization", 2021 (https://arxiv.org/abs/2106.08295), and it starts from a
trained network, which quantisation-aware training should anyway.

What changed: older courses call ``torch.quantization.prepare_qat`` with ``get_default_qat_qconfig("fbgemm")``. That
API (eager mode ``torch.ao.quantization``) is deprecated in favour of torchao's PT2E (https://github.com/pytorch/ao,
``torchao.quantization.pt2e``), which is used here. It also needs a network rewritten with ``QuantStub``, modules fused
by hand and ``train()`` called first, all of which is easily forgotten; and ``fbgemm`` is a format for x86: asymmetric
activations, which TensorRT refuses.
"""

from __future__ import annotations

import copy
import tempfile
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from robotbrain.errors import InputError, RobotBrainError
from robotbrain.files import write_bytes
from robotbrain.optimisation.pt2e import SymmetricQuantizer, pt2e
from robotbrain.optimisation.qat_graph import fold_batch_norms, settle_constants, write_out_quantisers

if TYPE_CHECKING:
    from torch.fx import GraphModule

    from robotbrain.optimisation.data import Scenes
    from robotbrain.optimisation.distillation import DistilConfig
    from robotbrain.optimisation.training import FitConfig, FitResult, TeacherTargets

OUTLIERS = 0.01
"""Share of outputs that may differ from torch by more than one step of an 8-bit grid."""


class QatNetwork(nn.Module):
    """A network with fake quantisers, to be trained like any other. :func:`prepare` makes it.

    In ``train()`` mode the ranges of activations grow with the data; in ``eval()`` mode they stand still, so that an
    evaluation cannot calibrate the network on what it evaluates. Once frozen (:func:`freeze`) they stand still in
    ``train()`` mode, too. A weight's range always is the weight's.

    Attributes:
        graph: the captured program.
        weight_bits: of the weights' grid.
        activation_bits: of the activations' grid.
        per_channel: one scale per output channel of a weight, or one for all.
    """

    frozen: torch.Tensor
    steps: torch.Tensor

    def __init__(self, graph: GraphModule, weight_bits: int, activation_bits: int, per_channel: bool) -> None:
        super().__init__()
        self.graph = graph
        self.weight_bits, self.activation_bits, self.per_channel = weight_bits, activation_bits, per_channel
        # In the state dict, so that a training that is resumed freezes at the same step and stays frozen.
        self.register_buffer("frozen", torch.tensor(False))
        self.register_buffer("steps", torch.tensor(0))

    def train(self, mode: bool = True) -> QatNetwork:
        """Choose the mode; it takes effect at the next forward."""
        self.training = mode  # the graph's own train() refuses, as all programs of torch.export do
        return self

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return the output for (N, ...) inputs, with quantisation simulated."""
        return self._run(image, follow=self.training and not bool(self.frozen))

    def observe(self, image: torch.Tensor) -> None:
        """Let the ranges follow these inputs, whatever the mode: calibration."""
        with torch.no_grad():
            self._run(image, follow=True)

    def activation_quantisers(self) -> list[Any]:
        """Return the fake quantisers of activations."""
        calls = [n for n in self.graph.graph.nodes if n.op == "call_module" and n.args[0].op != "get_attr"]
        parts = [self.graph.get_submodule(n.target) for n in calls]
        return [part for part in parts if isinstance(part, pt2e().FakeQuantize)]

    def _run(self, image: torch.Tensor, *, follow: bool) -> torch.Tensor:
        for quantiser in self.activation_quantisers():
            quantiser.enable_observer(follow)
        return self.graph(image)  # type: ignore[no-any-return]


def prepare(
    module: nn.Module,
    example: torch.Tensor,
    *,
    weight_bits: int = 8,
    per_channel: bool = True,
    activation_bits: int = 8,
) -> QatNetwork:
    """Return a trainable copy of a trained network, batch norms folded, with fake quantisers.

    Args:
        module: a float32 network of one input and one output; it is left as it is.
        example: an input, (N, ...) with N at least 2; the batch axis stays free.
        weight_bits: 2 to 8.
        per_channel: one weight scale per output channel, or one per tensor.
        activation_bits: 2 to 8.

    Raises:
        InputError: for widths out of range, or a network that ``torch.export`` cannot capture.
    """
    for name, bits in (("weight_bits", weight_bits), ("activation_bits", activation_bits)):
        if isinstance(bits, bool) or not isinstance(bits, int) or not 2 <= bits <= 8:
            raise InputError(name, given=bits, expected="a whole number, 2 to 8", fix="TensorRT's INT8 has 8.")
    if example.ndim < 2 or len(example) < 2:  # torch.export takes a batch of one for a constant
        raise InputError("example", given=tuple(example.shape), expected="a batch of 2 or more", fix="zeros(2, ...)")
    original = copy.deepcopy(module).to(device="cpu", dtype=torch.float32).eval()
    quantizer = SymmetricQuantizer(weight_bits, activation_bits, per_channel)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            program = torch.export.export(original, (example,), dynamic_shapes=({0: torch.export.Dim("batch")},))
        except Exception as error:  # the tracer, and the module's own code, may raise anything
            raise InputError(
                "module",
                given=f"{type(error).__name__}: {(str(error).splitlines() or [''])[0][:150]}",
                expected="a network that torch.export can capture with a free batch axis",
                fix="No branches on values, no fixed batch sizes in reshapes.",
            ) from error
        graph = pt2e().prepare_qat_pt2e(fold_batch_norms(program.module()), quantizer)
    if quantizer.layers == 0:
        raise InputError("module", given="no Conv2d or Linear", expected="at least one", fix="There is nothing to do.")
    return QatNetwork(graph, weight_bits, activation_bits, per_channel)


def calibrate(network: QatNetwork, inputs: NDArray[np.float32], *, batch: int = 50) -> QatNetwork:
    """Set the ranges from data without any training: post-training quantisation on exactly the same grid.

    Do it before :func:`finetune`, too: the first steps then start from ranges that fit.

    Args:
        network: from :func:`prepare`; changed in place, returned in eval mode.
        inputs: (N, C, H, W), normalised; neither test nor validation data.
        batch: images at a time.
    """
    values = np.asarray(inputs, dtype=np.float32)
    if values.ndim < 2 or len(values) == 0 or not np.isfinite(values).all():
        given = f"{values.dtype} {values.shape}"
        raise InputError("inputs", given=given, expected="finite float32 (N, ...)", fix="Use the calibration split.")
    for first in range(0, len(values), batch):
        network.observe(torch.from_numpy(values[first : first + batch]))
    return network.train(False)


def freeze(network: QatNetwork) -> QatNetwork:
    """Fix the ranges of activations for the rest of the training; weights learn on."""
    network.frozen.fill_(True)
    return network


def freeze_after(steps: int) -> Callable[[nn.Module], None]:
    """Return an ``after_step`` for ``training.fit`` that freezes the network after that many steps.

    Ranges that still move would shift every grid point from step to step, just when the learning rate is small.
    """

    def after_step(network: nn.Module) -> None:
        if not isinstance(network, QatNetwork):
            raise InputError("network", given=type(network).__name__, expected="a QatNetwork", fix="Call prepare.")
        network.steps += 1
        if int(network.steps) == steps:
            freeze(network)

    return after_step


def finetune(
    network: QatNetwork,
    scenes: Scenes,
    config: FitConfig,
    *,
    teacher: nn.Module | TeacherTargets | None = None,
    distil: DistilConfig | None = None,
    freeze_at: float = 0.7,
    run_dir: Path | None = None,
    progress: bool = True,
) -> FitResult:
    """Train on with simulated quantisation through ``training.fit``; frozen for the last part; left in eval mode.

    Args:
        network: from :func:`prepare`.
        scenes: to learn from.
        config: a tenth of the usual learning rate and a few epochs do: the network is nearly there.
        teacher: as for ``fit``: the full-precision network is a good one.
        distil: as for ``fit``.
        freeze_at: share of the steps, above 0, after which ranges stand still; 1 or more: at the end.
        run_dir: as for ``fit``.
        progress: show a bar.
    """
    from robotbrain.optimisation.training import fit

    if not freeze_at > 0:
        raise InputError("freeze_at", given=freeze_at, expected="a share above 0", fix="0.7 is a usual choice.")
    total = config.epochs * (len(scenes) // config.batch_size)
    hook = freeze_after(max(1, min(total, round(freeze_at * total))))
    result = fit(
        network, scenes, config, teacher=teacher, distil=distil, after_step=hook, run_dir=run_dir, progress=progress
    )
    freeze(network)
    return result


def convert(network: QatNetwork) -> GraphModule:
    """Return the network as it will be shipped: weights rounded, every grid fixed.

    It computes in float32 what integers would. Unlike torchao's ``convert_pt2e`` it does not end in operators that the
    ONNX exporter lacks: each layer's input and weight pass through torch's ``fake_quantize``.

    Raises:
        InputError: when a range has never been seen.
    """
    for part in network.activation_quantisers():
        low = part.activation_post_process.min_val
        if low.numel() == 0 or not bool(torch.isfinite(low).all()):
            raise InputError(
                "network",
                given="a layer whose input has not been seen",
                expected="a network that has seen data",
                fix="Call calibrate(network, inputs) or finetune it first.",
            )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch's own graphs complain when they are copied
        return write_out_quantisers(copy.deepcopy(network.graph))


def export_qat_onnx(
    network: QatNetwork,
    path: str | Path,
    *,
    example: Sequence[int] = (1, 3, 64, 64),
    input_name: str = "image",
    output_name: str = "logits",
) -> Path:
    """Write a trained network as QDQ ONNX, opset 17, dynamic batch, as TensorRT takes it; return the path.

    Symmetric INT8 at the input and the weight of every convolution and linear layer, biases in float32. Weights of
    fewer than 8 bits are written on the 8-bit grid (4 bits use the integers -7 to 7): the accuracy is that of the few
    bits, size and speed are those of INT8. ONNX has had INT4 only since opset 21, which TensorRT parses since version
    10 and for weights alone.

    Args:
        network: from :func:`prepare`, calibrated or trained.
        path: ending in ``.onnx``.
        example: shape of an input.
        input_name: of the graph's input.
        output_name: of the graph's output.

    Raises:
        InputError: for activations of fewer than 8 bits: QuantizeLinear would saturate at the 8-bit limits, not theirs.
        RobotBrainError: when ONNX Runtime's logits differ from torch's by more than one step of an 8-bit grid over
            their range, outliers aside.
    """
    from robotbrain.optimisation.export import OPSET, export_onnx

    if network.activation_bits != 8:
        raise InputError(
            "activation_bits",
            given=network.activation_bits,
            expected="8: ONNX's QuantizeLinear of opset 17 saturates at 8 bits and at no other width",
            fix="Prepare with activation_bits=8; few-bit weights can be exported.",
        )
    shipped = convert(network)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "network.onnx"
        # Not with its own check, which allows no value to fall on the other side of a rounding edge.
        export_onnx(
            shipped, file, opset=OPSET, example=example, check=False, input_name=input_name, output_name=output_name
        )
        settle_constants(file)
        _compare(shipped, file, example)
        return write_bytes(path, file.read_bytes())


def _compare(shipped: nn.Module, file: Path, example: Sequence[int]) -> None:
    """Refuse a file whose outputs are not torch's, within a step.

    Sums are taken in another order, so a value on a rounding edge may fall on its other side; what follows from it can
    add up to more than a step here and there, but not in more than a hundredth of the outputs.
    """
    from robotbrain.optimisation.evaluate import onnx_session

    session = onnx_session(file, optimise=False)
    generator = torch.Generator().manual_seed(0)
    for batch in (1, 3):
        image = torch.randn((batch, *example[1:]), generator=generator)
        with torch.no_grad():
            wanted = shipped(image).numpy()
        got = session.run(None, {session.get_inputs()[0].name: image.numpy()})[0]
        step = float(np.abs(wanted).max()) / 127.5
        off = np.abs(got - wanted) > step if got.shape == wanted.shape else np.ones(1, dtype=bool)
        if off.mean() > OUTLIERS:
            raise RobotBrainError(
                f"the exported network differs from torch by more than one step ({step:.3g}) in {off.mean():.1%} of "
                f"the outputs for a batch of {batch}. Does the network have a fixed batch size inside?"
            )
