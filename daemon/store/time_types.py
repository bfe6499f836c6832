"""Times in the tables, apart from the models, which the list of all sites does not need.

Times are TEXT in UTC, so that any SQLite tool reads them and their order is the order of time:
slots `2026-03-01T00:00:00Z`, instants `2026-03-01T00:00:00.000000Z`. In a central PostgreSQL they
are its own, `timestamptz`: 8 bytes each, and what months are parted by.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from sqlalchemy import TIMESTAMP, Dialect, Text, TypeDecorator
from sqlalchemy.types import TypeEngine

from daemon.errors import DamagedRowError
from daemon.times import instant_text, slot_text


class Slot(TypeDecorator[datetime]):
    """A slot time."""

    impl = Text
    cache_ok = True

    def load_dialect_impl(self, dialect: Dialect) -> TypeEngine[Any]:
        """PostgreSQL has a type of its own."""
        if dialect.name == "postgresql":
            return dialect.type_descriptor(TIMESTAMP(timezone=True))
        return dialect.type_descriptor(Text())

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> str | datetime | None:
        """Write."""
        if value is None or dialect.name == "postgresql":
            return value
        return self.text(value)

    def text(self, value: datetime) -> str:
        """A time as SQLite holds it."""
        return slot_text(value)

    def process_result_value(
        self, value: str | datetime | None, _dialect: Dialect
    ) -> datetime | None:
        """Read."""
        if value is None:
            return None
        if isinstance(value, datetime):
            return value.astimezone(UTC)
        try:
            return datetime.fromisoformat(value)
        except (ValueError, TypeError) as error:
            msg = f"{value!r} is no time"
            raise DamagedRowError(msg) from error


class Instant(Slot):
    """A moment to the microsecond."""

    cache_ok = True

    def text(self, value: datetime) -> str:
        """A time as SQLite holds it."""
        return instant_text(value)
