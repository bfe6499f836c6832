"""How many alarms each site has raised, and how often rows of its closed months changed."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects.postgresql import JSONB

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the columns; what was not counted before is unknown, and no late row."""
    op.add_column("site", sa.Column("alarms", sa.SmallInteger()))
    op.add_column("site", sa.Column("late", JSONB(), nullable=False, server_default="{}"))
