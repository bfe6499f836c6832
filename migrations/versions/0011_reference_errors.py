"""What a link of the datum has in common with the rows that count from its reference.

NULL in older links, whose digests therefore stay as they are.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the column."""
    op.add_column("datum", sa.Column("reference_errors", sa.Text()))
