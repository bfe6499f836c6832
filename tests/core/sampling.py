"""A perfect world of numbers, drawn from the priors: true site, noisy points, no images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from core.adjustment.bundle_adjustment import AdjustmentPriors, AdjustmentResult, adjust
from core.arrays import FloatArray
from core.calibration.joint_fit import nominal_rig, rig_prior
from core.checkerboard.board import Board
from core.checkerboard.board_shape import board_terms, shape_sigmas
from core.checkerboard.resection import BoardView
from core.discs.disc_finder import Discs
from core.geometry.lens import Lens
from core.geometry.pose import Pose
from core.lens.intrinsics import lens_prior, nominal_lens
from core.rig.calibrated_site import Baseline, CalibratedSite
from core.rig.rigid import MainView, Rig
from core.site import CheckerboardTarget
from tests.core.scenes import small_site

CORNER_PX = 0.005
DISC_PX = 0.005
LINE_MM, CORNER_MM = 0.006, 0.002
"""How the print is drawn; the adjustment has to find that out."""
SITE = small_site(sub_target=CheckerboardTarget(10, 8, 4.0, 50.0))
BOARD = Board.nominal(SITE.sub_target)
B = SITE.nominal_px_per_mm * np.diag([1.0, -1.0])
DRAWN = nominal_rig(SITE, B)
PRIORS = AdjustmentPriors(
    lens=lens_prior(SITE.sub), rig=rig_prior(SITE), discs_px=np.full(5, DISC_PX)
)


@dataclass(frozen=True, slots=True)
class Truth:
    """One true site, and what is seen of it."""

    lens: Lens
    corners_mm: FloatArray
    rig: Rig
    discs_px: FloatArray
    """(5, 2) in the reference."""
    reference: Pose

    def see_board(self, pose: Pose, rng: np.random.Generator) -> BoardView:
        """Noisy corners, those in the image."""
        px = self.lens.project(pose.apply(self.corners_mm))
        size = np.array([SITE.sub.width_px, SITE.sub.height_px]) - 4
        index = np.nonzero(((px > 3) & (px < size)).all(axis=1))[0]
        noisy = px[index] + CORNER_PX * rng.normal(size=(len(index), 2))
        return BoardView(index, noisy, np.tile(CORNER_PX**2 * np.eye(2), (len(index), 1, 1)))

    def see_discs(self, motion: Pose, moved_mm: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Noisy discs (5, 2) after a rig motion and a displacement of the target."""
        scale = self.rig.scale_px_per_mm * np.array([1.0, -1.0])
        px = self.rig.move(self.discs_px + moved_mm * scale, motion)
        return px + DISC_PX * rng.normal(size=px.shape)


def draw(rng: np.random.Generator) -> Truth:
    """A true site within its priors (the lens well within)."""
    lens = nominal_lens(SITE.sub).parameters + np.array(
        [6.0, 6.0, 0.0, 3.0, 3.0, 0.1, 0.05, 5e-4, 5e-4, 0.01]
    ) * rng.normal(size=10)
    lines = np.full(BOARD.columns + BOARD.rows, LINE_MM)
    sigma = np.concatenate([shape_sigmas(PRIORS.scale, PRIORS.bow_mm), lines])
    corners = BOARD.corners_mm + board_terms(BOARD) @ (sigma * rng.normal(size=len(sigma)))
    corners[:, :2] += CORNER_MM * rng.normal(size=(len(corners), 2))
    rig = DRAWN.perturbed(PRIORS.rig * rng.normal(size=8))
    discs = rig.centre_px + (SITE.main_target.centres_mm @ B.T) * (rig.scale_px_per_mm / B[0, 0])
    reference = Pose.from_vectors(
        0.02 * rng.normal(size=3), np.array([-20.0, -16.0, 50.0]) + rng.normal(size=3)
    )
    return Truth(Lens(lens), corners, rig, discs, reference)


def head_motion(pan_rad: float, tilt_rad: float) -> Pose:
    """`T_CSj_CS1` of a turn about axes that do not meet."""
    turn = Pose(Rotation.from_rotvec([tilt_rad, 0.0, 0.0]).as_matrix(), np.zeros(3))
    tilt = Pose(turn.R, np.array([0.0, 118.0, -25.0]) - turn.R @ [0.0, 118.0, -25.0])
    turn = Pose(Rotation.from_rotvec([0.0, pan_rad, 0.0]).as_matrix(), np.zeros(3))
    pan = Pose(turn.R, np.array([6.0, 0.0, -44.0]) - turn.R @ [6.0, 0.0, -44.0])
    return pan.compose(tilt)


def lens_view_pose(rng: np.random.Generator) -> Pose:
    """`T_CS_WS` of the board in the hand."""
    axis = rng.normal(size=2)
    tilt = np.radians(25.0) * np.sqrt(rng.uniform(0.2, 1.0)) * axis / np.hypot(*axis)
    R = Rotation.from_rotvec([*tilt, rng.uniform(-0.2, 0.2)]).as_matrix()
    middle = np.array([*rng.uniform(-4.0, 4.0, 2), rng.uniform(58.0, 70.0)])
    return Pose(R, middle - R @ [20.0, 16.0, 0.0])


def calibrated(truth: Truth, rng: np.random.Generator) -> tuple[CalibratedSite, AdjustmentResult]:
    """What the adjustment makes of six lens views, the reference and six head positions."""
    motions = [head_motion(*rng.uniform(-2e-3, 2e-3, 2)) for _ in range(6)]
    poses = [truth.reference, *(m.compose(truth.reference) for m in motions)]
    poses += [lens_view_pose(rng) for _ in range(6)]
    views = [truth.see_board(pose, rng) for pose in poses]
    reference_px = truth.see_discs(Pose.identity(), np.zeros(2), rng)
    main = [None]
    sigma, which = np.full(5, DISC_PX), np.arange(5)
    main += [
        MainView(truth.see_discs(m, np.zeros(2), rng), reference_px, sigma, which) for m in motions
    ]
    main += [None] * 6
    adjusted = adjust(BOARD, views, nominal_lens(SITE.sub), poses, PRIORS, DRAWN, main)
    scale = truth.rig.scale_px_per_mm
    calibrated = CalibratedSite(
        BOARD,
        adjusted.corners_mm,
        adjusted.lens,
        adjusted.poses[0],
        reference_px + adjusted.discs_px,
        np.diag([scale, -scale]),
        adjusted.rig,
        adjusted.posterior,
        Baseline(CORNER_PX, 180.0, 0.7, 180.0, 0.8, 3e-3, 1.0),
    )
    return calibrated, adjusted


def discs_of(points_px: FloatArray) -> Discs:
    """Clean discs at noisy points."""
    n = len(points_px)
    covariance = np.tile(DISC_PX**2 * np.eye(2), (n, 1, 1))
    return Discs(np.ones(n, dtype=bool), points_px, covariance, np.ones(n), 180.0, 0.8)
