"""What do zeros in the weights save, and what do missing channels?

The student at several unstructured sparsities, with a 2:4 pattern, and with channels removed: latency in ONNX Runtime
(one thread, in turns with the dense one: ratio of the turns, 1 means no gain), the twin's prediction, sizes. Nothing is
trained on after pruning, because only time and size are of interest.

Usage: python benchmarks/opt_sparsity.py [--network student] [--module orin-nano-8gb] [--rounds 15]
"""

from __future__ import annotations

import argparse
import gzip
import tempfile
from collections.abc import Callable
from pathlib import Path

import torch
from torch import nn

from robotbrain.jetson import predict
from robotbrain.jetson.tables import format_table, short
from robotbrain.optimisation.export import export_onnx
from robotbrain.optimisation.latency import host_latency, speedup
from robotbrain.optimisation.networks import load_network
from robotbrain.optimisation.pruning import MaskedPruning, l1_masks, sparsity_of
from robotbrain.optimisation.semi_structured import SOURCES, advice, two_four_masks
from robotbrain.optimisation.structured import prune_channels


def variants() -> dict[str, Callable[[nn.Module], nn.Module]]:
    """Return what is done to the network, by name; the first is nothing."""

    def zeros(share: float) -> Callable[[nn.Module], nn.Module]:
        return lambda network: MaskedPruning(network, l1_masks(network, share)).make_permanent()

    def channels(ratio: float) -> Callable[[nn.Module], nn.Module]:
        return lambda network: prune_channels(network, torch.zeros(1, 3, 64, 64), ratio)

    return {
        "dense": lambda network: network,
        **{f"{share:.0%} zeros": zeros(share) for share in (0.5, 0.8, 0.95)},
        "2:4 zeros": lambda network: MaskedPruning(network, two_four_masks(network)).make_permanent(),
        **{f"{ratio:.0%} fewer channels": channels(ratio) for ratio in (0.25, 0.5)},
    }


def main() -> None:
    """Measure and print one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--network", default="student")
    parser.add_argument("--module", default="orin-nano-8gb")
    parser.add_argument("--rounds", type=int, default=15)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        paths, zeros = {}, {}
        for index, (name, change) in enumerate(variants().items()):
            network = change(load_network(arguments.network))
            zeros[name] = sparsity_of(network)
            paths[name] = export_onnx(network, Path(folder) / f"{index}.onnx")
        times = host_latency(paths, rounds=arguments.rounds)
        rows = []
        for name, path in paths.items():
            content = path.read_bytes()
            twin = predict(path, arguments.module, precision="fp16")
            ratio = [f"{speedup(times['dense'], times[name], cpu=cpu):.2f}" for cpu in (False, True)]
            cells = [name, f"{zeros[name]:.0%}", short(times[name].median_ms), *ratio, f"{twin.latency_ms:.4f}"]
            rows.append([*cells, short(len(content) / 1e3), short(len(gzip.compress(content, 9)) / 1e3)])
    head = ["network", "zeros", "here (ms)", "times faster", "by CPU time"]
    head += [f"twin, {arguments.module}, fp16 (ms)", "file (kB)", "gz (kB)"]
    print(format_table(head, rows))
    print("\n2:4: " + advice(load_network(arguments.network), arguments.module).text)
    print("Published: " + "; ".join(SOURCES))


if __name__ == "__main__":
    main()
