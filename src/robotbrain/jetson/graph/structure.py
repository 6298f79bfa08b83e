"""Order of the nodes, and branches of an If whose condition is known."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import onnx

from robotbrain.errors import InputError


def ordered(nodes: Iterable[Any], known: set[str]) -> list[Any]:
    """Return nodes such that each comes after those it reads from, otherwise as given.

    Args:
        nodes: NodeProtos.
        known: names of inputs and initialisers.

    Raises:
        InputError: if two nodes write one name, if a name has no origin, or if the nodes form a cycle.
    """
    listed = list(nodes)
    writer: dict[str, int] = {}
    for index, node in enumerate(listed):
        for output in node.output:
            if output and (output in writer or output in known):
                raise InputError(
                    f"tensor {output!r}",
                    given="written twice",
                    expected="one origin for each name",
                    fix="The file is damaged or was merged from two models; rename the tensors.",
                )
            if output:
                writer[output] = index
    waiting: dict[int, set[int]] = {}
    readers: dict[int, list[int]] = {}
    for index, node in enumerate(listed):
        needs = {writer[name] for name in reads(node) if name in writer}
        waiting[index] = needs
        for need in needs:
            readers.setdefault(need, []).append(index)
    if all(need < index for index, needs in waiting.items() for need in needs):
        return listed
    made: list[Any] = []
    free = [index for index in range(len(listed)) if not waiting[index]][::-1]
    while free:
        index = free.pop()
        made.append(listed[index])
        for reader in readers.get(index, ()):
            waiting[reader].discard(index)
            if not waiting[reader]:
                free.append(reader)
    if len(made) != len(listed):
        stuck = next(listed[index] for index, needs in waiting.items() if needs)
        raise InputError(
            "graph",
            given=f"a cycle through {stuck.op_type} {stuck.name!r}",
            expected="a graph without cycles",
            fix="ONNX graphs are acyclic; the file is damaged.",
        )
    return made


def reads(node: Any) -> list[str]:
    """Return the names a node reads, those captured by its subgraphs included."""
    names = [name for name in node.input if name]
    for attribute in node.attribute:
        for graph in (attribute.g, *attribute.graphs) if attribute.type in (5, 10) else ():
            inner = {output for child in graph.node for output in child.output}
            inner.update(tensor.name for tensor in graph.initializer)
            inner.update(info.name for info in graph.input)
            names.extend(name for child in graph.node for name in reads(child) if name not in inner)
            names.extend(info.name for info in graph.output if info.name not in inner)
    return names


def branch_nodes(node: Any, taken: bool) -> tuple[list[Any], list[tuple[str, Any]]]:
    """Return the nodes of an If's branch, renamed so that they fit into the outer graph, and its initialisers.

    Raises:
        InputError: if the branch is missing or has another number of outputs than the If.
    """
    label = "then_branch" if taken else "else_branch"
    graph = next((item.g for item in node.attribute if item.name == label), None)
    if graph is None or len(graph.output) != len(node.output):
        raise InputError(
            f"node {node.name or 'If'!r}",
            given=f"no {label} with {len(node.output)} outputs",
            expected="a branch with as many outputs as the If",
            fix="The file is damaged; export it again.",
        )
    prefix = f"{node.name or node.output[0]}/{label}/"
    inner = {output for child in graph.node for output in child.output if output}
    inner.update(tensor.name for tensor in graph.initializer)
    rename = {name: prefix + name for name in inner}
    made = [_renamed(child, rename) for child in ordered(graph.node, set())]
    for info, output in zip(graph.output, node.output, strict=True):
        made.append(onnx.helper.make_node("Identity", [rename.get(info.name, info.name)], [output]))
    return made, [(rename[tensor.name], tensor) for tensor in graph.initializer]


def _renamed(node: Any, rename: dict[str, str]) -> Any:
    copy = onnx.NodeProto()
    copy.CopyFrom(node)
    for names in (copy.input, copy.output):
        for position, name in enumerate(names):
            names[position] = rename.get(name, name)
    for attribute in copy.attribute:
        for graph in (attribute.g, *attribute.graphs) if attribute.type in (5, 10) else ():
            children = [_renamed(child, rename) for child in graph.node]
            del graph.node[:]
            graph.node.extend(children)
            for info in graph.output:
                info.name = rename.get(info.name, info.name)
    return copy
