"""Named wrong solutions of `hw2_optimisation`: each is a mistake that students make, and must lose its own points."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from robotbrain.grading.harmful_onnx import endless_loop, weights_in_another_file
from robotbrain.grading.sample import Mutant

FILE = "student_int8.onnx"


def _edited(change: Callable[[Any], None]) -> dict[str, Callable[[Path], bytes]]:
    """Return what makes a changed copy of the reference network; ``change`` gets the ONNX model."""

    def make(folder: Path) -> bytes:
        import onnx

        model = onnx.load_model_from_string((folder / FILE).read_bytes())
        change(model)
        content: bytes = model.SerializeToString(deterministic=True)
        return content

    return {FILE: make}


def _floating(folder: Path) -> Any:
    """Return the reference network without its Q/DQ nodes."""
    import onnx

    from robotbrain.grading.suites.hw2_optimisation_judge import without_quantisers

    plain = without_quantisers(onnx.load_model_from_string((folder / FILE).read_bytes()))
    used = {name for node in plain.graph.node for name in node.input}
    kept = [tensor for tensor in plain.graph.initializer if tensor.name in used]
    del plain.graph.initializer[:]
    plain.graph.initializer.extend(kept)
    return plain


def _requantised(symmetric: bool) -> dict[str, Callable[[Path], bytes]]:
    """Return what quantises the reference network again, by ONNX Runtime, with other options than TensorRT wants."""

    def make(folder: Path) -> bytes:
        import tempfile

        import onnx
        from onnxruntime.quantization import QuantFormat, QuantType, quantize_static

        from robotbrain.optimisation.data import scenes_of

        class Images:
            def __init__(self) -> None:
                self.rest = [{"image": scenes_of(range(2_400_000, 2_400_006), 4).inputs()}]

            def get_next(self) -> Any:
                return self.rest.pop() if self.rest else None

        kinds = {} if not symmetric else {"activation_type": QuantType.QInt8, "weight_type": QuantType.QInt8}
        extra = {
            "ActivationSymmetric": True,
            "WeightSymmetric": True,
            "AddQDQPairToWeight": True,
            "QuantizeBias": False,
        }

        with tempfile.TemporaryDirectory() as name:
            source, target = Path(name) / "source.onnx", Path(name) / "target.onnx"
            onnx.save(_floating(folder), str(source))
            quantize_static(
                str(source),
                str(target),
                Images(),
                quant_format=QuantFormat.QDQ,
                per_channel=True,
                extra_options=extra if symmetric else {},
                **kinds,
            )
            return target.read_bytes()

    return {FILE: make}


def _claims_only(folder: Path) -> bytes:
    """Return the floating-point network with one Q/DQ pair, before its first convolution."""
    import numpy as np
    from onnx import helper, numpy_helper

    model = _floating(folder)
    model.graph.initializer.append(numpy_helper.from_array(np.array(0.03, np.float32), "claim_scale"))
    model.graph.initializer.append(numpy_helper.from_array(np.array(0, np.int8), "claim_zero"))
    for node in model.graph.node:
        node.input[:] = ["image_dq" if name == "image" else name for name in node.input]
    pair = [
        helper.make_node("QuantizeLinear", ["image", "claim_scale", "claim_zero"], ["image_q"]),
        helper.make_node("DequantizeLinear", ["image_q", "claim_scale", "claim_zero"], ["image_dq"]),
    ]
    for node in reversed(pair):
        model.graph.node.insert(0, node)
    return model.SerializeToString(deterministic=True)


def _weights(change: Callable[[Any, Any], Any]) -> Callable[[Any], None]:
    """Return what replaces every floating-point weight of a convolution by ``change(array, rng)``."""

    def all_weights(model: Any) -> None:
        import numpy as np
        from onnx import numpy_helper

        rng = np.random.default_rng(0)
        for tensor in model.graph.initializer:
            array = numpy_helper.to_array(tensor)
            if array.dtype == np.float32 and array.ndim == 4:
                tensor.CopyFrom(numpy_helper.from_array(change(array, rng).astype(np.float32), tensor.name))

    return all_weights


def _first_bias_nan(model: Any) -> None:
    import numpy as np
    from onnx import numpy_helper

    for tensor in model.graph.initializer:
        array = numpy_helper.to_array(tensor).copy()
        if (
            array.dtype == np.float32
            and array.ndim == 1
            and any(node.op_type == "Conv" and tensor.name in node.input[2:] for node in model.graph.node)
        ):
            array[0] = np.nan
            tensor.CopyFrom(numpy_helper.from_array(array, tensor.name))
            return
    raise ValueError("no bias")


def _small_ranges(model: Any) -> None:
    """Make the scales of all signals eight times too small: calibrated on a dark image, say."""
    import numpy as np
    from onnx import numpy_helper

    made = {name for node in model.graph.node for name in node.output}
    signals = {
        node.input[1]
        for node in model.graph.node
        if node.op_type in ("QuantizeLinear", "DequantizeLinear")
        and (node.input[0] in made or node.input[0] == "image")
    }
    for tensor in model.graph.initializer:
        array = numpy_helper.to_array(tensor)
        if tensor.name in signals and array.ndim == 0:
            tensor.CopyFrom(numpy_helper.from_array(np.float32(array / 8), tensor.name))


def _much_too_much(model: Any) -> None:
    """Add numbers that nobody needs."""
    import numpy as np
    from onnx import numpy_helper

    extra = np.random.default_rng(0).random(100_000, dtype=np.float32)
    model.graph.initializer.append(numpy_helper.from_array(extra, "forgotten"))


def _channels_last(model: Any) -> None:
    """Take images as a camera gives them, (N, H, W, 3)."""
    from onnx import helper

    for node in model.graph.node:
        node.input[:] = ["image_first" if name == "image" else name for name in node.input]
    model.graph.node.insert(0, helper.make_node("Transpose", ["image"], ["image_first"], perm=[0, 3, 1, 2]))
    for dimension, size in zip(model.graph.input[0].type.tensor_type.shape.dim[1:], (64, 64, 3), strict=True):
        dimension.dim_value = size
    del model.graph.value_info[:]


def _classes_turned(model: Any) -> None:
    """Give the classes another order: in the last layer, so that nothing is slower for it."""
    import numpy as np
    from onnx import numpy_helper

    made = {name: node for node in model.graph.node for name in node.output}
    weight, bias = made["logits"].input[1:]
    after = made[weight]  # DequantizeLinear of QuantizeLinear of the weights, a scale for each class
    names = {made[after.input[0]].input[0], *after.input[1:], bias}
    for tensor in model.graph.initializer:
        if tensor.name in names:
            array = numpy_helper.to_array(tensor)
            tensor.CopyFrom(numpy_helper.from_array(np.ascontiguousarray(array[[1, 2, 3, 0]]), tensor.name))


def _shipped(name: str) -> dict[str, Callable[[Path], bytes]]:
    """Return what quantises a network of the kit and hands it in."""

    def make(_folder: Path) -> bytes:
        import tempfile

        from robotbrain.optimisation.data import scenes_of
        from robotbrain.optimisation.networks import network_path
        from robotbrain.optimisation.ptq import quantise_onnx

        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / FILE
            quantise_onnx(network_path(name), out, scenes_of(range(2_400_000, 2_400_008), 4).inputs())
            return out.read_bytes()

    return {FILE: make}


def _disguised(folder: Path) -> bytes:
    """Return the kit's student, quantised, with a convolution at its end that changes nothing."""
    import numpy as np
    import onnx
    from onnx import helper, numpy_helper

    made = _shipped("student")[FILE](folder)
    assert made is not None
    model = onnx.load_model_from_string(made)
    for node in model.graph.node:
        node.output[:] = ["usual" if name == "logits" else name for name in node.output]
    nothing = np.eye(4, dtype=np.float32)[:, :, None, None]
    model.graph.initializer.append(numpy_helper.from_array(nothing, "nothing"))
    model.graph.node.append(helper.make_node("Conv", ["usual", "nothing"], ["logits"]))
    return model.SerializeToString(deterministic=True)


def _beside(name: str) -> dict[str, Callable[[Path], bytes]]:
    """Return what hands in a network that is stored beside this file."""
    return {FILE: lambda _folder: (Path(__file__).parent / name).read_bytes()}


def _code(name: str, exercise: str, hint: str, describe: str, *edits: tuple[str, str], loses: float | None = None,
          cell: str = "") -> Mutant:  # fmt: skip
    """Return a mutant made by edits of its exercise's answer."""
    return Mutant(name=name, exercise=exercise, hint=hint, describe=describe, loses=loses,
                  replace={cell or exercise: list(edits)})  # fmt: skip


def _file(
    name: str, hint: str, describe: str, files: dict[str, Callable[[Path], bytes | None]], loses: float | None = None
) -> Mutant:
    """Return a mutant whose notebook is right and whose file is not."""
    return Mutant(name=name, exercise="student", hint=hint, describe=describe, loses=loses, replace={}, files=files)


MUTANTS = [
    _code("detach-is-fatal", "bugs", "who-is-optimised", "holds the missing detach for a mistake in what is learned",
          ('"c": "wastes"', '"c": "breaks"'), loses=0.4),
    _code("zeros-are-fast", "bugs", "zeros-cost-the-same", "expects a fifth less time from a fifth of zeros",
          ('"i": "wastes"', '"i": "fine"'), loses=0.4),
    # ------------------------------------------------------------ scale
    _code("levels-for-steps", "scale", "levels-not-steps", "divides the range by 256",
          ("scale = (high - low) / (2**bits - 1)", "scale = (high - low) / 2**bits")),
    _code("minus-128-used", "scale", "levels-not-steps", "divides the magnitude by 128",
          ("max(-low, high) / (2 ** (bits - 1) - 1)", "max(-low, high) / 2 ** (bits - 1)")),
    _code("asymmetric-where-symmetric", "scale", "asymmetric-range", "returns an asymmetric range where symmetric is "
          "asked for", ("if symmetric:", "if False:")),
    _code("always-symmetric", "scale", "symmetric-range", "wastes half of the levels on values that do not occur",
          ("if symmetric:", "if True:")),
    _code("zero-left-out", "scale", "range-holds-zero", "takes the range as it comes: zero is not in it",
          ("low, high = min(low, 0.0), max(high, 0.0)", "low, high = float(low), float(high)"), loses=1.0),
    _code("fractional-zero-point", "scale", "whole-numbers", "does not round the zero point: zero is not exact",
          ("round(-low / scale)", "-low / scale")),
    _code("zero-point-upside-down", "scale", "zero-point-places-zero", "has the sign of the zero point wrong",
          ("round(-low / scale)", "round(low / scale)")),
    _code("zero-point-cut-off", "scale", "zero-point-places-zero", "cuts the zero point off",
          ("round(-low / scale)", "int(-low / scale)")),
    _code("scale-of-nothing", "scale", "some-scale", "gives zeros a scale of zero", ("return 1.0, 0", "return 0.0, 0"),
          loses=1.0),
    # ------------------------------------------------------------ quantise
    _code("truncates", "quantise", "nearest-not-below", "casts to int instead of rounding",
          ("np.rint(x / scale)", "np.trunc(x / scale)")),
    _code("does-not-clip", "quantise", "clip-to-the-range", "lets large values through",
          ("np.clip(steps, qmin, qmax).astype", "steps.astype")),
    _code("wraps-around", "quantise", "wrapped-around", "casts to uint8 without clipping: 300 becomes 44",
          ("np.clip(steps, qmin, qmax).astype(np.int32)", "steps.astype(np.int64).astype(np.uint8)")),
    _code("zero-point-ignored", "quantise", "zero-point-ignored", "knows no zero point",
          (" + zero_point", ""), ("q.astype(np.int32) - zero_point", "q.astype(np.int32)")),
    _code("caller-is-changed", "quantise", "leave-the-input", "divides the caller's array",
          ("    steps = np.rint(x / scale)", "    x /= scale\n    steps = np.rint(x)")),
    _code("clips-too-early", "quantise", "clip-after-the-shift", "clips before it adds the zero point",
          ("np.rint(x / scale) + zero_point", "np.clip(np.rint(x / scale), qmin, qmax) + zero_point"),
          ("np.clip(steps, qmin, qmax).astype", "steps.astype")),
    _code("unsigned-difference", "quantise", "uint8-cannot-be-negative", "subtracts in uint8",
          ("q.astype(np.int32) - zero_point", "q - zero_point"), loses=1.0),
    _code("shift-after-scaling", "quantise", "subtract-before-scaling", "scales first, and subtracts then",
          ("(q.astype(np.int32) - zero_point) * scale", "q.astype(np.int32) * scale - zero_point")),
    _code("floats-that-look-whole", "quantise", "whole-numbers", "returns rounded floats",
          ("np.clip(steps, qmin, qmax).astype(np.int32)",
          "np.clip(steps, qmin, qmax)")),
    _code("integers-come-back", "quantise", "floats-come-back", "returns integers from dequantise",
          (".astype(np.float32)", ".astype(np.int32)")),
    # ------------------------------------------------------------ weights
    _code("tensor-passed-as-channels", "weights", "one-scale-each", "repeats the scale of the tensor for each channel",
          ("scale = np.abs(weight).max(axis=axes, keepdims=per_channel) / 127",
           "scale = np.abs(weight).max(axis=axes, keepdims=per_channel) * 0 + np.abs(weight).max() / 127")),
    _code("input-channels", "weights", "output-channels", "has a scale for each input channel",
          ("tuple(range(1, weight.ndim))", "tuple(k for k in range(weight.ndim) if k != 1)")),
    _code("four-bytes-each", "weights", "one-byte-each", "keeps eight-bit weights in int32",
          (".astype(np.int8)", ""), loses=3.0),
    _code("down-to-minus-128", "weights", "symmetric-int8", "divides by 128", ("/ 127", "/ 128")),
    _code("dead-channel-divides", "weights", "dead-channel", "divides by the largest magnitude of a channel of zeros",
          ("    scale = np.where(scale > 0, scale, 1.0)\n", ""), loses=2.0),
    _code("largest-value", "weights", "largest-magnitude", "takes the largest value for the largest magnitude",
          ("np.abs(weight).max(axis=axes, keepdims=per_channel)", "np.abs(weight.max(axis=axes, keepdims=per_channel))")),
    _code("channels-always", "weights", "one-scale-for-all", "does not look at per_channel",
          ("tuple(range(1, weight.ndim)) if per_channel else None", "tuple(range(1, weight.ndim))"),
          ("keepdims=per_channel", "keepdims=True"), loses=2.0),
    # ------------------------------------------------------------ range
    _code("last-batch-only", "range", "all-batches", "keeps the last batch only",
          ("np.concatenate([np.ravel(batch) for batch in batches])", "[np.ravel(batch) for batch in batches][-1]")),
    Mutant(name="average-of-ranges", exercise="range", hint="all-batches",
           describe="averages the ranges of the batches",
           replace={"range": """
def activation_range(batches, percentile=None):
    lows, highs = [], []
    for batch in batches:
        top = np.percentile(np.abs(batch), percentile) if percentile is not None else None
        lows.append(np.min(batch) if top is None else -top)
        highs.append(np.max(batch) if top is None else top)
    return float(np.mean(lows)), float(np.mean(highs))
"""}),
    _code("percentile-of-signed-values", "range", "magnitudes", "takes the percentile of the values with their signs",
          ("np.percentile(np.abs(values), percentile)", "np.percentile(values, percentile)")),
    _code("share-for-percent", "range", "percent-not-share", "hands np.percentile a share",
          ("np.abs(values), percentile)", "np.abs(values), percentile / 100)")),
    Mutant(name="starts-at-zero", exercise="range", hint="min-and-max", loses=2.0,
           describe="keeps a running minimum and maximum that start at 0",
           replace={"range": """
def activation_range(batches, percentile=None):
    low = high = 0.0
    sizes = []
    for batch in batches:
        low, high = min(low, float(batch.min())), max(high, float(batch.max()))
        sizes.append(np.abs(batch).ravel())
    if percentile is None:
        return low, high
    top = float(np.percentile(np.concatenate(sizes), percentile))
    return -top, top
"""}),
    _code("two-tails", "range", "magnitudes", "cuts both tails by themselves",
          ("return -top, top", "return float(np.percentile(values, 100 - percentile)), "
           "float(np.percentile(values, percentile))")),
    _code("always-both-sides", "range", "min-and-max", "makes the plain range symmetric",
          ("return float(values.min()), float(values.max())", "return -float(np.abs(values).max()), "
           "float(np.abs(values).max())")),
    Mutant(name="walks-twice", exercise="range", hint="once-only", describe="walks through a generator twice",
           replace={"range": """
def activation_range(batches, percentile=None):
    if percentile is not None:
        top = float(np.percentile(np.abs(np.concatenate([b.ravel() for b in batches])), percentile))
        return -top, top
    return min(float(b.min()) for b in batches), max(float(b.max()) for b in batches)
"""}),
    # ------------------------------------------------------------ calibrate
    _code("calibrates-on-the-test-set", "calibrate", "not-the-test-set", "looks at the images that are to judge it",
          ('splits["calibration"]', 'splits["test"]')),
    _code("calibrates-on-training-images", "calibrate", "calibration-split", "takes the training images",
          ('splits["calibration"]', 'splits["train"]')),
    _code("last-batch-kept", "calibrate", "all-batches", "keeps the outputs of the last batch only",
          ("found[name].append(output.numpy().copy())", "found.update({name: [output.numpy().copy()]})")),
    _code("calibrates-in-train-mode", "calibrate", "calibrate-in-eval", "calibrates the network that is trained",
          ("network.eval()", "network.train()")),
    _code("eval-forgotten", "calibrate", "calibrate-in-eval", "relies on the mode that the network comes in",
          ("    network.eval()\n", ""), loses=3.0),
    _code("hooks-left-behind", "calibrate", "take-hooks-off", "leaves its hooks on the network",
          ("        handle.remove()", "        pass")),
    _code("mode-not-restored", "calibrate", "leave-as-found", "leaves a network in training in eval mode",
          ("    network.train(mode)\n", ""), loses=1.5),
    _code("range-of-the-input", "calibrate", "output-of-the-layer", "keeps what goes into a layer",
          ("found[name].append(output.numpy().copy())", "found[name].append(_i[0].numpy().copy())")),
    _code("raw-images", "calibrate", "network-input", "shows the network images from 0 to 255",
          ('torch.from_numpy(splits["calibration"].inputs())',
           'torch.from_numpy(splits["calibration"].images).permute(0, 3, 1, 2).float()')),
    # ------------------------------------------------------------ mask
    _code("signs-counted", "mask", "small-ones-go", "prunes the most negative weights",
          ("weight.abs().flatten().argsort()", "weight.flatten().argsort()")),
    _code("mask-upside-down", "mask", "true-keeps", "says True where a weight goes",
          ("return mask.view", "return ~mask.view")),
    _code("threshold-with-ties", "mask", "exactly-so-many", "compares with a quantile: equal weights all stay",
          ("return mask.view(weight.shape)",
           "return weight.abs() >= torch.quantile(weight.abs().flatten(), sparsity)")),
    _code("share-that-stays", "mask", "share-that-goes", "keeps the share that is to go",
          ("round(sparsity * weight.numel())", "round((1 - sparsity) * weight.numel())")),
    Mutant(name="row-by-row", exercise="mask", hint="each-tensor-at-once", describe="ranks each row by itself",
           replace={"mask": """
def magnitude_mask(weight, sparsity):
    rows = weight.reshape(len(weight), -1)
    mask = torch.ones_like(rows, dtype=torch.bool)
    drop = rows.abs().argsort(dim=1)[:, : round(sparsity * rows.shape[1])]
    return mask.scatter_(1, drop, False).view(weight.shape)
"""}),
    # ------------------------------------------------------------ pattern
    Mutant(name="groups-along-columns", exercise="pattern", hint="groups-along-inputs", loses=1.0,
           describe="groups along the last axis, which in a convolution holds its columns",
           replace={"pattern": """
def two_four_mask(weight):
    groups = weight.abs().reshape(-1, 4)
    mask = torch.zeros_like(groups, dtype=torch.bool)
    return mask.scatter_(1, groups.topk(2, dim=1).indices, True).view(weight.shape)
"""}),
    _code("half-anywhere", "pattern", "two-of-four", "keeps the larger half of the whole tensor",
          ("return mask.view(last.shape).movedim(-1, 1)", "return magnitude_mask(weight, 0.5)")),
    _code("pattern-by-threshold", "pattern", "two-of-four", "compares with the second largest: equal weights all stay",
          ("return mask.view(last.shape).movedim(-1, 1)",
           "return (groups >= groups.topk(2, dim=-1).values[..., 1:]).view(last.shape).movedim(-1, 1)"), loses=1.0),
    _code("smaller-two-stay", "pattern", "true-keeps", "keeps the two smallest",
          ("topk(2, dim=-1)", "topk(2, dim=-1, largest=False)")),
    # ------------------------------------------------------------ prune
    _code("mask-not-applied", "prune", "apply-the-mask", "makes masks and applies none",
          ("                layer.weight.mul_(mask)\n", "")),
    _code("biases-pruned", "prune", "weights-only", "prunes the biases, too",
          ('                masks[f"{name}.weight"] = mask\n',
           '                masks[f"{name}.weight"] = mask\n'
           "                if layer.bias is not None:\n"
           "                    layer.bias.mul_(magnitude_mask(layer.bias, sparsity))\n")),
    _code("batch-norms-pruned", "prune", "weights-only", "prunes everything that is called weight",
          ("isinstance(layer, (nn.Conv2d, nn.Linear))", 'getattr(layer, "weight", None) is not None')),
    Mutant(name="one-threshold-for-all", exercise="prune", hint="each-layer-its-own", loses=3.0,
           describe="ranks the weights of all layers together",
           replace={"prune": [("                mask = magnitude_mask(layer.weight, sparsity)\n",
                               "                every = torch.cat([m.weight.abs().flatten() for m in network.modules()\n"
                               "                                   if isinstance(m, (nn.Conv2d, nn.Linear))])\n"
                               "                limit = limit if masks else every.sort().values[round(sparsity * "
                               "len(every)) - 1]\n"
                               "                mask = layer.weight.abs() > limit\n")]}),
    _code("mask-not-permanent", "prune", "mask-after-the-step", "prunes once, and trains the zeros away",
          ("            parameters[name].mul_(mask)", "            pass"), loses=4.0),
    _code("gradients-masked", "prune", "momentum-remembers", "masks the gradients and trusts the optimiser",
          ("    optimiser.step()\n    parameters = dict(network.named_parameters())\n",
           "    parameters = dict(network.named_parameters())\n"),
          ("            parameters[name].mul_(mask)", "            parameters[name].grad.mul_(mask)\n    optimiser.step()"),
          loses=4.0),
    _code("gradients-pile-up", "prune", "zero-grad", "does not clear old gradients", ("    optimiser.zero_grad()\n", ""),
          loses=4.0),
    _code("a-copy-is-pruned", "prune", "apply-the-mask", "prunes a copy of the weights",
          ("layer.weight.mul_(mask)", "layer.weight.clone().mul_(mask)")),
    # ------------------------------------------------------------ loss
    _code("t-not-squared", "loss", "t-squared", "forgets T squared", (" * temperature**2", "")),
    _code("t-once", "loss", "t-squared", "multiplies by T", ("temperature**2", "temperature")),
    _code("kl-reversed", "loss", "kl-direction", "lets the student weigh the classes",
          ("log_p.exp() * (log_p - log_q)", "log_q.exp() * (log_q - log_p)")),
    _code("sum-over-pixels", "loss", "mean-over-pixels", "divides by the number of images, as batchmean does",
          (".sum(dim=1).mean()", ".sum() / len(student_logits)")),
    _code("mean-over-classes", "loss", "mean-over-pixels", "takes the mean over the classes, too",
          (".sum(dim=1).mean()", ".mean()")),
    _code("softmax-over-columns", "loss", "classes-are-axis-1", "takes the softmax over the last axis",
          ("log_softmax(student_logits / temperature, dim=1)", "log_softmax(student_logits / temperature, dim=-1)"),
          ("log_softmax(teacher_logits.detach() / temperature, dim=1)",
           "log_softmax(teacher_logits.detach() / temperature, dim=-1)")),
    _code("alpha-exchanged", "loss", "alpha-is-the-teachers", "gives alpha to the labels",
          ("        return alpha * soft", "        return (1 - alpha) * soft"),
          ("return alpha * soft + (1 - alpha) * F", "return (1 - alpha) * soft + alpha * F")),
    _code("labels-at-temperature", "loss", "hard-at-one", "softens the hard term, too",
          ("F.cross_entropy(student_logits,", "F.cross_entropy(student_logits / temperature,")),
    _code("teacher-not-softened", "loss", "soften-both", "takes the teacher's softmax at temperature 1",
          ("teacher_logits.detach() / temperature", "teacher_logits.detach()")),
    _code("cross-entropy-for-kl", "loss", "zero-when-equal", "leaves the teacher's entropy in",
          ("log_p.exp() * (log_p - log_q)", "-log_p.exp() * log_q")),
    _code("no-hard-term", "loss", "the-hard-term", "returns the soft term alone, as the outline does",
          ("    return alpha * soft + (1 - alpha) * F.cross_entropy(student_logits, labels, ignore_index=255)",
           "    return soft")),
    _code("gradient-into-the-teacher", "loss", "teacher-is-a-constant", "lets the teacher follow the student",
          ("teacher_logits.detach()", "teacher_logits"), loses=3.0),
    _code("student-detached", "loss", "loss-has-a-gradient", "cuts the student off",
          ("student_logits / temperature", "student_logits.detach() / temperature"),
          ("F.cross_entropy(student_logits,", "F.cross_entropy(student_logits.detach(),"), loses=5.0),
    _code("unlabelled-is-background", "loss", "255-is-no-class", "takes unlabelled pixels for class 0",
          ("F.cross_entropy(student_logits, labels, ignore_index=255)",
           "F.cross_entropy(student_logits, labels.where(labels < 4, 0))"), loses=2.0),
    _code("nan-in-the-gradient", "loss", "mean-of-nothing", "replaces the NaN in the value, and keeps it in the gradient",
          ("if (labels == 255).all():", "if False:"),
          ("F.cross_entropy(student_logits, labels, ignore_index=255)",
           "torch.where((labels == 255).all(), student_logits.new_zeros(()), -(F.log_softmax(student_logits, dim=1)"
           ".gather(1, labels.where(labels < 4, 0)[:, None])[:, 0] * (labels < 4)).sum() / (labels < 4).sum())"),
          loses=2.0),
    _code("mean-of-nothing", "loss", "mean-of-nothing", "returns NaN where no pixel has a label",
          ("if (labels == 255).all():", "if False:"), loses=2.0),
    # ------------------------------------------------------------ step
    _code("teacher-in-train-mode", "step", "teacher-in-eval", "puts the teacher into train mode",
          ("teacher.eval()", "teacher.train()"), loses=3.0),
    _code("teacher-left-as-it-came", "step", "teacher-in-eval", "forgets to put the teacher into eval mode",
          ("    teacher.eval()\n", ""), loses=3.0),
    _code("graph-through-the-teacher", "step", "teacher-is-a-constant", "keeps the teacher's graph",
          ("with torch.no_grad():", "if True:"), loses=3.0),
    _code("last-batch-lost", "step", "every-image-once", "leaves out what does not fill a batch",
          ("for part in images.split(50)]", "for part in images[: max(50, len(images) // 50 * 50)].split(50)]"), loses=2.0),
    _code("all-at-once", "step", "fifty-at-a-time", "asks about thousands of images at once", ("split(50)", "split(5000)"),
          loses=1.0),
    _code("probabilities-for-logits", "step", "logits-not-probabilities", "returns probabilities",
          ("teacher(part) for", "teacher(part).softmax(dim=1) for"), loses=3.0),
    _code("student-in-eval-mode", "step", "student-in-train", "trains a student in eval mode",
          ("student.train()", "student.eval()"), loses=3.0),
    _code("old-gradients", "step", "zero-grad", "does not clear old gradients", ("    optimiser.zero_grad()\n", ""),
          loses=3.0),
    _code("settings-ignored", "step", "use-what-is-given", "leaves temperature and alpha at their defaults",
          ("labels, temperature, alpha)", "labels)"), loses=3.0),
    _code("loss-with-its-graph", "step", "loss-as-a-float", "returns the loss as a tensor, with its graph",
          ("return loss.item()", "return loss"), loses=1.5),
    # ------------------------------------------------------------ iou
    Mutant(name="average-over-images", exercise="iou", hint="iou-over-all-pixels",
           describe="averages the IoU of the images",
           replace={"iou": [("    found = []\n    for c in range(4):\n",
                             "    found = []\n    for c, predicted, truth in [(c, a, b) for c in range(4) for a, b in "
                             "zip(predicted, scenes.labels)]:\n")]}),
    _code("score-on-training-images", "iou", "not-what-was-trained-on", "scores what was learned by heart",
          ('splits["test"]', 'splits["train"]')),
    _code("score-on-validation", "iou", "test-split", "reports the score that choices were made by",
          ('splits["test"]', 'splits["validation"]')),
    _code("accuracy", "iou", "iou-not-accuracy", "returns the share of right pixels",
          ("return float(np.mean(found))", "return float((predicted == truth).mean())")),
    _code("dice", "iou", "union-counts-once", "counts what both have twice in the union",
          ("union = ((predicted == c) | (truth == c)).sum()", "union = (predicted == c).sum() + (truth == c).sum()")),
    _code("absent-counts-as-zero", "iou", "absent-classes", "gives an absent class an IoU of 0",
          ("        if union > 0:\n            found.append(((predicted == c) & (truth == c)).sum() / union)",
           "        found.append(((predicted == c) & (truth == c)).sum() / max(union, 1))"), loses=1.0),
    _code("scored-in-train-mode", "iou", "evaluate-in-eval", "relies on the mode that the network comes in",
          ("    network.eval()\n", ""), loses=2.0),
    _code("training-goes-on-in-eval", "iou", "leave-the-mode", "leaves a network in training in eval mode",
          ("    network.train(mode)\n", ""), loses=1.0),
    # ------------------------------------------------------------ readings
    _code("floating-point-operations", "readings", "latency-of-the-whole", "divides operations by the peak",
          ("prediction.latency_ms", "prediction.baseline_ms")),
    _code("default-mode", "readings", "mode-and-module", "reads the module in its default mode",
          (', mode=budget["mode"]', "")),
    _code("one-camera", "readings", "all-cameras-at-once", "reads the latency of one image",
          (' batch=budget["cameras"],', "")),
    _code("always-fp16", "readings", "precision-of-the-file", "takes every file for floating point",
          ('"int8" if quantised else "fp16"', '"fp16"')),
    _code("always-int8", "readings", "precision-of-the-file", "takes every file for INT8",
          ('"int8" if quantised else "fp16"', '"int8"'), loses=2.0),
    _code("drop-upside-down", "readings", "teacher-minus-student", "has the sign of the drop wrong",
          ("teacher_iou - iou", "iou - teacher_iou")),
    _code("relative-drop", "readings", "teacher-minus-student", "divides the drop by the teacher's score",
          ("teacher_iou - iou", "1 - iou / teacher_iou")),
    _code("kilobytes", "readings", "size-of-the-file", "returns kilobytes", (".st_size", ".st_size / 1024")),
    # ------------------------------------------------------------ student
    _file("file-not-handed-in", "file-beside-the-notebook", "hands in the notebook alone", {FILE: lambda _: None}, 19.0),
    _file("file-cut-off", "not-a-network", "hands in half of a file",
          {FILE: lambda folder: (folder / FILE).read_bytes()[:40_000]}, 19.0),
    _file("weights-elsewhere", "not-a-network", "refers to a file on the grader's disk",
          _edited(weights_in_another_file), 19.0),
    _file("loops-for-ever", "not-a-network", "holds a loop without end", _edited(lambda model: endless_loop(model, "image")), 19.0),
    _file("channels-last", "image-in-logits-out", "wants images with the channels last", _edited(_channels_last), 19.0),
    _file("not-a-number", "numbers-are-finite", "answers NaN", _edited(_first_bias_nan), 19.0),
    _file("floating-point-network", "int8-by-qdq", "hands in the network from before quantisation",
          {FILE: lambda folder: _floating(folder).SerializeToString(deterministic=True)}, 5.0),
    _file("int8-by-name", "most-of-it-in-int8", "quantises the image and nothing else", {FILE: _claims_only}, 3.0),
    _file("default-options", "tensorrt-safe", "uses the defaults of ONNX Runtime: asymmetric, unsigned",
          _requantised(symmetric=False)),
    _file("pairs-before-relus", "faster-please", "puts Q/DQ nodes between convolutions and their ReLUs",
          _requantised(symmetric=True), 2.0),
    _file("forgotten-numbers", "smaller-please", "carries numbers that nobody uses", _edited(_much_too_much), 2.0),
    _file("teacher-handed-in", "train-your-own", "quantises the teacher and hands it in", _shipped("teacher")),
    _file("kits-student", "train-your-own", "quantises the kit's student and hands it in", _shipped("student"), 11.0),
    _file("kits-student-in-disguise", "train-your-own", "adds a layer that does nothing to the kit's student",
          {FILE: _disguised}, None),
    _file("plain-student", "labels-are-not-enough", "hands in the student that never met the teacher",
          _beside("plain_int8.onnx")),
    _file("exported-before-training", "no-better-than-chance", "exports a network that has learned nothing",
          _edited(_weights(lambda array, rng: 0.1 * rng.standard_normal(array.shape))), 11.0),
    _file("classes-in-another-order", "no-better-than-chance", "numbers the classes in another way",
          _edited(_classes_turned), 11.0),
    _file("calibrated-in-the-dark", "quantisation-broke-it", "has ranges that are much too small",
          _edited(_small_ranges)),
]  # fmt: skip
