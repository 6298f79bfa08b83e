"""torchao's PT2E, quietly imported, and the quantiser that asks it for what TensorRT takes."""

from __future__ import annotations

import functools
import logging
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import torch

from robotbrain.errors import MissingDependencyError

if TYPE_CHECKING:
    from torch.fx import GraphModule

LAYERS = (torch.ops.aten.conv2d.default, torch.ops.aten.linear.default)
"""Operators whose input and weight are quantised."""

PASSING = (
    torch.ops.aten.cat.default,
    torch.ops.aten.upsample_nearest2d.vec,
    torch.ops.aten.upsample_nearest2d.default,
    torch.ops.aten.max_pool2d.default,
)
"""Operators that only move numbers about. With one scale on all sides, they move integers."""


@functools.cache
def pt2e() -> SimpleNamespace:
    """Return the names of torchao that are used here; importing it is slow, and talks about GPU kernels it lacks.

    Raises:
        MissingDependencyError: when torchao is not installed.
    """
    level = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        from torchao.quantization import pt2e as core
        from torchao.quantization.pt2e import quantize_pt2e, quantizer
    except ImportError as error:
        raise MissingDependencyError(
            "torchao", needed_for="quantisation-aware training", install="pip install torchao"
        ) from error
    finally:
        logging.disable(level)
    return SimpleNamespace(
        FakeQuantize=core.FakeQuantize,
        MinMaxObserver=core.MinMaxObserver,
        PerTensorObserver=core.MovingAverageMinMaxObserver,
        PerChannelObserver=core.MovingAveragePerChannelMinMaxObserver,
        QuantizationSpec=quantizer.QuantizationSpec,
        SharedQuantizationSpec=quantizer.SharedQuantizationSpec,
        QuantizationAnnotation=quantizer.QuantizationAnnotation,
        prepare_qat_pt2e=quantize_pt2e.prepare_qat_pt2e,
        convert_pt2e=quantize_pt2e.convert_pt2e,
    )


class SymmetricQuantizer:
    """Symmetric integers at the input and weight of every convolution and linear layer; biases stay in float32.

    It has the methods of torchao's ``Quantizer`` without deriving from it, which would load torchao along with this
    module. XNNPACK's quantiser, which torchao ships as an example, asks for asymmetric activations.

    Args:
        weight_bits: of a narrow grid: 8 bits are -127 to 127.
        activation_bits: of the full grid: 8 bits are -128 to 127, where ONNX's QuantizeLinear saturates.
        per_channel: one weight scale per output channel.

    Attributes:
        layers: how many layers were annotated.
    """

    def __init__(self, weight_bits: int, activation_bits: int, per_channel: bool) -> None:
        tools = pt2e()
        largest, half = 2 ** (weight_bits - 1) - 1, 2 ** (activation_bits - 1)
        # Not FusedMovingAvgObsFakeQuantize: on a narrow grid its kernel takes another scale (min / 8 where there are 7
        # steps) than its observer gives when the network is converted: a network trained so changes when it is shipped.
        self.weight = tools.QuantizationSpec(
            dtype=torch.int8,
            quant_min=-largest,
            quant_max=largest,
            qscheme=torch.per_channel_symmetric if per_channel else torch.per_tensor_symmetric,
            ch_axis=0 if per_channel else None,
            observer_or_fake_quant_ctr=tools.FakeQuantize.with_args(
                observer=tools.PerChannelObserver if per_channel else tools.PerTensorObserver,
                averaging_constant=1.0,  # the range of the present weight, no average with earlier ones
            ),
        )
        self.activation = tools.QuantizationSpec(
            dtype=torch.int8,
            quant_min=-half,
            quant_max=half - 1,
            qscheme=torch.per_tensor_symmetric,
            # Not a moving average: a quantiser that several tensors share would end up between their ranges.
            observer_or_fake_quant_ctr=tools.FakeQuantize.with_args(observer=tools.MinMaxObserver),
        )
        self.layers = 0

    def transform_for_annotation(self, model: GraphModule) -> GraphModule:
        """Return the graph unchanged."""
        return model

    def annotate(self, model: GraphModule) -> GraphModule:
        """Say what is to be quantised; two layers that read the same tensor share its quantiser."""
        tools = pt2e()
        for node in model.graph.nodes:
            if node.target in LAYERS:
                self.layers += 1
                node.meta["quantization_annotation"] = tools.QuantizationAnnotation(
                    input_qspec_map={node.args[0]: self.activation, node.args[1]: self.weight}, _annotated=True
                )
        for node in reversed(model.graph.nodes):  # from the layers back to what feeds them
            if node.target in PASSING and any(_quantised(user, node) for user in node.users):
                first, *others = dict.fromkeys(node.args[0] if node.target is PASSING[0] else [node.args[0]])
                same = tools.SharedQuantizationSpec((first, node))
                node.meta["quantization_annotation"] = tools.QuantizationAnnotation(
                    input_qspec_map={first: self.activation, **dict.fromkeys(others, same)},
                    output_qspec=same,
                    _annotated=True,
                )
        return model

    def validate(self, model: GraphModule) -> None:
        """Accept every graph."""

    def prepare_obs_or_fq_callback(self, model: GraphModule, edge_or_node_to_obs_or_fq: Any) -> None:
        """Leave the quantisers as they were made."""


def _quantised(user: Any, node: Any) -> bool:
    annotation = user.meta.get("quantization_annotation")
    return annotation is not None and node in annotation.input_qspec_map
