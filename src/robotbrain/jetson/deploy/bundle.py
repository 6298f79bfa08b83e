"""Making a bundle: everything that can be known before the board, checked before it is written."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robotbrain import __version__
from robotbrain.errors import InputError
from robotbrain.jetson.catalogue import load_module
from robotbrain.jetson.deploy import manifest as manifests
from robotbrain.jetson.deploy import network as networks
from robotbrain.jetson.deploy.contents import MAX_BYTES, write
from robotbrain.jetson.deploy.network import MODEL, Network, Preprocessing
from robotbrain.jetson.deploy.target import check_opset, check_precision, target_of

CACHE = "calibration.cache"
"""Name of the calibration cache in a bundle."""

_HERE = Path(__file__).resolve().parent


def make_bundle(
    onnx: str | Path,
    out: str | Path,
    *,
    module: str,
    mode: str | None = None,
    jetpack: str | None = None,
    precision: str = "int8",
    calibration: Any = None,
    inputs: NDArray[np.float32] | None = None,
    preprocessing: Preprocessing | None = None,
    batch: int = 1,
    seed: int = 0,
) -> Path:
    """Write a bundle and return its path. The same arguments give the same bytes.

    Args:
        onnx: the network, in one file.
        out: where to: a folder, or an archive if it ends in .tar.gz, .tgz or .zip.
        module: slug of the Jetson module.
        mode: its power mode; None for its default.
        jetpack: release on the board; None for the newest of the module.
        precision: ``fp32``, ``fp16`` or ``int8``.
        calibration: a CalibrationTable made with this network, or its JSON file; for INT8 without QDQ (TensorRT up to
            10, which deprecates it).
        inputs: (N, ...) float32 normalised inputs, the first of which become test vectors; None: seeded pictures.
        preprocessing: of a network of one image; None: that of the kit's networks.
        batch: inputs in one query, where the ONNX leaves it open.
        seed: of the test vectors.

    Raises:
        InputError: for anything that would fail on the board: an opset the parser does not take, a precision the
            module lacks, QDQ that TensorRT does not fuse, weights in another file, a foreign calibration.
    """
    path = Path(onnx)
    size = path.stat().st_size if path.is_file() else 0
    if not 0 < size <= MAX_BYTES // 2:
        raise InputError(
            "model",
            given=f"{path}, {size / 1e6:.0f} MB" if size else str(path),
            expected=f"an ONNX file of at most {MAX_BYTES / 2e6:.0f} MB",
            fix="Split or shrink the network." if size else "Check the path.",
        )
    content = path.read_bytes()
    if batch < 1 or seed < 0:
        raise InputError("--batch, --seed", given=(batch, seed), expected="at least 1, at least 0", fix="Correct it.")
    target = target_of(module, mode, jetpack)
    network = networks.inspect(content, batch)
    cache, section = _calibration(calibration, network, target)
    check_precision(target, precision, quantised=network.quantised, half=network.half, calibrated=cache is not None)
    check_opset(target, network.opset)
    pre = networks.preprocessing_of(network, preprocessing)
    feeds = networks.make_inputs(network, pre, inputs, seed)
    files = {MODEL: content, **programs()}
    if cache is not None:
        files[CACHE] = cache
    vectors = _vectors(files, feeds, networks.run(content, feeds))
    name = re.sub(r"[^A-Za-z0-9_-]+", "_", path.stem).strip("_-")[:60] or "model"
    data = {
        "schema": manifests.SCHEMA,
        "version": manifests.VERSION,
        "kit": __version__,
        "name": name,
        "parameters": {
            "module": target["module"],
            "mode": target["mode"],
            "jetpack": target["jetpack"],
            "precision": precision,
            "batch": batch,
            "seed": seed,
            "vectors_from": "made up" if inputs is None else "given inputs",
        },
        "target": target,
        "network": network.section(),
        "preprocessing": None if pre is None else pre.section(),
        "calibration": section,
        "lint": lint_section(content, target["jetpack"]),
        "numerics": {**tolerance(target, precision, cache is not None), "vectors": vectors},
        "prediction": _prediction(content, target, precision, batch),
        "files": manifests.files_section(files),
    }
    raw = manifests.to_bytes(data)
    files[manifests.MANIFEST], files[manifests.DIGEST] = raw, manifests.digest_line(raw)
    manifests.check_form(data, manifests.FORM, manifests.MANIFEST)
    total = sum(map(len, files.values()))
    if total > MAX_BYTES:
        raise InputError(
            "bundle",
            given=f"{total / 1e6:.0f} MB with its test vectors",
            expected=f"at most {MAX_BYTES / 1e6:.0f} MB",
            fix="Choose a smaller --batch.",
        )
    return write(Path(out), files, f"{name}-{target['module']}-{precision}")


def programs() -> dict[str, bytes]:
    """Return what runs on the board, by name in the bundle."""
    found = {f"program/{path.name}": path for path in sorted((_HERE / "program").glob("*.py"))}
    found.update(
        {path.name: path for path in sorted((_HERE / "scripts").iterdir()) if path.suffix in (".sh", ".py", ".txt")}
    )
    # Without carriage returns, which a checkout on Windows may have put in.
    return {name: path.read_bytes().replace(b"\r\n", b"\n") for name, path in found.items()}


def tolerance(target: Mapping[str, Any], precision: str, calibrated: bool) -> dict[str, Any]:
    """Return how far an engine may be from the expected outputs: the section ``numerics`` but for its vectors."""
    tf32 = load_module(target["module"]).tf32_tflops is not None
    arithmetic = networks.arithmetic_of(precision, tf32=tf32, calibrated=calibrated)
    return {"arithmetic": arithmetic, **networks.TOLERANCES[arithmetic]}


def lint_section(content: bytes, jetpack: str) -> dict[str, Any]:
    """Return what the QDQ lint has to say about a network.

    Raises:
        InputError: with its first error: TensorRT would refuse this file, or run it slowly.
    """
    import onnx

    from robotbrain.optimisation import qdq_lint

    findings = qdq_lint.check(onnx.load_model_from_string(content), jetpack=jetpack)
    rows = [
        {"code": f.code, "severity": f.severity, "node": f.node or "", "message": f.message}
        for f in findings
        if f.code != "not-quantised"  # which precision goes with which network is for target.check_precision
    ]
    return {"findings": rows}


def check_calibration(cache: bytes, network: Network) -> int:
    """Return how many tensors a calibration cache has a scale for.

    Raises:
        InputError: if it is none, or names tensors that the network does not have.
    """
    from robotbrain.optimisation.calibration import parse_tensorrt_cache

    scales = parse_tensorrt_cache(cache.decode("utf-8", "replace"))
    foreign = sorted(scales.keys() - network.tensors)
    if foreign or not scales:
        raise InputError(
            "calibration",
            given=f"{len(foreign)} tensors that the network does not have, such as {foreign[:1]}",
            expected="ranges of this network's tensors",
            fix="Calibrate this very ONNX (robotbrain.optimisation.calibrate).",
        )
    return len(scales)


def _calibration(given: Any, network: Network, target: Mapping[str, Any]) -> tuple[bytes | None, dict[str, Any] | None]:
    if given is None:
        return None, None
    from robotbrain.optimisation.calibration import CalibrationTable

    table = given if isinstance(given, CalibrationTable) else CalibrationTable.load(given)
    if table.model_sha256 != network.sha256:
        raise InputError(
            "calibration",
            given=f"a table of the model with SHA-256 {table.model_sha256[:12] or 'unknown'}",
            expected=f"one of this model, {network.sha256[:12]}",
            fix="Calibrate this very ONNX (robotbrain.optimisation.calibrate).",
        )
    # Its first line is written for the board's exact TensorRT by the board's program.
    cache = table.tensorrt_cache(target["tensorrt"]).encode("utf-8")
    tensors = check_calibration(cache, network)
    return cache, {"file": CACHE, "method": table.method, "network_sha256": network.sha256, "tensors": tensors}


def _vectors(
    files: dict[str, bytes],
    feeds: list[dict[str, NDArray[Any]]],
    answers: list[dict[str, NDArray[Any]]],
) -> list[dict[str, Any]]:
    """Add the vectors to ``files``, and return how the manifest names them."""
    rows = []
    for index, (feed, answer) in enumerate(zip(feeds, answers, strict=True)):
        row: dict[str, Any] = {"inputs": {}, "outputs": {}}
        for at, (name, value) in enumerate(feed.items()):
            row["inputs"][name] = file = f"vectors/{index}_in{at}.f32"
            files[file] = np.ascontiguousarray(value, "<f4").tobytes()
        for at, (name, value) in enumerate(answer.items()):
            file = f"vectors/{index}_out{at}.f32"
            files[file] = np.ascontiguousarray(value, "<f4").tobytes()
            row["outputs"][name] = {"file": file, "shape": list(value.shape)}
        rows.append(row)
    return rows


def _prediction(content: bytes, target: Mapping[str, Any], precision: str, batch: int) -> dict[str, Any]:
    from robotbrain.jetson.twin import as_graph, predict

    # Without its checksum the twin predicts: what this machine happens to have measured must not get into the bundle.
    graph = replace(as_graph(content), sha256="")
    said = predict(graph, target["module"], mode=target["mode"], precision=precision, batch=batch).to_dict()
    kept = manifests.FORM["prediction"].keys() - {"label"}
    return {"label": manifests.LABEL, **{key: said[key] for key in sorted(kept)}}
