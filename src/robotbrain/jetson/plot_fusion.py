"""Figure of what becomes of an ONNX file's nodes: which run together as one kernel, and which vanish."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from robotbrain.errors import InputError
from robotbrain.figures import BLUE, GREEN, INK, MAUVE, QUIET, SKY, VERMILLION, new_figure, text_on, title
from robotbrain.jetson.graph import analyse

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    from robotbrain.jetson.kernels import KernelGraph

NODES: dict[str, tuple[str, str]] = {
    "Conv": ("C", "#B9DDF6"),
    "Relu": ("R", "#FFF6B0"),
    "Resize": ("U", "#F7D9B8"),
    "Concat": ("J", "#E3C8DA"),
    "QuantizeLinear": ("Q", "#A9D8C6"),
    "DequantizeLinear": ("D", "#D5EEE4"),
}
"""Letter and tint of an operator; others are grey without a letter."""

KERNELS: dict[str, tuple[str, str]] = {
    "conv": ("convolution", BLUE),
    "dw": ("depthwise convolution", SKY),
    "mm": ("matrix product", GREEN),
    "pw": ("pointwise", MAUVE),
    "mem": ("data movement", VERMILLION),
}
"""Name and colour of a class of kernels."""


def fusion(path: str | Path) -> tuple[list[tuple[str, int | None]], KernelGraph]:
    """Return what becomes of each node, and the kernels.

    Args:
        path: of an ONNX file.

    Returns:
        ``(operator, index of the kernel that it runs in, or None)`` for each node in the file's order, and the graph.

    Raises:
        InputError: for a file that cannot be analysed.
    """
    import onnx

    graph = analyse(path)
    home = {layer: index for index, kernel in enumerate(graph.kernels) for layer in kernel.layers}
    nodes = onnx.load(str(path), load_external_data=False).graph.node
    return [(node.op_type, home.get(node.name)) for node in nodes], graph


def plot_fusion(networks: Mapping[str, str | Path], longest: int = 120) -> Figure:
    """Return a strip for each network: its ONNX nodes above, the kernels that TensorRT would make of them below.

    Args:
        networks: ONNX files by title.
        longest: most nodes of a network that can be drawn.

    Raises:
        InputError: for no network, one with too many nodes, or one that cannot be analysed.
    """
    found = {name: fusion(path) for name, path in networks.items()}
    most = max((len(nodes) for nodes, _ in found.values()), default=0)
    if not 1 <= most <= longest:
        raise InputError(
            "networks", given=f"{most} nodes", expected=f"1 to {longest} nodes in each", fix="Choose a smaller network."
        )
    figure = new_figure(10.0, 0.7 + 1.55 * len(found))
    words = []
    for axes, (name, (nodes, graph)) in zip(
        figure.subplots(len(found), squeeze=False)[:, 0], found.items(), strict=True
    ):
        _draw(axes, nodes, graph)
        gone = sum(home is None for _, home in nodes)
        text = f"{name}: {len(nodes)} ONNX nodes, {gone} of which vanish, become {len(graph.kernels)} kernels"
        title(axes, text)
        axes.set(xlim=(-0.2, most + 0.2), ylim=(-0.15, 2.4))
        axes.axis("off")
        words.append(text)
    _legend(figure, found)
    figure.set_label(
        "Nodes of ONNX files in their order, and below them the kernels they run in. " + "; ".join(words) + "."
    )
    return figure


def _draw(axes: Axes, nodes: list[tuple[str, int | None]], graph: KernelGraph) -> None:
    spans: dict[int, list[int]] = {}
    for place, (operator, home) in enumerate(nodes):
        letter, colour = NODES.get(operator, ("", "#D9D9D9"))
        axes.add_patch(_box(place, 1.4, 1, 0.75, colour, 1.0 if home is not None else 0.45))
        axes.text(place + 0.5, 1.77, letter, ha="center", va="center", fontsize=8, color=INK)
        if home is None:
            axes.plot([place + 0.25, place + 0.75], [1.05, 1.25], color=QUIET, lw=0.9)
            axes.plot([place + 0.25, place + 0.75], [1.25, 1.05], color=QUIET, lw=0.9)
        else:
            spans.setdefault(home, []).append(place)
    for home, places in spans.items():
        colour = KERNELS[graph.kernels[home].op.partition(":")[0]][1]
        first, last = min(places), max(places) + 1
        axes.add_patch(_box(first, 0.0, last - first, 0.75, colour, 1.0))
        axes.text((first + last) / 2, 0.37, f"{home + 1}", ha="center", va="center", fontsize=8, color=text_on(colour))
        for place in places:
            axes.plot([place + 0.5, place + 0.5], [0.78, 1.37], color=QUIET, lw=0.8)


def _box(x: float, y: float, width: float, height: float, colour: str, alpha: float) -> Rectangle:
    from matplotlib.patches import Rectangle

    return Rectangle((x + 0.06, y), width - 0.12, height, facecolor=colour, edgecolor=INK, lw=0.5, alpha=alpha)


def _legend(figure: Figure, found: Mapping[str, tuple[list[tuple[str, int | None]], KernelGraph]]) -> None:
    from matplotlib.patches import Patch

    operators = {operator for nodes, _ in found.values() for operator, _ in nodes}
    kinds = {kernel.op.partition(":")[0] for _, graph in found.values() for kernel in graph.kernels}
    handles = [
        Patch(facecolor=c, edgecolor=INK, lw=0.5, label=f"{t} {n}") for n, (t, c) in NODES.items() if n in operators
    ]
    handles.append(Patch(facecolor="#D9D9D9", edgecolor=INK, lw=0.5, label="other node"))
    handles += [
        Patch(facecolor=c, edgecolor=INK, lw=0.5, label=f"kernel: {n}") for k, (n, c) in KERNELS.items() if k in kinds
    ]
    rows = -(-len(handles) // 8)
    figure.legend(
        handles=handles,
        loc="outside lower center",
        ncols=-(-len(handles) // rows),
        frameon=False,
        fontsize=8.5,
        handlelength=1,
    )
