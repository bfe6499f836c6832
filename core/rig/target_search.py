"""All targets of a calibrated site found in one image, where the rig's motion puts them."""

from __future__ import annotations

import numpy as np

from core.arrays import FloatArray
from core.discs.disc_finder import Discs
from core.discs.plates import WantedPlate, find_plates, find_plates_near
from core.geometry.pose import Pose
from core.images import GreyImage
from core.results import RigMotion
from core.rig.calibrated_site import CalibratedSite
from core.rig.calibrated_target import CalibratedTarget
from core.rig.propagation import predict_shift_of
from core.site import MAIN, CirclesTarget, Site

_FIXED_WITHIN_MM = 15.0
"""How far a fixed target may be from where the rig's motion puts it. Chosen: fifty times what a
season's bending was seen to do, so that one that has moved by itself is found and named."""
_ALIKE_SHARE = 0.1
"""Share of a layout's size within which discs stand alike in two layouts."""


def find_calibrated_targets(
    image: GreyImage, site: Site, calibrated: CalibratedSite, motion: RigMotion | None
) -> dict[str, Discs]:
    """Find the targets that the reference shows, by name; those that are not seen are left out.

    With the rig's motion known each is sought where it should be, the fixed ones first; without,
    all are sought as shifted by the same amount. Raises TargetNotFoundError where it is not certain
    which of two alike targets is which.
    """
    drawn = {MAIN: site.main_target, **{one.name: one.target for one in site.extra_targets}}
    targets = [
        target for target in (*calibrated.further, calibrated.main_target) if target.name in drawn
    ]
    targets.sort(key=lambda target: not target.is_fixed)
    wanted = [_wanted(calibrated, target, drawn[target.name], motion) for target in targets]
    if motion is None:
        found = find_plates(image, wanted)
    else:
        found = find_plates_near(image, wanted, [_within(one, wanted, targets) for one in wanted])
    return {
        target.name: discs
        for target, discs in zip(targets, found, strict=True)
        if discs is not None
    }


def _wanted(
    calibrated: CalibratedSite,
    target: CalibratedTarget,
    drawn: CirclesTarget,
    motion: RigMotion | None,
) -> WantedPlate:
    """A target, and where its discs are if it is at rest."""
    scale = float(np.sqrt(abs(np.linalg.det(target.B))))
    near_px = target.reference_px.copy()
    if motion is not None:
        seen = np.nonzero(np.isfinite(near_px).all(axis=1))[0]
        pose = Pose.from_vectors(motion.rotation_rad, motion.translation_mm)
        near_px[seen] += predict_shift_of(calibrated, target, seen, pose).shift_px
    return WantedPlate(target.name, drawn, scale, near_px)


def _within(one: WantedPlate, wanted: list[WantedPlate], targets: list[CalibratedTarget]) -> float:
    """How far, px, a target may be from there: never nearer to where another alike should be."""
    fixed = targets[[other is one for other in wanted].index(True)].is_fixed
    within = _FIXED_WITHIN_MM * one.px_per_mm if fixed else np.inf
    middle = _middle(one)
    for other in wanted:
        if other is not one and _alike(one.target, other.target):
            within = min(within, 0.5 * float(np.hypot(*(_middle(other) - middle))))
    return within


def _middle(wanted: WantedPlate) -> FloatArray:
    assert wanted.near_px is not None  # noqa: S101 - given above
    return np.asarray(np.nanmean(wanted.near_px, axis=0))


def _alike(one: CirclesTarget, other: CirclesTarget) -> bool:
    """Whether two layouts are the same but for their size."""
    if len(one.centres_mm) != len(other.centres_mm):
        return False
    scaled = []
    for target in (one, other):
        places = target.centres_mm - target.centres_mm.mean(axis=0)
        scaled.append(places / np.ptp(places, axis=0).max())
    away = np.hypot(*np.moveaxis(scaled[0][:, None] - scaled[1][None], -1, 0))
    return bool((away.min(axis=1) < _ALIKE_SHARE).all())
