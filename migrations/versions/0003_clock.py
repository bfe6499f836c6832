"""What a row's time rests on, and what was taken while the clock was wrong.

A row knows its boot and the seconds since, and whether the clock was disciplined then: with these
its time can be put right once the clock is. What is taken while the clock is before the last slot
goes to `undated` until it can be dated.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add columns, table and index; of older rows none of this is known."""
    for column in (
        sa.Column("boot_id", sa.Text()),
        sa.Column("uptime_s", sa.Float()),
        sa.Column("clock_synchronised", sa.Boolean()),
        sa.Column("redated_from_utc", sa.Text()),
    ):
        op.add_column("measurement", column)
    op.execute(
        "CREATE INDEX ix_measurement_unsynchronised ON measurement (boot_id, uptime_s) "
        "WHERE clock_synchronised = 0"
    )
    op.execute(
        "CREATE INDEX ix_measurement_redated ON measurement (redated_from_utc) "
        "WHERE redated_from_utc IS NOT NULL"
    )
    op.create_table(
        "undated",
        sa.Column("id", sa.Integer(), primary_key=True),
        sa.Column("boot_id", sa.Text(), nullable=False),
        sa.Column("uptime_s", sa.Float(), nullable=False),
        sa.Column("clock_utc", sa.Text(), nullable=False),
        sa.Column("content", sa.Text(), nullable=False),
        sa.UniqueConstraint("boot_id", "uptime_s"),
    )
