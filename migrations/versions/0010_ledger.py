"""What people say of the record: spans annotated or excluded, comments, and what was taken back."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None

_IMMUTABLE = """
CREATE TRIGGER ledger_no_{verb} BEFORE {verb} ON ledger
BEGIN SELECT RAISE(ABORT, 'ledger rows are immutable'); END
"""


def upgrade() -> None:
    """Make the table; rows are never changed by what stands in it."""
    op.create_table(
        "ledger",
        sa.Column("id", sa.Integer(), primary_key=True),
        sa.Column("created_utc", sa.Text(), nullable=False),
        sa.Column("author", sa.Text(), nullable=False),
        sa.Column("kind", sa.Text(), nullable=False),
        sa.Column("since_utc", sa.Text()),
        sa.Column("until_utc", sa.Text()),
        sa.Column("point", sa.Text()),
        sa.Column("entry_id", sa.Integer()),
        sa.Column("text", sa.Text(), nullable=False),
        sa.Column("digest", sa.Integer()),
    )
    for verb in ("update", "delete"):
        op.execute(_IMMUTABLE.format(verb=verb))
