"""What a training says about itself: JSON lines that survive a kill, TensorBoard where installed, a progress bar.

A line of ``metrics.jsonl`` is ``{"step": 2048, "elapsed_s": 3.1, "values": {"return": 0.5}}``: environment steps so
far, wall-clock seconds of training so far (pauses between resumed sessions not counted), and figures by name. A figure
that is not finite is ``null``.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from robotbrain.errors import InputError, MissingDependencyError
from robotbrain.files import write_bytes, write_text

METRICS_FILE = "metrics.jsonl"
SETTINGS_FILE = "run.json"
TENSORBOARD_FOLDER = "tensorboard"


@dataclass(frozen=True)
class Series:
    """One figure over a training; the arrays are of one length, in the order of logging.

    Attributes:
        step: environment steps so far, int64.
        elapsed_s: wall-clock seconds of training so far.
        value: the figure, NaN where it was not finite.
    """

    step: NDArray[np.int64]
    elapsed_s: NDArray[np.float64]
    value: NDArray[np.float64]


@dataclass(frozen=True)
class Run:
    """What a run logged: its folder (None where there is none), its settings, and its figures by name."""

    folder: Path | None
    settings: dict[str, Any]
    series: dict[str, Series]

    def __getitem__(self, name: str) -> Series:
        """Return the figure ``name``.

        Raises:
            InputError: when it was not logged.
        """
        if name not in self.series:
            raise InputError(
                "name of a figure",
                given=name,
                expected=", ".join(sorted(self.series)) or "nothing, since nothing was logged",
                fix="Names are as in TensorBoard.",
            )
        return self.series[name]


class RunLog:
    """Writes figures of a training into its folder.

    Args:
        run_dir: folder of the run; made when it is not there. None keeps the log in memory only.
        resume_step: continue after this many environment steps; lines beyond it, logged after the checkpoint that is
            being resumed, are removed. None starts anew.
        tensorboard: True insists, False leaves it out, None writes it where the package is installed.

    A context manager; :meth:`close` otherwise. Each line is flushed when written, so a killed process loses at most the
    line that it was writing.

    Raises:
        MissingDependencyError: when TensorBoard is insisted on and missing.
    """

    def __init__(
        self, run_dir: str | Path | None, *, resume_step: int | None = None, tensorboard: bool | None = None
    ) -> None:
        self.folder = None if run_dir is None else Path(run_dir)
        self._settings: dict[str, Any] = {}
        self._lines: list[dict[str, Any]] = []
        self._file: TextIO | None = None
        self._writer: Any = None
        if self.folder is not None:
            self.folder.mkdir(parents=True, exist_ok=True)
            path = self.folder / METRICS_FILE
            kept = _lines(path, resume_step) if resume_step is not None else []
            self._lines = [line for _, line in kept]
            # Whole or not at all: a kill here must not cost the lines that were there.
            write_bytes(path, b"".join(raw for raw, _ in kept))
            self._file = path.open("a", encoding="utf-8", newline="\n")
            self._writer = _tensorboard(self.folder, resume_step, tensorboard)
        self._before_s = float(self._lines[-1]["elapsed_s"]) if self._lines else 0.0
        self._start = time.perf_counter()

    @property
    def elapsed_s(self) -> float:
        """Wall-clock seconds of training so far, those before a resumption included."""
        return self._before_s + time.perf_counter() - self._start

    def scalar(self, name: str, value: float, step: int) -> None:
        """Log one figure after ``step`` environment steps."""
        self.scalars({name: value}, step)

    def scalars(self, values: Mapping[str, float], step: int) -> None:
        """Log figures that belong together, as one line, after ``step`` environment steps."""
        plain = {name: float(value) for name, value in values.items()}
        line = {
            "step": int(step),
            "elapsed_s": round(self.elapsed_s, 3),
            "values": {name: value if math.isfinite(value) else None for name, value in plain.items()},
        }
        self._lines.append(line)
        if self._file is not None:
            self._file.write(json.dumps(line) + "\n")
            self._file.flush()
        if self._writer is not None:
            for name, value in plain.items():
                self._writer.add_scalar(name, value, int(step))

    def settings(self, values: Mapping[str, Any]) -> None:
        """Store the run's settings (plain values) as ``run.json``."""
        self._settings = dict(values)
        if self.folder is not None:
            write_text(self.folder / SETTINGS_FILE, json.dumps(values, indent=2, sort_keys=True) + "\n")

    def run(self) -> Run:
        """Return everything logged so far, that before a resumption included."""
        return Run(self.folder, self._settings, _series(self._lines))

    def close(self) -> None:
        """Finish the files; closing twice is fine."""
        if self._file is not None:
            self._file.close()
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def __enter__(self) -> RunLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def read_run(run_dir: str | Path) -> Run:
    """Return what a run logged, also one that is under way or was killed (an unfinished last line is left out).

    Raises:
        InputError: for a folder without a log, or a log with a damaged line.
    """
    folder = Path(run_dir)
    path = folder / METRICS_FILE
    if not path.is_file():
        raise InputError(
            "run folder",
            given=str(run_dir),
            expected=f"a folder with {METRICS_FILE}",
            fix="Give the folder that the training printed (--run-dir).",
        )
    return Run(folder, read_settings(folder), _series([line for _, line in _lines(path, None)]))


def read_settings(run_dir: str | Path) -> dict[str, Any]:
    """Return the settings of a run; empty when it has none.

    Raises:
        InputError: when they are not JSON.
    """
    path = Path(run_dir) / SETTINGS_FILE
    if not path.is_file():
        return {}
    try:
        settings: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError("settings of a run", given=str(path), expected="JSON", fix=f"{error}.") from error
    return settings


def _series(lines: Sequence[Mapping[str, Any]]) -> dict[str, Series]:
    rows: dict[str, list[tuple[int, float, float]]] = {}
    for line in lines:
        for name, value in line["values"].items():
            row = (line["step"], line["elapsed_s"], math.nan if value is None else value)
            rows.setdefault(name, []).append(row)
    return {
        name: Series(
            np.array([row[0] for row in found], np.int64),
            np.array([row[1] for row in found], np.float64),
            np.array([row[2] for row in found], np.float64),
        )
        for name, found in rows.items()
    }


def _lines(path: Path, last_step: int | None) -> list[tuple[bytes, dict[str, Any]]]:
    """Return the whole lines of a log up to a step, raw and parsed."""
    if not path.is_file():
        return []
    found = []
    for number, raw in enumerate(path.read_bytes().splitlines(keepends=True), start=1):
        if not raw.endswith(b"\n"):  # a process was killed while it wrote this
            break
        try:
            line = json.loads(raw)
            step = line["step"]
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"{path}, line {number}",
                given=raw[:80].decode("utf-8", "replace"),
                expected='{"step": ..., "elapsed_s": ..., "values": {...}}',
                fix="Delete this line; the others are unharmed.",
            ) from error
        if last_step is None or step <= last_step:
            found.append((raw, line))
    return found


def _tensorboard(folder: Path, resume_step: int | None, wanted: bool | None) -> Any:
    if wanted is False:
        return None
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        if wanted:
            raise MissingDependencyError(
                "tensorboard", needed_for="TensorBoard logs of a training", install="pip install tensorboard"
            ) from error
        return None
    purge = None if resume_step is None else resume_step + 1
    return SummaryWriter(str(folder / TENSORBOARD_FOLDER), purge_step=purge, flush_secs=10)


class Progress:
    """A progress bar for terminals and notebooks; where the output is a file or a pipe it stays silent.

    Args:
        total: what counts as done; None for an open end.
        description, unit: shown with the count.
        enabled: False hides it.

    A context manager.
    """

    def __init__(
        self, total: float | None, *, description: str = "training", unit: str = "step", enabled: bool = True
    ) -> None:
        from tqdm.auto import tqdm

        self._bar: Any = tqdm(
            total=total,
            desc=description,
            unit=unit,
            unit_scale=True,
            disable=not (enabled and _someone_watches()),
            mininterval=0.2,
            dynamic_ncols=True,
        )

    def update(self, amount: float = 1, **shown: float | str) -> None:
        """Advance by ``amount`` and show figures behind the bar."""
        if shown:
            words = {name: value if isinstance(value, str) else f"{value:.3g}" for name, value in shown.items()}
            self._bar.set_postfix(words, refresh=False)
        self._bar.update(amount)

    def write(self, text: str) -> None:
        """Print a line without breaking the bar."""
        self._bar.write(text)

    def close(self) -> None:
        """Leave the bar as it is."""
        self._bar.close()

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _someone_watches() -> bool:
    """Return whether standard error is a terminal or a notebook's cell."""
    if "ipykernel" in sys.modules and hasattr(sys.stderr, "pub_thread"):
        return True
    return bool(getattr(sys.stderr, "isatty", lambda: False)())
