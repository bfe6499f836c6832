"""From a frame set on the disk to a stored calibration: one way, wherever the frames came from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path

from core.calibration.calibrate import (
    Calibration,
    CalibrationReport,
    CalibrationView,
    Method,
    ViewRole,
    calibrate,
)
from core.errors import CalibrationError, ImageError
from core.images import GreyImage, require_size
from core.site import CameraGeometry, Site
from daemon.config.reading import Config
from daemon.datum.seen import NewReference
from daemon.slots.identity import made_by
from daemon.slots.measuring import row_moment
from daemon.store.database import Store
from daemon.store.records import CalibrationRecord, DatumRecord, Reading
from daemon.store.rows.circumstances import KEY, Circumstances
from drivers.errors import FrameSetError
from drivers.frameset import FrameSet, FrameSetRow, format_slot, read_frame_set
from drivers.protocols import Role

OnStep = Callable[[str], None]
"""Called with what has just been done, once for each view."""
Begin = Callable[[str], None]
"""Called with what begins and cannot be counted."""


@dataclass(frozen=True, slots=True)
class CalibrationRun:
    """A calibration that has been computed and not yet stored."""

    directory: Path
    calibration: Calibration
    report: CalibrationReport
    left_out: tuple[str, ...]
    """Views that could not be read, each with its reason."""
    reference: NewReference
    """The pair that is the calibration's own zero."""
    rejected: tuple[FrameSetRow, ...] = ()
    """Rows of the views that were read, but do not fit the others or show no target."""
    circumstances: Circumstances = field(default_factory=Circumstances)
    """What its reference was taken with."""

    @property
    def rejected_positions(self) -> list[FrameSetRow]:
        """Rows of the rig positions among the rejected views."""
        return [row for row in self.rejected if row.role == "rig"]


def views_in(directory: Path) -> FrameSet:
    """Read the table of a calibration's frame set: all rows but `measure`.

    Raises FrameSetError, CalibrationError when no row is there to calibrate with.
    """
    frames = read_frame_set(directory)
    rows = frames.rows_of("intrinsics", "reference", "rig")
    if not rows:
        msg = f"{directory}: no rows of role intrinsics, reference or rig; nothing to calibrate on"
        raise CalibrationError(msg)
    return replace(frames, rows=rows)


def calibrate_frames(
    frames: FrameSet,
    site: Site,
    method: Method,
    on_step: OnStep = lambda _: None,
    begin: Begin = lambda _: None,
    *,
    skew: bool = False,
) -> CalibrationRun:
    """Calibrate on all views of a frame set that can be read.

    on_step hears of each view that was read, begin of the fit. A lens or rig view with a damaged
    image is left out, and the report says so; without the reference there is no zero. Raises
    FrameSetError, ImageError, CalibrationError, NotObservableError.
    """
    views: list[CalibrationView] = []
    left_out: list[str] = []
    for row in frames.rows:
        try:
            views.append(_view(frames, row, site))
        except (FrameSetError, ImageError) as error:
            if row.role == "reference":
                raise
            left_out.append(str(error))
        on_step(f"read {format_slot(row.slot_utc)}")
    begin("fitting lens, board and rig")
    calibration, report = calibrate(views, site, method, skew=skew, unreadable=left_out)
    rows = {_view_name(row): row for row in frames.rows}
    rejected = tuple(rows[entry["view"]] for entry in report.figures["rejected"])
    reference = _new_reference(frames, views, calibration)
    return CalibrationRun(
        frames.directory, calibration, report, tuple(left_out), reference, rejected
    )


def with_circumstances(
    run: CalibrationRun, frames: FrameSet, config: Config, serials: Mapping[Role, str]
) -> CalibrationRun:
    """Add what the reference was taken with: serials that the session noted, or else the config's.

    The readings are those of the table, in the units of the config.
    """
    (row,) = frames.rows_of("reference")
    units = {one.name: one.unit for one in config.reading}
    readings = [Reading(name, units.get(name, ""), value) for name, value in row.readings.items()]
    circumstances = Circumstances({**config.camera.serials, **serials}, tuple(readings))
    report = replace(run.report, lines=(*run.report.lines, *circumstances.lines))
    reference = replace(run.reference, serials=circumstances.serials)
    return replace(run, circumstances=circumstances, report=report, reference=reference)


def _new_reference(
    frames: FrameSet, views: Sequence[CalibrationView], calibration: Calibration
) -> NewReference:
    (row,) = frames.rows_of("reference")
    (view,) = (view for view in views if view.role is ViewRole.REFERENCE)
    lens_utc = [row.slot_utc for row in frames.rows_of("intrinsics")]
    return NewReference(
        row.slot_utc, view.main, view.sub, calibration, view.moment, max(lens_utc, default=None)
    )


def store_run(
    store: Store,
    run: CalibrationRun,
    zero: DatumRecord,
    config: Config,
    created_utc: datetime,
    *,
    activate: bool,
) -> int:
    """Store a calibration for good with its datum, active if asked; give its number.

    All of it is one transaction: a process that is killed leaves the calibration before in use.
    """
    record = CalibrationRecord(
        created_utc=created_utc,
        content={**run.calibration.to_dict(), KEY: run.circumstances.to_dict()},
        report=run.report,
        config_hash=config.config_hash(),
        version=made_by(),
        frames=str(run.directory),
    )
    return store.add_calibration(record, zero, activate=activate)


def _view(frames: FrameSet, row: FrameSetRow, site: Site) -> CalibrationView:
    sub = _image(frames, row.sub, site.sub)
    if sub is None:
        msg = f"{frames.directory}: row {format_slot(row.slot_utc)} names no sub image"
        raise FrameSetError(msg)
    return CalibrationView(
        name=_view_name(row),
        role=ViewRole(row.role),
        main=_image(frames, row.main, site.main),
        sub=sub,
        moment=row_moment(row),
        main_name=_called(row, row.main),
    )


def _view_name(row: FrameSetRow) -> str:
    """How messages call a view; unique in a frame set, as its slot is."""
    return _called(row, row.sub)


def _called(row: FrameSetRow, image: str | None) -> str:
    return f"{row.role} {format_slot(row.slot_utc)} ({image})"


def _image(frames: FrameSet, name: str | None, camera: CameraGeometry) -> GreyImage | None:
    if name is None:
        return None
    image = frames.read(name)
    require_size(image, camera, str(frames.directory / name))
    return image
