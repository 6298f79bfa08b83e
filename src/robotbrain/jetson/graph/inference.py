"""Shapes of every tensor, and what of the graph is constant, in one pass in running order.

Each node goes through onnx's own type and shape inference with the content of its small constant inputs, so that a
Reshape to a computed shape is as static as any other. Constants are folded as we go (``folding``); what is left is
the part of the graph that a device runs for each inference.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper, numpy_helper, shape_inference

from robotbrain.errors import InputError
from robotbrain.jetson.graph import folding
from robotbrain.jetson.graph.ir import Graph, Node, Tensor, checked_shape
from robotbrain.jetson.graph.loading import Loaded
from robotbrain.jetson.graph.protos import attributes, static_type, stored_tensor
from robotbrain.jetson.graph.structure import branch_nodes, ordered, reads

_RANDOM = frozenset(
    {"RandomNormal", "RandomUniform", "RandomNormalLike", "RandomUniformLike", "Multinomial", "Bernoulli"}
)
# Operators whose first input is data and whose other inputs only say where or how many.
_SHAPE_ARGUMENTS = frozenset(
    {"Reshape", "Expand", "Tile", "Slice", "Gather", "Unsqueeze", "Squeeze", "Split", "Pad", "Resize", "Upsample"}
)
_POSITIVE = ("strides", "dilations", "kernel_shape", "group", "blocksize", "num_groups", "num_outputs")
# Custom operators that leave a tensor's shape alone; ONNX Runtime writes 16- and 4-bit Q/DQ in its own domain.
_SAME_SHAPE = frozenset({"QuantizeLinear", "DequantizeLinear", "Gelu", "FastGelu", "QuickGelu"})


def infer(loaded: Loaded, inputs: list[Tensor], warnings: list[str]) -> Graph:
    """Return the graph with static shapes and folded constants.

    Raises:
        InputError: for a graph that is not well formed, control flow that depends on data, an unknown operator
            whose output shape cannot be told, or a shape that depends on data.
    """
    return _Pass(loaded, inputs, warnings).run()


class _Pass:
    """State of the pass: the tensors so far, and the nodes that run."""

    def __init__(self, loaded: Loaded, inputs: list[Tensor], warnings: list[str]) -> None:
        self.loaded = loaded
        self.inputs = inputs
        self.warnings = warnings
        self.tensors: dict[str, Tensor] = {tensor.name: tensor for tensor in inputs}
        self.types: dict[str, Any] = {}
        self.data: dict[str, Any] = {}
        self.kept: list[Node] = []
        self.serial = 0
        self.declared = {info.name: info.type for info in [*loaded.graph.value_info, *loaded.graph.output]}
        self.read = {name for proto in loaded.graph.node for name in reads(proto)}
        self.read |= {info.name for info in loaded.graph.output}
        self.opset_imports = [helper.make_opsetid(domain, version) for domain, version in loaded.opsets.items()]
        for proto in loaded.initializers:
            tensor = stored_tensor(proto, proto.name)
            self.tensors[tensor.name] = tensor
        for sparse in loaded.graph.sparse_initializer:
            name = sparse.values.name
            self.tensors[name] = Tensor(
                name,
                checked_shape(tuple(sparse.dims), f"{name!r}"),
                sparse.values.data_type,
                const=True,
                roots=frozenset({name}),
            )

    def run(self) -> Graph:
        pending = deque(ordered(self.loaded.graph.node, set(self.tensors)))
        while pending:
            proto = pending.popleft()
            if proto.op_type == "If" and proto.domain in ("", "ai.onnx"):
                pending.extendleft(reversed(self._branch(proto)))
            else:
                self._visit(proto)
        outputs = tuple(dict.fromkeys(info.name for info in self.loaded.graph.output))
        for name in outputs:
            if name not in self.tensors:
                raise InputError(
                    f"output {name!r}",
                    given="no node that makes it",
                    expected="the output of a node, an input or an initialiser",
                    fix="The file is damaged; export it again.",
                )
        return Graph(self.kept, self.tensors, tuple(t.name for t in self.inputs), outputs, self.warnings)

    def _branch(self, proto: Any) -> list[Any]:
        condition = self.tensors.get(proto.input[0]) if proto.input else None
        if condition is None or condition.value is None or condition.value.size != 1:
            raise InputError(
                f"node {proto.name or 'If'!r}",
                given="If with a condition that depends on data",
                expected="a graph without control flow",
                fix="Trace the network with fixed input sizes, or export the branches as models of their own.",
            )
        nodes, initializers = branch_nodes(proto, bool(condition.value.ravel()[0]))
        for name, tensor in initializers:
            self.tensors[name] = stored_tensor(tensor, name)
        self.read |= {name for node in nodes for name in reads(node)}
        return nodes

    def _visit(self, proto: Any) -> None:
        domain = "" if proto.domain == "ai.onnx" else proto.domain
        self.serial += 1
        node = Node(
            proto.op_type,
            proto.name or f"{proto.op_type}_{self.serial}",
            list(proto.input),
            list(proto.output),
            attributes(proto),
            domain,
            self.loaded.opsets.get(domain, 0),
        )
        for name in node.inputs:
            if name and name not in self.tensors:
                raise InputError(
                    f"input {name!r} of {node.op} {node.name!r}",
                    given="no tensor of that name",
                    expected="an input, an initialiser or the output of a node",
                    fix="The file is damaged; export it again.",
                )
        for output in self._made(node, proto):
            self.tensors[output.name] = output
        if not all(self.tensors[name].const for name in node.outputs if name):
            self.kept.append(node)

    def _made(self, node: Node, proto: Any) -> list[Tensor]:
        if node.domain == "":
            if node.op in ("Loop", "Scan"):
                raise InputError(
                    f"node {node.name!r}",
                    given=node.op,
                    expected="a graph without control flow",
                    fix="Unroll the loop when exporting (trace with fixed sizes), or export its body on its own.",
                )
            if node.op == "Constant":
                return [self._constant(node)]
            if node.op in ("Shape", "Size"):
                return [self._shape_of(node)]
        const = bool(node.inputs) and all(self.tensors[name].const for name in node.inputs if name)
        const = const and node.op not in _RANDOM and not node.domain
        types = self._output_types(node, proto)
        roots = self._roots(node) if const else frozenset()
        quantized = const and (
            any(self.tensors[name].quantized for name in node.inputs if name)
            or (node.op == "DequantizeLinear" and self.tensors[node.input(0)].dtype in (2, 3))
        )
        made = [
            Tensor(
                name,
                shape,
                dtype,
                const=const,
                roots=frozenset({name}) if node.op == "ConstantOfShape" else roots,
                quantized=quantized,
            )
            for name, shape, dtype in types
            if name
        ]
        if const and len(made) == len(node.outputs):
            self._fold(node, made)
        return made

    def _fold(self, node: Node, made: list[Tensor]) -> None:
        values: folding.Inputs = [self.tensors[name].value if name else None for name in node.inputs]
        if any(name and value is None for name, value in zip(node.inputs, values, strict=True)):
            return
        folded = folding.evaluate(node, values, [tensor.shape for tensor in made])
        for tensor, value in zip(made, folded or [], strict=False):
            tensor.value = value

    def _roots(self, node: Node) -> frozenset[str]:
        names = node.inputs[:1] if node.op in _SHAPE_ARGUMENTS else node.inputs
        return frozenset().union(*(self.tensors[name].roots for name in names if name))

    def _constant(self, node: Node) -> Tensor:
        name = node.outputs[0] if node.outputs else ""
        attrs = node.attrs
        if "value" in attrs and isinstance(attrs["value"], onnx.TensorProto):
            return stored_tensor(attrs["value"], name)
        if "sparse_value" in attrs:
            sparse = attrs["sparse_value"]
            shape = checked_shape(tuple(sparse.dims), f"constant {name!r}")
            return Tensor(name, shape, sparse.values.data_type, const=True, roots=frozenset({name}))
        for key, kind in (
            ("value_float", np.float32),
            ("value_floats", np.float32),
            ("value_int", np.int64),
            ("value_ints", np.int64),
        ):
            if key in attrs:
                value: NDArray[Any] = np.asarray(attrs[key], dtype=kind)
                dtype = 1 if kind is np.float32 else 7
                small = value if value.size <= folding.MAX_FOLDED else None
                return Tensor(name, value.shape, dtype, const=True, value=small, roots=frozenset({name}))
        raise InputError(
            f"constant {name!r}",
            given=sorted(attrs),
            expected="a tensor or numbers",
            fix="TensorRT takes no string constants; remove the part of the graph that needs them.",
        )

    def _shape_of(self, node: Node) -> Tensor:
        shape = self.tensors[node.input(0)].shape if node.input(0) else ()
        name = node.outputs[0] if node.outputs else ""
        if node.op == "Size":
            return Tensor(name, (), 7, const=True, value=np.asarray(math.prod(shape), np.int64))
        part = shape[slice(node.integer("start", 0), node.integer("end", len(shape)))]
        return Tensor(name, (len(part),), 7, const=True, value=np.asarray(part, np.int64))

    def _output_types(self, node: Node, proto: Any) -> list[tuple[str, tuple[int, ...], int]]:
        for name in _POSITIVE:  # a stride of zero would divide by zero inside older releases of onnx
            value = node.attrs.get(name)
            sizes = value if isinstance(value, list) else [value]
            if value is not None and not all(isinstance(size, int) and size > 0 for size in sizes):
                raise InputError(
                    f"attribute {name} of {node.op} {node.name!r}",
                    given=value,
                    expected="whole numbers of 1 or more",
                    fix="The file is damaged, or the exporter is at fault; check it with onnx.checker.",
                )
        inferred = self._by_schema(node, proto)
        made: list[tuple[str, tuple[int, ...], int]] = []
        for position, name in enumerate(node.outputs):
            if not name:
                made.append(("", (), 0))
                continue
            shape, dtype = static_type(inferred.get(name))
            if shape is None:
                declared, declared_type = static_type(self.declared.get(name))
                shape, dtype = declared, dtype or declared_type
            if shape is None and name not in self.read:
                shape = ()  # nobody asks: a mask of Dropout, running statistics
            if shape is None:
                shape, dtype = self._last_resort(node, position, dtype)
            made.append((name, checked_shape(shape, f"output {name!r} of {node.op} {node.name!r}"), dtype))
        return made

    def _by_schema(self, node: Node, proto: Any) -> dict[str, Any]:
        if node.domain:
            return {}
        try:
            schema = onnx.defs.get_schema(node.op, node.version, node.domain)
        except Exception as error:  # SchemaError's home moved between releases
            raise InputError(
                f"node {node.name!r}",
                given=f"operator {node.op!r} of opset {node.version}",
                expected="an operator of that ONNX opset",
                fix="Is it a custom operator whose domain got lost? Export it again, or upgrade onnx.",
            ) from error
        names = [name for name in node.inputs if name]
        try:
            inferred: dict[str, Any] = shape_inference.infer_node_outputs(
                schema,
                proto,
                {name: self._type(name) for name in names},
                {name: self._data(name) for name in names if self.tensors[name].value is not None},
                opset_imports=self.opset_imports,
                ir_version=self.loaded.ir_version,
            )
        except Exception as error:  # InferenceError, and what pybind makes of other C++ exceptions
            reason = (str(error).strip() or type(error).__name__).splitlines()[0]
            raise InputError(
                f"{node.op} {node.name!r}",
                given="inputs of shape " + ", ".join(str(self.tensors[name].shape) for name in names),
                expected="shapes and attributes that fit the operator",
                fix=f"Is an axis bound to a wrong length? onnx says: {reason[:160]}",
            ) from error
        return inferred

    def _type(self, name: str) -> Any:
        if name not in self.types:
            tensor = self.tensors[name]
            self.types[name] = helper.make_tensor_type_proto(tensor.dtype, tensor.shape)
        return self.types[name]

    def _data(self, name: str) -> Any:
        if name not in self.data:
            value = self.tensors[name].value
            assert value is not None
            self.data[name] = numpy_helper.from_array(np.ascontiguousarray(value).reshape(value.shape), name)
        return self.data[name]

    def _last_resort(self, node: Node, position: int, dtype: int) -> tuple[tuple[int, ...], int]:
        """Return a shape that inference did not find: an upper bound, or that of the input."""
        first = self.tensors[node.input(0)] if node.input(0) else None
        if node.op == "NonMaxSuppression" and not node.domain and len(node.inputs) > 1:
            batch, classes, boxes = self.tensors[node.input(1)].shape
            most = self.tensors[node.input(2)].value if node.input(2) else None
            each = min(boxes, max(0, int(most.ravel()[0]))) if most is not None and most.size else boxes
            self._bound(node)
            return (batch * classes * each, 3), 7
        if first is not None and not node.domain:
            if node.op == "NonZero":
                self._bound(node)
                return (len(first.shape), first.elems), 7
            if node.op in ("Unique", "Compress") and "axis" not in node.attrs:
                self._bound(node)
                return (first.elems,), dtype or first.dtype
            schema = onnx.defs.get_schema(node.op, node.version, "")
            if schema.has_function and not schema.has_type_and_shape_inference_function:
                return first.shape, dtype or first.dtype
        if node.domain and node.op in _SAME_SHAPE and first is not None:
            zero_point = self.tensors[node.input(2)].dtype if node.input(2) else 0
            given = {"QuantizeLinear": zero_point or 2, "DequantizeLinear": 1}.get(node.op, first.dtype)
            return first.shape, given
        if node.domain:
            raise InputError(
                f"node {node.name!r}",
                given=f"custom operator {node.op!r} of domain {node.domain!r}, of unknown output shape",
                expected="ONNX's own operators, or outputs declared with static shapes in value_info",
                fix="TensorRT would need a plugin for it. Export without it, declare its shapes, or, if ONNX Runtime "
                "made it while quantising, quantise in QDQ format.",
            )
        raise InputError(
            f"output {position} of {node.op} {node.name!r}",
            given="a shape that depends on data",
            expected="shapes that follow from the input shapes",
            fix="Export that part with fixed sizes, or leave it out of the network (post-processing on the CPU).",
        )

    def _bound(self, node: Node) -> None:
        self.warnings.append(f"{node.op} {node.name!r} is counted at the largest output it can have")
