"""The zero passes from one reference to the next through a fixed target that both show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from core.arrays import FloatArray
from core.geometry.pose import Pose
from core.rig.calibrated_site import CalibratedSite
from core.rig.calibrated_target import CalibratedTarget
from core.rig.datum import through_fixed_targets
from core.rig.propagation import predict_shift_of
from core.rig.rigid import Rig
from core.rig.travel import travel_by
from core.site import CirclesTarget, ExtraTarget, Site, TargetRole
from tests.core.scenes import CENTRES_MM
from tests.core.sessions import Session

PLATE = ExtraTarget(
    "abutment", TargetRole.FIXED, CirclesTarget(0.5 * CENTRES_MM, np.full(5, 4.0), 11125.0, 20.0)
)


def with_plate(made: Session) -> tuple[Site, CalibratedSite]:
    """A calibrated site with a fixed plate 30 mm beside the main one."""
    calibrated = made.calibration.calibrated
    places = calibrated.reference_discs_px.mean(axis=0) + (
        (0.5 * CENTRES_MM + [30.0, 4.0]) @ calibrated.B.T
    )
    plate = CalibratedTarget(
        "abutment", TargetRole.FIXED, places, np.full(5, 1e-6), calibrated.B, 11125.0, 20.0
    )
    site = replace(made.site, extra_targets=(PLATE,))
    return site, replace(calibrated, further=(plate,))


def turned(
    site: Site, old: CalibratedSite, moved_mm: FloatArray, roll_rad: float, scale: float
) -> CalibratedSite:
    """The reference of another camera position, in which the bridge has moved."""

    def image(points_px: FloatArray) -> FloatArray:
        c, s = np.cos(roll_rad), np.sin(roll_rad)
        away = points_px - site.main.centre_px
        return site.main.centre_px + [31.0, -12.0] + scale * away @ np.array([[c, s], [-s, c]])

    main = image(old.reference_discs_px + old.B @ moved_mm)
    plate = replace(old.further[0], reference_px=image(old.further[0].reference_px))
    return replace(old, reference_discs_px=main, further=(plate,))


def test_the_bridge_beside_the_plate_is_what_has_moved(usual: Session) -> None:
    """Through any shift, a roll of a degree, and a lens that was refocused."""
    site, old = with_plate(usual)
    moved_mm = np.array([0.34, 2.75])
    for roll_rad, scale in ((0.0, 1.0), (2e-4, 1.0), (0.017, 1.0), (1e-4, 1.004)):
        found = through_fixed_targets(old, turned(site, old, moved_mm, roll_rad, scale), site)
        assert found is not None
        np.testing.assert_allclose(found["main"].displacement.mm, moved_mm, atol=1e-3)
        sigma = np.sqrt(np.diag(found["main"].displacement.covariance_mm2))
        assert (sigma > 1e-3).all()
        assert (sigma < 0.05).all()


def test_parallax_of_an_unknown_shift_is_in_the_sigma(usual: Session) -> None:
    """1.5 mm of drift between plates at 11 and 11.125 m are 0.017 mm."""
    site, old = with_plate(usual)
    found = through_fixed_targets(old, old, site)
    assert found is not None
    sigma = np.sqrt(np.diag(found["main"].displacement.covariance_mm2))
    np.testing.assert_allclose(sigma, 1.5 * 125.0 / 11125.0, rtol=0.15)


def test_a_known_travel_takes_the_parallax_off(usual: Session) -> None:
    """A pair that has moved by 2 mm to the side sees targets at 11 and 11.125 m 0.022 mm apart."""
    site, old = with_plate(usual)
    model = old.model
    assert isinstance(model, Rig)
    motion = Pose.from_vectors(np.zeros(3), np.array([2.0, -1.0, 0.0]))
    plate = old.further[0]
    every = np.arange(5)
    seen = [
        target.reference_px + predict_shift_of(old, target, every, motion).shift_px
        for target in (old.main_target, plate)
    ]
    new = replace(old, reference_discs_px=seen[0], further=(replace(plate, reference_px=seen[1]),))
    unknown = through_fixed_targets(old, new, site)
    known = through_fixed_targets(old, new, site, travel_by(old, motion, 0.1))
    assert unknown is not None
    assert known is not None
    assert 0.015 < np.hypot(*unknown["main"].displacement.mm) < 0.03
    np.testing.assert_allclose(known["main"].displacement.mm, 0.0, atol=5e-4)
    assert np.sqrt(known["main"].displacement.covariance_mm2[0, 0]) < 0.003


def test_without_a_fixed_target_in_both_there_is_no_answer(usual: Session) -> None:
    site, old = with_plate(usual)
    alone = replace(old, further=())
    assert through_fixed_targets(old, alone, site) is None
    assert through_fixed_targets(alone, old, site) is None
