"""New databases that are copied from one that all migrations have gone through, once in a process.

The migrations take ten times as long as all else that a test of a few rows does. They have tests of
their own, on databases of every revision; a database that is there already is migrated as ever.
"""

from __future__ import annotations

import atexit
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path
from tempfile import mkdtemp
from uuid import uuid4

from sqlalchemy import Engine

from daemon.store import migrate
from daemon.store.records import Mark
from daemon.store.sqlite import FILE_NAME


def share() -> None:
    """Have all new stores from now on in this process be copies, each with its own identity."""
    by_migrations = migrate._upgrade_plainly
    directory = Path(mkdtemp(prefix="dcam-tests-"))
    atexit.register(shutil.rmtree, directory, ignore_errors=True)
    made = directory / FILE_NAME

    def upgrade(engine: Engine, path: Path) -> None:
        with closing(engine.raw_connection()) as pooled:
            is_new = not pooled.cursor().execute("SELECT 1 FROM sqlite_schema").fetchall()
        if not (is_new and made.exists()):
            by_migrations(engine, path)
        if is_new and not made.exists():
            with closing(engine.raw_connection()) as pooled, closing(sqlite3.connect(made)) as copy:
                pooled.driver_connection.backup(copy)
        elif is_new:
            with closing(engine.raw_connection()) as pooled, closing(sqlite3.connect(made)) as copy:
                copy.backup(pooled.driver_connection)
            with engine.begin() as connection:
                migrate._set_mark(connection, Mark.IDENTITY, uuid4().hex, replace=True)

    migrate._upgrade_plainly = upgrade
