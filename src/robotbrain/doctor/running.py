"""Runs probes side by side; whatever one of them does, there is a finding for it and the others go on."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

from robotbrain.doctor.finding import Finding, Situation, everywhere, fault, warning

Probe = Callable[[Situation], Sequence[Finding]]

PATIENCE = 8
"""A probe may try several things, each within ``Situation.limit_s``; after this many times that, it hangs."""


def run_probes(probes: Mapping[str, Probe], situation: Situation) -> Iterator[tuple[str, list[Finding]]]:
    """Run all ``probes`` at once and yield name and findings of each, in the order of ``probes``.

    A probe that hangs is left behind in a daemon thread: it ends with the process.
    """
    running = [(name, _Run(name, probe, situation)) for name, probe in probes.items()]
    for name, run in running:
        yield name, [replace(finding, probe=name) for finding in run.result(PATIENCE * situation.limit_s)]


class _Run:
    """One probe in a thread of its own."""

    def __init__(self, name: str, probe: Probe, situation: Situation) -> None:
        self._name, self._probe, self._situation = name, probe, situation
        self._findings: list[Finding] = []
        self._thread = threading.Thread(target=self._run, name=f"probe {name}", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self._findings = list(self._probe(self._situation))
        except BaseException as error:  # a probe must not take the others with it, not even by sys.exit
            last = traceback.extract_tb(error.__traceback__)[-1]
            self._findings = [
                warning(
                    f"the probe itself failed: {type(error).__name__}: {error}",
                    everywhere(f"Read the other findings first; if they are fine, report this one ({last.name})."),
                    detail=f"{last.filename}:{last.lineno}",
                )
            ]

    def result(self, limit_s: float) -> list[Finding]:
        self._thread.join(limit_s)
        if self._thread.is_alive():
            return [
                fault(
                    f"no answer within {limit_s:g} s: something it asked hangs (a network drive? a driver?)",
                    everywhere(
                        f"Run `robotbrain doctor --only {self._name} --timeout {max(60, round(limit_s))}` to see "
                        "whether it is merely slow; if not, unmount network drives and restart the computer."
                    ),
                )
            ]
        return self._findings
