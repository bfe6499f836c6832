"""The central tables: a site's own, column by column from the same models, behind its number.

The central revisions make them (a test holds the two together).
"""

from __future__ import annotations

from typing import Any, cast

from sqlalchemy import (
    BigInteger,
    Boolean,
    Column,
    Integer,
    PrimaryKeyConstraint,
    Table,
)

from daemon.store.central.site_table import CENTRAL
from daemon.store.integrity.checksum import DIGEST
from daemon.store.schema import (
    ActivationRow,
    Base,
    CalibrationRow,
    DatumRow,
    EventRow,
    GapRow,
    LedgerRow,
    MarkRow,
    MeasurementRow,
)
from daemon.store.time_types import Slot


def _central(model: type[Base], *key: str) -> Table:
    """A model's table with the site's number before its columns and in its key."""
    columns = [_copied(column) for column in cast("Table", model.__table__).columns]
    return Table(
        model.__tablename__,
        CENTRAL,
        Column("site_id", Integer, nullable=False),
        *columns,
        PrimaryKeyConstraint("site_id", *key),
    )


def _copied(column: Column[Any]) -> Column[Any]:
    kind = BigInteger() if column.name == DIGEST else column.type
    return Column(column.name, kind, nullable=column.nullable and not column.primary_key)


MEASUREMENT = _central(MeasurementRow, "slot_utc")
EVENT = _central(EventRow, "id", "time_utc")
GAP = _central(GapRow, "id")
CALIBRATION = _central(CalibrationRow, "id")
ACTIVATION = _central(ActivationRow, "id")
DATUM = _central(DatumRow, "id")
LEDGER = _central(LedgerRow, "id")
MARK = _central(MarkRow, "name")

MIRRORED = (CALIBRATION, ACTIVATION, DATUM, LEDGER, GAP, MARK)
"""Small tables, copied by what differs, in an order in which each names only what is there."""
CHANGING = frozenset({GAP.name, MARK.name})
"""Whose rows change and go; of the others each stays for good."""

DIGEST_PART = 0xFFFF_FFFF
"""Of a digest, for sums: so that the sum of many fits into 64 bits."""


def key_of(table: Table) -> str:
    """The column that names a row within its site."""
    return next(column.name for column in table.primary_key if column.name != "site_id")


def from_sqlite(table: Table, row: dict[str, Any], site_id: int) -> dict[str, Any]:
    """A row as SQLite holds it, for the central table."""
    from datetime import datetime

    found: dict[str, Any] = {"site_id": site_id}
    for name, value in row.items():
        kind = table.c[name].type
        if value is None:
            found[name] = None
        elif isinstance(kind, Slot):
            found[name] = datetime.fromisoformat(value)
        elif isinstance(kind, Boolean):
            found[name] = bool(value)
        else:
            found[name] = value
    return found


def to_sqlite(table: Table, row: dict[str, Any]) -> dict[str, Any]:
    """A central row as the site's SQLite held it, its digest with it."""
    found: dict[str, Any] = {}
    for name, value in row.items():
        kind = table.c[name].type
        if name == "site_id":
            continue
        if value is None:
            found[name] = None
        elif isinstance(kind, Slot):
            found[name] = kind.text(value)
        elif isinstance(kind, Boolean):
            found[name] = int(value)
        else:
            found[name] = str(value) if kind.python_type is str else value
    return found
