"""Several pairs a slot: how many a value rests on, and how far they lie apart."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the columns; until now every value rested on one pair."""
    op.add_column("measurement", sa.Column("spread_x_mm", sa.Float()))
    op.add_column("measurement", sa.Column("spread_y_mm", sa.Float()))
    op.add_column(
        "measurement",
        sa.Column("frames_used", sa.Integer(), nullable=False, server_default=sa.text("0")),
    )
    op.execute("UPDATE measurement SET frames_used = 1 WHERE x_mm IS NOT NULL")
