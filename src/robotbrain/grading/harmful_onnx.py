"""Ways to make an ONNX model harmful, for submissions that must be refused: mutants and tests."""

from __future__ import annotations

from typing import Any


def weights_in_another_file(model: Any) -> None:
    """Point the first weights to a file outside of the submission."""
    tensor = model.graph.initializer[0]
    tensor.ClearField("raw_data")
    tensor.data_location = 1
    for key, value in (("location", "../../../../../../etc/hostname"), ("offset", "0")):
        entry = tensor.external_data.add()
        entry.key, entry.value = key, value


def endless_loop(model: Any, entry: str) -> None:
    """Put a loop of 2^62 rounds between the input ``entry`` and the network."""
    import numpy as np
    from onnx import TensorProto, helper, numpy_helper

    body = helper.make_graph(
        [helper.make_node("Identity", ["again"], ["goes_on"]), helper.make_node("Tanh", ["x"], ["y"])],
        "body",
        [
            helper.make_tensor_value_info("k", TensorProto.INT64, []),
            helper.make_tensor_value_info("again", TensorProto.BOOL, []),
            helper.make_tensor_value_info("x", TensorProto.FLOAT, None),
        ],
        [
            helper.make_tensor_value_info("goes_on", TensorProto.BOOL, []),
            helper.make_tensor_value_info("y", TensorProto.FLOAT, None),
        ],
    )
    model.graph.initializer.append(numpy_helper.from_array(np.array(2**62), "rounds"))
    for node in model.graph.node:
        node.input[:] = ["looped" if name == entry else name for name in node.input]
    model.graph.node.insert(0, helper.make_node("Loop", ["rounds", "", entry], ["looped"], body=body))
