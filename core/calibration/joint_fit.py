"""The dual calibration: one fitted model of lens, board, rig and reference from all views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from scipy.spatial.transform import Rotation

from core.adjustment.bundle_adjustment import (
    AdjustmentPriors,
    AdjustmentResult,
    PrintSpread,
    adjust,
    predict_adjustment,
)
from core.arrays import FloatArray
from core.calibration.observability import drift_motions, require_motion
from core.calibration.views import RejectedView, Views
from core.checkerboard.board import Board
from core.checkerboard.resection import resect
from core.discs.disc_finder import Discs
from core.errors import CalibrationError
from core.geometry.lens import Lens
from core.geometry.pose import Pose
from core.lens.intrinsics import lens_prior
from core.rig.calibrated_site import Baseline, CalibratedSite
from core.rig.calibrated_target import CalibratedTarget
from core.rig.compensation import affine
from core.rig.paper import PaperModel, fit_paper
from core.rig.posterior import Posterior
from core.rig.propagation import expected_effects, predict_shift
from core.rig.rigid import MainView, Rig
from core.site import Site

_SCALE_SIGMA = 2e-3
"""Relative: the target may be tilted, and printed to a part in a thousand."""
_MIN_ASPECT = 0.5
"""Of a plate's scales along its two axes: it would face 60 degrees away from the camera. Discs on
one line have none across it."""
_CLEAN = 0.9
"""Share of a disc's pixels that its model explains, for the disc to count. Insensitive below."""
_OUTLIER_FACTOR, _OUTLIER_FLOOR_PX = 4.0, 0.003
"""A view does not fit whose corners miss by so many times what those of most views do, the median
being at least so large. Insensitive."""
_LEAST_KEPT = 0.6
"""Mean weight of a view's corners, for it to fit: most must. Insensitive below."""
_MOVED_FACTOR, _MOVED_FLOOR_PX = 6.0, 0.1
"""The main target had moved where it is off by so many times what it is in most views, and by so
much: 0.008 mm at 12 px/mm. Insensitive."""
_MOST_OUTLIERS, _MOST_MOVED = 0.4, 0.3
"""Share of the views that may be left out as not fitting, or as taken with the target moved: with
more it is not known which are right."""
_HOLD_OUT_EVERY = 4
"""Every fourth rig view is held out of the fit that validates: five of twenty-one."""
MIN_LENS_VIEWS = 3
"""Zhang's method needs three views of a plane for all five intrinsics."""


class Method(StrEnum):
    """The dual calibration's model."""

    RIGID = "rigid"
    PAPER = "paper"


@dataclass(frozen=True, slots=True)
class FitOptions:
    """What to fit."""

    site: Site
    board: Board
    method: Method
    skew: bool
    """Whether the lens's gamma of Eq. 10 may vary."""


@dataclass(frozen=True, slots=True)
class Fit:
    """A fitted model of the whole site, and the views it rests on."""

    views: Views
    adjustment: AdjustmentResult
    """Its poses are in the order of `views.all`."""
    B: FloatArray
    """(2, 2) B~ of Eq. 8, px/mm."""
    model: Rig | PaperModel
    posterior: Posterior
    """Of lens, model, reference pose and board, whole."""

    @property
    def reference_pose(self) -> Pose:
        """`T_CS1_WS`."""
        return self.adjustment.poses[0]

    @property
    def motions(self) -> list[Pose]:
        """`T_CSj_CS1` of the rig views, Eq. 12."""
        poses = self.adjustment.poses[1 : 1 + len(self.views.rig)]
        return [pose.compose(self.reference_pose.inverse()) for pose in poses]


def fit_views(views: Views, start: Lens, options: FitOptions) -> Fit:
    """Fit the model to the views. Raises NotObservableError if the motions are too few."""
    nominal, B = options.board.corners_mm, main_scale(views, options)
    poses = [resect(start, nominal, v.board.view).pose for v in views.all]
    require_motion([p.compose(poses[0].inverse()) for p in poses[1 : 1 + len(views.rig)]])
    if options.method is Method.RIGID:
        return _fit_rigid(views, start, poses, B, options)
    return _fit_paper(views, start, poses, B, options)


def predict_fit(
    views: Views, lens: Lens, poses: Sequence[Pose], options: FitOptions, spreads: PrintSpread
) -> Fit:
    """Say what a fit of the rigid model to such views will know; views, lens and poses are exact.

    spreads are those of the print to come. Raises NotObservableError if the motions are too few.
    """
    require_motion([p.compose(poses[0].inverse()) for p in poses[1 : 1 + len(views.rig)]])
    return _fit_rigid(views, lens, poses, main_scale(views, options), options, spreads)


def main_scale(views: Views, options: FitOptions) -> FloatArray:
    """B~ of Eq. 8 by the reference, (2, 2) px/mm. Raises CalibrationError where it is flat."""
    discs = views.reference.discs
    centres_mm = options.site.main_target.centres_mm
    B = affine(centres_mm[discs.found], discs.points_px[discs.found])[0]
    longest, shortest = np.linalg.svd(B, compute_uv=False)
    if shortest < _MIN_ASPECT * longest:
        msg = (
            f"calibration: the reference shows {discs.found.sum()} of the main target's "
            f"{len(centres_mm)} discs at the places of target.main.centres_mm, which are too few; "
            "clear the view and take the reference again, or measure the plate"
        )
        raise CalibrationError(msg)
    return B


def _fit_rigid(
    views: Views,
    start: Lens,
    poses: Sequence[Pose],
    B: FloatArray,
    options: FitOptions,
    predicted: PrintSpread | None = None,
) -> Fit:
    """Everything jointly, the survey as prior; with predicted spreads nothing is moved."""
    site, reference = options.site, views.reference.discs
    priors = AdjustmentPriors(
        lens=lens_prior(site.sub, skew=options.skew, model=start.model),
        scale=site.sub_target.scale_sigma,
        rig=rig_prior(site),
        discs_px=disc_sigmas_px(reference),
    )
    main = [None, *(main_view(v.discs, reference) for v in views.rig), *(None for _ in views.lens)]
    boards = [v.board.view for v in views.all]
    given = options.board, boards, start, poses, priors, nominal_rig(site, B), main
    adjusted = adjust(*given) if predicted is None else predict_adjustment(*given, predicted)
    if adjusted.rig is None:
        msg = "calibration: the rig views show too little of the main target"
        raise CalibrationError(msg)
    return Fit(views, adjusted, B, adjusted.rig, adjusted.posterior)


def _fit_paper(
    views: Views, start: Lens, poses: Sequence[Pose], B: FloatArray, options: FitOptions
) -> Fit:
    """The lens on the nominal board, then Eq. 17-19 on the mean of the discs."""
    perfect = AdjustmentPriors(
        lens=lens_prior(options.site.sub, skew=options.skew, model=start.model),
        scale=0.0,
        bow_mm=(0.0, 0.0, 0.0),
        line_mm=0.0,
        corner_mm=0.0,
        discs_px=disc_sigmas_px(views.reference.discs),
    )
    boards = [v.board.view for v in views.all]
    adjusted = adjust(options.board, boards, start, poses, perfect)
    reference = views.reference.discs
    motions, shifts = [], []
    for view, pose in zip(views.rig, adjusted.poses[1:], strict=False):
        main = main_view(view.discs, reference)
        if main is not None:
            motions.append(pose.compose(adjusted.poses[0].inverse()))
            shifts.append((main.points_px - main.reference_px).mean(axis=0))
    drawn = nominal_rig(options.site, B)
    middle = reference.points_px[reference.found].mean(axis=0)
    p_CS1 = drawn.T_CM_CS.inverse().apply(drawn.target_points_CM1(middle[None]))[0]
    start_B = drawn.scale_px_per_mm * drawn.T_CM_CS.R[:2]
    model = fit_paper(motions, np.array(shifts), start_B, p_CS1)
    posterior = adjusted.posterior.with_model(model.covariance)
    return Fit(views, adjusted, B, model, posterior)


def nominal_rig(site: Site, B: FloatArray) -> Rig:
    """The rig as drawn, with the scale measured on the target (largest singular value of B~)."""
    angles = site.rig.rotation_main_sub_deg
    return Rig(
        Pose(
            np.asarray(Rotation.from_euler("xyz", angles, degrees=True).as_matrix()),
            np.asarray(site.rig.offset_main_sub_mm, dtype=float),
        ),
        site.main_target.distance_mm,
        float(np.linalg.svd(B, compute_uv=False)[0]),
        site.main.centre_px,
    )


def rig_prior(site: Site) -> FloatArray:
    """(8,) 1-sigma of the rig parameters: drawing, survey, and the measured scale."""
    target = site.main_target
    return np.array(
        [np.radians(site.rig.rotation_sigma_deg)] * 3
        + [site.rig.offset_sigma_mm] * 3
        + [target.distance_sigma_mm / target.distance_mm, _SCALE_SIGMA]
    )


def main_view(discs: Discs, reference: Discs) -> MainView | None:
    """The discs that are clear in a view and in the reference, or None."""
    common = discs.found & reference.found & (discs.explained_fraction > _CLEAN)
    if not common.any():
        return None
    which = np.nonzero(common)[0]
    return MainView(
        discs.points_px[which], reference.points_px[which], disc_sigmas_px(discs)[which], which
    )


def disc_sigmas_px(discs: Discs) -> FloatArray:
    """(n,) 1 sigma of a coordinate of each disc; 0 where it was not found."""
    variance = np.trace(discs.covariance_px2, axis1=1, axis2=2) / 2.0
    return np.asarray(np.where(discs.found, np.sqrt(variance), 0.0))


def main_residuals_px(
    model: Rig | PaperModel, discs: Discs, reference: Discs, motion: Pose
) -> FloatArray:
    """Discs of a target at rest minus their prediction, (k, 2) px."""
    main = main_view(discs, reference)
    if main is None:
        return np.zeros((0, 2))
    shift = predict_shift(model, main.reference_px, motion).shift_px
    return np.asarray(main.points_px - main.reference_px - shift)


def reject_outlier_views(fit: Fit, options: FitOptions) -> tuple[Fit, list[RejectedView]]:
    """Fit again without the views whose corners fit far worse than the others'."""
    rms = np.array(fit.adjustment.view_rms_px)
    typical = float(np.median(rms))
    kept = np.array(fit.adjustment.view_kept)
    bad = (rms > _OUTLIER_FACTOR * max(typical, _OUTLIER_FLOOR_PX)) | (kept < _LEAST_KEPT)
    if not bad.any():
        return fit, []
    if bad[0] or bad.sum() > _MOST_OUTLIERS * len(bad):
        msg = (
            f"calibration: {int(bad.sum())} of {len(bad)} views do not fit the others"
            f"{', the reference among them' if bad[0] else ''}; was the lens or the board touched?"
        )
        raise CalibrationError(msg)
    rejected = [
        (
            view.name,
            (
                f"corners off by {r:.3f} px rms, the others by {typical:.3f} px; "
                f"{100.0 * (1.0 - share):.0f} % of them do not fit at all"
            ),
        )
        for view, r, share, is_bad in zip(fit.views.all, rms, kept, bad, strict=True)
        if is_bad
    ]
    others = fit.views.without({name for name, _ in rejected})
    return fit_views(others, fit.adjustment.lens, options), rejected


def reject_moved_targets(fit: Fit, options: FitOptions) -> tuple[Fit, list[RejectedView]]:
    """Fit again without the rig views in which the main target was not where it rested."""
    reference = fit.views.reference.discs
    off = np.array(
        [
            np.hypot(*main_residuals_px(fit.model, v.discs, reference, m).mean(axis=0))
            if main_view(v.discs, reference)
            else 0.0
            for v, m in zip(fit.views.rig, fit.motions, strict=True)
        ]
    )
    typical = float(np.median(off))
    bad = off > max(_MOVED_FACTOR * typical, _MOVED_FLOOR_PX)
    if options.method is not Method.RIGID or not bad.any() or bad.sum() > _MOST_MOVED * len(bad):
        return fit, []
    rejected = [
        (view.name, f"main target off by {miss:.2f} px, in the other views by {typical:.2f} px")
        for view, miss, is_bad in zip(fit.views.rig, off, bad, strict=True)
        if is_bad
    ]
    others = fit.views.without({name for name, _ in rejected})
    return fit_views(others, fit.adjustment.lens, options), rejected


def build_calibrated_site(fit: Fit, options: FitOptions) -> CalibratedSite:
    """What measurements need of a fit."""
    calibrated = build_uncompressed_site(fit, options)
    effects_px = [
        expected_effects(calibrated, options.site.sub, motion)
        for motion in (*fit.motions, *drift_motions(options.site.quality))
    ]
    seen = fit.views.reference.discs.found
    effects_px.append(fit.posterior.discs[seen].mean(axis=0))  # raw displacement
    return replace(calibrated, posterior=fit.posterior.compressed(np.concatenate(effects_px)))


def build_uncompressed_site(fit: Fit, options: FitOptions) -> CalibratedSite:
    """Likewise with all that the fit knows, what no measurement needs included."""
    reference = fit.views.reference
    baseline = Baseline(
        float(np.median(fit.adjustment.view_rms_px)),
        # By single frames, as rows are; the reference may be a mean of many, in finer grey values.
        *_typical([(v.board.contrast_dn, v.board.blur_px) for v in fit.views.rig]),
        *_typical([(v.discs.contrast_dn, v.discs.blur_px) for v in fit.views.rig]),
        max(float(np.linalg.norm(m.rotation_rad)) for m in fit.motions),
        max(float(np.linalg.norm(m.t_mm)) for m in fit.motions),
    )
    return CalibratedSite(
        options.board,
        fit.adjustment.corners_mm,
        fit.adjustment.lens,
        fit.reference_pose,
        reference.discs.points_px + fit.adjustment.discs_px,
        fit.B,
        fit.model,
        fit.posterior,
        baseline,
        _further_targets(fit, options),
    )


def _further_targets(fit: Fit, options: FitOptions) -> tuple[CalibratedTarget, ...]:
    """The further targets that the reference shows."""
    targets = []
    seen_there = fit.views.reference.further  # none in views that are only planned
    for extra, discs in zip(options.site.extra_targets, seen_there, strict=False):
        if discs is None or options.method is not Method.RIGID:
            continue
        seen = discs.found
        targets.append(
            CalibratedTarget(
                extra.name,
                extra.role,
                discs.points_px,
                disc_sigmas_px(discs) ** 2,
                affine(extra.target.centres_mm[seen], discs.points_px[seen])[0],
                extra.target.distance_mm,
                extra.target.distance_sigma_mm,
            )
        )
    return tuple(targets)


def _typical(contrast_and_blur: Sequence[tuple[float, float]]) -> tuple[float, float]:
    contrast_dn, blur_px = np.median(np.array(contrast_and_blur), axis=0)
    return float(contrast_dn), float(blur_px)


def held_out_errors_mm(fit: Fit, options: FitOptions) -> FloatArray:
    """Errors (n, 2) mm at rig positions held out of a second fit; the target was at rest.

    Empty if too few positions would be left to fit to.
    """
    held = fit.views.rig[1::_HOLD_OUT_EVERY]
    try:
        kept = fit.views.without({view.name for view in held})
        trial = fit_views(kept, fit.adjustment.lens, options)
    except CalibrationError:
        return np.zeros((0, 2))
    errors = []
    for view in held:
        pose = resect(trial.adjustment.lens, trial.adjustment.corners_mm, view.board.view).pose
        motion = pose.compose(trial.reference_pose.inverse())
        misses = main_residuals_px(trial.model, view.discs, fit.views.reference.discs, motion)
        if len(misses):
            errors.append(np.linalg.solve(trial.B, misses.mean(axis=0)))
    return np.array(errors).reshape(-1, 2)
