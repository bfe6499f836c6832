"""Slots by their minute after noon."""

from datetime import UTC, datetime, timedelta

NOON = datetime(2026, 3, 1, 12, tzinfo=UTC)


def slot(minute: int) -> datetime:
    """The slot of a minute after noon."""
    return NOON + timedelta(minutes=minute)


def minute_of(slot_utc: datetime) -> int:
    """The minute after noon of a slot."""
    minutes, rest = divmod((slot_utc - NOON).total_seconds(), 60)
    assert rest == 0
    return int(minutes)
