"""Bring a database to this version's tables, after a backup; refuse a newer version's."""

from __future__ import annotations

import hashlib
import json
import uuid
from collections.abc import Iterable, Sequence
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sqlalchemy import Connection, Engine, inspect, text

from daemon.durable import fsync_directory
from daemon.errors import TO_SALVAGE, DatabaseDamagedError, DatabaseForeignError, StoreError
from daemon.store import revisions
from daemon.store.copying import backup
from daemon.store.engine import translated
from daemon.store.integrity.checksum import row_digest
from daemon.store.records import Mark
from daemon.store.schema import Base
from daemon.times import stamp_text

if TYPE_CHECKING:
    from alembic.config import Config

_PENDING = ".pending"
"""Ends the name of a backup as long as its migration is not done."""

SCHEMA_QUERY = "SELECT type, name, tbl_name, sql FROM sqlite_master ORDER BY name"


def scripts() -> Path:
    """Where the migrations are installed: beside this program."""
    return revisions.SCRIPTS


def alembic_config() -> Config:
    """Alembic's settings."""
    from alembic.config import Config  # half a second that a start without migration does not need

    config = Config()
    config.set_main_option("script_location", str(scripts()).replace("%", "%%"))
    return config


def head_revision() -> str:
    """The revision this version of the program works with."""
    return known_revisions()[-1]


def known_revisions() -> tuple[str, ...]:
    """The revisions whose scripts are installed, in the order in which they are applied."""
    return revisions.known_revisions(scripts())


def revision(connection: Connection, path: Path) -> str | None:
    """A database's revision; None for one without tables.

    Raises DatabaseForeignError for a database that this program never made.
    """
    tables = set(inspect(connection).get_table_names())
    if not tables:
        return None
    if "alembic_version" in tables:
        found = connection.scalar(text("SELECT version_num FROM alembic_version"))
        if found is not None:
            return str(found)
    if tables & set(Base.metadata.tables):
        msg = f"{path}: damaged (its revision is missing): {TO_SALVAGE}"
        raise DatabaseDamagedError(msg)
    msg = f"{path}: a SQLite database, but not one of this program: name another state directory"
    raise DatabaseForeignError(msg)


def require_head(engine: Engine, path: Path) -> None:
    """Raise DatabaseNewerError or DatabaseOlderError unless the revision is this version's."""
    with translated(path), engine.connect() as connection:
        found = revision(connection, path)
    revisions.require_head(found, path, known_revisions())


def migrate(engine: Engine, path: Path, now_utc: datetime) -> Path | None:
    """Upgrade to this version's tables in one transaction; the backup made before, if any.

    Raises DatabaseNewerError.
    """
    with translated(path), engine.connect() as connection:
        found = revision(connection, path)
    revisions.require_known(found, path, known_revisions())
    if found == head_revision():
        _settle_pending(path, found)
        return None
    _clear_attempts(path)
    saved = None
    if found is not None:
        saved = _backup_name(path, found, now_utc)
        backup(path, saved)
    try:
        _upgrade_plainly(engine, path)
    except BaseException:
        if saved is not None:  # nothing has changed; copies must not pile up with every restart
            saved.unlink()
        raise
    return None if saved is None else _keep(saved)


def _upgrade_plainly(engine: Engine, path: Path) -> None:
    """Upgrade; a script that fails, in whatever way, is said with what it means for the user."""
    try:
        with translated(path):
            upgrade(engine)
    except Exception as error:
        if isinstance(error, StoreError) and type(error) is not StoreError:
            raise  # disk or lock: it says itself what to do
        why = " ".join(str(error).removeprefix(f"{path}: ").split()) or type(error).__name__
        msg = (
            f"{path}: cannot be brought to revision {head_revision()} ({why}); nothing was "
            "changed: install the version before again, and report this"
        )
        raise StoreError(msg) from error


def _settle_pending(path: Path, found: str) -> None:
    """After a cut: a backup of an older revision is kept, of this one the migration never was."""
    for pending in path.parent.glob(f"{path.name}.revision-*{_PENDING}"):
        if pending.name.startswith(f"{path.name}.revision-{found}."):
            pending.unlink()
        else:
            _keep(pending)


def _keep(pending: Path) -> Path:
    """Give a backup its lasting name, now that it is older than the database."""
    saved = pending.with_name(pending.name.removesuffix(_PENDING))
    pending.rename(saved)
    fsync_directory(saved.parent)
    return saved


def upgrade(engine: Engine, target: str | None = None) -> None:
    """Upgrade to a revision, by default this version's, in one transaction.

    It holds the write lock from its start, and the revision is read again inside it, so that of
    two processes only one upgrades.
    """
    from alembic import command

    config = alembic_config()
    with engine.execution_options(dcam_begin="IMMEDIATE").begin() as connection:
        config.attributes["connection"] = connection
        command.upgrade(config, target or "head")
        if target in {None, head_revision()}:
            _note_schema(connection)


def schema_digests(definitions: Iterable[Sequence[Any]]) -> dict[str, str]:
    """A short digest of each table's, index's and trigger's definition, from `SCHEMA_QUERY`."""
    return {
        str(name): hashlib.blake2b(
            f"{kind} {table} {sql}".encode(errors="surrogateescape"), digest_size=6
        ).hexdigest()
        for kind, name, table, sql in definitions
    }


def _note_schema(connection: Connection) -> None:
    digests = schema_digests(connection.exec_driver_sql(SCHEMA_QUERY).all())
    _set_mark(connection, Mark.SCHEMA, json.dumps([head_revision(), digests]), replace=True)
    _set_mark(connection, Mark.IDENTITY, uuid.uuid4().hex, replace=False)


def _set_mark(connection: Connection, name: Mark, value: str, *, replace: bool) -> None:
    mark = {"name": name.value, "value": value}
    connection.execute(
        text(
            "INSERT INTO mark VALUES (:name, :value, :digest) ON CONFLICT (name) DO UPDATE"
            " SET value = :value, digest = :digest WHERE :replace"
        ),
        {**mark, "digest": row_digest("mark", mark), "replace": replace},
    )


def _clear_attempts(path: Path) -> None:
    """Remove what cuts left of earlier attempts: the database is as it was before them."""
    halves = path.parent.glob(f".{path.name}.revision-*.tmp*")
    for left in (*halves, *path.parent.glob(f"{path.name}.revision-*{_PENDING}")):
        with suppress(OSError):  # the backup, next, says what is wrong with the directory
            left.unlink()


def _backup_name(path: Path, found: str, now_utc: datetime) -> Path:
    name = f"{path.name}.revision-{found}.{stamp_text(now_utc)}"
    candidate = path.with_name(name)
    number = 1
    while candidate.exists():  # a clock that stands still must not cost an older backup
        number += 1
        candidate = path.with_name(f"{name}.{number}")
    return candidate.with_name(candidate.name + _PENDING)
