"""What can tell where a new reference lies in the record's zero, and what speaks against it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from types import MappingProxyType

import numpy as np

from core.arrays import FloatArray
from core.errors import digits
from core.results import Displacement, Flag, Measurement, gains_for
from core.rig.calibrated_site import CalibratedSite
from core.rig.datum import through_fixed_targets
from core.rig.reference_errors import Gains, ReferenceErrors
from core.site import MAIN, Site, TargetRole
from daemon.datum.chain import NOTHING, offset_by
from daemon.datum.movement import movement_sigma_mm
from daemon.datum.pair_travel import pair_travel
from daemon.datum.seen import Known, NewReference, SeenRow
from daemon.slots.measuring import ImagePair, measure
from daemon.store.records import DatumMethod, DatumRecord, DatumStep
from daemon.text import span_text, utc_text
from drivers.genicam.serial_number import is_same_serial
from drivers.protocols import Role

_LENS_SIGMAS = 4.0
_LENS_SHARE = 0.005
"""Of the focal length or of the main camera's scale. Chosen: lenses of one kind differ by a per
cent, one lens calibrated again by a fifth of that, and warmth changes less."""
_SAME_PX = 0.1
"""Of all discs, of references taken at one time: adjustments move the discs of one image by some
hundredths, and only simulated time comes twice."""
_CAMERAS: Mapping[Role, str] = MappingProxyType({"main": "main camera", "sub": "sub-camera"})
_CENTRE_PX = 5.0
"""Of the principal point. Chosen: a lens screwed in again comes back to some ten pixels."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """One answer."""

    step: DatumStep
    offset: Displacement
    """In the record's zero."""
    words: str
    """How it was found."""
    doubts: tuple[str, ...] = ()
    """Why it is not believed."""

    @property
    def sigma_mm(self) -> FloatArray:
        """(2,) 1 sigma."""
        return np.asarray(np.sqrt(np.diag(self.offset.covariance_mm2)))


def candidate(
    step: DatumStep,
    base: DatumRecord | None,
    words: str,
    doubts: Sequence[str] = (),
    errors: ReferenceErrors | None = None,
) -> Candidate:
    """One answer from one step; errors are those of the new reference."""
    return Candidate(step, offset_by(step, base, errors).offset, words, tuple(doubts))


def by_same_reference(earlier: Known, new: NewReference) -> Candidate | None:
    """Nothing lies between two calibrations on one reference; None where it is another image."""
    old_px = earlier.active.calibration.calibrated.reference_discs_px
    new_px = new.calibration.calibrated.reference_discs_px
    if old_px.shape != new_px.shape or not np.nanmax(np.abs(old_px - new_px)) < _SAME_PX:
        return None
    targets = () if earlier.active.datum is None else earlier.active.datum.targets
    step = DatumStep(
        DatumMethod.SAME_REFERENCE, earlier.id, NOTHING, dict.fromkeys(targets, NOTHING)
    )
    words = f"by the reference, which is that of calibration {earlier.id}"
    return candidate(step, earlier.active.datum, words)


def by_old_calibration(
    known: Known, new: NewReference, site: Site, *, board_untouched: bool
) -> tuple[Candidate | None, str]:
    """Let the calibration before measure the new reference; None and why where it cannot."""
    words = f"measured by calibration {known.id}"
    pair = ImagePair(new.main, new.sub, moment=new.moment)
    measured = measure([pair], site, known.active)
    if measured.corrected is None:
        return None, f"{words}: {'+'.join(measured.reasons)}"
    gains = gains_of(measured)
    targets = dict(measured_targets(measured))
    step = DatumStep(
        DatumMethod.OLD_CALIBRATION, known.id, measured.corrected, targets, gains, gains
    )
    doubts = [] if measured.flag is Flag.GOOD else [f"the pair is {'+'.join(measured.reasons)}"]
    moved_utc = new.lens_views_utc
    if moved_utc is not None and moved_utc > known.reference_utc and not board_untouched:
        doubts.append(
            f"lens views of {utc_text(moved_utc)}: the board was off the pier since "
            "(if it was not: --board-untouched)"
        )
    doubts += camera_changes(known.serials, new.serials)
    doubts += lens_changes(known.active.calibration.calibrated, new.calibration.calibrated)
    doubts += drift_beyond(measured, site)
    return candidate(step, known.active.datum, words, doubts, new.errors), ""


def by_fixed_targets(
    known: Known, new: NewReference, site: Site, rows: Sequence[SeenRow]
) -> Candidate | None:
    """What has moved beside the fixed targets that both references show; None without any.

    By the last rows the pair's own travel since the old reference is known, and so its parallax.
    """
    old, now = known.active.calibration.calibrated, new.calibration.calibrated
    moved = through_fixed_targets(old, now, site, pair_travel(known, new, site, rows))
    if moved is None or MAIN not in moved:
        return None
    before = {target.name for target in old.further if target.is_fixed}
    names = [target.name for target in now.further if target.is_fixed and target.name in before]
    offsets = {name: one.displacement for name, one in moved.items()}
    main, gains = offsets.pop(MAIN), {name: one.gains for name, one in moved.items()}
    step = DatumStep(DatumMethod.FIXED_TARGETS, known.id, main, offsets, gains, gains)
    words = f"through the fixed target{'s' if len(names) > 1 else ''} {', '.join(names)}"
    return candidate(step, known.active.datum, words, errors=new.errors)


def measured_targets(measured: Measurement) -> list[tuple[str, Displacement]]:
    """The displacements of the measured further targets, by name."""
    return [
        (target.name, target.corrected)
        for target in measured.targets
        if target.role is TargetRole.MEASURED and target.corrected is not None
    ]


def gains_of(measured: Measurement) -> dict[str, Gains] | None:
    """What of fixed targets' values was taken off the main target and measured ones, by name.

    None where that is not known.
    """
    moving = [one.name for one in measured.targets if one.role is TargetRole.MEASURED]
    found = {name: gains_for(name, measured.targets) for name in (MAIN, *moving)}
    known: dict[str, Gains] = {n: gains for n, gains in found.items() if gains is not None}
    return known if len(known) == len(found) else None


def mean_gains(gains: Sequence[Mapping[str, Gains] | None]) -> dict[str, Gains] | None:
    """The mean of several rows; nothing was taken off where a row does not name a fixed target."""
    known = [one for one in gains if one is not None]
    if not known or len(known) < len(gains):
        return None
    found: dict[str, Gains] = {}
    for target in dict.fromkeys(name for one in known for name in one):
        own = [one[target] for one in known if target in one]
        names = dict.fromkeys(name for one in own for name in one)
        found[target] = {
            name: np.sum([one[name] for one in own if name in one], axis=0) / len(own)
            for name in names
        }
    return found


def camera_changes(old: Mapping[Role, str], new: Mapping[Role, str]) -> list[str]:
    """What says that a camera was replaced; none where a serial number is not known of both."""
    return [
        f"the {_CAMERAS[role]} is another one, serial {new[role]} after {old[role]}"
        for role in _CAMERAS
        if role in old and role in new and not is_same_serial(old[role], new[role])
    ]


def lens_changes(old: CalibratedSite, new: CalibratedSite) -> list[str]:
    """What says that a lens or a camera is another than at the calibration before."""
    changes = []
    sigmas = np.hypot(old.posterior.lens_sigma[:5], new.posterior.lens_sigma[:5])
    apart = np.abs(old.lens.parameters[:5] - new.lens.parameters[:5])
    focal_px = old.lens.parameters[0]
    if apart[0] > max(_LENS_SIGMAS * sigmas[0], _LENS_SHARE * focal_px):
        changes.append(f"the sub-camera's focal length differs by {apart[0] / focal_px:.2%}")
    if (apart[3:] > np.maximum(_LENS_SIGMAS * sigmas[3:], _CENTRE_PX)).any():
        changes.append(f"the sub-camera's principal point differs by {apart[3:].max():.1f} px")
    scales = [np.sqrt(abs(np.linalg.det(one.B))) for one in (old, new)]
    if abs(scales[1] / scales[0] - 1.0) > _LENS_SHARE:
        changes.append(f"the main camera's scale differs by {abs(scales[1] / scales[0] - 1):.2%}")
    return changes


def drift_beyond(measured: Measurement, site: Site) -> list[str]:
    """What says that the board, not the rig, has moved: a drift beyond the expected of its axis."""
    if measured.motion is None:
        return []
    limits, beyond = site.quality, []
    turn_mrad = 1e3 * float(np.abs(measured.motion.rotation_rad).max())
    shift_mm = float(np.abs(measured.motion.translation_mm).max())
    if turn_mrad > limits.expected_drift_mrad:
        limit = f"[quality] expected_drift_mrad = {limits.expected_drift_mrad:g}"
        beyond.append(f"the rig would have turned by {turn_mrad:.2f} mrad about one axis, {limit}")
    if shift_mm > limits.expected_drift_mm:
        limit = f"[quality] expected_drift_mm = {limits.expected_drift_mm:g}"
        beyond.append(f"the rig would have moved by {shift_mm:.2f} mm along one axis, {limit}")
    return beyond


def by_rows(
    rows: Sequence[SeenRow], datums: dict[int, DatumRecord], reference_utc: datetime
) -> Candidate | None:
    """The last good row before the reference, the bridge's own movement since as its sigma.

    rows are in order, all before the reference. None where they do not tell how it moves.
    """
    if not rows:
        return None
    last = rows[-1]
    gap_s = (reference_utc - last.slot_utc).total_seconds()
    sigma_mm = movement_sigma_mm(
        np.array([row.slot_utc.timestamp() for row in rows]),
        np.array([row.displacement.mm + _datum_mm(row, datums) for row in rows]),
        gap_s,
    )
    if sigma_mm is None:
        return None
    moving_mm2 = np.diag(sigma_mm**2)
    step = DatumStep(
        DatumMethod.ROWS,
        last.calibration_id,
        _wider(last.displacement, moving_mm2),
        {name: _wider(seen, moving_mm2) for name, seen in last.targets},
        before=last.gains,
    )
    words = (
        f"by the last good row, {span_text(gap_s)} before ({utc_text(last.slot_utc)}); "
        f"the bridge moves by {digits(sigma_mm[0])}, {digits(sigma_mm[1])} mm in such a time"
    )
    return candidate(step, datums.get(last.calibration_id or 0), words)


def lost(
    old_id: int, last: SeenRow | None, site: Site, datums: dict[int, DatumRecord]
) -> Candidate:
    """Nothing tells: the last known row, or the reference before, to the size of the image."""
    size_mm = np.array([site.main.width_px, site.main.height_px]) / site.nominal_px_per_mm
    anywhere_mm2 = np.diag(size_mm**2 / 12.0)
    seen = NOTHING if last is None else last.displacement
    from_id = old_id if last is None else last.calibration_id
    step = DatumStep(DatumMethod.LOST, from_id, _wider(seen, anywhere_mm2))
    words = (
        "THE ZERO IS LOST: nothing shows where this reference lies; enter a surveyed value with "
        "dcam-ctl datum set"
    )
    return candidate(step, datums.get(from_id or 0), words)


def _wider(displacement: Displacement, more_mm2: FloatArray) -> Displacement:
    return Displacement(displacement.mm, displacement.covariance_mm2 + more_mm2)


def _datum_mm(row: SeenRow, datums: dict[int, DatumRecord]) -> FloatArray:
    link = datums.get(row.calibration_id or 0)
    return np.zeros(2) if link is None else link.offset.mm


def contradicted(one: Candidate, other: Candidate, sigmas: float) -> bool:
    """Whether two answers differ by more than their sigmas allow."""
    apart = np.abs(one.offset.mm - other.offset.mm)
    return bool((apart > sigmas * np.hypot(one.sigma_mm, other.sigma_mm)).any())
