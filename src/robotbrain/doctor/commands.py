"""``robotbrain doctor``."""

from __future__ import annotations

import argparse
import os
import platform
import sys
from pathlib import Path

from robotbrain import __version__
from robotbrain.doctor import report
from robotbrain.doctor.finding import Finding, Severity, Situation
from robotbrain.doctor.probes import PROBES
from robotbrain.doctor.running import run_probes

LIMIT_S = 60.0


def doctor_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``robotbrain doctor``."""
    parser.add_argument(
        "--only",
        action="append",
        metavar="PROBE",
        choices=list(PROBES),
        help=f"look at this only (repeatable): {', '.join(PROBES)}",
    )
    parser.add_argument("--json", action="store_true", help="findings as JSON")
    parser.add_argument(
        "--timeout", type=_seconds, default=LIMIT_S, metavar="S", help=f"patience with one step (default: {LIMIT_S:g})"
    )
    parser.add_argument("--directory", type=Path, metavar="D", help="the course (default: where you are)")


def doctor_main(arguments: argparse.Namespace) -> int:
    """Run ``robotbrain doctor``; 1 if there is a fault."""
    chosen = {name: probe for name, probe in PROBES.items() if not arguments.only or name in arguments.only}
    folder = _folder(arguments.directory)
    situation = Situation(folder, _course(folder, named=arguments.directory is not None), arguments.timeout)
    colour = sys.stdout.isatty() and "NO_COLOR" not in os.environ and sys.platform != "win32"
    about = _about()
    findings: list[Finding] = []
    if not arguments.json:
        report.write(sys.stdout, "{program}, {python}, {system}\n{interpreter}\n".format_map(about))
    for _, found in run_probes(chosen, situation):
        findings += found
        if not arguments.json and found:
            report.write(sys.stdout, report.rows(found, colour=colour))
    if arguments.json:
        report.write(sys.stdout, report.as_json(findings, about))
    else:
        report.write(sys.stdout, "\n" + report.summary(findings, colour=colour))
    return 1 if any(finding.severity is Severity.FAULT for finding in findings) else 0


def _about() -> dict[str, str]:
    return {
        "program": f"robotbrain {__version__}",
        "python": f"Python {platform.python_version()}",
        "system": f"{platform.system()} {platform.release()} on {platform.machine()}",
        "interpreter": sys.executable,
    }


def _folder(named: Path | None) -> Path:
    """Where the user is; the home folder if that place has been deleted."""
    try:
        return (named or Path.cwd()).resolve()
    except OSError:
        return Path.home()


def _course(folder: Path, *, named: bool) -> Path | None:
    from robotbrain.errors import InputError
    from robotbrain.jupyter import find_course

    for start in (folder, None):
        try:
            return find_course(start)
        except (InputError, OSError):
            if named:
                return None
    return None


def _seconds(text: str) -> float:
    number = float(text)
    if not 0 < number < 1e6:
        raise argparse.ArgumentTypeError(f"{text} is no time limit; give seconds > 0")
    return number
