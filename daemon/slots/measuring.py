"""From images to a measurement, wherever they come from; every pair gets an answer."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from typing import cast

import structlog

from core.calibration.calibrate import Calibration
from core.errors import CalibrationError, ImageError
from core.images import GreyImage, require_size
from core.measurement import assess_pair, look_at_pair
from core.moment import Moment
from core.quality.burst import combine
from core.quality.fixed_targets import PastRow, moved_alone, not_believed_any_more
from core.quality.step_detection import add_reasons
from core.quality.verdicts import flag_of
from core.results import Flag, Measurement, Reason
from core.rig.learnt import Learnt
from core.seeing import SeenPair, see_pair
from core.site import CameraGeometry, Site
from daemon.store.database import Store
from daemon.store.frames.archive import ArchivedPair, FrameArchive
from daemon.store.records import DatumRecord, Reading, rig_temperature_c, values_of
from daemon.times import slot_text
from drivers.errors import FrameSetError, ImageMissingError
from drivers.frameset import FramePath, FrameSetRow, read_image
from drivers.protocols import CapturedPair, Role

_log = structlog.get_logger("dcam.daemon")

_MISSING = {"main": Reason.MAIN_IMAGE_MISSING, "sub": Reason.SUB_IMAGE_MISSING}
_UNREADABLE = {"main": Reason.MAIN_IMAGE_UNREADABLE, "sub": Reason.SUB_IMAGE_UNREADABLE}


@dataclass(frozen=True, slots=True)
class ActiveCalibration:
    """The calibration that rows are measured with, and its number in the database."""

    id: int | None
    calibration: Calibration
    datum: DatumRecord | None = None
    """Where its reference lies in the record's zero; None: there."""


@dataclass(frozen=True, slots=True)
class ImagePair:
    """The images of one pair as they are known before they are looked at."""

    main: GreyImage | None
    sub: GreyImage | None
    """None means no image: not there, or there and `unreadable`."""
    skew_s: float | None = None
    unreadable: frozenset[Role] = frozenset()
    moment: Moment | None = None
    """When it was taken, and how warm the main camera was."""


@dataclass(frozen=True, slots=True)
class SlotPair:
    """What a pair of a slot shows, its images no longer held."""

    seen: SeenPair | Measurement
    """A measurement where nothing more can be made of it: without a calibration or an image."""
    skew_s: float | None
    unreadable: frozenset[Role]
    moment: Moment | None


@dataclass(frozen=True, slots=True)
class PairFiles:
    """Where the images of one pair are."""

    main: FramePath | None
    sub: FramePath | None
    moment: Moment
    skew_s: float | None = None


def active_calibration(store: Store) -> ActiveCalibration | None:
    """Give the calibration in use, None when there is none or it cannot be read."""
    record = store.active_calibration()
    if record is None:
        return None
    try:
        return ActiveCalibration(record.id, record.calibration, store.datum(record.id))
    except CalibrationError as error:
        _log.error("calibration_unreadable", calibration=record.id, error=str(error))
        return None


def measure(
    pairs: Iterable[ImagePair],
    site: Site,
    calibration: ActiveCalibration | None,
    past: Sequence[PastRow] = (),
    learnt: Learnt | None = None,
) -> Measurement:
    """Measure the pairs of one slot and combine them; every slot gets an answer.

    past are the rows before, in order, by which fixed targets that moved by themselves are known.
    learnt serves where no fixed target is seen.
    """
    seen = [see(pair, site, calibration) for pair in pairs]
    return judge(seen, site, calibration, past, learnt)


def see(pair: ImagePair, site: Site, calibration: ActiveCalibration | None) -> SlotPair:
    """Find what a pair shows, whatever the rows before: the part that costs time."""
    if len(pair.unreadable) == len(_UNREADABLE):
        return SlotPair(_bad(*_UNREADABLE.values()), pair.skew_s, pair.unreadable, pair.moment)
    seen: SeenPair | Measurement
    try:
        if calibration is None:
            seen = look_at_pair(pair.main, pair.sub, site)
        else:
            seen = see_pair(pair.main, pair.sub, site, calibration.calibration.calibrated)
    except Exception:  # noqa: BLE001 - a fault of ours costs this value, not the row
        _log.exception("measurement_broke")
        seen = _bad(Reason.INTERNAL_ERROR)
    return SlotPair(seen, pair.skew_s, pair.unreadable, pair.moment)


def judge(
    pairs: Sequence[SlotPair],
    site: Site,
    calibration: ActiveCalibration | None,
    past: Sequence[PastRow] = (),
    learnt: Learnt | None = None,
) -> Measurement:
    """Give the measurement of a slot whose pairs were looked at: the rest of `measure`."""
    lost = not_believed_any_more(past)
    measurement = combine([_judge_one(pair, site, calibration, lost, learnt) for pair in pairs])
    moment = first_moment(pairs)
    if calibration is None or moment is None:
        return measurement
    moved = moved_alone(past, measurement, moment, site, calibration.calibration.calibrated)
    if not moved:
        return measurement
    without = [_judge_one(pair, site, calibration, lost | moved, learnt) for pair in pairs]
    return add_reasons(combine(without), (Reason.FIXED_TARGET_MOVED,))


def first_moment(pairs: Iterable[ImagePair | SlotPair]) -> Moment | None:
    """When a slot's pairs were taken; None where no image of it could be read."""
    return next((pair.moment for pair in pairs if pair.moment is not None), None)


def image_pair(
    pair: CapturedPair, slot_utc: datetime, readings: Sequence[Reading] = ()
) -> ImagePair:
    """What the cameras gave for a slot, and the sensors."""
    main, sub = (GreyImage(frame.pixels, frame.bits) for frame in (pair.main, pair.sub))
    warm = rig_temperature_c(pair.main.temperature_c, pair.sub.temperature_c)
    moment = Moment(slot_utc.timestamp(), warm, values_of(readings))
    return ImagePair(main, sub, pair.skew_s, moment=moment)


def read_pair(files: PairFiles, site: Site) -> ImagePair:
    """Read a pair's files; one that is missing or damaged is a reason, not an error."""
    images: dict[Role, GreyImage | None] = {"main": None, "sub": None}
    unreadable: set[Role] = set()
    paths: tuple[tuple[Role, FramePath | None], ...] = (("main", files.main), ("sub", files.sub))
    for role, path in paths:
        try:
            images[role] = read_image(path) if path else None
            _note_size(images[role], site.main if role == "main" else site.sub, path)
        except ImageMissingError as error:
            _log.warning("image_missing", error=str(error))
        except FrameSetError as error:
            _log.warning("image_unreadable", error=str(error))
            unreadable.add(role)
    return ImagePair(
        images["main"], images["sub"], files.skew_s, frozenset(unreadable), files.moment
    )


def row_moment(row: FrameSetRow) -> Moment:
    """When a row of a frame set was taken, how warm the rig was, and what the sensors said."""
    warm = rig_temperature_c(row.main_temperature_c, row.sub_temperature_c)
    return Moment(row.slot_utc.timestamp(), warm, row.readings)


def load_pairs(
    archive: FrameArchive, slot_utc: datetime
) -> tuple[list[ImagePair], ArchivedPair | None]:
    """Read a slot's pairs of the archive, and give what is known of the first good one.

    A damaged pair counts with both images unreadable; so does a slot without any.
    Raises ArchiveError.
    """
    pairs: list[ImagePair] = []
    first: ArchivedPair | None = None
    for number in archive.numbers(slot_utc) or [1]:
        try:
            stored = archive.load(slot_utc, number)
        except FrameSetError as error:
            _log.warning("stored_pair_damaged", slot=slot_text(slot_utc), error=str(error))
            pairs.append(ImagePair(None, None, unreadable=frozenset({"main", "sub"})))
            continue
        first = first or stored
        warm = rig_temperature_c(stored.main_camera.temperature_c, stored.sub_camera.temperature_c)
        moment = Moment(slot_utc.timestamp(), warm, stored.readings)
        pairs.append(ImagePair(stored.main, stored.sub, stored.skew_s, moment=moment))
    return pairs, first


def worst_skew_s(pairs: Sequence[ImagePair]) -> float | None:
    """The largest skew of a slot's pairs, with its sign."""
    known = [pair.skew_s for pair in pairs if pair.skew_s is not None]
    return max(known, key=abs, default=None)


def _note_size(image: GreyImage | None, camera: CameraGeometry, path: FramePath | None) -> None:
    """Log which file has another size than the config says; the core gives the reason."""
    if image is None:
        return
    try:
        require_size(image, camera, str(path))
    except ImageError as error:
        _log.warning("image_wrong_size", error=str(error))


def _judge_one(
    pair: SlotPair,
    site: Site,
    calibration: ActiveCalibration | None,
    distrusted: frozenset[str],
    learnt: Learnt | None,
) -> Measurement:
    try:
        measurement = _assessed(pair, site, calibration, distrusted, learnt)
    except Exception:  # noqa: BLE001 - as in `see`
        _log.exception("measurement_broke")
        return _bad(Reason.INTERNAL_ERROR)
    said = {_MISSING[role]: _UNREADABLE[role] for role in pair.unreadable}
    reasons = tuple(said.get(reason, reason) for reason in measurement.reasons)
    flag = flag_of(reasons, has_value=measurement.corrected is not None)
    return replace(measurement, flag=flag, reasons=reasons)


def _assessed(
    pair: SlotPair,
    site: Site,
    calibration: ActiveCalibration | None,
    distrusted: frozenset[str],
    learnt: Learnt | None,
) -> Measurement:
    if isinstance(pair.seen, Measurement) or calibration is None:
        return cast("Measurement", pair.seen)
    given = calibration.calibration
    return assess_pair(pair.seen, site, given, pair.skew_s, pair.moment, distrusted, learnt)


def _bad(*reasons: Reason) -> Measurement:
    return Measurement(Flag.BAD, reasons, None, None, None)
