"""Rows that prove themselves: every one written gets its checksum, every one loaded is checked."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, cast

from sqlalchemy import Boolean, Float, TypeDecorator, func, select
from sqlalchemy.dialects.sqlite import dialect as sqlite_dialect
from sqlalchemy.event import listens_for
from sqlalchemy.orm import ORMExecuteState, Session, UOWTransaction, class_mapper, object_mapper

from daemon.store.integrity.checksum import DIGEST, require_intact, row_digest
from daemon.store.schema import Base

_DIALECT = sqlite_dialect()

Convert = Callable[[Any], object]


def stored_values(row: Base) -> dict[str, object]:
    """A row's columns as SQLite holds them: numbers, text and None."""
    values: dict[str, object] = {}
    for name, convert in _plan(type(row)):
        value = getattr(row, name)
        values[name] = value if value is None or convert is None else convert(value)
    return values


@cache
def _plan(kind: type[Base]) -> tuple[tuple[str, Convert | None], ...]:
    columns = class_mapper(kind).columns
    return tuple(
        (column.key, _converter(column.type)) for column in columns if column.key != DIGEST
    )


def _converter(kind: object) -> Convert | None:
    if isinstance(kind, TypeDecorator):
        return lambda value: kind.process_bind_param(value, _DIALECT)
    if isinstance(kind, Boolean):
        return int
    if isinstance(kind, Float):  # an int given is a REAL once stored; damage may have made text
        return lambda value: float(value) if isinstance(value, int) else value
    return None


class CheckedSession(Session):
    """A session whose rows prove themselves."""


@listens_for(CheckedSession, "before_flush")
def _sign(session: Session, _context: UOWTransaction, _instances: object) -> None:
    """Give new rows their ids, which the digest covers, and every changed row its digest."""
    new = sorted(session.new, key=lambda row: object_mapper(row).class_.__name__)
    ids: dict[type[Any], int] = {}
    for row in new:
        kind = cast("Any", type(row))
        if hasattr(kind, "id") and row.id is None:
            if kind not in ids:
                ids[kind] = session.scalar(select(func.max(kind.id))) or 0
            ids[kind] += 1
            row.id = ids[kind]
    for row in (*new, *session.dirty):
        row.digest = row_digest(row.__tablename__, stored_values(row))


@listens_for(CheckedSession, "loaded_as_persistent")
def _check(_session: Session, row: Base) -> None:
    require_intact(row.__tablename__, stored_values(row), row.digest)


@listens_for(CheckedSession, "do_orm_execute")
def _refuse_bulk(state: ORMExecuteState) -> None:
    """A statement that writes past the session would leave the rows' digests behind."""
    if state.is_update or state.is_insert:
        msg = "write rows through the session's objects, or their digests would not fit"
        raise TypeError(msg)
