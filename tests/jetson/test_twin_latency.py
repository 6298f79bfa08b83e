"""The latency model against closed forms and its invariants, on kernels and coefficients made up for it."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robotbrain.errors import InputError
from robotbrain.jetson.catalogue import list_modules, load_module
from robotbrain.jetson.kernels import Kernel, KernelGraph
from robotbrain.jetson.twin.calibrate import load_calibration
from robotbrain.jetson.twin.conditions import HARNESSES, PRECISIONS, Conditions, conditions
from robotbrain.jetson.twin.data import load_kernel_lists
from robotbrain.jetson.twin.fit import Fitted
from robotbrain.jetson.twin.latency import (
    COMPONENTS,
    CONV,
    DATA,
    DEPTHWISE,
    MATMUL,
    WINDOW_CONV,
    Batch,
    Effect,
    design,
    list_effects,
    make_work,
    unseen_variance,
)

# One teraflop in FP32, two in FP16, four in INT8; the CUDA cores half of it; 100 GB/s.
BOARD = Conditions(
    module="m",
    family="f",
    precision="fp16",
    harness="h",
    peak=(1e12, 2e12, 4e12),
    cuda_peak=(0.5e12, 1e12, 1e12),
    bandwidth=1e11,
    gpu_ghz=1.0,
)
CONV1X1 = Kernel("conv", macs=10**9, in_elems=10**6, out_elems=10**6, weight_elems=10**6)
LISTS = load_kernel_lists()


def graph(*kernels: Kernel) -> KernelGraph:
    return KernelGraph("g", kernels)


def toy(**values: float) -> Fitted:
    """Coefficients that are the same everywhere; given as factors and ms, ``clock`` as an exponent."""
    known = {"compute": 1.0, "window": 1.0, "depthwise": 1.0, "memory": 1.0, "matmul": 1.0}
    known |= {"launch": 1e-9, "clock": 1.0, "fixed": 1e-9, **values}
    effects = tuple(Effect(c.name, "", c.mean, c.sd) for c in COMPONENTS)
    logs = [known[c.name] if c.name == "clock" else math.log(known[c.name]) for c in COMPONENTS]
    return Fitted(effects, np.array(logs), np.zeros((len(effects), len(effects))))


def ms(fitted: Fitted, network: KernelGraph, where: Conditions = BOARD) -> float:
    return float(fitted.predict_ms([make_work(network, where)], [where])[0])


# -- closed forms


def test_a_compute_bound_kernel_takes_its_operations_over_the_peak() -> None:
    kernel = replace(CONV1X1, macs=10**12, weight_elems=10**9)
    expected = math.hypot(1e3 * 2e12 / 2e12, 1e3 * 2 * 1.002e9 / 1e11)
    assert ms(toy(), graph(kernel)) == pytest.approx(expected, rel=1e-6)
    assert ms(toy(compute=0.5), graph(kernel)) == pytest.approx(math.hypot(2000, 20.04), rel=1e-6)


def test_a_memory_bound_kernel_takes_its_bytes_over_the_bandwidth() -> None:
    kernel = Kernel("pw", 0, 3 * 10**7, 2 * 10**7, 0)
    for precision, size in zip(PRECISIONS, (4, 2, 1), strict=True):
        where = replace(BOARD, precision=precision)
        assert ms(toy(), graph(kernel), where) == pytest.approx(1e3 * 5e7 * size / 1e11)
        assert ms(toy(memory=0.25), graph(kernel), where) == pytest.approx(4e3 * 5e7 * size / 1e11)


def test_a_kernel_bound_by_both_takes_the_square_root_of_two_of_either() -> None:
    # 2e9 FLOPs at 2e12 is 1 ms; 5e7 elements of 2 bytes at 1e11 are 1 ms.
    kernel = Kernel("conv", 10**9, 2 * 10**7, 2 * 10**7, 10**7)
    assert ms(toy(), graph(kernel)) == pytest.approx(math.sqrt(2), rel=1e-6)


def test_launches_are_paid_by_kernel_and_the_fixed_cost_once() -> None:
    nothing = Kernel("mem:shape", 0, 0, 0, 0)
    fitted = toy(launch=0.02, fixed=0.3)
    for count in (1, 2, 50):
        assert ms(fitted, graph(*[nothing] * count)) == pytest.approx(0.3 + 0.02 * count)
    assert ms(fitted, graph(nothing), replace(BOARD, gpu_ghz=0.5)) == pytest.approx(0.3 + 0.04)
    slow = toy(launch=0.02, fixed=0.3, clock=2.0)
    assert ms(slow, graph(nothing), replace(BOARD, gpu_ghz=0.5)) == pytest.approx(0.3 + 0.08)


def test_depthwise_runs_on_the_cuda_cores_whatever_the_tensor_cores_do() -> None:
    kernel = Kernel("dw", 10**9, 1, 1, 1)
    expected = 1e3 * 2e9 / 1e12
    assert ms(toy(), graph(kernel)) == pytest.approx(expected, rel=1e-5)
    assert ms(toy(compute=0.1), graph(kernel)) == pytest.approx(expected, rel=1e-5)
    assert ms(toy(), graph(kernel), replace(BOARD, peak=(1e15, 1e15, 1e15))) == pytest.approx(expected, rel=1e-5)
    assert ms(toy(depthwise=0.1), graph(kernel)) == pytest.approx(10 * expected, rel=1e-5)


def test_matrix_products_have_a_gain_of_their_own_in_bandwidth() -> None:
    product = Kernel("mm", 0, 10**6, 10**6, 10**8)
    conv = replace(product, op="conv")
    assert ms(toy(matmul=1.5), graph(product)) == pytest.approx(ms(toy(), graph(product)) / 1.5, rel=1e-6)
    assert ms(toy(matmul=1.5), graph(conv)) == pytest.approx(ms(toy(), graph(conv)), rel=1e-9)


def conv_of(k: int, c_in: int, c_out: int, size: int, stride: int = 1, groups: int = 1) -> Kernel:
    out = (size // stride) ** 2 * c_out
    weights = k * k * c_in // groups * c_out
    return Kernel("conv", out * k * k * c_in // groups, size * size * c_in, out, weights)


@pytest.mark.parametrize(
    ("kernel", "kind"),
    [
        (conv_of(1, 64, 256, 56), CONV),
        (conv_of(3, 64, 64, 56), WINDOW_CONV),
        (conv_of(5, 64, 64, 56), WINDOW_CONV),
        (conv_of(7, 3, 64, 224, stride=2), WINDOW_CONV),
        (conv_of(1, 256, 512, 56, stride=2), CONV),
        (conv_of(3, 64, 64, 56, groups=32), CONV),
        (Kernel("dw", 9 * 10**5, 10**5, 10**5, 900), DEPTHWISE),
        (Kernel("mm", 10**6, 10**3, 10**3, 10**6), MATMUL),
        (Kernel("pw", 0, 10, 10, 0), DATA),
        (Kernel("mem:pool", 0, 10, 10, 0), DATA),
        (Kernel("conv", 0, 10, 10, 0), DATA),
    ],
)
def test_kinds_of_kernels_are_told_apart(kernel: Kernel, kind: int) -> None:
    assert make_work(graph(kernel), BOARD).kind[0] == kind


def test_the_gain_of_windows_is_theirs_alone() -> None:
    fitted = toy(window=1.25)
    window, plain = conv_of(3, 512, 512, 64), conv_of(1, 512, 2048, 64)
    assert ms(fitted, graph(window)) < 0.85 * ms(toy(), graph(window))
    assert ms(fitted, graph(plain)) == pytest.approx(ms(toy(), graph(plain)))


# -- precision


@pytest.mark.parametrize("asked", PRECISIONS)
def test_quantised_kernels_run_in_int8_and_the_rest_in_half_precision(asked: str) -> None:
    first, second = Kernel("pw", 0, 10**8, 0, 0, precision="int8"), Kernel("pw", 0, 10**8, 0, 0)
    sizes = {"fp32": 4.0, "fp16": 2.0, "int8": 2.0}
    work = make_work(graph(first, second), replace(BOARD, precision=asked))
    assert work.bytes_moved.tolist() == [1e8, sizes[asked] * 1e8]


def test_without_qdq_all_of_it_runs_in_int8() -> None:
    work = make_work(graph(CONV1X1, CONV1X1), replace(BOARD, precision="int8"))
    assert work.bytes_moved.tolist() == [3e6, 3e6]
    assert work.compute_ms.tolist() == pytest.approx([1e3 * 2e9 / 4e12] * 2)


@pytest.mark.parametrize("slug", ["nano-4gb", "tx2"])
@pytest.mark.parametrize("network", [LISTS["resnet50"], graph(replace(CONV1X1, precision="int8"), CONV1X1)])
@pytest.mark.parametrize("harness", HARNESSES)
def test_int8_is_fp16_where_nothing_speeds_it_up(slug: str, network: KernelGraph, harness: str) -> None:
    module, fitted = load_module(slug), load_calibration().latency
    int8, fp16 = (conditions(module, module.default_mode, p, harness) for p in ("int8", "fp16"))
    assert ms(fitted, network, int8) == ms(fitted, network, fp16)
    for where in (int8, fp16):
        assert make_work(network, where).bytes_moved.tolist() == [2.0 * kernel.elems for kernel in network.kernels]


# -- invariants on real networks with the stored calibration


@pytest.mark.parametrize("slug", list_modules())
@pytest.mark.parametrize("name", ["resnet50", "mobilenet_v1_1p0_224", "bert_large_384"])
def test_more_of_anything_is_never_slower(slug: str, name: str) -> None:
    module, fitted = load_module(slug), load_calibration().latency
    half = replace(module.default_mode, gpu_mhz=module.gpu_max_mhz / 2, emc_mhz=module.emc_max_mhz / 2, sms_on=1)
    for precision in PRECISIONS:
        for harness in HARNESSES:
            slow = ms(fitted, LISTS[name], conditions(module, half, precision, harness))
            for more in (
                {"gpu_mhz": module.gpu_max_mhz},
                {"emc_mhz": module.emc_max_mhz},
                {"sms_on": module.sm_count},
            ):
                mode = replace(half, **more)
                fast = ms(fitted, LISTS[name], conditions(module, mode, precision, harness))
                assert fast < slow or (fast == slow and "sms_on" in more and module.sm_count == 1), more


def terms(where: Conditions) -> tuple[Any, Any, Any]:
    fitted = load_calibration().latency
    return Batch([make_work(LISTS["resnet50"], where)], [where]).kernel_ms(fitted.parameters([where]))


@pytest.mark.parametrize("slug", ["nano-4gb", "xavier-nx", "agx-orin-64gb"])
def test_each_clock_scales_its_own_term(slug: str) -> None:
    module = load_module(slug)
    mode = module.mode("MAXN")
    compute, memory, launch = terms(conditions(module, mode, "fp16", "trtexec"))
    slow_gpu = terms(conditions(module, replace(mode, gpu_mhz=mode.gpu_mhz / 2), "fp16", "trtexec"))
    np.testing.assert_allclose(slow_gpu[0], 2 * compute)
    np.testing.assert_array_equal(slow_gpu[1], memory)
    assert (slow_gpu[2] > launch).all()
    slow_memory = terms(conditions(module, replace(mode, emc_mhz=mode.emc_mhz / 2), "fp16", "trtexec"))
    np.testing.assert_array_equal(slow_memory[0], compute)
    np.testing.assert_allclose(slow_memory[1], 2 * memory)
    np.testing.assert_array_equal(slow_memory[2], launch)


@pytest.mark.parametrize("name", sorted(LISTS))
def test_a_batch_takes_longer_than_one_and_less_than_one_after_another(name: str) -> None:
    module, fitted = load_module("orin-nano-8gb"), load_calibration().latency
    where = conditions(module, module.default_mode, "fp16", "trtexec")
    one, two, eight = (ms(fitted, LISTS[name].at_batch(batch), where) for batch in (1, 2, 8))
    assert one < two < 2 * one
    assert two < eight < 4 * two


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["conv", "dw", "mm", "pw", "mem:pool"]),
            st.integers(0, 10**13),
            *[st.integers(0, 10**9)] * 3,
        ),
        min_size=1,
        max_size=6,
    )
)
def test_any_kernels_give_finite_times_that_add_up(items: list[tuple[str, int, int, int, int]]) -> None:
    kernels = [Kernel(*item) for item in items]
    fitted = load_calibration().latency
    where = conditions(load_module("xavier-nx"), load_module("xavier-nx").default_mode, "int8", "ultralytics")
    whole = ms(fitted, graph(*kernels), where)
    fixed = float(np.exp(fitted.parameters([where])["fixed"][0]))
    assert math.isfinite(whole)
    assert whole == pytest.approx(fixed + sum(ms(fitted, graph(k), where) - fixed for k in kernels), rel=1e-6)
    assert ms(fitted, graph(*reversed(kernels)), where) == pytest.approx(whole)
    assert math.isfinite(fitted.log_sd(make_work(graph(*kernels), where), where))


def test_a_pair_without_kernels_takes_the_fixed_cost_and_disturbs_no_other() -> None:
    fitted = toy(launch=0.5, fixed=0.25)
    empty, full = make_work(graph(), BOARD), make_work(graph(CONV1X1, CONV1X1), BOARD)
    alone = ms(fitted, graph(CONV1X1, CONV1X1))
    together = Batch([empty, full, empty], [BOARD] * 3).latency_ms(fitted.parameters([BOARD] * 3))
    assert together.tolist() == pytest.approx([0.25, alone, 0.25])


@pytest.mark.parametrize("name", ["mobilenet_v1_1p0_224", "resnet50", "bert_large_384", "efficientvit_b1_224"])
@pytest.mark.parametrize("slug", ["nano-4gb", "agx-orin-64gb"])
def test_slopes_are_those_of_central_differences(name: str, slug: str) -> None:
    module = load_module(slug)
    where = [conditions(module, module.default_mode, p, "ultralytics") for p in ("fp32", "fp16")]
    batch = Batch([make_work(LISTS[name], c) for c in where], where)
    theta = load_calibration().latency.parameters(where)
    slopes = batch.log_slopes(theta)
    assert set(slopes) == {component.name for component in COMPONENTS}
    for component, slope in slopes.items():
        up, down = ({**theta, component: theta[component] + step} for step in (1e-5, -1e-5))
        expected = (np.log(batch.latency_ms(up)) - np.log(batch.latency_ms(down))) / 2e-5
        np.testing.assert_allclose(slope, expected, atol=1e-8, err_msg=component)


def test_slopes_of_kernels_that_do_nothing_are_finite() -> None:
    nothing = make_work(graph(Kernel("mem:shape", 0, 0, 0, 0)), BOARD)
    slopes = Batch([nothing], [BOARD]).log_slopes(toy().parameters([BOARD]))
    assert all(np.isfinite(slope).all() for slope in slopes.values())


# -- effects


def test_effects_are_summed_by_their_keys_and_unknown_ones_are_zero() -> None:
    here, there = BOARD, replace(BOARD, family="g", harness="mlperf", module="n")
    effects = list_effects([here])
    matrices = design(effects, [here, there])
    for component in COMPONENTS:
        names = [e.key for e in effects if e.component == component.name]
        assert len(names) == len(set(names)) == 1 + len(component.effects)
        assert matrices[component.name][0].sum() == 1 + len(component.effects)
        # Elsewhere only what does not name the place is known: the general level.
        assert matrices[component.name][1].sum() == 1
        assert unseen_variance(effects, here)[component.name] == 0
        assert unseen_variance(effects, there)[component.name] == pytest.approx(
            sum(sd**2 for _, sd in component.effects)
        )


def test_conditions_follow_the_power_mode() -> None:
    module = load_module("agx-orin-64gb")
    for mode in module.modes.values():
        where = conditions(module, mode, "FP16", "TRTEXEC")
        assert (where.precision, where.harness) == ("fp16", "trtexec")
        assert where.peak == pytest.approx([module.peak_flops(p, mode) for p in ("tf32", "fp16", "int8")])
        cuda = module.peak_flops("fp32", mode)
        assert where.cuda_peak == pytest.approx([cuda, 2 * cuda, 2 * cuda])
        assert where.bandwidth == pytest.approx(module.bandwidth(mode))


@pytest.mark.parametrize(("precision", "harness"), [("fp8", "trtexec"), ("fp16", "trt"), (None, "mlperf"), (16, "")])
def test_unknown_conditions_are_refused(precision: Any, harness: Any) -> None:
    module = load_module("nano-4gb")
    with pytest.raises(InputError, match=r"precision|harness"):
        conditions(module, module.default_mode, precision, harness)


def test_no_efficiency_of_a_plain_engine_beats_the_peak() -> None:
    """Compute efficiencies above 1 would put kernels above the roof of a roofline plot."""
    fitted = load_calibration().latency
    beaten: dict[tuple[str, str, str, str], float] = {}
    for slug in list_modules():
        module = load_module(slug)
        for precision in PRECISIONS:
            for harness in set(HARNESSES) - {"mlperf"}:  # its kernels do less than the lists say (fused by hand)
                theta = fitted.parameters([conditions(module, module.default_mode, precision, harness)])
                best = {
                    "conv": theta["compute"][0],
                    "window": theta["compute"][0] + theta["window"][0],
                    "depthwise": theta["depthwise"][0],
                    "memory": theta["memory"][0],
                }
                beaten |= {(slug, precision, harness, k): math.exp(v) for k, v in best.items() if v > math.log(1.05)}
    assert not beaten, json.dumps({"/".join(k): v for k, v in beaten.items()})
