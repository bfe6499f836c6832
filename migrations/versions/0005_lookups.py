"""Indexes for what is asked at every slot and by every status, whatever the number of rows.

A row is held against the rows before it of its calibration and with its reasons; coverage counts
the flags of a month. Without these both read row after row of the table.
"""

from __future__ import annotations

from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add them."""
    op.create_index("ix_measurement_kin", "measurement", ["calibration_id", "reasons", "slot_utc"])
    op.create_index("ix_measurement_fate", "measurement", ["slot_utc", "flag"])
