"""Copies of the gradebook: before a run writes, and to move a class between SQLite and PostgreSQL."""

from __future__ import annotations

import contextlib
import sqlite3
import time
from pathlib import Path
from typing import Any

from sqlalchemy import Engine, create_engine, insert, inspect, select, text
from sqlalchemy.engine import make_url

from robotbrain.errors import InputError

KEEP = 10
_ROWS_AT_ONCE = 1000


def backup(url: str, folder: Path, *, keep: int = KEEP) -> Path | None:
    """Copy the gradebook at ``url`` into ``folder``, keeping the ``keep`` newest copies.

    SQLite is copied through its online backup interface, which is right even while others write. Any other database is
    copied table by table, in one snapshot, into an SQLite file that nbgrader can open; :func:`copy_gradebook` brings
    it back.

    Returns:
        The copy; the newest one there is, if nothing has changed since; None if there is no gradebook yet.
    """
    source = sqlite_file(url)
    if source is not None and not source.is_file():
        return None
    folder.mkdir(parents=True, exist_ok=True)
    made = folder / ".copying"
    made.unlink(missing_ok=True)  # of a run that was killed
    if source is not None:
        _copy_sqlite(source, made)
    elif not _copy_tables(url, made):
        return None
    copies = sorted(folder.glob("gradebook-*.db"))
    if copies and copies[-1].read_bytes() == made.read_bytes():
        made.unlink()
        return copies[-1]
    for old in copies[: max(0, len(copies) + 1 - keep)]:
        old.unlink()
    now = time.time_ns()
    name = f"gradebook-{time.strftime('%Y%m%dT%H%M%S', time.localtime(now // 10**9))}-{now % 10**9:09d}.db"
    return made.replace(folder / name)


def copy_gradebook(source_url: str, target_url: str) -> None:
    """Copy a whole gradebook into a new one, of any kind of database; the target must be empty."""
    source, target = create_engine(source_url), create_engine(target_url)
    try:
        if inspect(target).get_table_names():
            raise InputError(
                "target gradebook",
                given=make_url(target_url).render_as_string(),
                expected="an empty database",
                fix="Create a new one, or drop its tables.",
            )
        _copy(source, target)
    finally:
        source.dispose()
        target.dispose()


def contents(url: str) -> dict[str, list[tuple[Any, ...]]]:
    """What a gradebook says, table by table, without its random keys, so that two gradebooks can be compared."""
    from nbgrader.api import Base

    engine = create_engine(url)
    try:
        with engine.connect() as connection:
            named: dict[str, dict[str, tuple[Any, ...]]] = {}
            found = {}
            for table in Base.metadata.sorted_tables:
                rows = [dict(row._mapping) for row in connection.execute(select(table))]
                for row in rows:
                    for key in table.foreign_keys:
                        row[key.parent.name] = named[key.column.table.name].get(row[key.parent.name])
                unique = _natural_key(table)
                named[table.name] = {row["id"]: tuple(row[c] for c in unique) for row in rows if "id" not in unique}
                named[table.name] |= {row["id"]: (row["id"],) for row in rows if "id" in unique}
                columns = [c.name for c in table.columns if c.name != "id" or "id" in unique]
                found[table.name] = sorted((tuple(row[c] for c in columns) for row in rows), key=repr)
            return found
    finally:
        engine.dispose()


def _natural_key(table: Any) -> list[str]:
    from sqlalchemy import UniqueConstraint

    for constraint in sorted(table.constraints, key=repr):
        if isinstance(constraint, UniqueConstraint) and "id" not in constraint.columns:
            return sorted(c.name for c in constraint.columns)
    return ["id"]


def sqlite_file(url: str) -> Path | None:
    """The file of an SQLite gradebook, or None for other databases."""
    parsed = make_url(url)
    return Path(parsed.database) if parsed.get_backend_name() == "sqlite" and parsed.database else None


def _copy_sqlite(source: Path, target: Path) -> None:
    with (
        contextlib.closing(sqlite3.connect(f"file:{source.as_posix()}?mode=ro", uri=True)) as reader,
        contextlib.closing(sqlite3.connect(target)) as writer,
    ):
        reader.backup(writer, pages=-1, sleep=0.5)  # waits while somebody holds the lock


def _copy_tables(url: str, target: Path) -> bool:
    source, copy = create_engine(url), create_engine(f"sqlite:///{target.as_posix()}")
    try:
        if not inspect(source).has_table("alembic_version"):
            return False
        _copy(source, copy)
        return True
    finally:
        source.dispose()
        copy.dispose()


def _copy(source: Engine, target: Engine) -> None:
    from nbgrader.api import Base

    version = text("SELECT version_num FROM alembic_version")
    with source.connect().execution_options(isolation_level=_snapshot(source)) as reader, target.begin() as writer:
        Base.metadata.create_all(writer)
        writer.execute(text("CREATE TABLE alembic_version (version_num VARCHAR(32) NOT NULL)"))
        for (number,) in reader.execute(version):
            writer.execute(text("INSERT INTO alembic_version VALUES (:number)"), {"number": number})
        for table in Base.metadata.sorted_tables:
            for rows in reader.execute(select(table).order_by(table.c.id)).partitions(_ROWS_AT_ONCE):
                writer.execute(insert(table), [dict(row._mapping) for row in rows])


def _snapshot(engine: Engine) -> Any:
    """One state of the database for the whole copy, where a single statement is not enough for that."""
    return "SERIALIZABLE" if engine.dialect.name == "sqlite" else "REPEATABLE READ"
