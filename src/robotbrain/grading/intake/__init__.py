"""Reading what students hand in: whatever it is, a notebook comes out that can be graded, with what was repaired.

- :mod:`gate`: files become bytes; links, devices, giants and strange names stay outside.
- :mod:`text`, :mod:`tolerant`, :mod:`cells`: bytes become cells, however they are encoded, packed or broken.
- :mod:`recognise`: which cell is which of the lab's, by grade id, cell id, text, names, place, similarity.
- :mod:`restore`: locked cells as they were, answers where they count, missing cells put back.

Locked and graded cells come from the instructor's *master* (the source without its solutions but with the hidden
tests).
"""

from __future__ import annotations

from robotbrain.grading.intake.gate import Received, receive
from robotbrain.grading.intake.healing import MISSING, Healed, choose, heal, heal_bytes
from robotbrain.grading.intake.master import grade_id, is_graded_kind, master_of

__all__ = [
    "MISSING",
    "Healed",
    "Received",
    "choose",
    "grade_id",
    "heal",
    "heal_bytes",
    "is_graded_kind",
    "master_of",
    "receive",
]
