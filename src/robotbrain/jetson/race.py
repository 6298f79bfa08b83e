"""The same network on several modules, side by side, in slow motion: a picture that moves, made of HTML and CSS alone.

It needs no script, so that it plays in JupyterLab, in a saved page and offline. Still (when paused, printed, or for
readers who ask their system for less motion) its bars say the same.
"""

from __future__ import annotations

import hashlib
import html
from collections.abc import Sequence
from dataclasses import dataclass

from robotbrain.errors import InputError
from robotbrain.figures import PALETTE
from robotbrain.jetson.tables import short
from robotbrain.jetson.twin.prediction import Prediction

SLOW_MOTION = 50.0
"""How many times slower than in reality it plays, unless told otherwise."""

_LANE, _LEFT, _LENGTH, _WIDTH = 58, 250, 420, 860  # px


@dataclass(frozen=True, repr=False)
class Race:
    """Predictions side by side; a notebook shows it when it is the last line of a cell.

    Attributes:
        predictions: one for each lane.
        slow_motion: how many times slower than in reality it plays, > 0.

    Raises:
        InputError: without predictions, or for a factor that is not positive.
    """

    predictions: Sequence[Prediction]
    slow_motion: float = SLOW_MOTION

    def __post_init__(self) -> None:
        if not self.predictions:
            raise InputError("race", given="no predictions", expected="at least one", fix="Call twin.predict first.")
        if not 0 < self.slow_motion < 1e6:
            raise InputError(
                "slow_motion", given=self.slow_motion, expected="a positive number", fix="50 is fifty times slower."
            )

    def describe(self) -> str:
        """Return in words what it shows: its alternative text."""
        fastest = min(self.predictions, key=lambda p: p.latency_ms)
        lanes = ", ".join(f"{p.module.name} {short(p.latency_ms)} ms" for p in self.predictions)
        return (
            f"Race of {fastest.model} on {len(self.predictions)} modules, {self.slow_motion:g} times slower than real. "
            f"Time of one inference: {lanes}. The fastest is the {fastest.module.name}."
        )

    def __repr__(self) -> str:
        return self.describe()

    def _repr_html_(self) -> str:
        text = html.escape(self.describe())
        key = "race-" + hashlib.sha256(repr((text, self.slow_motion)).encode()).hexdigest()[:8]
        height = _LANE * len(self.predictions) + 10
        lanes = "".join(self._lane(index, prediction) for index, prediction in enumerate(self.predictions))
        style = (
            f"@keyframes robotbrain-race {{ to {{ transform: translateX({_LENGTH}px); }} }}"
            ".robotbrain-race circle { animation: robotbrain-race 1s linear infinite; }"
            ".robotbrain-race input:checked ~ svg circle { animation-play-state: paused; }"
            "@media (prefers-reduced-motion: reduce) { .robotbrain-race circle { animation: none; } }"
        )
        return (
            f'<div class="robotbrain-race" style="background:#fff;color:#1a1a1a;max-width:{_WIDTH}px">'
            f'<style>{style}</style><input type="checkbox" id="{key}"/> <label for="{key}">pause</label>'
            f'<svg role="img" aria-label="{text}" viewBox="0 0 {_WIDTH} {height}" width="100%" '
            f'font-family="sans-serif" font-size="15" fill="#1a1a1a"><title>{text}</title>{lanes}</svg></div>'
        )

    def _lane(self, index: int, prediction: Prediction) -> str:
        middle = index * _LANE + _LANE / 2
        colour = PALETTE[index % len(PALETTE)]
        # The bar is the rate: as long as the track for the fastest.
        share = min(p.latency_ms for p in self.predictions) / prediction.latency_ms
        seconds = prediction.latency_ms * self.slow_motion / 1e3
        name, mode = html.escape(prediction.module.name), html.escape(prediction.mode)
        right = _LEFT + _LENGTH + 26
        return (
            f'<text x="0" y="{middle - 4}" font-weight="bold">{name}</text><text x="0" y="{middle + 15}">{mode}</text>'
            f'<rect x="{_LEFT}" y="{middle + 13}" width="{_LENGTH}" height="6" fill="#e6e6e6"/>'
            f'<rect x="{_LEFT}" y="{middle + 13}" width="{share * _LENGTH:.1f}" height="6" fill="{colour}"/>'
            f'<circle cx="{_LEFT}" cy="{middle - 2}" r="10" fill="{colour}" '
            f'style="animation-duration:{seconds:.3f}s"/>'
            f'<text x="{right}" y="{middle - 4}">{short(prediction.latency_ms)} ms</text>'
            f'<text x="{right}" y="{middle + 15}">{short(prediction.throughput)} frames/s</text>'
        )
