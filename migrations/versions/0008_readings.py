"""What sensors said at each slot, in its row."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the column; of older rows there are no readings."""
    op.add_column("measurement", sa.Column("readings", sa.Text()))
