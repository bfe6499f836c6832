"""Further targets in the main image: what each says, and what the fixed ones say together.

All may be NULL and are so in older rows, whose digests therefore stay as they are.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None

_NUMBERS = (
    *("sigma_image_x_mm", "sigma_image_y_mm", "cov_image_xy_mm2"),
    *("closure_x_mm", "closure_y_mm"),
    *("closure_sigma_x_mm", "closure_sigma_y_mm", "closure_cov_xy_mm2"),
)


def upgrade() -> None:
    """Add the columns, and an index that holds the closures of a month side by side."""
    for name in _NUMBERS:
        op.add_column("measurement", sa.Column(name, sa.Float()))
    op.add_column("measurement", sa.Column("targets", sa.Text()))
    op.execute(
        "CREATE INDEX ix_measurement_closure ON measurement (slot_utc, closure_x_mm,"
        " closure_y_mm, closure_sigma_x_mm, closure_sigma_y_mm) WHERE closure_x_mm IS NOT NULL"
    )
