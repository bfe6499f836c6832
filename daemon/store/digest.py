"""A checksum in every row, so that a flipped byte is an error and never a value.

SQLite notices pages that contradict each other, not a changed number within one. Every row
therefore carries the first 8 bytes of the BLAKE2b of its table's name and its columns that are not
NULL, as JSON (keys sorted, ASCII only). A column added later and left NULL changes no digest; a
migration that writes values must renew it.

`CheckedSession` sets the digest of what it writes and checks that of every row it loads.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, cast

from sqlalchemy import Boolean, Float, TypeDecorator, func, select
from sqlalchemy.dialects.sqlite import dialect as sqlite_dialect
from sqlalchemy.event import listens_for
from sqlalchemy.orm import ORMExecuteState, Session, UOWTransaction, class_mapper, object_mapper

from daemon.store.errors import DamagedRowError
from daemon.store.schema import DIGEST, Base

# No column holds bytes; only damage makes them.
_encode = json.JSONEncoder(sort_keys=True, separators=(",", ":"), default=repr).encode
_DIALECT = sqlite_dialect()

Convert = Callable[[Any], object]


def row_digest(table: str, values: Mapping[str, object]) -> int:
    """The digest of a row: 64 bits, signed, of the values as SQLite holds them."""
    known = {name: value for name, value in values.items() if value is not None and name != DIGEST}
    content = f"{table}{_encode(known)}".encode()
    return int.from_bytes(hashlib.blake2b(content, digest_size=8).digest(), "big", signed=True)


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
    values = stored_values(row)
    if row_digest(row.__tablename__, values) != row.digest:
        msg = f"a row of {row.__tablename__}, {named(values)}, is not what was written"
        raise DamagedRowError(msg)


@listens_for(CheckedSession, "do_orm_execute")
def _refuse_bulk(state: ORMExecuteState) -> None:
    """A statement that writes past the session would leave the rows' digests behind."""
    if state.is_update or state.is_insert:
        msg = "write rows through the session's objects, or their digests would not fit"
        raise TypeError(msg)


def named(values: Mapping[str, object]) -> str:
    """A row by the name that a user knows it by."""
    for name in ("slot_utc", "start_utc", "name", "id"):
        if name in values:
            return f"{name} {values[name]}"
    return "unnamed"
