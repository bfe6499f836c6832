"""SQL that is compiled once in a process: each test has its own database, and the same statements.

SQLAlchemy keeps what it compiles for each engine by itself; of a test that opens a database, writes
a few rows and closes it, a quarter of the time goes into that.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import Engine
from sqlalchemy.dialects.sqlite.pysqlite import SQLiteDialect_pysqlite
from sqlalchemy.util import LRUCache

from daemon.store import engine


def share() -> None:
    """Have all engines from now on keep it in one place, and all dialects count as one."""
    create, compiled = engine.create_engine, LRUCache(1000)

    def create_engine(*arguments: Any, **options: Any) -> Engine:
        made = create(*arguments, **options)
        made._compiled_cache = compiled
        return made

    engine.create_engine = create_engine
    SQLiteDialect_pysqlite.__eq__ = lambda self, other: type(self) is type(other)
    SQLiteDialect_pysqlite.__hash__ = lambda self: hash(type(self))
