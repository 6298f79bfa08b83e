"""The same network for larger images: what a fully convolutional network would cost at a camera's own resolution."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from robotbrain.errors import InputError


def check_image_size(image_size: object) -> tuple[int, int]:
    """Return ``image_size`` as (width, height), or raise InputError."""
    if (
        not isinstance(image_size, tuple)
        or len(image_size) != 2
        or not all(isinstance(side, int) and not isinstance(side, bool) and 1 <= side <= 8192 for side in image_size)
    ):
        raise InputError(
            "image size",
            given=image_size,
            expected="(width, height), whole numbers of pixels from 1 to 8192",
            fix="VGA is (640, 480).",
        )
    return image_size


def at_image_size(model: Path, image_size: tuple[int, int]) -> Any:
    """Return the network as an ``onnx.ModelProto`` for images of another size, to be analysed (not run).

    Args:
        model: path of an ONNX file with one input (batch, channels, height, width).
        image_size: (width, height), pixels.

    Raises:
        InputError: if the file is no such network. Whether its layers agree with the size is for the analyser to find.
    """
    import onnx

    width, height = check_image_size(image_size)
    try:
        proto = onnx.load(str(model), load_external_data=False)
    except Exception as error:  # protobuf raises errors of several families
        raise InputError(
            "model", given=str(model), expected="a valid ONNX file", fix=f"onnx says: {str(error)[:200]}"
        ) from error
    stored = {tensor.name for tensor in proto.graph.initializer}
    inputs = [value for value in proto.graph.input if value.name not in stored]
    if len(inputs) != 1 or len(inputs[0].type.tensor_type.shape.dim) != 4:
        raise InputError(
            f"network {model.name}",
            given=", ".join(value.name for value in inputs),
            expected="one input (batch, channels, height, width)",
            fix="Only networks that take one image can be resized.",
        )
    for axis, size in ((2, height), (3, width)):
        inputs[0].type.tensor_type.shape.dim[axis].dim_value = size
    # Shapes further on follow from the input's.
    del proto.graph.value_info[:]
    for output in proto.graph.output:
        output.type.tensor_type.ClearField("shape")
    return proto
