"""What all changes to a pipeline have in common."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from robotbrain.errors import InputError
from robotbrain.monitoring.whatif_model import Model, Stage

Effort = Literal["configuration", "hardware", "code"]
"""What a change takes: a setting, other hardware or power, or work on the program."""

EFFORTS: tuple[Effort, ...] = ("configuration", "hardware", "code")
"""From little to much: of two changes that gain about the same, the easier one is named first."""


@dataclass(frozen=True)
class Change:
    """Base of the changes.

    ``takes`` says how much trouble it is; ``str(change)`` says it in words.
    """

    effort: ClassVar[Effort] = "configuration"

    @property
    def takes(self) -> Effort:
        """What it takes: a setting, other hardware, or work on the code."""
        return self.effort

    def apply(self, model: Model) -> Model:
        """Return the changed model.

        Raises:
            InputError: if the pipeline does not have what is to be changed.
        """
        raise NotImplementedError

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {"change": type(self).__name__, "text": str(self), **dataclasses.asdict(self)}


def check_positive(what: str, value: object, fix: str) -> None:
    """Raise InputError unless ``value`` is a finite number above zero."""
    good = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and value > 0
    if not good:
        raise InputError(what, given=value, expected="a number > 0", fix=fix)


def edit_stages(model: Model, chosen: Callable[[Stage], bool], edit: Callable[[Stage], Stage]) -> Model:
    """Return a model with ``edit`` made to the chosen callbacks."""
    return dataclasses.replace(
        model, stages={place: edit(stage) if chosen(stage) else stage for place, stage in model.stages.items()}
    )
