"""Verifying a bundle offline: every byte, and that its parts belong together."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from robotbrain import __version__
from robotbrain.errors import InputError
from robotbrain.jetson.deploy import manifest as manifests
from robotbrain.jetson.deploy import network as networks
from robotbrain.jetson.deploy.bundle import CACHE, check_calibration, lint_section, programs, tolerance
from robotbrain.jetson.deploy.contents import AGAIN, check_names, read, refuse
from robotbrain.jetson.deploy.network import MODEL, Network, Preprocessing
from robotbrain.jetson.deploy.target import check_opset, check_precision, target_of

REPRODUCES = {False: 1e-3, True: 2e-2}
"""Relative error (rms) within which ONNX Runtime of another machine must repeat the expected outputs, by quantised."""

_MIXED = "The parts are of different bundles or kits: make it again with `robotbrain jetson deploy`."


@dataclass(frozen=True)
class Report:
    """What a bundle is that passed.

    Attributes:
        path: where it lies.
        form: ``folder``, ``tar.gz`` or ``zip``.
        manifest: as it stands there.
        sha256: of the manifest, which names every other file's.
        notes: what a reader should know.
    """

    path: Path
    form: str
    manifest: Mapping[str, Any]
    sha256: str
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        target, parameters, said = (self.manifest[key] for key in ("target", "parameters", "prediction"))
        rows = [
            f"{self.path}: {len(self.manifest['files'])} files as they were written",
            f"  for          {target['name']} in mode {target['mode']}, {parameters['precision']}, batch "
            f"{parameters['batch']}",
            f"  pinned to    JetPack {target['jetpack']}: TensorRT {target['tensorrt']}, CUDA {target['cuda']}",
            f"  {said['provenance']:<12} {said['latency_ms']:.3f} ms ({said['latency_low_ms']:.3f} to "
            f"{said['latency_high_ms']:.3f} ms): {said['label']}",
            f"  manifest     SHA-256 {self.sha256}",
        ]
        return "\n".join([*rows, *(f"  note         {note}" for note in self.notes)])


def verify_bundle(path: str | Path) -> Report:
    """Check a bundle without a network connection and without writing anything.

    Raises:
        InputError: with what is wrong, what was expected and what to do, at the first of: a form that is no bundle's,
            a file missing, extra, truncated or altered, versions that do not belong together, a precision that the
            module does not have, a calibration of another network, test vectors that the network does not reproduce.
    """
    contents = read(path)
    data = manifests.read_json(contents.files, manifests.MANIFEST, manifests.DIGEST, manifests.FORM)
    check_files(contents.files, data["files"])
    notes = _check_programs(contents.files, data["kit"])
    _check_target(data)
    network = networks.inspect(contents.files[MODEL], _batch(data))
    _same("network", data["network"], network.section())
    _check_calibration(contents.files, data, network)
    check_precision(
        data["target"],
        data["parameters"]["precision"],
        quantised=network.quantised,
        half=network.half,
        calibrated=data["calibration"] is not None,
    )
    check_opset(data["target"], network.opset)
    section = data["preprocessing"]
    if (section is None) != (networks.preprocessing_of(network, None) is None):
        raise refuse("preprocessing", section, "one for a network of one image, none for others", _MIXED)
    if section is not None:
        mean, std, classes = (tuple(section[key]) for key in ("mean", "std", "classes"))
        given = Preprocessing(mean, std, classes, section["layout"], section["colour"])
        networks.preprocessing_of(network, given)
    _same("lint", data["lint"], lint_section(contents.files[MODEL], data["target"]["jetpack"]))
    _check_prediction(data["prediction"])
    _check_vectors(contents.files, data, network)
    digest = hashlib.sha256(contents.files[manifests.MANIFEST]).hexdigest()
    return Report(Path(path), contents.form, data, digest, tuple(notes))


def check_files(files: Mapping[str, bytes], listed: Mapping[str, Mapping[str, Any]]) -> None:
    """Refuse files that are missing, extra, of another size or with another checksum.

    Raises:
        InputError: naming the first.
    """
    check_names(listed)
    have = files.keys() - {manifests.MANIFEST, manifests.DIGEST}
    for name in sorted(listed.keys() - have):
        raise refuse(name, "no such file", "every file of the manifest", AGAIN)
    for name in sorted(have - listed.keys()):
        raise refuse(name, "a file", "only files that the manifest names", "Remove it, or make the bundle again.")
    for name, entry in sorted(listed.items()):
        if len(files[name]) != entry["bytes"]:
            raise refuse(name, f"{len(files[name])} bytes", f"{entry['bytes']} bytes", AGAIN)
        digest = hashlib.sha256(files[name]).hexdigest()
        if digest != entry["sha256"]:
            raise refuse(name, f"SHA-256 {digest[:12]}...", f"{entry['sha256'][:12]}... of the manifest", AGAIN)


def _check_programs(files: Mapping[str, bytes], kit: str) -> list[str]:
    expected = {MODEL, CACHE, manifests.MANIFEST, manifests.DIGEST, *programs()}
    foreign = [name for name in sorted(files) if name not in expected and not name.startswith("vectors/")]
    foreign += [name for name, content in programs().items() if files.get(name) != content]
    # Also where another kit made it: whoever alters a program can name any version.
    if foreign and kit != __version__:
        raise refuse(
            foreign[0],
            f"what may be the program of robotbrain {kit}",
            f"that of this kit, {__version__}",
            f"Verify with robotbrain {kit}, or make the bundle again.",
        )
    if foreign:
        raise refuse(foreign[0], "another program, or a file too many", f"what robotbrain {kit} puts there", _MIXED)
    return [] if kit == __version__ else [f"made by robotbrain {kit}; its program is that of {__version__}"]


def _check_target(data: Mapping[str, Any]) -> None:
    if data["schema"] != manifests.SCHEMA or data["version"] != manifests.VERSION:
        given = f"{data['schema']} {data['version']}"
        raise refuse("version", given, f"{manifests.SCHEMA} {manifests.VERSION}", "Verify with the kit that made it.")
    parameters = data["parameters"]
    _same("target", data["target"], target_of(parameters["module"], parameters["mode"], parameters["jetpack"]))


def _check_calibration(files: Mapping[str, bytes], data: Mapping[str, Any], network: Network) -> None:
    section = data["calibration"]
    if section is None:
        return
    if section["network_sha256"] != network.sha256 or section["file"] not in files:
        raise refuse("calibration", section, f"one of the network {network.sha256[:12]}", _MIXED)
    if check_calibration(files[section["file"]], network) != section["tensors"]:
        raise refuse("calibration", "another number of tensors", f"{section['tensors']}", _MIXED)


def _check_prediction(said: Mapping[str, Any]) -> None:
    inside = 0 < said["latency_low_ms"] <= said["latency_ms"] <= said["latency_high_ms"]
    if said["label"] != manifests.LABEL or not inside:
        raise refuse("prediction", said["latency_ms"], "labelled as a prediction, inside its interval", _MIXED)


def _check_vectors(files: Mapping[str, bytes], data: Mapping[str, Any], network: Network) -> None:
    numerics = data["numerics"]
    allowed = tolerance(data["target"], data["parameters"]["precision"], data["calibration"] is not None)
    _same("numerics", {key: value for key, value in numerics.items() if key != "vectors"}, allowed)
    shapes = {tensor.name: tensor.shape for tensor in network.inputs}
    feeds = [
        {name: _array(files, file, shapes.get(name, ())) for name, file in vector["inputs"].items()}
        for vector in numerics["vectors"]
    ]
    if len(feeds) != networks.VECTORS or any(feed.keys() != shapes.keys() for feed in feeds):
        raise refuse("test vectors", f"{len(feeds)} vectors", f"{networks.VECTORS} of inputs {sorted(shapes)}", _MIXED)
    answers = networks.run(files[MODEL], feeds)
    for vector, answer in zip(numerics["vectors"], answers, strict=True):
        if vector["outputs"].keys() != answer.keys():
            raise refuse("test vectors", sorted(vector["outputs"]), f"outputs {sorted(answer)}", _MIXED)
        for name, entry in vector["outputs"].items():
            if tuple(entry["shape"]) != answer[name].shape:
                raise refuse(f"output {name}", entry["shape"], f"the network's {list(answer[name].shape)}", _MIXED)
            expected = _array(files, entry["file"], answer[name].shape).astype(np.float64)
            error = np.sqrt(np.mean((answer[name] - expected) ** 2) / max(np.mean(expected**2), 1e-30))
            if not error <= REPRODUCES[network.quantised]:
                expectation = f"at most {REPRODUCES[network.quantised]:g} of the output's size"
                raise refuse(f"output {name} of {entry['file']}", f"error {error:.3g}", expectation, _MIXED)


def _array(files: Mapping[str, bytes], name: str, shape: tuple[int, ...]) -> Any:
    content = files.get(name, b"")
    if len(content) != 4 * int(np.prod(shape, dtype=np.int64)) or not content:
        raise refuse(name, f"{len(content)} bytes", f"float32 values of shape {shape}", _MIXED)
    return np.frombuffer(content, "<f4").reshape(shape)


def _batch(data: Mapping[str, Any]) -> int:
    batch = int(data["parameters"]["batch"])
    if batch < 1:
        raise refuse("batch", batch, "1 or more", AGAIN)
    return batch


def _same(section: str, given: Any, expected: Any) -> None:
    if given == expected:
        return
    keys = [key for key in sorted({*given, *expected}) if given.get(key) != expected.get(key)]
    key = keys[0]
    raise InputError(
        f"bundle: {section}: {key}", given=given.get(key), expected=f"{expected.get(key)!r}"[:300], fix=_MIXED
    )
