"""What the frame archive holds of each day, and what has been removed of it on purpose."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Make the table; days without a line have not been counted yet."""
    op.create_table(
        "frame_day",
        sa.Column("day", sa.Text(), primary_key=True),
        sa.Column("level", sa.Text(), nullable=False),
        sa.Column("until_utc", sa.Text()),
        sa.Column("kept", sa.Text(), nullable=False),
        sa.Column("removed", sa.Integer(), nullable=False),
        sa.Column("bytes", sa.Integer(), nullable=False),
        sa.Column("finished", sa.Boolean(), nullable=False),
        sa.Column("digest", sa.Integer()),
    )
