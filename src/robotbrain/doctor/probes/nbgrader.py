"""Nbgrader: its gradebook, its configuration, its exchange. All but the commands matter to instructors only."""

from __future__ import annotations

import shutil
import sqlite3
import sys
from pathlib import Path

from robotbrain.doctor.finding import (
    Finding,
    Situation,
    everywhere,
    fault,
    note,
    ok,
    posix_or_windows,
    quoted,
    reinstall,
    warning,
)
from robotbrain.doctor.isolated import try_out
from robotbrain.doctor.probes.packages import version_of

_LOCK_WAIT_S = 1.0


def nbgrader(situation: Situation) -> list[Finding]:
    """The command ``alembic``, without which nbgrader cannot open a gradebook, the configuration, the exchange."""
    if version_of("nbgrader") is None:
        return []  # the probe of versions says so
    found = []
    scripts = Path(sys.executable).parent
    beside = shutil.which("alembic", path=str(scripts))
    on_path = shutil.which("alembic")
    activate = posix_or_windows(f"source {quoted(scripts / 'activate')}", str(scripts / "Activate.ps1"))
    if beside is None and on_path is None:
        found.append(
            fault(
                "the command `alembic` is missing; nbgrader cannot make or open a gradebook without it",
                reinstall("alembic"),
            )
        )
    elif on_path is None:
        found.append(
            note(
                f"`alembic` is beside this Python ({scripts}) but not on PATH; the kit finds it there, nbgrader's own "
                "commands do not",
                activate,
            )
        )
    return [ok(f"nbgrader {version_of('nbgrader')}"), *found, *_configuration(situation)]


def _configuration(situation: Situation) -> list[Finding]:
    """The instructor's configuration and the exchange, which it takes nbgrader itself to find."""
    config = None if situation.course is None else situation.course / "autograder" / "nbgrader_config.py"
    loading = f"nbgrader-config:{config}" if config is not None and config.is_file() else ""
    exchange = "exchange" if sys.platform != "win32" else ""  # nbgrader has none there
    outcomes = try_out([trial for trial in (loading, exchange) if trial], situation.limit_s)
    found = []
    if loading and not outcomes[loading].fine:
        again = "git checkout autograder/nbgrader_config.py"
        found.append(
            fault(
                f"nbgrader's configuration {config} cannot be loaded",
                everywhere(f"Correct what the error names, or take the file from the release again: {again}"),
                outcomes[loading].message,
            )
        )
    if exchange and outcomes[exchange].fine:
        place = outcomes[exchange].data
        if not place["problem"]:
            found.append(ok(f"exchange {place['path']} ({place['why']})"))
        else:
            path = Path(place["path"])
            found.append(
                fault(
                    f"nbgrader's exchange {path} ({place['why']}) {place['problem']}: labs can be neither fetched nor "
                    "handed in",
                    everywhere(
                        f"sudo mkdir -p {quoted(path)} && sudo chmod ugo+rwx {quoted(path)}, or name another: export "
                        "ROBOTBRAIN_EXCHANGE=/a/folder/of/the/class"
                    ),
                )
            )
    elif exchange:
        found.append(
            warning(
                "nbgrader cannot say where its exchange is: the assignment list will be empty",
                reinstall("nbgrader"),
                outcomes[exchange].message,
            )
        )
    return found


def gradebook(situation: Situation) -> list[Finding]:
    """The SQLite gradebook of the course, if there is one: whole, and not locked by somebody."""
    if situation.course is None:
        return []
    file = situation.course / "autograder" / "gradebook.db"
    if not file.is_file():
        return [note("no gradebook yet; grading makes one")] if file.parent.is_dir() else []
    backups = file.parent / "backups"
    restore = posix_or_windows(
        f'mv {file} {file}.damaged && cp "$(ls {backups}/gradebook-*.db | tail -1)" {file}',
        f'Move-Item "{file}" "{file}.damaged"; Copy-Item (Get-ChildItem "{backups}\\gradebook-*.db" | Select -Last 1) '
        f'"{file}"',
    )
    try:
        connection = sqlite3.connect(f"{file.resolve().as_uri()}?mode=rw", uri=True, timeout=_LOCK_WAIT_S)
        try:
            verdict = str(connection.execute("PRAGMA quick_check(1)").fetchone()[0])
            tables = {row[0] for row in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
            connection.execute("BEGIN IMMEDIATE")
            connection.rollback()
        finally:
            connection.close()
    except sqlite3.OperationalError as error:
        if "locked" in str(error):
            return [
                warning(
                    f"the gradebook {file} is locked: something is writing to it, or was stopped while it did",
                    everywhere(
                        "Wait until grading has ended; close formgrader; then end Python processes that are left."
                    ),
                )
            ]
        return [
            fault(
                f"the gradebook {file} cannot be opened for writing: {error}",
                posix_or_windows(
                    f"sudo chown $(id -un) {quoted(file)} {quoted(file.parent)} && chmod u+rw {quoted(file)}",
                    f'icacls "{file.parent}" /grant "$env:USERNAME:(OI)(CI)F"',
                ),
            )
        ]
    except sqlite3.DatabaseError as error:
        return [fault(f"the gradebook {file} is damaged: {error}", restore)]
    if verdict != "ok":
        return [fault(f"the gradebook {file} is damaged: {verdict}", restore)]
    if tables and "alembic_version" not in tables:
        return [fault(f"{file} is a database, but no gradebook of nbgrader's", restore)]
    return [ok(f"gradebook {file}")]
