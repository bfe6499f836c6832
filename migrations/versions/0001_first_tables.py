"""The first tables: measurements, gaps, calibrations, events and marks.

The triggers keep what the program promises also against other programs: a calibration never
changes, and no slot is both measured and missed.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None

_MEASURED_REAL = (
    *("x_mm", "y_mm", "sigma_x_mm", "sigma_y_mm", "cov_xy_mm2"),
    *("raw_x_mm", "raw_y_mm", "raw_sigma_x_mm", "raw_sigma_y_mm", "raw_cov_xy_mm2"),
    *("rx_rad", "ry_rad", "rz_rad", "tx_mm", "ty_mm", "tz_mm"),
)
_DIAGNOSTIC_REAL = (
    *("main_residual_px", "sub_residual_px"),
    *("main_contrast_dn", "sub_contrast_dn"),
    *("main_blur_px", "sub_blur_px"),
)
_CAMERA_REAL = (
    "skew_s",
    *("main_exposure_us", "main_gain_db", "main_temperature_c"),
    *("sub_exposure_us", "sub_gain_db", "sub_temperature_c"),
)

_IMMUTABLE = """
CREATE TRIGGER {table}_no_{verb} BEFORE {verb} ON {table}
BEGIN SELECT RAISE(ABORT, '{table} rows are immutable'); END
"""

# A gap holds the slots start + k * period only: after a change of the period, a slot may lie
# between two slots of an older gap without being one of them.
_NOT_IN_GAP = """
CREATE TRIGGER measurement_not_in_gap BEFORE INSERT ON measurement
WHEN EXISTS (
    SELECT 1 FROM gap WHERE start_utc <= NEW.slot_utc AND end_utc >= NEW.slot_utc
    AND (CAST(strftime('%s', NEW.slot_utc) AS INTEGER)
         - CAST(strftime('%s', start_utc) AS INTEGER)) % period_s = 0
)
BEGIN SELECT RAISE(ABORT, 'the slot lies in a gap'); END
"""

_NOT_MEASURED = """
CREATE TRIGGER gap_not_measured_{verb} BEFORE {verb} ON gap
WHEN EXISTS (
    SELECT 1 FROM measurement WHERE slot_utc BETWEEN NEW.start_utc AND NEW.end_utc
    AND (CAST(strftime('%s', slot_utc) AS INTEGER)
         - CAST(strftime('%s', NEW.start_utc) AS INTEGER)) % NEW.period_s = 0
)
BEGIN SELECT RAISE(ABORT, 'a slot of the gap was measured'); END
"""


def _real(names: tuple[str, ...]) -> list[sa.Column[float]]:
    return [sa.Column(name, sa.Float()) for name in names]


def _text(name: str) -> sa.Column[str]:
    return sa.Column(name, sa.Text(), nullable=False)


def upgrade() -> None:
    """Make everything."""
    _calibrations()
    _measurements()
    _gaps()
    op.create_table(
        "event",
        sa.Column("id", sa.Integer(), primary_key=True),
        _text("time_utc"),
        _text("kind"),
        _text("detail"),
    )
    op.create_index("ix_event_time_utc", "event", ["time_utc"])
    op.create_table("mark", sa.Column("name", sa.Text(), primary_key=True), _text("value"))
    for table in ("calibration", "calibration_activation"):
        for verb in ("update", "delete"):
            op.execute(_IMMUTABLE.format(table=table, verb=verb))
    op.execute(_NOT_IN_GAP)
    for verb in ("insert", "update"):
        op.execute(_NOT_MEASURED.format(verb=verb))


def _calibrations() -> None:
    op.create_table(
        "calibration",
        sa.Column("id", sa.Integer(), primary_key=True),
        _text("created_utc"),
        _text("method"),
        sa.Column("passed", sa.Boolean(), nullable=False),
        _text("content"),
        _text("report"),
        sa.Column("frames", sa.Text()),
        _text("config_hash"),
        _text("version"),
    )
    op.create_table(
        "calibration_activation",
        sa.Column("id", sa.Integer(), primary_key=True),
        sa.Column("calibration_id", sa.Integer(), sa.ForeignKey("calibration.id"), nullable=False),
        _text("activated_utc"),
    )


def _measurements() -> None:
    op.create_table(
        "measurement",
        sa.Column("id", sa.Integer(), primary_key=True),
        _text("slot_utc"),
        sa.Column("flag", sa.Integer(), nullable=False),
        _text("reasons"),
        *_real(_MEASURED_REAL),
        sa.Column("motion_covariance", sa.Text()),
        sa.Column("discs_found", sa.Integer(), nullable=False),
        sa.Column("corners_used", sa.Integer(), nullable=False),
        *_real(_DIAGNOSTIC_REAL),
        *_real(_CAMERA_REAL),
        sa.Column("main_frame", sa.Text()),
        sa.Column("sub_frame", sa.Text()),
        sa.Column("captured_utc", sa.Text()),
        sa.Column("recorded_late", sa.Boolean(), nullable=False),
        sa.Column("calibration_id", sa.Integer(), sa.ForeignKey("calibration.id")),
        _text("config_hash"),
        _text("version"),
        sa.UniqueConstraint("slot_utc"),
        sa.CheckConstraint("flag IN (1, 3, 4, 9)", name="measurement_flag"),
        sa.CheckConstraint("(flag IN (1, 3)) = (x_mm IS NOT NULL)", name="measurement_value"),
        sa.CheckConstraint("slot_utc GLOB '????-??-??T??:??:??Z'", name="measurement_slot"),
    )


def _gaps() -> None:
    op.create_table(
        "gap",
        sa.Column("id", sa.Integer(), primary_key=True),
        _text("start_utc"),
        _text("end_utc"),
        sa.Column("slots", sa.Integer(), nullable=False),
        sa.Column("period_s", sa.Integer(), nullable=False),
        _text("cause"),
        _text("detail"),
        sa.UniqueConstraint("start_utc"),
        sa.CheckConstraint("period_s > 0 AND slots > 0", name="gap_positive"),
        sa.CheckConstraint(
            "CAST(strftime('%s', end_utc) AS INTEGER) - CAST(strftime('%s', start_utc) AS INTEGER)"
            " = (slots - 1) * period_s",
            name="gap_slots",
        ),
    )
    op.create_index("ix_gap_end_utc", "gap", ["end_utc"])
