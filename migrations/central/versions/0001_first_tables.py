"""Sites, their rows by month, and what hangs on them."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects.postgresql import JSONB, TIMESTAMP

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None

_TIME = TIMESTAMP(timezone=True)

_MONTH = """
CREATE FUNCTION dcam_month(slot timestamptz) RETURNS void
LANGUAGE plpgsql SECURITY DEFINER SET search_path FROM CURRENT AS $$
DECLARE
  since timestamp := date_trunc('month', slot AT TIME ZONE 'UTC');
  part text := 'measurement_' || to_char(since, 'YYYY_MM');
BEGIN
  IF to_regclass(part) IS NOT NULL THEN
    RETURN;
  END IF;
  PERFORM pg_advisory_xact_lock(hashtext('dcam_month'));
  EXECUTE format(
    'CREATE TABLE IF NOT EXISTS %I PARTITION OF measurement FOR VALUES FROM (%L) TO (%L)',
    part, since AT TIME ZONE 'UTC', (since + interval '1 month') AT TIME ZONE 'UTC');
END $$
"""
"""Makes a month's part of the rows; piers may call it, and need no right to make tables."""


def upgrade() -> None:
    """Make the tables."""
    op.create_table(
        "calibration",
        sa.Column("site_id", sa.Integer(), nullable=False),
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("created_utc", _TIME, nullable=False),
        sa.Column("method", sa.Text(), nullable=False),
        sa.Column("passed", sa.Boolean(), nullable=False),
        sa.Column("content", sa.Text(), nullable=False),
        sa.Column("report", sa.Text(), nullable=False),
        sa.Column("frames", sa.Text()),
        sa.Column("config_hash", sa.Text(), nullable=False),
        sa.Column("version", sa.Text(), nullable=False),
        sa.Column("digest", sa.BigInteger()),
        sa.PrimaryKeyConstraint("site_id", "id"),
    )
    op.create_table(
        "calibration_activation",
        sa.Column("site_id", sa.Integer(), nullable=False),
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("calibration_id", sa.Integer(), nullable=False),
        sa.Column("activated_utc", _TIME, nullable=False),
        sa.Column("digest", sa.BigInteger()),
        sa.PrimaryKeyConstraint("site_id", "id"),
    )
    op.create_table(
        "datum",
        sa.Column("site_id", sa.Integer(), nullable=False),
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("calibration_id", sa.Integer(), nullable=False),
        sa.Column("created_utc", _TIME, nullable=False),
        sa.Column("reference_utc", _TIME),
        sa.Column("method", sa.Text(), nullable=False),
        sa.Column("x_mm", sa.Float(), nullable=False),
        sa.Column("y_mm", sa.Float(), nullable=False),
        sa.Column("var_x_mm2", sa.Float(), nullable=False),
        sa.Column("var_y_mm2", sa.Float(), nullable=False),
        sa.Column("cov_xy_mm2", sa.Float(), nullable=False),
        sa.Column("targets", sa.Text(), nullable=False),
        sa.Column("steps", sa.Text(), nullable=False),
        sa.Column("detail", sa.Text(), nullable=False),
        sa.Column("digest", sa.BigInteger()),
        sa.PrimaryKeyConstraint("site_id", "id"),
    )
    op.create_table(
        "event",
        sa.Column("site_id", sa.Integer(), nullable=False),
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("time_utc", _TIME, nullable=False),
        sa.Column("kind", sa.Text(), nullable=False),
        sa.Column("detail", sa.Text(), nullable=False),
        sa.Column("digest", sa.BigInteger()),
        sa.PrimaryKeyConstraint("site_id", "id", "time_utc"),
    )
    op.create_table(
        "gap",
        sa.Column("site_id", sa.Integer(), nullable=False),
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("start_utc", _TIME, nullable=False),
        sa.Column("end_utc", _TIME, nullable=False),
        sa.Column("slots", sa.Integer(), nullable=False),
        sa.Column("period_s", sa.Integer(), nullable=False),
        sa.Column("cause", sa.Text(), nullable=False),
        sa.Column("detail", sa.Text(), nullable=False),
        sa.Column("digest", sa.BigInteger()),
        sa.PrimaryKeyConstraint("site_id", "id"),
    )
    op.create_table(
        "ledger",
        sa.Column("site_id", sa.Integer(), nullable=False),
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("created_utc", _TIME, nullable=False),
        sa.Column("author", sa.Text(), nullable=False),
        sa.Column("kind", sa.Text(), nullable=False),
        sa.Column("since_utc", _TIME),
        sa.Column("until_utc", _TIME),
        sa.Column("point", sa.Text()),
        sa.Column("entry_id", sa.Integer()),
        sa.Column("text", sa.Text(), nullable=False),
        sa.Column("digest", sa.BigInteger()),
        sa.PrimaryKeyConstraint("site_id", "id"),
    )
    op.create_table(
        "mark",
        sa.Column("site_id", sa.Integer(), nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("value", sa.Text(), nullable=False),
        sa.Column("digest", sa.BigInteger()),
        sa.PrimaryKeyConstraint("site_id", "name"),
    )
    op.create_table(
        "measurement",
        sa.Column("site_id", sa.Integer(), nullable=False),
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("slot_utc", _TIME, nullable=False),
        sa.Column("flag", sa.Integer(), nullable=False),
        sa.Column("reasons", sa.Text(), nullable=False),
        sa.Column("x_mm", sa.Float()),
        sa.Column("y_mm", sa.Float()),
        sa.Column("sigma_x_mm", sa.Float()),
        sa.Column("sigma_y_mm", sa.Float()),
        sa.Column("cov_xy_mm2", sa.Float()),
        sa.Column("raw_x_mm", sa.Float()),
        sa.Column("raw_y_mm", sa.Float()),
        sa.Column("raw_sigma_x_mm", sa.Float()),
        sa.Column("raw_sigma_y_mm", sa.Float()),
        sa.Column("raw_cov_xy_mm2", sa.Float()),
        sa.Column("rx_rad", sa.Float()),
        sa.Column("ry_rad", sa.Float()),
        sa.Column("rz_rad", sa.Float()),
        sa.Column("tx_mm", sa.Float()),
        sa.Column("ty_mm", sa.Float()),
        sa.Column("tz_mm", sa.Float()),
        sa.Column("motion_covariance", sa.Text()),
        sa.Column("discs_found", sa.Integer(), nullable=False),
        sa.Column("corners_used", sa.Integer(), nullable=False),
        sa.Column("main_residual_px", sa.Float()),
        sa.Column("sub_residual_px", sa.Float()),
        sa.Column("main_contrast_dn", sa.Float()),
        sa.Column("sub_contrast_dn", sa.Float()),
        sa.Column("main_blur_px", sa.Float()),
        sa.Column("sub_blur_px", sa.Float()),
        sa.Column("spread_x_mm", sa.Float()),
        sa.Column("spread_y_mm", sa.Float()),
        sa.Column("frames_used", sa.Integer(), nullable=False),
        sa.Column("skew_s", sa.Float()),
        sa.Column("main_exposure_us", sa.Float()),
        sa.Column("main_gain_db", sa.Float()),
        sa.Column("main_temperature_c", sa.Float()),
        sa.Column("sub_exposure_us", sa.Float()),
        sa.Column("sub_gain_db", sa.Float()),
        sa.Column("sub_temperature_c", sa.Float()),
        sa.Column("main_frame", sa.Text()),
        sa.Column("sub_frame", sa.Text()),
        sa.Column("captured_utc", _TIME),
        sa.Column("boot_id", sa.Text()),
        sa.Column("uptime_s", sa.Float()),
        sa.Column("clock_synchronised", sa.Boolean()),
        sa.Column("redated_from_utc", _TIME),
        sa.Column("recorded_late", sa.Boolean(), nullable=False),
        sa.Column("calibration_id", sa.Integer()),
        sa.Column("config_hash", sa.Text(), nullable=False),
        sa.Column("version", sa.Text(), nullable=False),
        sa.Column("sigma_image_x_mm", sa.Float()),
        sa.Column("sigma_image_y_mm", sa.Float()),
        sa.Column("cov_image_xy_mm2", sa.Float()),
        sa.Column("closure_x_mm", sa.Float()),
        sa.Column("closure_y_mm", sa.Float()),
        sa.Column("closure_sigma_x_mm", sa.Float()),
        sa.Column("closure_sigma_y_mm", sa.Float()),
        sa.Column("closure_cov_xy_mm2", sa.Float()),
        sa.Column("targets", sa.Text()),
        sa.Column("readings", sa.Text()),
        sa.Column("digest", sa.BigInteger()),
        sa.PrimaryKeyConstraint("site_id", "slot_utc"),
        postgresql_partition_by="RANGE (slot_utc)",
    )
    op.create_table(
        "site",
        sa.Column("id", sa.Integer(), sa.Identity(), primary_key=True),
        sa.Column("name", sa.Text(), nullable=False, unique=True),
        sa.Column("identity", sa.Text(), nullable=False),
        sa.Column("revision", sa.Text(), nullable=False),
        sa.Column("version", sa.Text(), nullable=False),
        sa.Column("heard_utc", _TIME, nullable=False),
        sa.Column("period_s", sa.Integer(), nullable=False),
        sa.Column("latitude_deg", sa.Float()),
        sa.Column("longitude_deg", sa.Float()),
        sa.Column("level", sa.SmallInteger()),
        sa.Column("summary", sa.Text()),
        sa.Column("status", JSONB()),
        sa.Column("config", sa.Text()),
        sa.Column("last_slot_utc", _TIME),
        sa.Column("progress", JSONB()),
        sa.Column("event_id", sa.BigInteger(), nullable=False, server_default="0"),
        sa.Column("small", JSONB(), nullable=False, server_default="{}"),
        sa.Column("rewritten", sa.BigInteger(), nullable=False, server_default="0"),
    )
    op.create_index("ix_site_level", "site", ["level"])
    op.execute("ALTER TABLE site SET (fillfactor = 50)")  # each pier changes its row all the time
    op.execute(_MONTH)
