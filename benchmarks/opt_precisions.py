"""What INT8 and FP16 bring on a Jetson: the twin's ratios against published ones, and the kit's own networks.

Run with ``python benchmarks/opt_precisions.py`` (about 15 s on one core). A ratio is the latency in the lower precision
over that in the higher one, for the same network, module, mode, harness and source, one input at a time. First every
published pair beside the twin's ratio; then the errors with the network, the architecture or the module left out of the
fit, in all precisions at once; ``peaks`` is what the data sheet's peaks alone would say. Last, per module, predicted
latencies of the kit's own networks.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from robotbrain.jetson.catalogue import list_modules, load_module
from robotbrain.jetson.tables import format_table
from robotbrain.jetson.twin import PRECISIONS, predict
from robotbrain.jetson.twin.calibrate import load_calibration
from robotbrain.jetson.twin.data import load_latency_rows
from robotbrain.jetson.twin.precisions import (
    LEFT_OUT,
    PROMISE,
    PrecisionPair,
    pairs_left_out,
    precision_pairs,
    predict_rows,
)
from robotbrain.optimisation.networks import network_path
from robotbrain.pipeline.brain import default_model


def name(pair: PrecisionPair) -> tuple[str, str, str, str]:
    """Return module, network, harness and ratio."""
    row = pair.lower.row
    return row.module, row.kernels, row.harness, pair.kind


def summary(what: str, pairs: Sequence[PrecisionPair]) -> list[str]:
    """Return one line: errors of some pairs, and those of the data sheet's peaks on the same."""
    errors = np.abs([pair.error for pair in pairs])
    peaks = np.abs([pair.peaks / pair.published - 1 for pair in pairs])
    cells = [f"{len(pairs)}", f"{np.median(errors):.1%}", f"{errors.max():.1%}", f"{np.mean(errors <= PROMISE):.0%}"]
    return [what, *cells, f"{np.median(peaks):.0%}", f"{np.mean(peaks <= PROMISE):.0%}"]


def by_kind(what: str, pairs: Sequence[PrecisionPair]) -> list[list[str]]:
    """Return a line for each kind of ratio."""
    kinds = dict.fromkeys(pair.kind for pair in pairs)
    return [summary(f"{what}, {kind}", [pair for pair in pairs if pair.kind == kind]) for kind in sorted(kinds)]


def published() -> None:
    """Print every published pair, and how well the twin does when it has not seen it."""
    fitted, rows = load_calibration().latency, load_latency_rows()
    seen = precision_pairs(predict_rows(rows, fitted))
    outside = precision_pairs(predict_rows(load_latency_rows(uses=("check",)), fitted))
    table = [
        [*name(p), f"{p.published:.2f}", f"{p.predicted:.2f}", f"{p.error:+.1%}", "" if p in seen else "in no fit"]
        for p in (*seen, *outside)
    ]
    head = ["module", "network", "harness", "ratio", "published", "twin", "error", ""]
    print(format_table(head, table, left=(0, 1, 2, 3, 7)) + "\n")
    lines = [*by_kind("all, in the fit", seen), *by_kind("in no fit", outside)]
    misses = []
    for what, key in LEFT_OUT.items():
        pairs = pairs_left_out(rows, key, fitted)
        lines += by_kind(f"{what} left out", pairs)
        misses += [(what, p) for p in pairs if abs(p.error) > PROMISE]
    head = ["what the fit has seen", "pairs", "median", "largest", "within 25 %", "peaks: median", "peaks: within"]
    print(format_table(head, lines, left=(0,)))
    for what, p in misses:
        told = f"published {p.published:.2f}, twin {p.predicted:.2f}"
        print(f"beyond 25 % with the {what} left out: {' '.join(name(p))}: {told}")


def own(harness: str) -> None:
    """Print predicted latencies of the kit's networks on every module, in its default mode."""
    networks: dict[str, Path] = {"segmentation": Path(default_model())}
    networks |= {network: network_path(network) for network in ("teacher", "student")}
    for network, path in networks.items():
        rows = []
        for slug in list_modules():
            module = load_module(slug)
            ms = {p: predict(path, module, precision=p, harness=harness).latency_ms for p in PRECISIONS}
            fast = module.int8_tops is not None
            cells = [f"{ms['fp32']:.3f}", f"{ms['fp16']:.3f}", f"{ms['int8']:.3f}" if fast else "none"]
            cells += [f"{ms['fp16'] / ms['fp32']:.2f}", f"{ms['int8'] / ms['fp16']:.2f}" if fast else "-"]
            rows.append([slug, module.default_mode.name, *cells])
        print(f"\n{network}: predicted, ms, timed as by {harness}")
        head = ["module", "mode", "FP32", "FP16", "INT8", "FP16/FP32", "INT8/FP16"]
        print(format_table(head, rows, left=(0, 1)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--harness", default="trtexec", help="way of timing to predict for the kit's own networks")
    arguments = parser.parse_args()
    published()
    own(arguments.harness)


if __name__ == "__main__":
    main()
