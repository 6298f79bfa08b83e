"""All attacks."""

from __future__ import annotations

from tests.grading.attacks import (
    bombs,
    crafted,
    exfiltration,
    files,
    forgery,
    interpreter,
    kernel_calls,
    lies,
    notebook_file,
    patching,
    processes,
    reference,
    replies,
    theft,
)
from tests.grading.attacks.attack import Attack


def every_attack() -> list[Attack]:
    """The catalogue: names are unique."""
    modules = (
        interpreter, lies, patching, files, theft, forgery, notebook_file, bombs, processes, kernel_calls, replies,
        crafted, reference, exfiltration,
    )  # fmt: skip
    return [attack for module in modules for attack in module.attacks()] + exfiltration.pages()
