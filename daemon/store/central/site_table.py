"""`site`, the central database's own: who there is, how far each has come, how it said it was.

Apart from the sites' tables, which are made from the models: the list of all sites does not need
these, and to load them takes longer than to read 10,000 sites.
"""

from __future__ import annotations

from sqlalchemy import (
    BigInteger,
    Column,
    Float,
    Identity,
    Index,
    Integer,
    MetaData,
    SmallInteger,
    Table,
    Text,
)
from sqlalchemy.dialects.postgresql import JSONB

from daemon.store.time_types import Instant, Slot

CENTRAL = MetaData()
"""Of all central tables."""

SITE = Table(
    "site",
    CENTRAL,
    Column("id", Integer, Identity(), primary_key=True),
    Column("name", Text, nullable=False, unique=True),
    Column("identity", Text, nullable=False),
    Column("revision", Text, nullable=False),
    Column("version", Text, nullable=False),
    Column("heard_utc", Instant, nullable=False),
    Column("period_s", Integer, nullable=False),
    Column("latitude_deg", Float),
    Column("longitude_deg", Float),
    Column("level", SmallInteger),
    Column("summary", Text),
    Column("status", JSONB),
    Column("config", Text),
    Column("last_slot_utc", Slot),
    Column("progress", JSONB),
    Column("event_id", BigInteger, nullable=False, server_default="0"),
    Column("small", JSONB, nullable=False, server_default="{}"),
    Column("rewritten", BigInteger, nullable=False, server_default="0"),
    Column("alarms", SmallInteger),
    Column("late", JSONB, nullable=False, server_default="{}"),
)
"""`rewritten` counts rows that went or changed, so that a copy knows when it must begin again;
`alarms` those that are raised; `late`, by month, the copies that changed it when the site was in a
later month already, so that an archive knows which of its months to look at."""

Index("ix_site_level", SITE.c.level)
