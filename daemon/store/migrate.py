"""Bring a database to this version's tables, after a backup; refuse a newer version's."""

from __future__ import annotations

from contextlib import suppress
from datetime import UTC, datetime
from importlib.resources import files
from pathlib import Path

from alembic import command
from alembic.config import Config
from alembic.script import ScriptDirectory
from sqlalchemy import Connection, Engine, inspect, text

from daemon.store import revisions
from daemon.store.copying import backup
from daemon.store.engine import translated
from daemon.store.errors import DatabaseDamagedError


def alembic_config() -> Config:
    """Alembic's settings; the scripts are those installed beside this program."""
    config = Config()
    config.set_main_option("script_location", str(files("migrations")).replace("%", "%%"))
    return config


def head_revision() -> str:
    """The revision this version of the program works with."""
    return known_revisions()[-1]


def known_revisions() -> list[str]:
    """The revisions whose scripts are installed, in the order in which they are applied."""
    scripts = ScriptDirectory.from_config(alembic_config())
    known = [script.revision for script in scripts.walk_revisions()][::-1]
    if not known:
        msg = "no migrations are installed: install the program anew"
        raise RuntimeError(msg)
    return known


def revision(connection: Connection, path: Path) -> str | None:
    """A database's revision; None for one without tables.

    Raises DatabaseDamagedError for a database that this program never made.
    """
    tables = set(inspect(connection).get_table_names())
    if not tables:
        return None
    if "alembic_version" in tables:
        found = connection.scalar(text("SELECT version_num FROM alembic_version"))
        if found is not None:
            return str(found)
    msg = f"{path}: a SQLite database, but not one of this program: name another state directory"
    raise DatabaseDamagedError(msg)


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
        return None
    saved = None
    if found is not None:
        _clear_half_copies(path)
        saved = _backup_name(path, found, now_utc)
        backup(path, saved)
    try:
        with translated(path):
            _upgrade(engine)
    except BaseException:
        if saved is not None:  # nothing has changed; copies must not pile up with every restart
            saved.unlink()
        raise
    return saved


def _upgrade(engine: Engine) -> None:
    """Upgrade in a transaction that holds the write lock from its start.

    The revision is read again inside it, so that of two processes only one upgrades.
    """
    config = alembic_config()
    with engine.execution_options(dcam_begin="IMMEDIATE").begin() as connection:
        config.attributes["connection"] = connection
        command.upgrade(config, "head")


def _clear_half_copies(path: Path) -> None:
    """Remove what a cut left of an earlier backup: no later one has that name again."""
    for half in path.parent.glob(f".{path.name}.revision-*.tmp*"):
        with suppress(OSError):  # the backup, next, says what is wrong with the directory
            half.unlink()


def _backup_name(path: Path, found: str, now_utc: datetime) -> Path:
    stamp = now_utc.astimezone(UTC).strftime("%Y%m%dT%H%M%SZ")
    name = f"{path.name}.revision-{found}.{stamp}"
    candidate = path.with_name(name)
    number = 1
    while candidate.exists():  # a clock that stands still must not cost an older backup
        number += 1
        candidate = path.with_name(f"{name}.{number}")
    return candidate
