"""The AVX2 trap, reproduced with the genuine ONNX Runtime and explained number for number.

Small layers are run by ONNX Runtime with its integer kernels (all graph optimisations on) and without (off), on this
machine and, where qemu's user emulation is installed, on an emulated Haswell (AVX2, no VNNI). What the emulated machine
returns is compared with robotbrain.optimisation.saturation. EfficientNet-Lite0 then goes through the same.

    python benchmarks/opt_saturation.py --qemu qemu-x86_64      (Debian: apt-get install qemu-user)
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import onnxruntime

LAYERS = (
    # name, inputs, outputs, kernel, groups
    ("matmul", 64, 16, 0, 1),
    ("conv 1x1", 64, 32, 1, 1),
    ("conv 3x3", 3, 16, 3, 1),
    ("conv 3x3", 32, 16, 3, 1),
    ("conv 3x3, 2 groups", 16, 16, 3, 2),
    ("conv 3x3 depthwise", 32, 32, 3, 32),
)
KINDS = ("u8", "s8", "u8, 7-bit weights")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--qemu", default="qemu-x86_64", help="program of qemu's user emulation")
    parser.add_argument("--cpu", default="Haswell", help="processor that it emulates")
    parser.add_argument("--images", type=int, default=0, help="photographs through EfficientNet-Lite0 (0: none)")
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--emulated", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        run_here(arguments.child, arguments.emulated)
        return

    from robotbrain.optimisation.cpu import cpu_features, onnxruntime_saturates

    print(f"this machine: {cpu_features().sentence()}")
    print(f"ONNX Runtime {onnxruntime.__version__} saturates here: {'yes' if onnxruntime_saturates() else 'no'}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        layers = make_layers(folder)
        networks = make_networks(folder, arguments.images) if arguments.images else {}
        here = results(folder, [])
        there = None
        if shutil.which(arguments.qemu):
            there = results(folder, [arguments.qemu, "-cpu", arguments.cpu])
        else:
            print(f"{arguments.qemu} is not installed: no genuine run on a machine without VNNI")
        report_layers(folder, layers, here, there, arguments.cpu)
        report_networks(folder, networks, here, there)


def run_here(folder: Path, emulated: bool) -> None:
    """Run every model of a folder on its inputs, with and without graph optimisations; needs ONNX Runtime only.

    Emulated, networks run with their integer kernels alone: floating point takes minutes an image there.
    """
    levels = onnxruntime.GraphOptimizationLevel
    found = {}
    for file in sorted(folder.glob("*.onnx")):
        inputs = np.load(file.with_suffix(".npy"))
        for key, level, slow in (
            ("all", levels.ORT_ENABLE_ALL, "0"),
            ("off", levels.ORT_DISABLE_ALL, "0"),
            ("option", levels.ORT_ENABLE_ALL, "1"),
        ):
            if emulated and key != "all" and file.stem.startswith("net"):
                continue
            options = onnxruntime.SessionOptions()
            options.graph_optimization_level = level
            options.intra_op_num_threads = 1
            options.log_severity_level = 3
            options.add_session_config_entry("session.x64quantprecision", slow)
            session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
            name = session.get_inputs()[0].name
            found[f"{file.stem}/{key}"] = np.concatenate([session.run(None, {name: one[None]})[0] for one in inputs])
    np.savez(folder / "found.npz", **found)


def results(folder: Path, emulator: list[str]) -> dict[str, np.ndarray]:
    command = [*emulator, sys.executable, __file__, "--child", str(folder), *(["--emulated"] if emulator else [])]
    subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
    with np.load(folder / "found.npz") as stored:
        return dict(stored)


def make_layers(folder: Path) -> dict[str, tuple[str, str]]:
    made = {}
    for index, (title, inputs, outputs, kernel, groups) in enumerate(LAYERS):
        for kind in KINDS:
            rng = np.random.default_rng(index)
            stem = f"layer{index}{KINDS.index(kind)}"
            weights = rng.normal(
                0.0, 60.0, (outputs, inputs // groups, kernel, kernel) if kernel else (inputs, outputs)
            )
            write_layer(folder / f"{stem}.onnx", weights, kind, groups)
            shape = (20, inputs, 9, 9) if kernel else (20, inputs)
            np.save(folder / f"{stem}.npy", rng.uniform(-0.1, 0.9, shape).astype(np.float32))
            made[stem] = (title, kind)
    return made


def write_layer(file: Path, weights: np.ndarray, kind: str, groups: int) -> None:
    """Write Q/DQ -> MatMul or Conv with stored int8 weights -> Q/DQ."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    limit, signed = (63, False) if "7-bit" in kind else (127, kind == "s8")
    dtype = np.int8 if signed else np.uint8
    w = np.clip(np.rint(weights * limit / 127), -limit, limit).astype(np.int8)
    terms = w.size // (w.shape[0] if w.ndim == 4 else w.shape[1])
    constants = {
        "sx": np.float32(1 / (127 if signed else 255)),
        "zx": dtype(0 if signed else 40),
        "w": w,
        "sw": np.float32(1 / limit),
        "zw": np.int8(0),
        "sy": np.float32(0.008 * terms),
    }
    if w.ndim == 4:
        pads = [w.shape[2] // 2] * 4
        middle = helper.make_node("Conv", ["xd", "wd"], ["product"], group=groups, pads=pads)
        shape = ["n", w.shape[1] * groups, 9, 9]
    else:
        middle = helper.make_node("MatMul", ["xd", "wd"], ["product"])
        shape = ["n", w.shape[0]]
    nodes = [
        helper.make_node("QuantizeLinear", ["x", "sx", "zx"], ["xq"]),
        helper.make_node("DequantizeLinear", ["xq", "sx", "zx"], ["xd"]),
        helper.make_node("DequantizeLinear", ["w", "sw", "zw"], ["wd"]),
        middle,
        helper.make_node("QuantizeLinear", ["product", "sy", "zx"], ["yq"]),
        helper.make_node("DequantizeLinear", ["yq", "sy", "zx"], ["y"]),
    ]
    graph = helper.make_graph(
        nodes,
        "layer",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, shape)],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, None)],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), str(file))


def make_networks(folder: Path, images: int) -> dict[str, str]:
    """Write EfficientNet-Lite0, quantised for the CPU with 8- and 7-bit weights, with photographs as inputs."""
    from robotbrain.optimisation import imagenet, quantise_onnx

    calibration = imagenet.inputs_of(imagenet.CALIBRATION, 3)
    inputs = imagenet.inputs_of(imagenet.EVALUATION, -(-images // len(imagenet.EVALUATION)), 1)[:images]
    made = {}
    with tempfile.TemporaryDirectory() as name:
        source = imagenet.export_efficientnet(Path(name) / "float.onnx")
        for stem, title, reduce in (("net8", "8-bit weights", False), ("net7", "7-bit weights", True)):
            quantise_onnx(source, folder / f"{stem}.onnx", calibration, target="cpu", reduce_range=reduce)
            np.save(folder / f"{stem}.npy", inputs)
            made[stem] = title
        np.save(folder / "float.logits", imagenet.logits_of(source, inputs), allow_pickle=False)
    return made


def share(a: np.ndarray, b: np.ndarray) -> str:
    return f"{100 * np.mean(~np.isclose(a, b, atol=1e-4)):.1f} %"


def report_layers(
    folder: Path,
    layers: dict[str, tuple[str, str]],
    here: dict[str, np.ndarray],
    there: dict[str, np.ndarray] | None,
    cpu: str,
) -> None:
    from robotbrain.optimisation.saturation import run_saturating

    print("\nOutputs that differ between integer kernels and the graph as written (ORT_DISABLE_ALL)")
    print(f"{'layer':<22}{'format':<20}{'here':>9}{cpu:>10}{'option on':>11}   emulation differs from genuine in")
    for stem, (title, kind) in layers.items():
        row = f"{title:<22}{kind:<20}{share(here[f'{stem}/all'], here[f'{stem}/off']):>9}"
        if there is not None:
            exact = there[f"{stem}/off"]
            row += f"{share(there[f'{stem}/all'], exact):>10}{share(there[f'{stem}/option'], exact):>11}"
            if "depthwise" in title:
                row += "   (its kernel does not saturate)"
            else:
                emulated = run_saturating(folder / f"{stem}.onnx", np.load(folder / f"{stem}.npy"))
                row += f"   {share(emulated, there[f'{stem}/all'])}"
        print(row)


def report_networks(
    folder: Path, networks: dict[str, str], here: dict[str, np.ndarray], there: dict[str, np.ndarray] | None
) -> None:
    if not networks:
        return
    from robotbrain.optimisation.imagenet import agreement
    from robotbrain.optimisation.saturation import layer_saturation, run_saturating

    floats = np.load(folder / "float.logits.npy")
    print(f"\nEfficientNet-Lite0, per channel, U8S8: agreement with float32 on {len(floats)} photographs")
    print(f"{'':<16}{'how':<34}{'top-1':>8}{'cosine':>9}{'SQNR':>10}")
    for stem, title in networks.items():
        inputs = np.load(folder / f"{stem}.npy")
        rows = [("exact sums (optimisations off)", here[f"{stem}/off"])]
        rows.append(("integer kernels, this machine", here[f"{stem}/all"]))
        rows.append(("saturating sums, emulated in numpy", run_saturating(folder / f"{stem}.onnx", inputs)))
        if there is not None:
            rows.append(("integer kernels, genuine, no VNNI", there[f"{stem}/all"]))
        for how, logits in rows:
            a = agreement(floats, logits)
            print(f"{title:<16}{how:<34}{100 * a.top1:>6.0f} %{a.cosine:>9.4f}{a.sqnr_db:>7.1f} dB")
        layers = layer_saturation(folder / f"{stem}.onnx", inputs[:2])
        risky = [layer for layer in layers if layer.risky_pairs > 0]
        worst = min(layers, key=lambda layer: layer.sqnr_db)
        print(
            f"{'':<16}{len(risky)} of {len(layers)} integer layers can saturate"
            + (f"; worst {worst.name}: {worst.sqnr_db:.1f} dB" if risky else "")
        )


if __name__ == "__main__":
    main()
