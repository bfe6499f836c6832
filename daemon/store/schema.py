"""The tables, as SQLAlchemy sees them; the migrations make them (a test holds the two together)."""

from __future__ import annotations

from datetime import datetime
from typing import Any, ClassVar, Literal

from sqlalchemy import (
    Boolean,
    CheckConstraint,
    Dialect,
    Float,
    ForeignKey,
    Index,
    Integer,
    Text,
    TypeDecorator,
    UniqueConstraint,
    text,
)
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

from daemon.errors import DamagedRowError
from daemon.store.records import GapCause
from daemon.store.time_types import Instant, Slot


class Cause(TypeDecorator[GapCause]):
    """The cause of a gap."""

    impl = Text
    cache_ok = True

    def process_bind_param(self, value: GapCause | None, _dialect: Dialect) -> str | None:
        """Write."""
        return None if value is None else GapCause(value).value

    def process_result_value(self, value: str | None, _dialect: Dialect) -> GapCause | None:
        """Read."""
        try:
            return None if value is None else GapCause(value)
        except ValueError as error:
            msg = f"{value!r} is no cause of a gap"
            raise DamagedRowError(msg) from error


class Base(DeclarativeBase):
    """The one metadata."""

    type_annotation_map: ClassVar[dict[Any, Any]] = {
        datetime: Slot,
        GapCause: Cause,
        str: Text,
        float: Float(),  # SQLAlchemy's own choice changed between 2.0 and 2.1
    }

    digest: Mapped[int | None] = mapped_column(sort_order=1000)
    """Checksum of the row, see `daemon.store.integrity.digest`."""


class MeasurementRow(Base):
    """One slot of the schedule, measured. Ids grow in the order of writing: late rows too."""

    __tablename__ = "measurement"
    __table_args__ = (
        CheckConstraint("flag IN (1, 3, 4, 9)", name="measurement_flag"),
        CheckConstraint("(flag IN (1, 3)) = (x_mm IS NOT NULL)", name="measurement_value"),
        CheckConstraint("slot_utc GLOB '????-??-??T??:??:??Z'", name="measurement_slot"),
        Index(
            "ix_measurement_unsynchronised",
            "boot_id",
            "uptime_s",
            sqlite_where=text("clock_synchronised = 0"),
        ),
        Index(
            "ix_measurement_redated",
            "redated_from_utc",
            sqlite_where=text("redated_from_utc IS NOT NULL"),
        ),
        Index("ix_measurement_kin", "calibration_id", "reasons", "slot_utc"),
        Index("ix_measurement_fate", "slot_utc", "flag"),
        Index(
            "ix_measurement_closure",
            *("slot_utc", "closure_x_mm", "closure_y_mm"),
            *("closure_sigma_x_mm", "closure_sigma_y_mm"),
            sqlite_where=text("closure_x_mm IS NOT NULL"),
        ),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    slot_utc: Mapped[datetime] = mapped_column(unique=True)
    flag: Mapped[int]
    reasons: Mapped[str]
    """Joined by `+`, empty when good."""

    x_mm: Mapped[float | None]
    y_mm: Mapped[float | None]
    sigma_x_mm: Mapped[float | None]
    sigma_y_mm: Mapped[float | None]
    cov_xy_mm2: Mapped[float | None]
    raw_x_mm: Mapped[float | None]
    raw_y_mm: Mapped[float | None]
    raw_sigma_x_mm: Mapped[float | None]
    raw_sigma_y_mm: Mapped[float | None]
    raw_cov_xy_mm2: Mapped[float | None]
    rx_rad: Mapped[float | None]
    ry_rad: Mapped[float | None]
    rz_rad: Mapped[float | None]
    tx_mm: Mapped[float | None]
    ty_mm: Mapped[float | None]
    tz_mm: Mapped[float | None]
    motion_covariance: Mapped[str | None]
    """JSON: the 21 numbers of the upper triangle, row by row, of (rx..rz, tx..tz)."""

    discs_found: Mapped[int]
    corners_used: Mapped[int]
    main_residual_px: Mapped[float | None]
    sub_residual_px: Mapped[float | None]
    main_contrast_dn: Mapped[float | None]
    sub_contrast_dn: Mapped[float | None]
    main_blur_px: Mapped[float | None]
    sub_blur_px: Mapped[float | None]

    spread_x_mm: Mapped[float | None]
    """1 sigma of one pair of a burst about their mean; NULL with one pair."""
    spread_y_mm: Mapped[float | None]
    frames_used: Mapped[int] = mapped_column(server_default=text("0"))
    """Pairs that the value rests on."""

    skew_s: Mapped[float | None]
    main_exposure_us: Mapped[float | None]
    main_gain_db: Mapped[float | None]
    main_temperature_c: Mapped[float | None]
    sub_exposure_us: Mapped[float | None]
    sub_gain_db: Mapped[float | None]
    sub_temperature_c: Mapped[float | None]
    main_frame: Mapped[str | None]
    sub_frame: Mapped[str | None]
    captured_utc: Mapped[datetime | None] = mapped_column(Instant)
    boot_id: Mapped[str | None]
    uptime_s: Mapped[float | None]
    clock_synchronised: Mapped[bool | None]
    redated_from_utc: Mapped[datetime | None]
    recorded_late: Mapped[bool]
    calibration_id: Mapped[int | None] = mapped_column(ForeignKey("calibration.id"))
    config_hash: Mapped[str]
    version: Mapped[str]

    sigma_image_x_mm: Mapped[float | None]
    """Of the part of the uncertainty that pixels and calibration give; NULL: all of it."""
    sigma_image_y_mm: Mapped[float | None]
    cov_image_xy_mm2: Mapped[float | None]
    closure_x_mm: Mapped[float | None]
    """What the fixed targets together say of the rig's error; NULL where none is believed."""
    closure_y_mm: Mapped[float | None]
    closure_sigma_x_mm: Mapped[float | None]
    closure_sigma_y_mm: Mapped[float | None]
    closure_cov_xy_mm2: Mapped[float | None]
    targets: Mapped[str | None]
    """JSON of the further targets, see `daemon.store.rows.targets`; NULL without any."""
    readings: Mapped[str | None]
    """JSON: name to [value, unit], or to [null, unit, cause]; NULL where there are no sensors."""


class UndatedRow(Base):
    """A pair measured while the clock was before the last slot: when it was is not known yet."""

    __tablename__ = "undated"
    __table_args__ = (UniqueConstraint("boot_id", "uptime_s"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    boot_id: Mapped[str]
    uptime_s: Mapped[float]
    clock_utc: Mapped[datetime] = mapped_column(Instant)
    """What the clock said at the capture."""
    content: Mapped[str]
    """JSON: the columns of its `measurement` row, the slot by the wrong clock."""


class RedatedRow(Base):
    """What a wrong clock had dated, as it was then; triggers refuse to change or delete that."""

    __tablename__ = "redated"
    __table_args__ = (Index("ix_redated_waiting", "slot_utc", sqlite_where=text("again IS NULL")),)

    id: Mapped[int] = mapped_column(primary_key=True)
    slot_utc: Mapped[datetime | None]
    """The slot that it got; NULL of a row that became an undated pair."""
    from_slot_utc: Mapped[datetime]
    """The slot that it had."""
    content: Mapped[str]
    """JSON: the columns of its `measurement` row before."""
    row_id: Mapped[int | None]
    """The id of that row; NULL of an undated pair."""
    newest_id: Mapped[int | None]
    """The last row that may have been held against it under the slot that it had."""
    again: Mapped[str | None]
    """What came of measuring it again, see `records.Again`; NULL: it waits."""


class GapRow(Base):
    """Missed slots `start + k * period_s`, k = 0 .. slots - 1, with one cause."""

    __tablename__ = "gap"
    __table_args__ = (
        CheckConstraint("period_s > 0 AND slots > 0", name="gap_positive"),
        CheckConstraint(
            "CAST(strftime('%s', end_utc) AS INTEGER) - CAST(strftime('%s', start_utc) AS INTEGER)"
            " = (slots - 1) * period_s",
            name="gap_slots",
        ),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    start_utc: Mapped[datetime] = mapped_column(unique=True)
    end_utc: Mapped[datetime] = mapped_column(index=True)
    slots: Mapped[int]
    period_s: Mapped[int]
    cause: Mapped[GapCause]
    detail: Mapped[str]


class CalibrationRow(Base):
    """A calibration; triggers refuse UPDATE and DELETE."""

    __tablename__ = "calibration"

    id: Mapped[int] = mapped_column(primary_key=True)
    created_utc: Mapped[datetime] = mapped_column(Instant)
    method: Mapped[str]
    passed: Mapped[bool]
    content: Mapped[str]
    """JSON of `Calibration.to_dict()`."""
    report: Mapped[str]
    """JSON: lines and figures."""
    frames: Mapped[str | None]
    config_hash: Mapped[str]
    version: Mapped[str]


class ActivationRow(Base):
    """Which calibration was made active when; the newest id holds."""

    __tablename__ = "calibration_activation"

    id: Mapped[int] = mapped_column(primary_key=True)
    calibration_id: Mapped[int] = mapped_column(ForeignKey("calibration.id"))
    activated_utc: Mapped[datetime] = mapped_column(Instant)


class DatumRow(Base):
    """Where a calibration's reference lies in the record's zero; the newest id holds.

    Triggers refuse UPDATE and DELETE.
    """

    __tablename__ = "datum"
    __table_args__ = (Index("ix_datum_calibration", "calibration_id"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    calibration_id: Mapped[int] = mapped_column(ForeignKey("calibration.id"))
    created_utc: Mapped[datetime] = mapped_column(Instant)
    reference_utc: Mapped[datetime | None]
    """When the calibration's reference was taken."""
    method: Mapped[str]
    x_mm: Mapped[float]
    y_mm: Mapped[float]
    var_x_mm2: Mapped[float]
    var_y_mm2: Mapped[float]
    cov_xy_mm2: Mapped[float]
    targets: Mapped[str]
    """JSON: the five numbers above of each measured further target, by its name."""
    steps: Mapped[str]
    """JSON: what was observed, from which calibration's reference, and how."""
    detail: Mapped[str]
    reference_errors: Mapped[str | None]
    """JSON: what the noise of the reference does to all rows of the calibration, and its covariance
    with the offset."""


class LedgerRow(Base):
    """What a person said of the record; triggers refuse UPDATE and DELETE."""

    __tablename__ = "ledger"

    id: Mapped[int] = mapped_column(primary_key=True)
    created_utc: Mapped[datetime] = mapped_column(Instant)
    author: Mapped[str]
    kind: Mapped[str]
    since_utc: Mapped[datetime | None]
    until_utc: Mapped[datetime | None]
    """The span since <= slot < until; None of what answers another entry."""
    point: Mapped[str | None]
    """`main` or a further target; None: all."""
    entry_id: Mapped[int | None]
    """The entry that is commented or taken back; it may be lost to damage."""
    text: Mapped[str]


class EventRow(Base):
    """Something that happened to the system."""

    __tablename__ = "event"

    id: Mapped[int] = mapped_column(primary_key=True)
    time_utc: Mapped[datetime] = mapped_column(Instant, index=True)
    kind: Mapped[str]
    detail: Mapped[str]


class FrameDayRow(Base):
    """What the frame archive holds of one day, UTC."""

    __tablename__ = "frame_day"

    day: Mapped[str] = mapped_column(primary_key=True)
    """As `2026-03-01`."""
    level: Mapped[str]
    until_utc: Mapped[datetime | None]
    kept: Mapped[str]
    """The slots up to `until_utc` whose frames stay: `000000 010000 ...`."""
    removed: Mapped[int]
    bytes: Mapped[int]
    finished: Mapped[bool]


class MarkRow(Base):
    """Single values that survive a restart: heartbeat, clean stop, boot id."""

    __tablename__ = "mark"

    name: Mapped[str] = mapped_column(primary_key=True)
    value: Mapped[str]


Kind = Literal["time", "real", "whole", "truth", "text"]


def kind_of(column: str) -> Kind:
    """What a column of `measurement` holds."""
    sql = MeasurementRow.__table__.columns[column].type
    if isinstance(sql, Slot):
        return "time"
    if isinstance(sql, Boolean):
        return "truth"
    if isinstance(sql, Integer):
        return "whole"
    return "real" if isinstance(sql, Float) else "text"
