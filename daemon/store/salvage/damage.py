"""Whether a database is damaged: as much is looked at as its last end gives reason for.

A busy or failing disk is no damage, and says so as the error that it is.
"""

from __future__ import annotations

import json
import os
import sqlite3
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, suppress
from enum import IntEnum
from pathlib import Path

import structlog

from daemon.errors import DatabaseDamagedError, DatabaseForeignError, StoreError
from daemon.store.frames.archive import FOLDER
from daemon.store.integrity.checksum import DIGEST, named, row_digest
from daemon.store.migrate import SCHEMA_QUERY, known_revisions, schema_digests
from daemon.store.records import Mark
from daemon.store.revisions import require_known
from daemon.store.salvage.sqlite_pages import PageFile, RawRow
from daemon.store.schema import Base
from daemon.store.sqlite import (
    any_text,
    connect,
    connect_readonly,
    is_database_file,
    said_plainly,
)

_log = structlog.get_logger("dcam.daemon")

NEWEST_ROWS = 1000
"""What a cut can have torn was written last: these rows of each table are read at every start."""

PAGES_BUDGET_S = 60.0
"""A start waits no longer for the check of all pages; `dcam-ctl verify` has time for the rest."""

_OPCODES = 100_000
"""SQLite's steps between two looks at the clock: a few milliseconds."""

_FIRST_PAGES = 64
"""The marks stand in one of them."""

_MARK = ("name", "value", DIGEST)
_BATCH = 1000


class Depth(IntEnum):
    """How much is looked at."""

    NEWEST = 0
    """Header, tables and the newest rows: after an orderly stop."""
    PAGES = 1
    """Also whether all pages fit together: after any other end."""
    EVERYTHING = 2
    """Also every row and index: when something has been noticed."""


def find_damage(path: Path, depth: Depth) -> str | None:
    """Say what is damaged, None when nothing is; a finding is made twice before it counts.

    Raises DatabaseNewerError, DatabaseForeignError, DatabaseBusyError, DatabaseUnwritableError.
    """
    found = _look(path, depth)
    if found is None:
        return None
    _forget_cached(path)
    again = _look(path, depth)
    if again is None:
        _log.warning("database_sound_after_all", first_look=found)
        return None
    quoted = again.encode(errors="backslashreplace").decode()  # it may quote damaged text
    return " ".join(quoted.split())


def has_foreign_log(path: Path) -> bool:
    """Whether file and log bear different names: a copy was put in place, the log was forgotten.

    SQLite would take the log's pages for newer ones and overwrite the file's with them.
    """
    with closing(PageFile(path, with_log=False)) as file, closing(PageFile(path)) as both:
        ours, theirs = _identities(file.rows(last=_FIRST_PAGES)), _identities(both.log_rows())
    return bool(ours and theirs) and not ours & theirs


def _identities(rows: Iterable[RawRow]) -> set[object]:
    found: set[object] = set()
    for row in rows:
        if row.values[:1] == (Mark.IDENTITY.value,) and len(row.values) == len(_MARK):
            mark = dict(zip(_MARK, row.values, strict=True))
            if row_digest("mark", mark) == mark[DIGEST]:
                found.add(mark["value"])
    return found


def traces_of_a_lost_database(path: Path) -> str:
    """Say what lies beside a missing or empty database that only one with rows can have left."""
    directory = path.parent
    log = path.with_name(path.name + "-wal")
    traces = {
        "its log": log.exists() and log.stat().st_size > 0,
        "its frames": (directory / FOLDER).exists(),
        "its calibrations": any(directory.glob("calibrations/*/report.json")),
    }
    return " and ".join(name for name, is_there in traces.items() if is_there)


def ended_in_order(path: Path) -> bool:
    """Whether the last daemon closed the database as it was asked to: its log is gone then."""
    log = path.with_name(path.name + "-wal")
    if log.exists() and log.stat().st_size:
        return False
    try:
        with closing(connect_readonly(path)) as connection:
            query = "SELECT value FROM mark WHERE name = ?"
            return connection.execute(query, (Mark.CLEAN_STOP_UTC.value,)).fetchone() is not None
    except sqlite3.Error:
        return False


def _look(path: Path, depth: Depth) -> str | None:
    if not path.is_file():
        return "not a file"
    _roll_back(path)
    if not is_database_file(path):
        return "not a SQLite database" if path.stat().st_size else "empty"
    if found := _damaged_log(path):
        return found
    if depth > Depth.NEWEST and has_foreign_log(path):
        return "the log beside it is that of another database"
    try:
        with said_plainly(path), closing(connect_readonly(path)) as connection:
            connection.text_factory = any_text
            return next(_findings(connection, path, depth), None)
    except DatabaseDamagedError as error:
        return str(error.__cause__)


def _damaged_log(path: Path) -> str | None:
    """Say what SQLite would drop of the log without a word, and overwrite.

    A header that a cut left half written stands alone, or before frames that the database has: the
    log is begun over only once it has all of them, and the header is on the disk before the first
    new frame.
    """
    with closing(PageFile(path)) as pages:
        log = pages.log
        if log.is_header_sound:
            lost = log.lost_commits
            return f"the log is damaged: SQLite would drop {lost} commits of it" if lost else None
        if not log.has_content or (log.committed and pages.holds_newest_of_log()):
            return None
        lost = log.lost_commits
        return f"the log's header is damaged: SQLite would drop it, with {lost} commits or more"


def _roll_back(path: Path) -> None:
    """Undo what a cut left of a database's making: a journal that no reader may undo itself."""
    journal = path.with_name(path.name + "-journal")
    if journal.exists() and journal.stat().st_size:
        with suppress(sqlite3.Error, StoreError), closing(connect(path)) as connection:
            connection.execute("SELECT count(*) FROM sqlite_master").close()


def _findings(connection: sqlite3.Connection, path: Path, depth: Depth) -> Iterator[str]:
    yield from _wrong_tables(connection, path)
    if depth is Depth.PAGES:
        yield from _wrong_pages(connection)
    if depth is Depth.EVERYTHING:
        findings = connection.execute("PRAGMA integrity_check(1)")
        yield from (str(row[0]).splitlines()[-1] for row in findings if row[0] != "ok")
    for table in program_tables(connection):
        (newest,) = connection.execute(f"SELECT max(rowid) FROM {table}").fetchone()  # noqa: S608
        after = 0 if depth is Depth.EVERYTHING else (newest or 0) - NEWEST_ROWS
        yield from wrong_rows(connection, table, after)


def _wrong_tables(connection: sqlite3.Connection, path: Path) -> Iterator[str]:
    """Compare revision and definitions with what the migration noted of them.

    A byte changed in a name or a trigger would otherwise refuse every row from now on.
    """
    schema = connection.execute(SCHEMA_QUERY).fetchall()
    (pages,) = connection.execute("PRAGMA page_count").fetchone()
    if not schema and pages > 1:
        yield f"no tables in {pages} pages"
    if not schema:
        return
    names = {name for _, name, *_ in schema}
    if not names & {"alembic_version", *Base.metadata.tables}:
        msg = (
            f"{path}: a SQLite database, but not one of this program: name another state directory"
        )
        raise DatabaseForeignError(msg)
    query = "SELECT value FROM mark WHERE name = ?"
    try:
        found = connection.execute("SELECT version_num FROM alembic_version").fetchone()
        noted = connection.execute(query, (Mark.SCHEMA.value,)).fetchone()
    except sqlite3.OperationalError as error:
        if error.sqlite_errorcode != sqlite3.SQLITE_ERROR:
            raise
        # Another program's file in our place, with a table of a name that we use too
        yield f"its tables are not those of this program ({error})"
        return
    try:
        noted_revision, digests = json.loads(noted[0]) if noted else (None, {})
    except (ValueError, TypeError):
        yield "the note of the tables' definitions is not what was written"
        return
    revision = None if found is None else str(found[0])
    yield from _wrong_definitions(path, revision, noted_revision, digests, schema_digests(schema))


def _wrong_definitions(
    path: Path,
    revision: str | None,
    noted_revision: str | None,
    noted: dict[str, str],
    found: dict[str, str],
) -> Iterator[str]:
    known = known_revisions()
    if revision is None:
        yield "its revision is missing"
    elif noted_revision not in known:  # of a newer version, or from before there was a note
        require_known(revision, path, known)
    elif revision not in known or known.index(revision) < known.index(noted_revision):
        yield f"its revision is {revision}, written was {noted_revision}"
    elif revision == noted_revision:  # else it was migrated by other means since
        wrong = [name for name, digest in noted.items() if found.get(name) != digest]
        yield from (f"the definition of {name} is not what was written" for name in wrong)


def _wrong_pages(connection: sqlite3.Connection) -> Iterator[str]:
    """Let SQLite look whether all pages fit together, for as long as a start may take."""
    ends_s = time.monotonic() + PAGES_BUDGET_S
    connection.set_progress_handler(lambda: time.monotonic() > ends_s, _OPCODES)
    try:
        (finding,) = connection.execute("PRAGMA quick_check(1)").fetchone()
    except sqlite3.OperationalError as error:
        if error.sqlite_errorcode != sqlite3.SQLITE_INTERRUPT:
            raise
        advice = "run dcam-ctl verify, which takes its time"
        _log.warning("database_check_cut_short", after_s=PAGES_BUDGET_S, advice=advice)
        return
    finally:
        connection.set_progress_handler(None, 0)
    if finding != "ok":
        yield str(finding).splitlines()[-1]


def program_tables(connection: sqlite3.Connection) -> list[str]:
    """The program's tables that a database has: of an older revision not all."""
    found = {name for (name,) in connection.execute("SELECT name FROM sqlite_master")}
    return [name for name in Base.metadata.tables if name in found]


def wrong_rows(
    connection: sqlite3.Connection,
    table: str,
    after: int = 0,
    tell: Callable[[int], None] = lambda _count: None,
) -> Iterator[str]:
    """Read a table's rows, from a rowid on, in small steps; name those that are not as written.

    `tell` hears the number of each step's rows. A table of a version without checksums has no
    wrong rows. Raises sqlite3.Error where it cannot be read.
    """
    cursor = connection.execute(f"SELECT rowid, * FROM {table} LIMIT 0")  # noqa: S608 - our names
    names = [column[0] for column in cursor.description][1:]
    if DIGEST not in names:
        return
    query = f"SELECT rowid, * FROM {table} WHERE rowid > ? ORDER BY rowid LIMIT {_BATCH}"  # noqa: S608
    while rows := connection.execute(query, (after,)).fetchall():
        for _, *cells in rows:
            row = dict(zip(names, cells, strict=True))
            if row_digest(table, row) != row[DIGEST]:
                yield f"a row of {table}, {named(row)}, is not what was written"
        after = rows[-1][0]
        tell(len(rows))


def _forget_cached(path: Path) -> None:
    """Have the next look read the disk again: memory or cable may have been at fault."""
    with suppress(OSError), path.open("rb") as file:
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
