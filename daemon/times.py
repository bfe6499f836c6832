"""Times as the database, file names' tables and exports write them.

TEXT in UTC, so that any SQLite tool reads them and their order is the order of time: slots
`2026-03-01T00:00:00Z`, instants `2026-03-01T00:00:00.000000Z`.
"""

from __future__ import annotations

from datetime import UTC, datetime

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def slot_text(slot_utc: datetime) -> str:
    """A slot as the database, file names' tables and exports write it.

    Raises ValueError for a time without zone or with a fraction of a second.
    """
    if slot_utc.tzinfo is None or slot_utc.microsecond:
        msg = f"not a slot (whole seconds, with a time zone): {slot_utc.isoformat()}"
        raise ValueError(msg)
    return slot_utc.astimezone(UTC).replace(tzinfo=None).isoformat(timespec="seconds") + "Z"


def instant_text(time_utc: datetime) -> str:
    """A moment, to the microsecond. Raises ValueError for a time without zone."""
    if time_utc.tzinfo is None:
        msg = f"not a moment in UTC (no time zone): {time_utc.isoformat()}"
        raise ValueError(msg)
    return time_utc.astimezone(UTC).replace(tzinfo=None).isoformat(timespec="microseconds") + "Z"


def stamp_text(when: datetime) -> str:
    """A moment in the name of a file, to the second: `20260301T000000Z`."""
    return when.astimezone(UTC).strftime("%Y%m%dT%H%M%SZ")
