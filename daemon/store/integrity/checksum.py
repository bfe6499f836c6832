"""The checksum in every row, so that a flipped byte is an error and never a value.

SQLite notices pages that contradict each other, not a changed number within one. Every row
therefore carries the first 8 bytes of the BLAKE2b of its table's name and its columns that are not
NULL, as JSON (keys sorted, ASCII only). A column added later and left NULL changes no digest; a
migration that writes values must renew it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping

from daemon.errors import DamagedRowError

DIGEST = "digest"
"""The column of every table that holds its row's checksum."""

# No column holds bytes; only damage makes them.
encoded = json.JSONEncoder(sort_keys=True, separators=(",", ":"), default=repr).encode
"""A value, or a row's values by name, as the digest takes them."""


def row_digest(table: str, values: Mapping[str, object]) -> int:
    """The digest of a row: 64 bits, signed, of the values as SQLite holds them."""
    known = {name: value for name, value in values.items() if value is not None and name != DIGEST}
    content = f"{table}{encoded(known)}".encode()
    return int.from_bytes(hashlib.blake2b(content, digest_size=8).digest(), "big", signed=True)


def require_intact(table: str, values: Mapping[str, object], digest: object) -> None:
    """Raise DamagedRowError unless a row, as SQLite holds it, is what was written."""
    if row_digest(table, values) != digest:
        raise not_as_written(table, values)


def not_as_written(table: str, values: Mapping[str, object]) -> DamagedRowError:
    """The error that names a damaged row."""
    return DamagedRowError(f"a row of {table}, {named(values)}, is not what was written")


def named(values: Mapping[str, object]) -> str:
    """A row by the name that a user knows it by."""
    for name in ("slot_utc", "start_utc", "day", "name", "id"):
        if name in values:
            return f"{name} {values[name]}"
    return "unnamed"
