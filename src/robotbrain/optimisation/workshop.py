"""Carrying recipes out: each step once, its result kept under the key of all that went into it.

In the folder, ``steps/KEY.pt`` (state of a network), ``steps/KEY.onnx`` and ``steps/KEY.json`` (what was done, with the
SHA-256 of the result) are the cache; ``artefacts/`` holds the finished networks under readable names. Anything may be
deleted at any time: what is missing or damaged is made again. The JSON of a step is written last, so that a result
without it counts as not made.
"""

from __future__ import annotations

import functools
import gzip
import hashlib
import importlib.metadata
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotbrain import __version__
from robotbrain.errors import InputError, MissingDependencyError
from robotbrain.files import write_bytes, write_text
from robotbrain.optimisation.recipe import TWO_FOUR, Artefact, Budget, Recipe, Step, plan, step_key

if TYPE_CHECKING:
    from torch import nn

    from robotbrain.optimisation.data import Scenes
    from robotbrain.optimisation.training import TeacherTargets

SAID = Callable[[str], None]

_QDQ = ("QuantizeLinear", "DequantizeLinear")

_DOING = {
    "network": "training a student",
    "channels": "removing channels",
    "sparsity": "setting weights to zero",
    "export": "exporting",
    "qat": "training for INT8",
    "ptq": "quantising",
}


class Workshop:
    """A folder of intermediate results, and the data and the teacher that they were made with.

    Args:
        out_dir: the folder; it is made.
        budget: Budget() if None.
        train: images to train on; the first ``budget.images`` of the training split if None.
        calibration: images to calibrate on; of the calibration split if None.
        progress: show a bar for each training.
        say: also an attribute; called with a few words before each step that is not there yet.

    Raises:
        InputError: for a folder that cannot be used, or fewer images than the budget asks for.
    """

    def __init__(
        self,
        out_dir: str | Path,
        budget: Budget | None = None,
        *,
        train: Scenes | None = None,
        calibration: Scenes | None = None,
        progress: bool = True,
        say: SAID | None = None,
    ) -> None:
        self.folder, self.budget, self.progress = Path(out_dir), budget or Budget(), progress
        self.say: SAID = say or (lambda _words: None)
        self._given = {"train": train, "calibration": calibration}
        for name, wanted in (("train", self.budget.images), ("calibration", self.budget.calibration_images)):
            scenes = self._given[name]
            if scenes is not None and len(scenes) < wanted:
                raise InputError(f"{name} scenes", given=len(scenes), expected=f"{wanted}", fix="Lower the budget.")
        try:
            (self.folder / "steps").mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                "folder", given=str(out_dir), expected="a folder that can be written to", fix=str(error)
            ) from error

    def make(self, recipe: Recipe) -> Artefact:
        """Return the artefact of a recipe, doing only what has not been done before."""
        key, lineage = "", []
        used = {"robotbrain": __version__}
        for step in plan(recipe, self.budget):
            inputs = self._inputs(step)
            used |= inputs
            previous, key = key, step_key(step, key, inputs)
            record = self._stored(key)
            if record is None:
                if "name" not in step.settings:  # shipped weights are only copied
                    self.say(f"{_DOING[step.kind]}: {recipe.label}")
                record = self._do(step, key, previous, recipe)
            lineage.append({"kind": step.kind, "key": key, "seconds": record["seconds"], "settings": step.settings})
        return self._finish(recipe, key, lineage, used)

    def key(self, recipe: Recipe) -> str:
        """Return the key of a recipe's last step: a digest of all that its artefact depends on. Nothing is made."""
        key = ""
        for step in plan(recipe, self.budget):
            key = step_key(step, key, self._inputs(step))
        return key

    @functools.cached_property
    def train(self) -> Scenes:
        """The images that trainings learn from."""
        return self._scenes("train", self.budget.images)

    @functools.cached_property
    def calibration(self) -> Scenes:
        """The images that activations are measured on."""
        return self._scenes("calibration", self.budget.calibration_images)

    @functools.cached_property
    def targets(self) -> TeacherTargets:
        """The teacher's answers for the training images."""
        from robotbrain.optimisation.networks import load_network
        from robotbrain.optimisation.training import teacher_targets

        self.say("asking the teacher")
        return teacher_targets(load_network("teacher"), self.train, progress=self.progress)

    def _scenes(self, split: str, count: int) -> Scenes:
        from robotbrain.optimisation.data import scenes

        given = self._given[split]
        return given[:count] if given is not None else scenes(split, count, progress=self.progress)

    # ------------------------------------------------------------------ keys

    def _inputs(self, step: Step) -> dict[str, str]:
        """Return digests of the data and weights that a step reads, and the version of what computes it."""
        import onnxruntime
        import torch

        found = {"torch": torch.__version__.partition("+")[0]}
        if "name" in step.settings:
            found["weights"] = _weights_digest(step.settings["name"])
        if step.trains:
            found["train"] = self._train_digest
            if step.settings["distil"]:
                found["teacher"] = _weights_digest("teacher")
        if step.kind in ("ptq", "qat"):
            found["calibration"] = self._calibration_digest
        if step.kind == "ptq":
            found["onnxruntime"] = onnxruntime.__version__
        if step.kind == "qat":
            found["torchao"] = _version("torchao")
        if step.kind == "channels":
            found["torch-pruning"] = _version("torch-pruning")
        return found

    @functools.cached_property
    def _train_digest(self) -> str:
        return scenes_digest(self.train)

    @functools.cached_property
    def _calibration_digest(self) -> str:
        return scenes_digest(self.calibration)

    # ------------------------------------------------------------------ cache

    def _path(self, key: str, suffix: str) -> Path:
        return self.folder / "steps" / f"{key}{suffix}"

    def _stored(self, key: str) -> dict[str, Any] | None:
        """Return the record of a step that is there with its results as they were written, or None."""
        try:
            record: dict[str, Any] = json.loads(self._path(key, ".json").read_text(encoding="utf-8"))
            whole = all(_digest(self._path(key, suffix)) == digest for suffix, digest in record["results"].items())
            return record if whole and isinstance(record["seconds"], float) else None
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return None

    def _do(self, step: Step, key: str, previous: str, recipe: Recipe) -> dict[str, Any]:
        begin = time.monotonic()
        if step.kind in ("network", "channels", "sparsity"):
            network = self._network_step(step, previous, recipe)
            self._save(network, key)
            suffixes = [".pt"]
        elif step.kind == "export":
            from robotbrain.optimisation.export import export_onnx

            export_onnx(self._load(previous, recipe), self._path(key, ".onnx"), opset=step.settings["opset"])
            suffixes = [".onnx"]
        elif step.kind == "qat":
            self._quantisation_aware(step, key, self._load(previous, recipe))
            suffixes = [".onnx"]
        else:
            self._quantise(step, key, previous)
            suffixes = [".onnx", ".cpu.onnx"]
        record = {
            "kind": step.kind,
            "settings": step.settings,
            "previous": previous,
            "seconds": round(time.monotonic() - begin, 3),
            "results": {suffix: _digest(self._path(key, suffix)) for suffix in suffixes},
        }
        write_text(self._path(key, ".json"), json.dumps(record, indent=1) + "\n")
        return record

    def _save(self, network: nn.Module, key: str) -> None:
        import io

        import torch

        file = io.BytesIO()
        torch.save({name: value.contiguous() for name, value in network.state_dict().items()}, file)
        write_bytes(self._path(key, ".pt"), file.getvalue())

    def _load(self, key: str, recipe: Recipe) -> nn.Module:
        """Return the network of a step before, with as many channels as it has left."""
        import torch

        from robotbrain.optimisation.structured import fit_to_state

        state = torch.load(self._path(key, ".pt"), map_location="cpu", weights_only=True)
        return fit_to_state(_untrained(recipe), state).eval()

    # ------------------------------------------------------------------ steps

    def _network_step(self, step: Step, previous: str, recipe: Recipe) -> nn.Module:
        import torch

        from robotbrain.optimisation.networks import load_network

        if "name" in step.settings:
            return load_network(step.settings["name"])
        if step.kind == "network":
            network = _untrained(recipe)
            self._train(network, step)
            return network
        network = self._load(previous, recipe)
        if step.kind == "channels":
            from robotbrain.optimisation.structured import prune_channels

            example = torch.zeros(1, *self.train.images.shape[3:], *self.train.images.shape[1:3])
            settings = step.settings
            network = prune_channels(network, example, settings["ratio"], importance=settings["importance"])
            self._train(network, step)
            return network
        from robotbrain.optimisation.pruning import GradualPruning, MaskedPruning
        from robotbrain.optimisation.semi_structured import two_four_masks

        pattern = step.settings["pattern"]
        if pattern == TWO_FOUR:
            pruning = MaskedPruning(network, two_four_masks(network))
        else:
            steps = step.settings["epochs"] * (len(self.train) // step.settings["batch_size"])
            end = max(1, round(0.6 * steps))  # the rest of the training is for recovery
            pruning = GradualPruning(network, float(pattern), end=end, every=max(1, end // 10))
        self._train(network, step, after_step=pruning.after_step)
        return pruning.make_permanent()

    def _train(self, network: nn.Module, step: Step, after_step: Callable[[nn.Module], None] | None = None) -> None:
        import torch

        from robotbrain.optimisation.training import FitConfig, fit

        s = step.settings
        config = FitConfig(
            epochs=s["epochs"], batch_size=s["batch_size"], learning_rate=s["learning_rate"], seed=s["seed"]
        )
        threads = torch.get_num_threads()
        torch.set_num_threads(1)  # small networks: more threads cost more than they bring, and change the last digits
        try:
            teacher = self.targets if s["distil"] else None
            fit(network, self.train, config, teacher=teacher, after_step=after_step, progress=self.progress)
        finally:
            torch.set_num_threads(threads)

    def _quantisation_aware(self, step: Step, key: str, network: nn.Module) -> None:
        import torch

        try:
            from robotbrain.optimisation import qat
        except ImportError as error:
            raise MissingDependencyError(
                "torchao", needed_for="quantisation-aware training", install="pip install torchao"
            ) from error
        from robotbrain.optimisation.pruning import MaskedPruning

        settings = step.settings
        example = torch.from_numpy(self.train[:2].inputs())
        prepared = qat.prepare(network, example, weight_bits=settings["bits"], per_channel=settings["per_channel"])
        qat.calibrate(prepared, self.calibration.inputs())
        # What is zero stays zero: a pruned network remains one. In a dense network hardly any weight is exactly zero.
        zeros = MaskedPruning(prepared, {n: p.detach() != 0 for n, p in prepared.named_parameters() if p.ndim >= 2})
        steps = settings["epochs"] * (len(self.train) // settings["batch_size"])
        freeze = qat.freeze_after(max(1, round(0.7 * steps)))  # ranges that move disturb the last, small steps

        def after_step(trained: nn.Module) -> None:
            zeros.after_step()
            freeze(trained)

        self._train(prepared, step, after_step=after_step)
        qat.export_qat_onnx(prepared, self._path(key, ".onnx"))

    def _quantise(self, step: Step, key: str, previous: str) -> None:
        from robotbrain.optimisation.ptq import quantise_onnx

        source, inputs = self._path(previous, ".onnx"), self.calibration.inputs()
        options: dict[str, Any] = {"per_channel": step.settings["per_channel"], "method": step.settings["method"]}
        quantise_onnx(source, self._path(key, ".onnx"), inputs, target="tensorrt", **options)
        # The same for this machine: ONNX Runtime's fast kernels take unsigned activations.
        quantise_onnx(source, self._path(key, ".cpu.onnx"), inputs, target="cpu", **options)

    # ------------------------------------------------------------------ artefact

    def host_file(self, artefact: Artefact) -> Path:
        """Return the file whose latency on this machine is worth measuring: with integers that its kernels like."""
        twin = self._path(artefact.facts["key"], ".cpu.onnx")
        return twin if twin.is_file() else artefact.onnx

    def _finish(self, recipe: Recipe, key: str, lineage: list[dict[str, Any]], used: dict[str, str]) -> Artefact:
        content = self._path(key, ".onnx").read_bytes()
        target = self.folder / "artefacts" / f"{recipe.slug}.onnx"
        facts = {
            "recipe": recipe.to_dict(),
            "label": recipe.label,
            "key": key,
            "onnx": target.name,
            "sha256": hashlib.sha256(content).hexdigest(),
            "size_bytes": len(content),
            "gzip_bytes": len(gzip.compress(content, 9, mtime=0)),
            **weight_facts(content),
            "precision": recipe.precision,
            "steps": lineage,
            "made_with": used,
        }
        text = json.dumps(facts, indent=1) + "\n"
        if not target.is_file() or target.read_bytes() != content:
            write_bytes(target, content)
        metadata = target.with_suffix(".json")
        if not metadata.is_file() or metadata.read_text(encoding="utf-8") != text:
            write_text(metadata, text)
        return Artefact(target, metadata, facts)


def weight_facts(model: bytes) -> dict[str, Any]:
    """Return ``weights``, ``zero_weights`` and ``weights_bytes`` of an ONNX file.

    ``weights_bytes`` is what the weights take once they are stored in the precision they run in: one byte for each
    weight behind a Q/DQ pair, although the file may hold it as a float for TensorRT to quantise. Scales and zero points
    of activations are not counted.
    """
    import numpy as np
    import onnx
    from onnx import numpy_helper

    graph = onnx.load_from_string(model).graph
    quantised = {node.input[0] for node in graph.node if node.op_type == "QuantizeLinear"}
    parameters = {name for node in graph.node if node.op_type in _QDQ for name in node.input[1:]}
    count = zeros = size = 0
    for tensor in graph.initializer:
        values = numpy_helper.to_array(tensor)
        if tensor.name in parameters or values.dtype.kind not in "fiu" or values.dtype == np.int64:
            continue
        if values.ndim >= 2:
            count += values.size
            zeros += int(np.count_nonzero(values == 0))
        size += values.size * (1 if tensor.name in quantised else values.dtype.itemsize)
    return {"weights": count, "zero_weights": zeros, "weights_bytes": size}


def scenes_digest(scenes: Scenes) -> str:
    """Return a digest of images and labels."""
    digest = hashlib.sha256(repr(scenes.images.shape).encode())
    digest.update(scenes.images.tobytes())
    digest.update(scenes.labels.tobytes())
    return digest.hexdigest()[:24]


def _untrained(recipe: Recipe) -> nn.Module:
    """Return the network that a recipe begins with, its weights drawn from the recipe's seed."""
    import torch

    from robotbrain.optimisation.networks import build_student, build_teacher

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(recipe.seed)
        if isinstance(recipe.student, int):
            return build_student(recipe.student)
        return build_teacher() if recipe.student == "teacher" else build_student()


def _weights_digest(name: str) -> str:
    from robotbrain.optimisation.networks import network_path

    path = network_path(name).with_suffix(".pt")
    if not path.is_file():
        raise InputError(
            f"weights of {name}",
            given="no such file",
            expected="the weights that the kit ships",
            fix=f"Install the kit again, or make them with `robotbrain train {name.partition('_')[0]}`.",
        )
    return _digest(path)[:24]


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return ""  # the step itself will say that it is missing


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
