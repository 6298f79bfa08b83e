"""From a torch module to an ONNX file that has been checked against it."""

from __future__ import annotations

import copy
import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import nn

from robotbrain.errors import InputError, RobotBrainError
from robotbrain.files import write_bytes

OPSET = 17
"""What TensorRT 8.5 to 11 parse; JetPack 4's TensorRT 8.2 stops at 13."""

TOLERANCE = 1e-4
"""Largest difference between torch and ONNX Runtime that is rounding, per unit of the largest output."""


def export_onnx(
    module: nn.Module,
    path: str | Path,
    *,
    opset: int = OPSET,
    input_name: str = "image",
    output_name: str = "logits",
    example: Sequence[int] = (1, 3, 64, 64),
    dynamic_batch: bool = True,
    check: bool = True,
) -> Path:
    """Write ``module`` (a copy of it, in eval mode) as ONNX and compare the two; return the path.

    Batch norms are folded into the convolutions. The file appears only once it has passed, and the same module gives
    the same bytes.

    Args:
        module: with one input and one output; left as it is.
        path: ending in ``.onnx``.
        opset: of the file, 13 to 20.
        input_name: of the graph's input.
        output_name: of the graph's output.
        example: shape of an input, batch axis first.
        dynamic_batch: leave the batch axis open; False fixes it to ``example[0]``.
        check: compare with torch, at batches 1 and 3 where the batch is open.

    Raises:
        InputError: for a module that cannot be exported, or a path or opset that cannot be right.
        RobotBrainError: when torch wrote another opset than asked for, or the file computes something else.
    """
    target = Path(path)
    if target.suffix != ".onnx":
        raise InputError("path", given=str(path), expected="a path ending in .onnx", fix="Add the suffix.")
    if not 13 <= opset <= 20:  # torch's TorchScript exporter knows no more
        raise InputError("opset", given=opset, expected="13 to 20", fix="Use 17, or 13 for JetPack 4.")
    frozen = copy.deepcopy(module).to(device="cpu", dtype=torch.float32, memory_format=torch.contiguous_format)  # type: ignore[call-overload]
    frozen.eval()
    data = _trace(frozen, tuple(example), opset, input_name, output_name, dynamic_batch)
    data = _clean(data, opset)
    if check:
        batches = (1, 3) if dynamic_batch else (example[0],)
        _compare(frozen, data, [(b, *example[1:]) for b in batches])
    return write_bytes(target, data)


def _trace(
    module: nn.Module, example: tuple[int, ...], opset: int, input_name: str, output_name: str, dynamic_batch: bool
) -> bytes:
    axes = {input_name: {0: "batch"}, output_name: {0: "batch"}} if dynamic_batch else None
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        file = Path(folder) / "network.onnx"
        # torch recommends its newer exporter, which turns any older opset into 18 without an error.
        warnings.simplefilter("ignore")
        try:
            torch.onnx.export(
                module,
                (torch.zeros(example),),
                str(file),
                dynamo=False,
                opset_version=opset,
                input_names=[input_name],
                output_names=[output_name],
                dynamic_axes=axes,
            )
        except Exception as error:  # the exporter, and the module's own code, may raise anything
            lines = str(error).splitlines() or [""]
            raise InputError(
                "module",
                given=f"{type(error).__name__}: {lines[0][:150]}",
                expected=f"one that takes {example} and consists of exportable operators",
                fix="Call it once on torch.zeros(example); replace operators that ONNX does not have.",
            ) from error
        return file.read_bytes()


def _clean(data: bytes, opset: int) -> bytes:
    """Return the model without names of Python modules and source files, after a check of opset and structure."""
    import onnx

    model = onnx.ModelProto()
    model.ParseFromString(data)
    opsets = {entry.domain: entry.version for entry in model.opset_import}
    if opsets.get("") != opset:
        raise RobotBrainError(
            f"torch exported opset {opsets.get('')} instead of {opset}: its newer exporter does so silently, and a "
            "TensorRT of the older JetPack would refuse the file; use a version of torch that the kit supports"
        )
    model.graph.name, model.producer_name, model.producer_version, model.doc_string = "network", "robotbrain", "", ""
    for node in model.graph.node:
        node.doc_string = ""
        del node.metadata_props[:]
    del model.metadata_props[:]
    onnx.checker.check_model(model)
    content: bytes = model.SerializeToString(deterministic=True)
    return content


def _compare(module: nn.Module, data: bytes, shapes: Sequence[tuple[int, ...]]) -> None:
    from robotbrain.optimisation.evaluate import onnx_session

    generator = torch.Generator().manual_seed(0)
    with tempfile.TemporaryDirectory() as folder:
        session = onnx_session(write_bytes(Path(folder) / "network.onnx", data))
        name = session.get_inputs()[0].name
        for shape in shapes:
            rows = torch.randn(shape, generator=generator)
            with torch.no_grad():
                wanted = module(rows).numpy()
            got = session.run(None, {name: rows.numpy()})[0]
            worst = float(np.abs(got - wanted).max()) if got.shape == wanted.shape else float("inf")
            allowed = TOLERANCE * max(1.0, float(np.abs(wanted).max()))
            if not worst <= allowed:
                raise RobotBrainError(
                    f"the exported network differs from the module by {worst:.2g} (allowed: {allowed:.2g}) for an "
                    f"input of shape {shape}. Does it draw random numbers, branch on values, or mix images?"
                )
