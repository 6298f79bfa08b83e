"""The order of measurements and the arithmetic; how fast this machine is belongs to the benchmarks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from torch import nn

import robotbrain.optimisation.latency as latency
from robotbrain.errors import InputError
from robotbrain.optimisation.export import export_onnx
from robotbrain.optimisation.latency import HostLatency, host_latency, speedup


def test_files_take_turns_and_the_median_is_theirs(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a clock that only inferences advance, 1 ms for a, 3 ms for b; once the machine is ten times slower."""
    now, calls = [0.0], []

    class Session:
        def __init__(self, name: str) -> None:
            self.name = name

        def get_inputs(self) -> list[Any]:
            return [type("Input", (), {"name": "image", "shape": ["batch", 3, 8, 8]})()]

        def run(self, _: object, feed: dict[str, Any]) -> None:
            calls.append((self.name, feed["image"].shape))
            slow = 10.0 if 10 < now[0] * 1e3 <= 20 + 40 else 1.0
            now[0] += {"a": 1e-3, "b": 3e-3}[self.name] * slow

    monkeypatch.setattr(latency, "onnx_session", lambda path, threads: Session(Path(path).stem))
    monkeypatch.setattr(latency.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(latency.time, "process_time", lambda: now[0] / 2)
    result = host_latency({"a": Path("a.onnx"), "b": Path("b.onnx")}, rounds=5, min_ms=0.0, batch=2)
    assert [name for name, _ in calls[-10:]] == ["a", "b"] * 5
    assert {shape for _, shape in calls} == {(2, 3, 8, 8)}
    assert len(result["a"].rounds_ms) == 5
    assert result["a"].median_ms == pytest.approx(1.0) and result["b"].median_ms == pytest.approx(3.0)
    assert result["b"].cpu_ms == pytest.approx(1.5)
    assert result["a"].fastest_ms == min(result["a"].rounds_ms)


def test_a_ratio_pairs_neighbours() -> None:
    """Both slow down together in the second round: the ratio does not care, that of the medians might."""
    slow = HostLatency(12.0, 6.0, 8.0, (6.0, 60.0, 12.0), (8.0, 8.0, 9.0))
    fast = HostLatency(2.0, 2.0, 2.0, (2.0, 20.0, 2.0), (2.0, 2.0, 1.0))
    assert speedup(slow, fast) == 3.0
    assert speedup(slow, fast, cpu=True) == 4.0


def test_genuine_files_are_measured(tmp_path: Path) -> None:
    small = export_onnx(nn.Conv2d(3, 4, 1), tmp_path / "small.onnx")
    result = host_latency({"x": small}, rounds=2, min_ms=0.1)
    assert result["x"].median_ms > 0.0 and len(result["x"].rounds_ms) == 2


def test_mistakes_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="at least one file"):
        host_latency({})
    with pytest.raises(InputError, match="rounds"):
        host_latency({"x": tmp_path / "x.onnx"}, rounds=0)
    with pytest.raises(InputError, match="ONNX"):
        host_latency({"x": tmp_path / "x.onnx"})
