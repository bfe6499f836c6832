"""Where the reference of each calibration lies in the record's zero: links that never change."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None

_IMMUTABLE = """
CREATE TRIGGER datum_no_{verb} BEFORE {verb} ON datum
BEGIN SELECT RAISE(ABORT, 'datum rows are immutable'); END
"""


def upgrade() -> None:
    """Make the table; a calibration without a line measures in a zero of its own."""
    op.create_table(
        "datum",
        sa.Column("id", sa.Integer(), primary_key=True),
        sa.Column("calibration_id", sa.Integer(), sa.ForeignKey("calibration.id"), nullable=False),
        sa.Column("created_utc", sa.Text(), nullable=False),
        sa.Column("reference_utc", sa.Text()),
        sa.Column("method", sa.Text(), nullable=False),
        sa.Column("x_mm", sa.Float(), nullable=False),
        sa.Column("y_mm", sa.Float(), nullable=False),
        sa.Column("var_x_mm2", sa.Float(), nullable=False),
        sa.Column("var_y_mm2", sa.Float(), nullable=False),
        sa.Column("cov_xy_mm2", sa.Float(), nullable=False),
        sa.Column("targets", sa.Text(), nullable=False),
        sa.Column("steps", sa.Text(), nullable=False),
        sa.Column("detail", sa.Text(), nullable=False),
        sa.Column("digest", sa.Integer()),
    )
    op.create_index("ix_datum_calibration", "datum", ["calibration_id"])
    for verb in ("update", "delete"):
        op.execute(_IMMUTABLE.format(verb=verb))
