"""One slot's pairs now, measured and shown, and nothing recorded: `dcam-ctl capture`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime, timedelta
from typing import Any

from core.errors import ImageError, TargetNotFoundError
from core.images import GreyImage, require_size
from core.recognition import disc_doubt, recognise_mounted_board, recognise_targets
from core.results import Measurement
from core.site import Site
from daemon.burst import Shot
from daemon.plain import plain
from daemon.schedule import Schedule
from daemon.slots.learner import Learner
from daemon.slots.measuring import ActiveCalibration, image_pair, measure
from daemon.slots.row_history import measure_in_record
from daemon.store.database import Store
from daemon.store.queries.json_fields import result_fields
from daemon.store.records import Reading
from daemon.store.rows.datum import in_record_zero
from drivers.protocols import CapturedFrame, CapturedPair

ROOM_S = 60.0
"""A look needs as much time before the next slot, or half a period: cameras that hang take 30 s."""


def room_for_look(schedule: Schedule, now_utc: datetime, ended_utc: datetime | None) -> bool:
    """Tell whether a look can neither delay the next slot nor overtake one that is due.

    `ended_utc` is the last slot that was over.
    """
    next_utc = schedule.first_after(now_utc)
    due_utc = next_utc - timedelta(seconds=schedule.period_s)
    is_over = ended_utc is not None and ended_utc >= due_utc
    if not is_over and not schedule.is_too_late(due_utc, now_utc):
        return False
    return (next_utc - now_utc).total_seconds() >= min(schedule.period_s / 2, ROOM_S)


def measure_look(
    shots: Sequence[Shot],
    slot_utc: datetime,
    site: Site,
    calibration: ActiveCalibration | None,
    store: Store | None,
    learner: Learner,
    readings: Sequence[Reading] = (),
) -> Measurement:
    """Measure pairs as a slot's row is: held against those of `store`, in the record's zero.

    readings are what the sensors said then: one may be the temperature of the steel.

    Raises StoreError.
    """
    pairs = [image_pair(shot.pair, slot_utc, readings) for shot in shots]
    if store is None or calibration is None:
        return measure(pairs, site, calibration)
    judged = measure_in_record(store, site, calibration, learner, slot_utc, pairs)
    return in_record_zero(judged, calibration.datum)


def look_fields(
    slot_utc: datetime,
    measurement: Measurement,
    shots: Sequence[Shot],
    site: Site,
    readings: Sequence[Reading] = (),
) -> dict[str, Any]:
    """Give a look in plain JSON types; one without a value with what explains that."""
    pair, seen = shots[0].pair, measurement.diagnostics
    problems = [] if measurement.corrected is not None else recognition_problems(pair, site)
    fields: dict[str, Any] = plain(
        {
            "measurement": result_fields(slot_utc, measurement),
            "pairs": len(shots),
            "seen": {"discs": seen.discs_found, "corners": seen.corners_used},
            "problems": problems,
            "readings": [
                {"name": one.name, "unit": one.unit, "value": one.value, "cause": one.cause}
                for one in readings
            ],
            **pair_fields(pair),
        }
    )
    return fields


def recognition_problems(pair: CapturedPair, site: Site) -> list[str]:
    """Say of each target why it is not recognised in a pair, by the config alone."""
    main, sub = (GreyImage(frame.pixels, frame.bits) for frame in (pair.main, pair.sub))
    problems: list[str] = []
    for recognise, image, camera, role in (
        (_require_discs, main, site.main, "main"),
        (recognise_mounted_board, sub, site.sub, "sub"),
    ):
        try:
            require_size(image, camera, f"{role} image")
            recognise(image, site)
        except (TargetNotFoundError, ImageError) as error:
            text = str(error)
            problems.append(text if text.startswith(role) else f"{role} target: {text}")
    return problems


def _require_discs(image: GreyImage, site: Site) -> None:
    """Find the main target as configured, among further ones. Raises as `recognise_targets`."""
    doubt = disc_doubt(image, recognise_targets(image, site)[0], site)
    if doubt is not None:
        raise doubt


def pair_fields(pair: CapturedPair) -> dict[str, Any]:
    """What is reported of a pair that is not measured."""
    return {
        "skew_s": pair.skew_s,
        "main": frame_fields(pair.main),
        "sub": frame_fields(pair.sub),
    }


def frame_fields(frame: CapturedFrame) -> dict[str, Any]:
    """A frame's size, light and settings."""
    return {
        "width_px": frame.pixels.shape[1],
        "height_px": frame.pixels.shape[0],
        "bits": frame.bits,
        "mean_dn": float(frame.pixels.mean()),
        "max_dn": int(frame.pixels.max()),
        "exposure_us": frame.exposure_us,
        "gain_db": frame.gain_db,
        "temperature_c": frame.temperature_c,
    }


def frame_text(frame: Mapping[str, Any]) -> str:
    """A frame's fields in one line."""
    light = frame["max_dn"] / (2 ** frame["bits"] - 1)
    size = f"{frame['width_px']}x{frame['height_px']} px, {frame['bits']} bits"
    parts = [f"{size}, brightest pixel at {light:.0%}"]
    for name, unit in (("exposure_us", "us"), ("gain_db", "dB"), ("temperature_c", "°C")):
        if frame[name] is not None:
            parts.append(f"{frame[name]:g} {unit}")
    return ", ".join(parts)
