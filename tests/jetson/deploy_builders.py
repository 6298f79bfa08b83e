"""Small networks and bundles for the tests of deployment, and ways to tamper with them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from robotbrain.jetson.deploy import make_bundle
from robotbrain.jetson.deploy import manifest as manifests

Files = dict[str, bytes]


def network(folder: Path, *, seed: int = 0, opset: int = 13, batch: int | str = "batch", name: str = "net") -> Path:
    """Return the path of a network of two convolutions: image (batch, 3, 16, 16) to logits (batch, 4, 16, 16)."""
    rng = np.random.default_rng(seed)
    weights = {
        "w1": rng.normal(0, 0.3, (8, 3, 3, 3)),
        "b1": rng.normal(0, 0.1, 8),
        "w2": rng.normal(0, 0.3, (4, 8, 1, 1)),
    }
    nodes = [
        helper.make_node("Conv", ["image", "w1", "b1"], ["a"], "conv1", pads=[1, 1, 1, 1]),
        helper.make_node("Relu", ["a"], ["r"], "relu"),
        helper.make_node("Conv", ["r", "w2"], ["logits"], "conv2"),
    ]
    graph = helper.make_graph(
        nodes,
        "g",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, [batch, 3, 16, 16])],
        [helper.make_tensor_value_info("logits", TensorProto.FLOAT, [batch, 4, 16, 16])],
        [numpy_helper.from_array(value.astype(np.float32), key) for key, value in weights.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=8)
    path = folder / f"{name}.onnx"
    onnx.save(model, path)
    return path


def quantised(folder: Path) -> Path:
    """Return the path of the same network with Q/DQ, as TensorRT takes it."""
    from robotbrain.optimisation import quantise_onnx

    images = np.random.default_rng(1).normal(0, 1, (8, 3, 16, 16)).astype(np.float32)
    return quantise_onnx(network(folder, name="float"), folder / "quantised.onnx", images, target="tensorrt").path


def bundle(folder: Path, out: str = "bundle", model: Path | None = None, **changes: Any) -> Path:
    """Return a bundle in FP16 for an Orin Nano with JetPack 6.2."""
    options: dict[str, Any] = {"module": "orin-nano-8gb", "jetpack": "6.2", "precision": "fp16", **changes}
    return make_bundle(model or network(folder), folder / out, **options)


def files_of(folder: Path) -> Files:
    """Return all files of a folder by name."""
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def put(folder: Path, files: Files) -> Path:
    """Write files into a new folder."""
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return folder


def reseal(files: Files, edit: Callable[[dict[str, Any]], object] = lambda _: None) -> Files:
    """Return the files with an edited manifest and with all checksums right again, as someone careful would do it."""
    data = json.loads(files[manifests.MANIFEST])
    edit(data)
    kept = {n: c for n, c in files.items() if n not in (manifests.MANIFEST, manifests.DIGEST)}
    if isinstance(data.get("files"), dict):
        data["files"] = manifests.files_section(kept)
    raw = manifests.to_bytes(data)
    return {**kept, manifests.MANIFEST: raw, manifests.DIGEST: manifests.digest_line(raw)}
