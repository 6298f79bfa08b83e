"""Where quantisation-aware training matters: a depthwise-separable student, one scale per tensor, few bits.

For each seed a network is trained in float32. Each row then quantises it twice on the same integer grid: from
calibration alone (PTQ), and after a short training with simulated quantisation (QAT). Mean IoU on test scenes.

    python benchmarks/opt_qat.py --seeds 2
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from robotbrain.optimisation import qat
from robotbrain.optimisation.data import scenes
from robotbrain.optimisation.evaluate import mean_iou
from robotbrain.optimisation.networks import build_depthwise, parameter_count
from robotbrain.optimisation.training import FitConfig, fit

GRIDS = ((8, True), (8, False), (4, True), (4, False))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--images", type=int, default=1200)
    parser.add_argument("--epochs", type=int, default=10, help="of the float32 training")
    parser.add_argument("--qat-epochs", type=int, default=3)
    parser.add_argument("--test", type=int, default=200)
    parser.add_argument("--width", type=int, default=8)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    begin = time.monotonic()
    train, calibration = scenes("train", arguments.images), scenes("calibration", 80).inputs()
    test = scenes("test", arguments.test)
    points: dict[str, list[tuple[float, float]]] = {}
    floats = []
    for seed in range(arguments.seeds):
        torch.manual_seed(seed)
        network = build_depthwise(arguments.width)
        fit(network, train, FitConfig(epochs=arguments.epochs, seed=seed), progress=False)
        floats.append(100 * mean_iou(network, test).mean)
        print(f"# seed {seed}: float32 {floats[-1]:.2f}  ({time.monotonic() - begin:.0f} s)", flush=True)
        for bits, per_channel in GRIDS:
            prepared = qat.prepare(network, torch.zeros(2, 3, 64, 64), weight_bits=bits, per_channel=per_channel)
            qat.calibrate(prepared, calibration)
            before = 100 * mean_iou(prepared, test).mean
            recipe = FitConfig(epochs=arguments.qat_epochs, learning_rate=2e-3, seed=seed)
            qat.finetune(prepared, train, recipe, progress=False)
            with tempfile.TemporaryDirectory() as folder:
                file = qat.export_qat_onnx(prepared, Path(folder) / "qat.onnx")
                after = 100 * mean_iou(file, test, optimise=False).mean
            name = f"{bits} bits per {'channel' if per_channel else 'tensor'}"
            points.setdefault(name, []).append((before - floats[-1], after - floats[-1]))
            print(f"# {name}: PTQ {before:.2f}, QAT {after:.2f}  ({time.monotonic() - begin:.0f} s)", flush=True)
    print(f"\nDepthwise student, {parameter_count(network) / 1e3:.0f} k parameters, {arguments.seeds} seeds")
    print(f"float32: {np.mean(floats):.2f} points of mean IoU on {arguments.test} test images")
    print(f"{'weights':<20}{'PTQ':>18}{'QAT':>18}   (points lost or won against float32: mean, worst seed)")
    for name, pairs in points.items():
        row = np.array(pairs)
        cells = "".join(f"{row[:, k].mean():>10.2f} ({row[:, k].min():+.2f})" for k in (0, 1))
        print(f"{name:<20}{cells}")


if __name__ == "__main__":
    main()
