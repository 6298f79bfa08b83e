"""The TensorRT engine does things in the right order in every version, and every wrong order is caught.

All of this runs on the simulated runtime; test_engine_jetson.py is the one that needs a board.
"""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.jetson.engine_models import SIZE, images, write

from robotbrain.errors import InputError
from robotbrain.jetson.engine import OnnxEngine, TensorRTEngine
from robotbrain.jetson.engine.build import BuildOptions
from robotbrain.jetson.engine.cuda import CudaError
from robotbrain.jetson.engine.runtime import TensorRTError
from robotbrain.jetson.engine.simulated import VERSIONS, MisuseError, simulated_runtime


@pytest.fixture
def model(tmp_path: Path) -> Path:
    return write(tmp_path / "tiny.onnx")


def opened(model: Path, version: str = "10.3", kind: type[TensorRTEngine] = TensorRTEngine, **more: Any) -> Any:
    return kind(
        model, BuildOptions(max_batch=4), cache=model.parent / "plans", runtime=simulated_runtime(version), **more
    )


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("kind", ["plain", "quantised", "half", "fixed", "two_outputs"])
def test_every_version_agrees_with_onnx_runtime(tmp_path: Path, version: str, kind: str) -> None:
    more = {} if kind == "plain" else {"batch": 2} if kind == "fixed" else {kind: True}
    path = write(tmp_path / "m.onnx", **more)
    reference = OnnxEngine(path)
    with opened(path, version) as engine:
        for batch in (2,) if kind == "fixed" else (1, 4, 2, 3, 1):  # shrinking and growing
            given = images(batch, seed=batch)
            np.testing.assert_allclose(engine.infer(given), reference.infer(given), rtol=1e-3, atol=1e-3)
        assert engine.backend == "simulated tensorrt" and "simulated" in repr(engine)
    assert engine.runtime.cuda.live == ()


def test_memory_is_allocated_once_and_results_are_copies(model: Path) -> None:
    with opened(model) as engine:
        before = list(engine.runtime.cuda.calls)
        first = engine.infer(images(2, seed=1))
        kept = first.copy()
        engine.infer(images(2, seed=2))
        np.testing.assert_array_equal(first, kept)
        later = engine.runtime.cuda.calls[len(before) :]
        assert not {"malloc", "host_alloc", "free", "host_free", "stream_create"} & set(later)
        once = ["copy_to_device", "execute", "copy_to_host", "stream_synchronize"]
        runs = ["run: copy_to_device", "run: execute", "run: copy_to_host"]
        assert later == (once + runs) * 2


# ---------------------------------------------------------------- wrong engines: each must be caught


class NoSynchronise(TensorRTEngine):
    """Reads the output without waiting for the stream."""

    def infer(self, batch: Any) -> Any:
        shapes = self._prepare(batch)
        self._enqueue(batch.nbytes, shapes)
        return np.array(self._outputs[0].view(shapes["logits"]))


class CopiesOutFirst(TensorRTEngine):
    """Enqueues the copy to the host before the network."""

    def _enqueue(self, size: int, shapes: Any) -> None:
        cuda, out = self.runtime.cuda, self._outputs[0]
        cuda.copy_to_device(self._input.device, self._input.host, size, self._stream)
        cuda.copy_to_host(out.host, out.device, out.view(shapes[out.name]).nbytes, self._stream)
        self._execute()


class ForgetsInput(TensorRTEngine):
    """Never copies the input to the device."""

    def _enqueue(self, size: int, shapes: Any) -> None:
        out = self._outputs[0]
        self._execute()
        self.runtime.cuda.copy_to_host(out.host, out.device, out.view(shapes[out.name]).nbytes, self._stream)


class SwapsHostAndDevice(TensorRTEngine):
    """Copies the input into host memory, as the outline's listing does."""

    def _enqueue(self, size: int, shapes: Any) -> None:
        self.runtime.cuda.copy_to_device(self._input.host, self._input.device, size, self._stream)


class PageableSource(TensorRTEngine):
    """Copies from an ordinary array, which an asynchronous copy must not."""

    def infer(self, batch: Any) -> Any:
        self._prepare(batch)
        self.runtime.cuda.copy_to_device(self._input.device, batch.ctypes.data, batch.nbytes, self._stream)


class DefaultStream(TensorRTEngine):
    """Runs in stream 0."""

    def _execute(self) -> None:
        self._context.execute_async_v3(0)


class OverwritesInput(TensorRTEngine):
    """Fills the host buffer again while the copy from it is still to run."""

    def _enqueue(self, size: int, shapes: Any) -> None:
        super()._enqueue(size, shapes)
        self._input.view((1, 3, SIZE, SIZE))[:] = 0


class FreesEarly(TensorRTEngine):
    """Frees the input's memory before the stream has used it."""

    def _enqueue(self, size: int, shapes: Any) -> None:
        super()._enqueue(size, shapes)
        self.runtime.cuda.free(self._input.device)


class UsesFreed(TensorRTEngine):
    """Frees first and copies then."""

    def _enqueue(self, size: int, shapes: Any) -> None:
        self.runtime.cuda.free(self._input.device)
        super()._enqueue(size, shapes)


class TooManyBytes(TensorRTEngine):
    """Takes the number of values for the number of bytes, the wrong way round."""

    def _enqueue(self, size: int, shapes: Any) -> None:
        super()._enqueue(4 * size, shapes)


class HostAddresses(TensorRTEngine):
    """Gives TensorRT the addresses of the host."""

    def _prepare(self, given: Any) -> Any:
        self._context.set_tensor_address(self._input.name, self._input.host)
        return super()._prepare(given)


class StaleShape(TensorRTEngine):
    """Asks for the output's shape before setting the input's."""

    def _prepare(self, given: Any) -> Any:
        shapes = {out.name: tuple(self._context.get_tensor_shape(out.name)) for out in self._outputs}
        super()._prepare(given)
        return shapes


SILENT = [NoSynchronise, CopiesOutFirst, ForgetsInput]
LOUD = [
    (SwapsHostAndDevice, "host-pointer"),
    (PageableSource, "unknown-pointer"),
    (DefaultStream, "stream"),
    (OverwritesInput, "overwritten"),
    (FreesEarly, "freed-early"),
    (UsesFreed, "use-after-free"),
    (TooManyBytes, "overrun"),
    (HostAddresses, "host-pointer"),
]


@pytest.mark.parametrize("kind", SILENT)
def test_a_wrong_order_shows_as_poison(model: Path, kind: type[TensorRTEngine]) -> None:
    engine = opened(model, kind=kind)
    assert np.isnan(engine.infer(images(1))).all()


@pytest.mark.parametrize(("kind", "word"), LOUD)
def test_misuse_of_memory_is_named(model: Path, kind: type[TensorRTEngine], word: str) -> None:
    engine = opened(model, kind=kind)
    with pytest.raises(MisuseError) as caught:
        engine.infer(images(4))
    assert caught.value.kind == word and "simulated" in str(caught.value)


def test_a_stale_shape_shows_in_the_output(model: Path) -> None:
    with opened(model, kind=StaleShape) as engine:
        assert engine.infer(images(1)).shape != (1, 4)  # that of the largest batch, from the allocation


def test_memory_that_was_not_given_back_is_seen(model: Path) -> None:
    class Leaks(TensorRTEngine):
        def close(self) -> None:
            pass

    engine = opened(model, kind=Leaks)
    engine.close()
    assert len(engine.runtime.cuda.live) == 5  # two buffers on each side, one stream


@pytest.mark.parametrize("version", VERSIONS)
def test_the_outlines_listing_is_caught(model: Path, version: str) -> None:
    """``execute_v2`` with host addresses: the call still exists in TensorRT 11, the mistake is the addresses."""
    engine = opened(model, version)
    engine._context.set_input_shape("image", (1, 3, SIZE, SIZE))
    with pytest.raises(MisuseError, match="host-pointer"):
        engine._context.execute_v2([engine._input.host, engine._outputs[0].host])
    assert engine._context.execute_v2([engine._input.device, engine._outputs[0].device])
    assert hasattr(engine._engine, "num_bindings") == version.startswith("8.")


# ---------------------------------------------------------------- errors and closing


def test_inputs_that_do_not_fit_are_refused_and_the_engine_lives_on(model: Path) -> None:
    with opened(model) as engine:
        good = images(1)
        for wrong, words in (
            (good.astype(np.float64), "float32"),
            (good[:, :, :, :-1], "float32"),
            (good[0], "float32"),
            (good[:0], "float32"),
            (np.full_like(good, np.nan), "finite"),
            (images(5), "at most 4"),
        ):
            with pytest.raises(InputError, match=words):
                engine.infer(wrong)
        assert engine.infer(good).shape == (1, 4)


def test_closing_frees_everything_once(model: Path) -> None:
    engine = opened(model)
    engine.close()
    engine.close()
    assert engine.runtime.cuda.live == ()
    with pytest.raises(InputError, match=r"close\(\)"):
        engine.infer(images(1))


@pytest.mark.parametrize("failing", ["host_alloc", "stream_create", "create_execution_context"])
def test_what_fails_while_opening_leaves_nothing_behind(
    model: Path, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    runtime = simulated_runtime("10.3")

    def fail(*_: object) -> int:
        raise CudaError(failing, 999, "unknown error")

    if failing == "create_execution_context":
        monkeypatch.setattr(TensorRTEngine, "_make_context", fail)
    else:
        monkeypatch.setattr(runtime.cuda, failing, fail)
    with pytest.raises(CudaError, match="unknown error"):
        TensorRTEngine(model, cache=model.parent, runtime=runtime)
    assert runtime.cuda.live == ()


def test_too_little_memory_says_what_to_lower(model: Path) -> None:
    runtime = simulated_runtime("10.3", memory_bytes=1000)
    with pytest.raises(InputError, match=r"max_batch.*") as caught:
        TensorRTEngine(model, cache=model.parent, runtime=runtime)
    assert "memory" in caught.value.what and runtime.cuda.live == ()


def test_a_failed_execution_leaves_idle_buffers(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with opened(model) as engine:
        given = images(1)
        with monkeypatch.context() as patch:
            patch.setattr(type(engine._context), "execute_async_v3", lambda *_: False)
            with pytest.raises(TensorRTError, match="execute_async_v3"):
                engine.infer(given)
        np.testing.assert_allclose(engine.infer(given), OnnxEngine(model).infer(given), atol=1e-5)


def test_threads_take_turns(model: Path) -> None:
    reference, results = OnnxEngine(model), dict[int, Any]()
    with opened(model) as engine:

        def work(seed: int) -> None:
            results[seed] = [engine.infer(images(1 + seed % 4, seed=seed)) for _ in range(10)]

        threads = [threading.Thread(target=work, args=(seed,)) for seed in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    for seed, found in results.items():
        expected = reference.infer(images(1 + seed % 4, seed=seed))
        assert len(found) == 10
        for one in found:
            np.testing.assert_allclose(one, expected, atol=1e-5)


def test_no_latency_comes_from_the_simulated_runtime(model: Path) -> None:
    with opened(model) as engine:
        assert engine.latency_ns == 0 and engine.timing == ""
        with pytest.raises(InputError, match="genuine TensorRT"):
            engine.measure(images(1))
        with pytest.raises(MisuseError, match="no-clock"):
            engine.runtime.cuda.event_elapsed_ms(1, 2)


def test_measuring_times_runs_after_the_warm_up(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The arithmetic of ``measure``, with made-up times; the label on them would be TensorRT's."""
    with opened(model) as engine:
        times = iter([1.0, 2.0, 9.0])
        monkeypatch.setattr(engine.runtime.cuda, "event_elapsed_ms", lambda *_: next(times))
        monkeypatch.setattr(type(engine.runtime), "simulated", False)
        latency = engine.measure(images(2), runs=3, warmup=2)
        assert (latency.median_ms, latency.runs, latency.batch) == (2.0, 3, 2)
        assert engine.runtime.cuda.calls.count("run: execute") == 1 + 2 + 3
        assert latency.source == "TensorRT on this board" and latency.p99_ms == pytest.approx(8.86)
        assert "simulated" in latency.harness and "CUDA events" in latency.harness
    assert engine.runtime.cuda.live == ()
