"""Rewrites around a captured graph: batch norms into convolutions, fake quantisers into what ONNX has."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from robotbrain.optimisation.pt2e import LAYERS, pt2e

if TYPE_CHECKING:
    from torch.fx import GraphModule

_ATEN = torch.ops.aten


def fold_batch_norms(graph: GraphModule) -> GraphModule:
    """Fold each batch norm that follows a convolution into its weight and bias, in place; return the graph.

    ``gamma (W x + b - mean) / sigma + beta`` is a convolution with ``W gamma / sigma``. The graph must have been
    captured in eval mode. A batch norm elsewhere, or behind a weight that two layers share, stays.
    """
    with torch.no_grad():
        for norm in list(graph.graph.nodes):
            if norm.target != _ATEN.batch_norm.default:
                continue
            layer = norm.args[0]
            if layer.target not in LAYERS or len(layer.users) > 1 or len(layer.args[1].users) > 1:
                continue
            gamma, beta = (None if n is None else _value(graph, n) for n in norm.args[1:3])
            mean, variance = (_value(graph, n) for n in norm.args[3:5])
            factor = (1.0 if gamma is None else gamma) / torch.sqrt(variance + norm.args[7])
            weight = _value(graph, layer.args[1])
            had_bias = len(layer.args) > 2 and layer.args[2] is not None
            bias = _value(graph, layer.args[2]) if had_bias else torch.zeros_like(mean)
            folded = (0.0 if beta is None else beta) + (bias - mean) * factor
            weight.copy_(weight * factor.reshape(-1, *[1] * (weight.ndim - 1)))
            owner = layer.args[1].target.rpartition(".")[0]
            name = f"{owner}.folded_bias" if owner else f"{layer.name}_bias"
            graph.get_submodule(owner).register_parameter(name.rpartition(".")[2], torch.nn.Parameter(folded))
            with graph.graph.inserting_before(layer):
                layer.args = (*layer.args[:2], graph.graph.get_attr(name), *layer.args[3:])
            norm.replace_all_uses_with(layer)
            graph.graph.erase_node(norm)
    (output,) = (node for node in graph.graph.nodes if node.op == "output")
    output.args = (output.args[0][0],)
    graph.graph.set_codegen(torch.fx.graph.CodeGen())  # one tensor in, one out: no need for torch.export's trees
    return _tidy(graph)


def write_out_quantisers(graph: GraphModule) -> GraphModule:
    """Replace each fake quantiser by one call of torch's ``fake_quantize`` with its grid as a constant, in place.

    The ONNX exporter writes such a call as a QuantizeLinear/DequantizeLinear pair. It knows no grids of fewer than
    8 bits; weights are therefore rounded to their own grid here, whose points all lie on the 8-bit grid of the same
    scale.
    """
    fake = pt2e().FakeQuantize
    with torch.no_grad():
        for node in list(graph.graph.nodes):
            if node.op != "call_module" or not isinstance(graph.get_submodule(node.target), fake):
                continue
            quantiser: Any = graph.get_submodule(node.target)
            source, layer = node.args[0], next(iter(node.users))
            low, high = quantiser.quant_min, quantiser.quant_max
            if layer.target in LAYERS and layer.args[1] is node:
                weight = _value(graph, source)
                weight.copy_(quantiser(weight.clone()))
                low, high = -128, 127
            scale, zero_point = quantiser.calculate_qparams()
            with graph.graph.inserting_before(node):
                if quantiser.ch_axis == -1:  # torchao's mark for one scale
                    call: Any = torch.fake_quantize_per_tensor_affine
                    arguments: tuple[Any, ...] = (source, float(scale), int(zero_point), low, high)
                else:
                    call = torch.fake_quantize_per_channel_affine
                    constants = []
                    for suffix, value in (("scale", scale.float()), ("zero_point", zero_point.int())):
                        graph.register_buffer(f"{layer.name}_{suffix}", value.clone())
                        constants.append(graph.graph.get_attr(f"{layer.name}_{suffix}"))
                    arguments = (source, *constants, quantiser.ch_axis, low, high)
                new = graph.graph.call_function(call, arguments)
            node.replace_all_uses_with(new)
            graph.graph.erase_node(node)
    for name in ("train", "eval"):  # torchao made them refuse; nothing here depends on the mode
        graph.__dict__.pop(name, None)
    return _tidy(graph)


def settle_constants(file: Path) -> None:
    """Turn Constant nodes and casts of constants into stored tensors, as TensorRT wants to see scales and zero points.

    The exporter computes per-channel zero points with casts and copies, as if they were values of the run.
    """
    import onnx
    from onnx import helper, numpy_helper

    model = onnx.load(str(file))
    stored = {tensor.name: tensor for tensor in model.graph.initializer}
    for node in list(model.graph.node):
        if node.op_type == "Constant" and node.attribute[0].name == "value":
            value = numpy_helper.to_array(node.attribute[0].t)
        elif node.op_type in ("Cast", "Identity") and node.input[0] in stored:
            value = numpy_helper.to_array(stored[node.input[0]])
            if node.op_type == "Cast":
                value = value.astype(helper.tensor_dtype_to_np_dtype(node.attribute[0].i))
        else:
            continue
        tensor = numpy_helper.from_array(value, node.output[0])
        stored[tensor.name] = tensor
        model.graph.initializer.append(tensor)
        model.graph.node.remove(node)
    used = {name for node in model.graph.node for name in node.input}
    for tensor in [t for t in model.graph.initializer if t.name not in used]:
        model.graph.initializer.remove(tensor)
    file.write_bytes(model.SerializeToString(deterministic=True))


def _tidy(graph: GraphModule) -> GraphModule:
    for node in list(graph.graph.nodes):
        if node.op == "call_module" and not node.users:  # torch.export's guards on the input's shape
            graph.graph.erase_node(node)
    graph.graph.eliminate_dead_code()
    graph.delete_all_unused_submodules()
    graph.recompile()
    return graph


def _value(graph: GraphModule, node: Any) -> torch.Tensor:
    owner, _, name = node.target.rpartition(".")
    tensor: torch.Tensor = getattr(graph.get_submodule(owner), name)
    return tensor.detach()
