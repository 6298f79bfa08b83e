"""From a trained network to a policy file: ONNX that says what goes in, what comes out, and how it was made."""

from __future__ import annotations

import copy
import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from robotbrain.errors import InputError, RobotBrainError
from robotbrain.files import write_bytes
from robotbrain.rl.onnx_policy import OnnxPolicy, checked_model
from robotbrain.rl.policy_meta import PolicyMeta

if TYPE_CHECKING:
    import torch
    from torch import nn

__all__ = ["OPSET", "OnnxPolicy", "PolicyMeta", "export_policy", "policy_bytes"]

OPSET = 17
"""TensorRT 8.5 and later, ONNX Runtime 1.12 and later."""
TOLERANCE = 1e-5


def export_policy(
    module: nn.Module,
    path: str | Path,
    meta: PolicyMeta,
    *,
    obs_dim: int | None = None,
    normaliser: nn.Module | Sequence[Any] | None = None,
) -> Path:
    """Write ``module`` as ONNX: input ``obs`` (batch, O), output ``actions`` (batch, A), weights inside.

    The same module and meta always give the same bytes. The file is written whole or not at all, and only once ONNX
    Runtime has computed from it what torch computes, within 1e-5 of the largest action, on random observations.

    Args:
        module: takes (n, O) float32, returns (n, A): the deterministic policy. It is neither moved nor changed.
        path: of the file, by custom ``.onnx``.
        meta: what the file is to say about itself.
        obs_dim: O; must agree with the meta.
        normaliser: becomes part of the file, before the module: a module, or (mean, standard deviation), (O,) each.

    Returns:
        The path.

    Raises:
        InputError: sizes that disagree with the meta, or a module that cannot be exported.
        RobotBrainError: the file does not compute what torch computes.
    """
    if obs_dim is not None and obs_dim != meta.observation_dim:
        raise InputError(
            "obs_dim",
            given=obs_dim,
            expected=f"{meta.observation_dim}, the sum of meta.observation_names",
            fix="Name every observation term with its size.",
        )
    return write_bytes(path, policy_bytes(module, meta, normaliser=normaliser))


def policy_bytes(module: nn.Module, meta: PolicyMeta, *, normaliser: nn.Module | Sequence[Any] | None = None) -> bytes:
    """Return the content of the file that :func:`export_policy` writes, checked in the same way."""
    import torch

    frozen = copy.deepcopy(module).to(device="cpu", dtype=torch.float32).eval()
    if normaliser is not None:
        frozen = torch.nn.Sequential(_normaliser(normaliser, meta.observation_dim), frozen).eval()
    rows = torch.randn(16, meta.observation_dim, generator=torch.Generator().manual_seed(0)) * 2.0
    with torch.no_grad():
        try:
            expected = frozen(rows)
        except Exception as error:  # a network's own code may raise anything
            raise _cannot(error, f"a module that takes (n, {meta.observation_dim}) float32") from error
    shape = tuple(expected.shape) if isinstance(expected, torch.Tensor) else type(expected).__name__
    if shape != (16, meta.action_dim):
        raise InputError(
            "policy output",
            given=shape,
            expected=f"(n, {meta.action_dim}) for {', '.join(meta.action_names)}",
            fix="Return the mean action only, and name every action in the meta.",
        )
    data = _with_metadata(_export(frozen, rows[:2]), meta)
    _compare(data, rows, expected)
    return data


def _normaliser(given: nn.Module | Sequence[Any], size: int) -> nn.Module:
    import torch
    from torch import nn

    if isinstance(given, nn.Module):
        return copy.deepcopy(given).to(device="cpu", dtype=torch.float32)
    mean, std = (torch.as_tensor(np.asarray(part), dtype=torch.float32).cpu() for part in given)
    usable = bool(torch.isfinite(mean).all() and torch.isfinite(std).all() and (std > 0).all())
    if mean.shape != (size,) or std.shape != (size,) or not usable:
        raise InputError(
            "normaliser",
            given=f"shapes {tuple(mean.shape)} and {tuple(std.shape)}",
            expected=f"finite mean and positive standard deviation, ({size},) each",
            fix="Add a small number to the standard deviation of observations that never change.",
        )

    class Standardise(nn.Module):
        mean: torch.Tensor
        std: torch.Tensor

        def __init__(self) -> None:
            super().__init__()
            self.register_buffer("mean", mean)
            self.register_buffer("std", std)

        def forward(self, obs: torch.Tensor) -> torch.Tensor:
            return (obs - self.mean) / self.std

    return Standardise()


def _export(module: nn.Module, example: torch.Tensor) -> bytes:
    import torch

    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        file = Path(folder) / "policy.onnx"
        # torch prefers its newer exporter, which turns the opset asked for into 18 and writes a graph per layer.
        warnings.simplefilter("ignore")
        try:
            torch.onnx.export(
                module,
                (example,),
                str(file),
                dynamo=False,
                opset_version=OPSET,
                input_names=["obs"],
                output_names=["actions"],
                dynamic_axes={"obs": {0: "batch"}, "actions": {0: "batch"}},
            )
        except Exception as error:  # the exporter raises many kinds
            raise _cannot(error, "a feed-forward network of common layers") from error
        return file.read_bytes()


def _with_metadata(data: bytes, meta: PolicyMeta) -> bytes:
    import onnx

    model = onnx.ModelProto()
    model.ParseFromString(data)
    opsets = {entry.domain: entry.version for entry in model.opset_import}
    if opsets != {"": OPSET}:
        raise RobotBrainError(
            f"torch exported opsets {opsets} instead of {OPSET}; use a version of torch that the kit supports"
        )
    # Names of modules and paths of source files are nobody's business, and differ between machines.
    model.graph.name, model.producer_name = "policy", "robotbrain"
    model.producer_version, model.doc_string = meta.kit_version, ""
    for node in model.graph.node:
        node.doc_string = ""
        del node.metadata_props[:]
    del model.metadata_props[:]
    onnx.helper.set_model_props(model, meta.to_metadata())
    content: bytes = model.SerializeToString(deterministic=True)
    checked_model(content)
    return content


def _compare(data: bytes, rows: torch.Tensor, expected: torch.Tensor) -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = write_bytes(Path(folder) / "policy.onnx", data)
        policy = OnnxPolicy(file)
        for count in (1, len(rows)):
            got, wanted = policy(rows[:count].numpy()), expected[:count].numpy()
            worst = float(np.abs(got - wanted).max())
            if worst > TOLERANCE * max(1.0, float(np.abs(wanted).max())):
                raise RobotBrainError(
                    f"the exported policy differs from the module by {worst:.2g} for {count} observations. Does the "
                    "module draw random numbers, or treat the rows of a batch differently?"
                )


def _cannot(error: Exception, expected: str) -> InputError:
    lines = str(error).splitlines() or [""]
    return InputError(
        "policy module",
        given=f"{type(error).__name__}: {lines[0][:150]}",
        expected=expected,
        fix="Export the actor alone: observation in, mean action out.",
    )
