"""What a link of the datum has in common with the rows that count from its reference."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the column."""
    op.add_column("datum", sa.Column("reference_errors", sa.Text()))
