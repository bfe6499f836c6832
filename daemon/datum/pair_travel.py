"""How the pair has moved from an old reference to a new one, by the old calibration's rows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from core.arrays import FloatArray
from core.geometry.pose import Pose
from core.rig.calibrated_site import CalibratedSite
from core.rig.travel import (
    IMAGE,
    Travel,
    image_between,
    motion_effects,
    travel_by,
    travel_by_turn,
)
from core.site import Site
from daemon.datum.movement import drift_share, drift_sigma_mm
from daemon.datum.seen import Known, NewReference, SeenRow

_LEAST_MM = 0.1
"""1 sigma, at least, of how the pair has moved by its last row. Chosen: somebody has worked on it
since; between targets 1 % apart in distance it is 0.001 mm."""
_LEAST_SEEN_MM = 0.03
"""Likewise where a fixed target shows how the pair has turned since. Chosen: what moves a bolted
pair by more turns it too, by more than a fixed target's noise."""
_FEWEST_ROWS = 8
"""That tell how a pair moves as it turns: twice the four unknowns of either axis."""


def pair_travel(
    known: Known, new: NewReference, site: Site, rows: Sequence[SeenRow]
) -> Travel | None:
    """How the main camera has moved since the old reference; None where no row tells.

    As far as it had moved by its last row; or, where that leaves less uncertain, with what it
    moves as it turns, for the turn that a fixed target shows since.
    """
    own = [row for row in rows if row.calibration_id == known.id and row.motion is not None]
    if not own:
        return None
    old, limit_mm = known.active.calibration.calibrated, site.quality.expected_drift_mm
    gap_s, times_s, motions = _gap_s(new, own[-1]), _times_s(own), _motions(own)
    drift_mm = drift_sigma_mm(times_s, motions[:, 3:], gap_s)
    if drift_mm is None:
        drift_mm = np.array([limit_mm * drift_share(gap_s)])
    at_rest = travel_by(old, _pose(motions[-1]), min(limit_mm, max(_LEAST_MM, _axis_mm(drift_mm))))
    turned = _as_it_turned(old, new, [row for row in own if row.closure is not None])
    if at_rest is None or turned is None or turned.sigma_mm > at_rest.sigma_mm:
        return at_rest
    return turned


def _as_it_turned(old: CalibratedSite, new: NewReference, rows: Sequence[SeenRow]) -> Travel | None:
    """Travel by the last row, and by the turn that a fixed target shows since.

    By a straight line through the rows: travel by the image of the fixed target. What a row
    misses of the line through the others drifts in the gap as a rig does.
    """
    earlier = {target.name: target for target in old.further if target.is_fixed}
    both = [one for one in new.calibration.calibrated.further if one.name in earlier]
    if not both or len(rows) < _FEWEST_ROWS:
        return None
    target, motions = earlier[both[0].name], _motions(rows)
    effects, last = motion_effects(old, target), travel_by(old, _pose(motions[-1]), 0.0)
    if effects is None or last is None:
        return None
    images, travels = np.split(motions @ effects.T, [IMAGE], axis=1)
    images[:, :2] += np.array([row.closure.mm for row in rows if row.closure]) @ target.B.T
    found = travel_by_turn(images, travels, image_between(target, both[0]) - images[-1])
    if found is None:
        return None
    drift_mm = drift_sigma_mm(_times_s(rows), found.missed_mm, _gap_s(new, rows[-1]))
    if drift_mm is None:
        return None
    parts_mm = np.array([_LEAST_SEEN_MM, _axis_mm(drift_mm), _axis_mm(found.sigma_mm)])
    return Travel(last.mm + found.mm, float(np.linalg.norm(parts_mm)))


def _times_s(rows: Sequence[SeenRow]) -> FloatArray:
    return np.array([row.slot_utc.timestamp() for row in rows])


def _motions(rows: Sequence[SeenRow]) -> FloatArray:
    """(n, 6) rotation vector (rad) and translation (mm) of each row's rig motion."""
    motions = [row.motion for row in rows if row.motion is not None]
    return np.array([np.concatenate([one.rotation_rad, one.translation_mm]) for one in motions])


def _pose(motion: FloatArray) -> Pose:
    return Pose.from_vectors(motion[:3], motion[3:])


def _gap_s(new: NewReference, last: SeenRow) -> float:
    return (new.slot_utc - last.slot_utc).total_seconds()


def _axis_mm(sigmas_mm: FloatArray) -> float:
    """Of one axis, by those of several."""
    return float(np.sqrt((sigmas_mm**2).mean()))
