"""The library's file: SQLite, which many processes may read and write at once."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from lanenet.errors import LibraryError

#: In the header of the file: what it is ("LnDr"), and the version of the tables.
_APPLICATION_ID, SCHEMA_VERSION = 0x4C6E4472, 1
#: How long a process waits for others; chosen: an addition holds the file for milliseconds.
_WAIT_S = 30.0

#: Strict tables hold what they say, whoever writes them.
_SCHEMA = """
CREATE TABLE drives (
  id INTEGER PRIMARY KEY AUTOINCREMENT,
  name TEXT NOT NULL UNIQUE,
  source TEXT NOT NULL,
  copied INTEGER NOT NULL,
  kind TEXT NOT NULL,
  car TEXT NOT NULL,
  camera TEXT NOT NULL,
  track TEXT NOT NULL,
  licence TEXT NOT NULL,
  notes TEXT NOT NULL,
  lane_width_cm REAL,
  frames INTEGER NOT NULL,
  duration_s REAL NOT NULL,
  checksum TEXT NOT NULL,
  added_at TEXT NOT NULL
) STRICT;
CREATE INDEX drives_by_checksum ON drives (checksum);
CREATE TABLE fingerprints (
  drive_id INTEGER PRIMARY KEY REFERENCES drives ON DELETE CASCADE,
  data BLOB NOT NULL
) STRICT;
CREATE TABLE relations (
  drive_id INTEGER NOT NULL REFERENCES drives ON DELETE CASCADE,
  other_id INTEGER NOT NULL REFERENCES drives ON DELETE CASCADE,
  first_frame INTEGER NOT NULL,
  last_frame INTEGER NOT NULL,
  other_first_frame INTEGER NOT NULL,
  other_last_frame INTEGER NOT NULL,
  matched INTEGER NOT NULL,
  same_bytes INTEGER NOT NULL,
  difference REAL NOT NULL
) STRICT;
CREATE INDEX relations_by_drive ON relations (drive_id);
CREATE INDEX relations_by_other ON relations (other_id);
"""


@contextmanager
def reading(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a library to read; what the block reads is of one moment.

    Raises:
        LibraryError: If it is missing, no library, damaged, locked or of a newer version.
    """
    with _errors(path), closing(_connect(path, "rw")) as connection:
        _check(path, connection)
        connection.execute("BEGIN")
        yield connection


@contextmanager
def writing(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a library to change: all that the block does is done at its end, or nothing of it.

    Raises:
        LibraryError: As :func:`reading`; or if it cannot be written, or the disk is full.
    """
    with _errors(path), closing(_connect(path, "rw")) as connection:
        _check(path, connection)
        with _transaction(connection):
            yield connection


def create(path: Path) -> None:
    """Make a library, unless there is one.

    Raises:
        LibraryError: As :func:`writing`.
    """
    with _errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with closing(_connect(path, "rwc")) as connection, _transaction(connection):
            if not _is_empty(connection):
                _check(path, connection)
                return
            for statement in _SCHEMA.split(";"):
                connection.execute(statement)
            connection.execute(f"PRAGMA application_id = {_APPLICATION_ID}")
            connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")


def _connect(path: Path, mode: str) -> sqlite3.Connection:
    connection = sqlite3.connect(
        f"{path.resolve().as_uri()}?mode={mode}", timeout=_WAIT_S, isolation_level=None, uri=True
    )
    connection.row_factory = sqlite3.Row
    connection.execute("PRAGMA foreign_keys = ON")
    return connection


@contextmanager
def _transaction(connection: sqlite3.Connection) -> Iterator[None]:
    # Immediate: who reads first and writes later would be refused where another writes in between.
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield
        connection.execute("COMMIT")
    except BaseException:
        if connection.in_transaction:
            connection.execute("ROLLBACK")
        raise


def _is_empty(connection: sqlite3.Connection) -> bool:
    return not connection.execute("SELECT count(*) FROM sqlite_schema").fetchone()[0]


def _check(path: Path, connection: sqlite3.Connection) -> None:
    application, version = (
        connection.execute(f"PRAGMA {name}").fetchone()[0] for name in ("application_id", "user_version")
    )
    if application != _APPLICATION_ID:
        raise LibraryError(f"{path}: not a library of drives, but another database; choose another file")
    if version > SCHEMA_VERSION:
        raise LibraryError(
            f"{path}: a library of version {version}, this lanenet knows up to {SCHEMA_VERSION}: "
            "pip install --upgrade lanenet"
        )


@contextmanager
def _errors(path: Path) -> Iterator[None]:
    """Turn SQLite's errors into one that says what to do."""
    try:
        yield
    except sqlite3.Error as error:
        raise LibraryError(f"{path}: {_reason(path, error)}") from error
    except OSError as error:
        raise LibraryError(f"{path}: the library cannot be written ({error})") from error


def _reason(path: Path, error: sqlite3.Error) -> str:
    name = getattr(error, "sqlite_errorname", "")
    if name.startswith(("SQLITE_BUSY", "SQLITE_LOCKED")):
        return f"another program has held this library for {_WAIT_S:.0f} s; end it, or try again later"
    if name.startswith("SQLITE_FULL"):
        return "the disk is full; the library is as it was before"
    if name.startswith("SQLITE_CANTOPEN"):
        if not path.exists():
            return "no such library; lanenet drives add makes it"
        return "the library cannot be opened; may it be read, and its folder be written?"
    if name.startswith("SQLITE_NOTADB"):
        return "not a library of drives (no SQLite file)"
    if name.startswith("SQLITE_CORRUPT"):
        return f"the library is damaged ({error}); sqlite3 FILE .recover saves what can be read"
    if name.startswith("SQLITE_READONLY"):
        return "the library cannot be written: it is read-only"
    return f"the library cannot be used ({error})"
