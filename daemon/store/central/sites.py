"""All sites of a central database, as each said it was: one query, however many rows there are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import func, select

from daemon.store.central.connecting import Central
from daemon.store.central.site_table import SITE


@dataclass(frozen=True, slots=True)
class CentralSite:
    """A site as its pier said it was."""

    id: int
    name: str
    heard_utc: datetime
    """By the central server's clock."""
    level: int | None
    """As in `status`; None where it has not said."""
    summary: str
    last_slot_utc: datetime | None
    position_deg: tuple[float, float] | None
    """Latitude, longitude."""
    version: str
    silent_s: float
    """Since it was heard, by the central server's clock."""
    period_s: int
    slot_age_s: float | None
    """Of the last slot, by the central server's clock."""
    alarms: int | None
    """How many are raised there; None where it has not said."""


def read_sites(central: Central, name: str | None = None) -> list[CentralSite]:
    """All of them by name, or the one of a name. Raises CentralAwayError."""
    columns = SITE.c
    query = select(
        *(columns.id, columns.name, columns.heard_utc, columns.level, columns.summary),
        *(columns.last_slot_utc, columns.latitude_deg, columns.longitude_deg, columns.version),
        *(columns.period_s, columns.alarms),
        func.extract("epoch", func.now() - columns.heard_utc).label("silent_s"),
        func.extract("epoch", func.now() - columns.last_slot_utc).label("slot_age_s"),
    ).order_by(columns.name)
    if name is not None:
        query = query.where(columns.name == name)
    with central.transaction() as connection:
        found = connection.execute(query).all()
    return [
        CentralSite(
            row.id,
            row.name,
            row.heard_utc,
            row.level,
            row.summary or "",
            row.last_slot_utc,
            None if row.latitude_deg is None else (row.latitude_deg, row.longitude_deg),
            row.version,
            float(row.silent_s),
            row.period_s,
            None if row.slot_age_s is None else float(row.slot_age_s),
            row.alarms,
        )
        for row in found
    ]


def site_row(central: Central, name: str) -> Mapping[str, Any] | None:
    """Everything that the central database has of one site itself. Raises CentralAwayError."""
    with central.transaction() as connection:
        found = connection.execute(select(SITE).where(SITE.c.name == name)).mappings().one_or_none()
    return None if found is None else dict(found)
