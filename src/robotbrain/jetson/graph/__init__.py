"""What an ONNX network asks of a device: kernels as TensorRT would form them, their arithmetic and their traffic.

The stages are modules of their own: ``loading`` (file to protobuf), ``binding`` (lengths for dynamic axes),
``inference`` with ``folding`` (static shapes, constants), ``patterns`` (normalisations written out), ``kinds`` and
``fusion`` (what runs together), ``layout`` (what moves data), ``quantization`` (Q/DQ), ``cost`` (multiply-accumulates),
``dla`` (what an accelerator refuses) and ``kernels`` (the result).

Conventions, which are those of the calibration data: a kernel's ``in_elems`` is the activation that streams through
it; the second operand of a fused residual addition is not counted, nor are biases and folded batch normalisation.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from robotbrain.errors import InputError
from robotbrain.jetson.kernels import KernelGraph

if TYPE_CHECKING:
    import onnx

__all__ = ["analyse"]


def analyse(
    model: str | Path | bytes | onnx.ModelProto,
    *,
    bindings: Mapping[str, int] | None = None,
    name: str | None = None,
) -> KernelGraph:
    """Return the kernels of an ONNX network.

    Weights may be in the file, beside it, stripped or missing: only their shapes count, and they are never read.

    Args:
        model: path of an ONNX file (opset 7 or later), its bytes, or a parsed ``onnx.ModelProto``, which is left alone.
        bindings: length of each dynamic axis, by symbolic name (``{"height": 480}``) or by ``"input:axis"``
            (``{"image:2": 480}``). A leading axis named like a batch defaults to 1.
        name: of the model; by default the file's stem, or the graph's own name.

    Raises:
        InputError: for a missing, damaged or non-ONNX file, an axis without a length, control flow that depends on
            data, or an operator whose output shape cannot be known; the message names the part at fault.
    """
    # Imported here: onnx takes a third of a second, which `import robotbrain.jetson` need not wait for.
    from robotbrain.jetson.graph.analysis import run

    try:
        return run(model, bindings, name)
    except InputError:
        raise
    except Exception as error:  # the last line of defence against files made to break parsers
        raise InputError(
            "model",
            given=f"a graph that the analyser stumbles over ({type(error).__name__}: {str(error)[:80]})",
            expected="an ONNX model that onnx.checker accepts",
            fix="If the checker accepts it, this is a defect of the analyser: please report it with the model.",
        ) from error
