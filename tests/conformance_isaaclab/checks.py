"""Runs beside the genuine wheel: ``python -m tests.conformance_isaaclab.checks`` (started by :mod:`.run`)."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import torch

STORE = Path(__file__).with_name("genuine_signatures.json")


def main() -> int:
    """Run every check and print the table; 1 when something differs."""
    torch.set_num_threads(1)
    from tests.conformance_isaaclab import dynamics, exported, facts, values
    from tests.conformance_isaaclab.report import Report

    report = Report()
    kit, genuine = facts.facts_of(0), facts.facts_of(1)
    wrong = dict(facts.compare(kit, genuine))
    for name in kit:
        report.check("signatures", name.partition(".")[0], name not in wrong, f"{name}: {wrong.get(name)}")
    if "--write" in sys.argv:
        STORE.write_text(json.dumps(genuine, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    else:
        report.check("signatures", "stored for CI", json.loads(STORE.read_text("utf-8")) == genuine, "run with --write")
    for check in (
        values.check_math,
        values.check_terms,
        values.check_managers,
        dynamics.check_commands,
        dynamics.check_actions,
        dynamics.check_events,
        exported.check_exports,
        exported.check_names,
    ):
        print(f"{check.__module__.rpartition('.')[2]}.{check.__name__} ...", file=sys.stderr, flush=True)
        with torch.inference_mode():  # as the environment runs its terms
            check(report)
    print(report)
    return int(report.failures > 0)


if __name__ == "__main__":
    sys.exit(main())
