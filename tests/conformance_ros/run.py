"""Runs the programs on the kit and on genuine rclpy and compares what they decided.

``python -m tests.conformance_ros`` makes the environments it needs, runs every program serially, prints a table and
returns 1 when anything differs that :mod:`tests.conformance_ros.differences` does not list. ``--record`` stores the
genuine logs that ``test_kit_programs.py`` compares with.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tests.conformance_ros.backends import (
    DISTROS,
    EXPECTED,
    Backend,
    Line,
    ProgramError,
    cache_folder,
    genuine,
    kit,
    programs,
    versions,
    write_log,
)
from tests.conformance_ros.cdr import exchange, problems_of
from tests.conformance_ros.compare import check_table, compare
from tests.conformance_ros.differences import DIFFERENCES


def run_one(backend: Backend, program: Path, domain: int, timeout_s: float) -> tuple[list[Line] | None, str, float]:
    """Run a program; return its log (None when it failed), what went wrong and the wall-clock seconds."""
    start = time.perf_counter()
    try:
        return backend.run(program, domain=domain, timeout_s=timeout_s), "", time.perf_counter() - start
    except ProgramError as error:
        return None, str(error), time.perf_counter() - start


def judge(program: str, distro: str, logs: dict[str, list[Line] | None]) -> list[str]:
    """Return the problems of one program on one distribution."""
    if logs["kit"] is None or logs[distro] is None:
        return [f"failed on {name}" for name in ("kit", distro) if logs[name] is None]
    return compare(program, distro, logs["kit"] or [], logs[distro] or [], DIFFERENCES)


def run_all(arguments: argparse.Namespace) -> dict[str, Any]:
    """Run and compare; return the results as JSON can hold them."""
    cache = cache_folder(arguments.cache)
    distros = [name for name in DISTROS if name in arguments.only]
    backends = [kit()] + [genuine(distro, cache) for distro in distros]
    domain = 1 + os.getpid() % 90
    results: dict[str, Any] = {"versions": {backend.name: versions(backend) for backend in backends}, "programs": {}}
    table = [f"{'program':<28}" + "".join(f"{backend.name:>14}" for backend in backends)]
    print(table[0], flush=True)
    for program in programs(arguments.programs):
        logs: dict[str, list[Line] | None] = {}
        cells, problems = [], {}
        for backend in backends:
            lines, error, seconds = run_one(backend, program, domain, arguments.timeout)
            logs[backend.name] = lines
            if backend.name == "kit":
                verdict = f"{len(lines)} lines" if lines is not None else "FAILED"
                wrong = [error] if error else []
            else:
                wrong = [error] if error else judge(program.stem, backend.name, logs)
                verdict = "FAILED" if lines is None else "differ" if wrong else "agree"
                if lines is not None and arguments.record:
                    write_log(EXPECTED / backend.name / f"{program.stem}.jsonl", lines)
            if wrong:
                problems[backend.name] = wrong
            cells.append(f"{verdict} {seconds:.1f}s")
        print(f"{program.stem:<28}" + "".join(f"{cell:>14}" for cell in cells), flush=True)
        for name, wrong in problems.items():
            print("\n".join(f"    {name}: {line}" for problem in wrong for line in problem.splitlines()), flush=True)
        results["programs"][program.stem] = {"cells": cells, "problems": problems}
    results["cdr"] = {}
    if not arguments.programs:
        for backend in backends[1:]:
            answers = exchange(backends[0], backend)
            wrong = problems_of(answers)
            results["cdr"][backend.name] = {"answers": answers, "problems": wrong}
            for direction, answer in answers.items():
                print(f"CDR {direction:<24}{answer['messages']:>6} messages of {answer['types']} types", flush=True)
            print("\n".join(f"    {line}" for line in wrong), end="\n" if wrong else "", flush=True)
    results["table"] = check_table(DIFFERENCES, [path.stem for path in programs()])
    results["differences"] = len(DIFFERENCES)
    rows = [*results["programs"].values(), *results["cdr"].values()]
    results["agree"] = not results["table"] and not any(row["problems"] for row in rows)
    return results


def main(argv: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.conformance_ros", description=__doc__)
    parser.add_argument("programs", nargs="*", help="names of programs; all when omitted")
    parser.add_argument("--cache", type=Path, help="folder of the virtual environments")
    parser.add_argument("--only", nargs="+", default=["kit", *DISTROS], choices=["kit", *DISTROS], metavar="BACKEND")
    parser.add_argument("--record", action="store_true", help="store the genuine logs as what CI compares with")
    parser.add_argument("--timeout", type=float, default=120.0, help="wall-clock seconds per program and backend")
    parser.add_argument("--output", type=Path, help="JSON results; default: results.json in the cache folder")
    arguments = parser.parse_args(argv)
    results = run_all(arguments)
    output = arguments.output or cache_folder(arguments.cache) / "results.json"
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    for problem in results["table"]:
        print(f"differences.py: {problem}")
    differing = sum(bool(row["problems"]) for row in results["programs"].values())
    print(
        f"{len(results['programs'])} programs, {differing} with problems, {len(DIFFERENCES)} listed differences; "
        f"results in {output}"
    )
    return 0 if results["agree"] else 1
