"""A checksum in every row, so that a flipped byte is noticed.

What stands in a row at this moment is believed and signed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None

_TABLES = (
    "calibration",
    "calibration_activation",
    "measurement",
    "gap",
    "event",
    "mark",
    "undated",
)

_IMMUTABLE = """
CREATE TRIGGER {table}_no_update BEFORE update ON {table}
BEGIN SELECT RAISE(ABORT, '{table} rows are immutable'); END
"""


def upgrade() -> None:
    """Add the column and fill it; the rows that never change may, this once."""
    immutable = ("calibration", "calibration_activation")
    for table in immutable:
        op.execute(f"DROP TRIGGER {table}_no_update")
    for table in _TABLES:
        op.add_column(table, sa.Column("digest", sa.Integer()))
        _fill(table)
    for table in immutable:
        op.execute(_IMMUTABLE.format(table=table))


def _fill(table: str) -> None:
    connection = op.get_bind()
    found = connection.exec_driver_sql(f"PRAGMA table_info({table})")
    names = [name for _, name, *_ in found if name != "digest"]
    driver = connection.connection.driver_connection
    driver.create_function("dcam_digest", len(names), _digest_of(table, names))  # type: ignore[union-attr]
    values = ", ".join(names)
    op.execute(f"UPDATE {table} SET digest = dcam_digest({values})")  # noqa: S608 - our own names


def _digest_of(table: str, names: list[str]) -> Callable[..., int]:
    def digest(*values: object) -> int:
        known = {
            name: value for name, value in zip(names, values, strict=True) if value is not None
        }
        content = f"{table}{json.dumps(known, sort_keys=True, separators=(',', ':'))}".encode()
        return int.from_bytes(hashlib.blake2b(content, digest_size=8).digest(), "big", signed=True)

    return digest
