"""Kernels and graphs of kernels: what they refuse, batches, and lists of plain mappings."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robotbrain.errors import InputError
from robotbrain.jetson.kernels import Kernel, KernelGraph
from robotbrain.jetson.paths import find_part

GOOD: dict[str, Any] = {"op": "conv", "macs": 1000, "in_elems": 10, "out_elems": 20, "weight_elems": 30}
COUNTS = ("macs", "in_elems", "out_elems", "weight_elems")
LISTS: dict[str, list[dict[str, Any]]] = json.loads(find_part("calibration/kernels.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("op", ["conv", "dw", "mm", "pw", "mem:pool", "mem"])
def test_the_classes_of_work_are_accepted(op: str) -> None:
    assert Kernel(**{**GOOD, "op": op}).computes == (op in ("conv", "dw", "mm"))


@pytest.mark.parametrize("op", ["", "Conv", "relu", ":mem", "convolution"])
def test_another_class_of_work_is_refused(op: str) -> None:
    with pytest.raises(InputError, match="op"):
        Kernel(**{**GOOD, "op": op})


@pytest.mark.parametrize("field", COUNTS)
@pytest.mark.parametrize("value", [-1, 1.0, True, None, "3", float("nan")])
def test_a_count_that_is_none_is_refused_by_name(field: str, value: object) -> None:
    with pytest.raises(InputError, match=field):
        Kernel(**{**GOOD, field: value})


def test_an_unknown_precision_is_refused() -> None:
    with pytest.raises(InputError, match="precision"):
        Kernel(**GOOD, precision="fp8")


def test_intensity_is_operations_over_bytes() -> None:
    assert Kernel(**GOOD).intensity(2.0) == 2 * 1000 / (60 * 2.0)
    assert Kernel("pw", 0, 0, 0, 0).intensity(4.0) == 0.0


@given(st.integers(1, 64), st.integers(1, 64))
def test_batches_multiply(first: int, second: int) -> None:
    graph = KernelGraph("g", (Kernel(**GOOD),), weight_elems=30, weight_bytes=120, peak_activation_elems=30)
    assert graph.at_batch(first).at_batch(second) == graph.at_batch(first * second)
    batched = graph.at_batch(first)
    assert batched.macs == first * graph.macs
    assert batched.peak_activation_elems == first * graph.peak_activation_elems
    kernel = batched.kernels[0]
    assert (kernel.macs, kernel.in_elems, kernel.out_elems) == (1000 * first, 10 * first, 20 * first)
    # Weights are read once, however many inputs there are.
    assert batched.kernels[0].weight_elems == 30
    assert (batched.weight_elems, batched.weight_bytes) == (30, 120)


@pytest.mark.parametrize("batch", [0, -1, 1.5, 2.0, True, "2", None])
def test_a_batch_that_is_no_count_is_refused(batch: Any) -> None:
    with pytest.raises(InputError, match="batch"):
        KernelGraph("g", (Kernel(**GOOD),)).at_batch(batch)


@pytest.mark.parametrize("name", sorted(LISTS))
def test_every_list_of_the_kit_is_read(name: str) -> None:
    graph = KernelGraph.from_list(LISTS[name], name)
    assert graph.name == name
    assert len(graph.kernels) == len(LISTS[name])
    assert graph.macs == sum(item["macs"] for item in LISTS[name])
    assert graph.weight_elems == sum(item["weight_elems"] for item in LISTS[name])
    assert graph.peak_activation_elems == max(item["in_elems"] + item["out_elems"] for item in LISTS[name])
    assert [kernel.op for kernel in graph.kernels] == [item["op"] for item in LISTS[name]]


# Multiply-accumulates and parameters as the architectures' papers and torchvision's documentation state them.
LITERATURE = {
    "alexnet": (0.714e9, 61.1e6),
    "resnet18": (1.814e9, 11.69e6),
    "resnet50": (4.089e9, 25.56e6),
    "resnet152": (11.51e9, 60.19e6),
    "vgg16": (15.47e9, 138.4e6),
    "densenet121": (2.834e9, 7.98e6),
    "squeezenet1_0": (0.819e9, 1.25e6),
    "mobilenet_v1_1p0_224": (0.569e9, 4.24e6),
    "mnasnet1_3": (0.526e9, 6.28e6),
}


@pytest.mark.parametrize("name", sorted(LITERATURE))
def test_the_lists_agree_with_the_literature(name: str) -> None:
    graph = KernelGraph.from_list(LISTS[name], name)
    macs, parameters = LITERATURE[name]
    assert graph.macs == pytest.approx(macs, rel=0.02)
    # The literature counts batch norms too, which are fused away.
    assert graph.weight_elems == pytest.approx(parameters, rel=0.02)


@pytest.mark.parametrize("field", ["op", *COUNTS])
def test_a_missing_field_is_named_with_its_kernel(field: str) -> None:
    broken = {key: value for key, value in GOOD.items() if key != field}
    with pytest.raises(InputError, match="kernel 1 of mine"):
        KernelGraph.from_list([GOOD, broken], "mine")


@pytest.mark.parametrize("item", [None, 3, "conv", [1, 2], {}])
def test_an_item_that_is_no_kernel_is_refused(item: Any) -> None:
    with pytest.raises(InputError, match="kernel 0 of"):
        KernelGraph.from_list([item])


def test_an_empty_list_is_refused() -> None:
    with pytest.raises(InputError, match="no kernels"):
        KernelGraph.from_list([])


def test_numbers_of_any_size_are_exact() -> None:
    huge = 10**30 + 1
    assert KernelGraph.from_list([{**GOOD, "macs": huge}]).at_batch(3).macs == 3 * huge
