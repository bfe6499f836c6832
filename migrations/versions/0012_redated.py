"""Rows as a wrong clock had dated them, and what came of measuring them again.

Rows that were dated again before are not in it: they stay as they are.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None

_IMMUTABLE = """
CREATE TRIGGER redated_no_{name} BEFORE {event} ON redated
BEGIN SELECT RAISE(ABORT, 'what was measured stays as it was'); END
"""


def upgrade() -> None:
    """Make the table; what it holds of a row is never changed."""
    op.create_table(
        "redated",
        sa.Column("id", sa.Integer(), primary_key=True),
        sa.Column("slot_utc", sa.Text()),
        sa.Column("from_slot_utc", sa.Text(), nullable=False),
        sa.Column("content", sa.Text(), nullable=False),
        sa.Column("row_id", sa.Integer()),
        sa.Column("newest_id", sa.Integer()),
        sa.Column("again", sa.Text()),
        sa.Column("digest", sa.Integer()),
    )
    op.create_index(
        "ix_redated_waiting", "redated", ["slot_utc"], sqlite_where=sa.text("again IS NULL")
    )
    op.execute(_IMMUTABLE.format(name="delete", event="DELETE"))
    kept = "UPDATE OF slot_utc, from_slot_utc, content, row_id, newest_id"
    op.execute(_IMMUTABLE.format(name="update", event=kept))
