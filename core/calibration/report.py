"""What a calibration is worth, in sentences and figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from core.arrays import FloatArray
from core.calibration.joint_fit import (
    MIN_LENS_VIEWS,
    Fit,
    FitOptions,
    main_residuals_px,
    nominal_rig,
    rig_prior,
)
from core.calibration.observability import (
    DriftError,
    describe_model,
    determined_share,
    drift_errors,
    suggest_motion,
)
from core.calibration.survey_check import SurveyCheck
from core.calibration.views import CalibrationView, RejectedView
from core.checkerboard.resection import resect
from core.lens.lens_choice import LensChoice
from core.lens.lens_coverage import lens_coverage
from core.results import CalibrationReport
from core.rig.calibrated_site import CalibratedSite
from core.rig.compensation import AFFINE_LIMIT_PX, affine_error_px
from core.rig.paper import PaperModel
from core.rig.rigid import Rig
from core.rig.stability import main_scale, season_sentence
from core.site import Site

_FEW_LENS_VIEWS = 10
"""Fewer are warned of; 12 are asked for (docs/method.md)."""
_FAR_SIGMAS = 4.5
"""Three angles drawn by chance are 3.5 sigma off at one site in 150, 4.5 at one in 7000."""


def write_report(
    fit: Fit,
    calibrated: CalibratedSite,
    options: FitOptions,
    choice: LensChoice,
    rejected: Sequence[RejectedView],
    given: Mapping[str, CalibrationView],
    held_out: FloatArray,
    survey: SurveyCheck,
    unreadable: Sequence[str] = (),
) -> CalibrationReport:
    """Judge a calibration. held_out (n, 2) are the errors in mm at held-out positions.

    given are the views by name, those rejected among them; unreadable has the reason of
    each view that could not be read.
    """
    drift = drift_errors(calibrated, options.site)
    problems = _problems(fit, calibrated, options, drift, held_out)
    problems += survey.problems + _contradictions(calibrated, options, survey)
    figures = _figures(fit, calibrated, options, drift, held_out)
    figures["rejected"] = [{"view": name, "reason": reason} for name, reason in rejected]
    if unreadable:
        figures["left_out"] = list(unreadable)
    figures["problems"] = problems
    figures["survey"] = [quantity.to_dict() for quantity in survey.quantities]
    figures["lens_held_out_px"] = {m.value: px for m, px in choice.held_out_px.items()}
    views = fit.views
    lines = [
        "calibration passed" if not problems else "calibration NOT passed: " + "; ".join(problems),
        (
            f"views used: {len(views.lens)} lens, 1 reference, {len(views.rig)} rig; "
            f"rejected: {len(rejected)}"
            + (f", could not be read: {len(unreadable)}" if unreadable else "")
        ),
        *(f"rejected {given[name].called(reason)}: {reason}" for name, reason in rejected),
        *(f"could not be read: {reason}" for reason in unreadable),
        (
            f"corners fit to {figures['sub_rms_px']:.4f} px rms, main discs to "
            f"{figures['main_rms_px']:.4f} px rms"
        ),
        choice.sentence,
        describe_model(calibrated.model),
        "expected error of a row after the drift expected (1 sigma, in brackets the calibration's "
        "part): "
        + ", ".join(f"{d.motion} {d.sigma_mm:.3f} mm ({d.calibration_mm:.3f})" for d in drift),
    ]
    advice = suggest_motion(calibrated, options.site)
    if advice is not None:
        lines.append(advice)
    if len(held_out):
        lines.append(
            f"validated on {len(held_out)} held-out positions: {_rms(held_out):.4f} mm rms, "
            f"{float(np.hypot(*held_out.T).max()):.4f} mm at most"
        )
    typical_mm = float(np.median([d.sigma_mm for d in drift]))
    scale = main_scale(calibrated.B)
    lines.append(season_sentence(options.site, scale, typical_mm, calibrated.lens))
    lines += survey.lines + _warnings(fit, figures)
    return CalibrationReport(not problems, tuple(lines), figures)


def _rms(errors: FloatArray) -> float:
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


def _problems(
    fit: Fit,
    calibrated: CalibratedSite,
    options: FitOptions,
    drift: Sequence[DriftError],
    held_out: FloatArray,
) -> list[str]:
    """Why the calibration should not be used; empty if it may."""
    limit = options.site.quality.max_sigma_mm
    worst = max(drift, key=lambda d: d.sigma_mm)
    problems = []
    if worst.sigma_mm > limit:
        problems.append(
            f"a {worst.motion} of the expected drift would be corrected to {worst.sigma_mm:.3f} mm "
            f"(1 sigma) only, the limit is {limit:g} mm"
        )
    if len(held_out) and _rms(held_out) > limit:
        problems.append(f"held-out positions are wrong by {_rms(held_out):.3f} mm rms")
    if len(fit.views.lens) < MIN_LENS_VIEWS:
        problems.append(
            f"{len(fit.views.lens)} lens views; pan and tilt do not determine the lens, take 12 "
            "or more views with the board in the hand"
        )
    if isinstance(calibrated.model, PaperModel) and calibrated.model.null_directions:
        problems.append(
            f"{calibrated.model.null_directions} of the paper's nine parameters are not determined "
            "by the motions; use --method rigid"
        )
    return problems


def _contradictions(
    calibrated: CalibratedSite, options: FitOptions, survey: SurveyCheck
) -> list[str]:
    """Where the views put the cameras far from the drawing of the rig."""
    if not isinstance(calibrated.model, Rig):
        return []
    site = options.site
    drawn = nominal_rig(site, calibrated.B)
    sigmas = np.abs(calibrated.model.deviation_from(drawn)) / rig_prior(site)
    turn, offset = float(np.linalg.norm(sigmas[:3])), float(np.linalg.norm(sigmas[3:6]))
    problems = []
    if turn > _FAR_SIGMAS:
        problems.append(
            f"the cameras are turned against one another {turn:.1f} sigma from the drawing; check "
            "[rig] rotation_main_sub_deg, its signs and its sigma"
        )
    if offset > _FAR_SIGMAS and not survey.problems:  # a wrong length shifts the cameras, too
        problems.append(
            f"the cameras' offset is {offset:.1f} sigma from the drawing; check [rig] "
            "offset_main_sub_mm and its signs"
        )
    return problems


def _warnings(fit: Fit, figures: dict[str, Any]) -> list[str]:
    warnings = []
    if MIN_LENS_VIEWS <= len(fit.views.lens) < _FEW_LENS_VIEWS:
        warnings.append(
            f"warning: {len(fit.views.lens)} lens views; take 12 or more, the board in the hand"
        )
    if not fit.views.reference.board.unambiguous:
        warnings.append(
            "warning: which part of the board the reference shows is not certain; let at least "
            "one border of the board into the sub image in each direction"
        )
    if figures["affine_error_px"] > AFFINE_LIMIT_PX:
        warnings.append(
            f"warning: Eq. 5 fails ({figures['affine_error_px']:.1f} px for the expected drift); "
            "the paper's affine camera does not hold here, the rigid method does not need it"
        )
    return warnings


def _figures(
    fit: Fit,
    calibrated: CalibratedSite,
    options: FitOptions,
    drift: Sequence[DriftError],
    held_out: FloatArray,
) -> dict[str, Any]:
    reference = fit.views.reference.discs
    misses = [
        main_residuals_px(calibrated.model, view.discs, reference, motion)
        for view, motion in zip(fit.views.rig, fit.motions, strict=True)
    ]
    site = options.site
    off_axis = float(np.nanmax(np.abs(calibrated.reference_discs_px - site.main.centre_px)))
    figures: dict[str, Any] = {
        "method": options.method.value,
        "sub_rms_px": calibrated.baseline.sub_rms_px,
        "main_rms_px": float(np.sqrt(np.mean(np.concatenate(misses) ** 2))),
        "view_rms_px": {
            v.name: round(r, 5)
            for v, r in zip(fit.views.all, fit.adjustment.view_rms_px, strict=True)
        },
        "lens_model": calibrated.lens.model.value,
        "lens": calibrated.lens.parameters.tolist(),
        "lens_sigma": fit.posterior.lens_sigma.tolist(),
        "board_scale": fit.adjustment.shape[:2].tolist(),
        "board_bow_mm": float(np.ptp(calibrated.corners_mm[:, 2])),
        "board_spread_mm": {
            "columns": fit.adjustment.spreads.column_mm,
            "rows": fit.adjustment.spreads.row_mm,
            "corners": fit.adjustment.spreads.corner_mm,
        },
        "px_per_mm": float(np.linalg.svd(calibrated.B, compute_uv=False)[0]),
        "expected_error_mm": {d.motion: d.sigma_mm for d in drift},
        "held_out_mm": held_out.tolist(),
        "affine_error_px": affine_error_px(
            site.main_target.distance_mm, site.quality.expected_drift_mm, off_axis
        ),
        "max_rotation_mrad": calibrated.baseline.max_rotation_rad * 1e3,
        "rig_views": _rig_views(fit, calibrated),
        "image_cells": _image_cells(fit, site),
    }
    if isinstance(calibrated.model, Rig):
        figures["determined_by_views"] = determined_share(fit.posterior, rig_prior(site)).tolist()
        figures["rig_sigma"] = fit.posterior.model_sigma.tolist()
        figures["depth_mm"] = calibrated.model.depth_mm
    else:
        figures["singular_values"] = calibrated.model.singular_values.tolist()
    return figures


def _rig_views(fit: Fit, calibrated: CalibratedSite) -> list[dict[str, Any]]:
    """Each rig position as a row would see it: the motion by the sub image alone, what is left."""
    to_mm, reference = np.linalg.inv(calibrated.B), fit.views.reference.discs
    positions = []
    for view in fit.views.rig:
        pose = resect(calibrated.lens, calibrated.corners_mm, view.board.view).pose
        motion = pose.compose(calibrated.reference_pose.inverse())
        left_px = main_residuals_px(calibrated.model, view.discs, reference, motion).mean(axis=0)
        positions.append(
            {
                "view": view.name,
                "rotation_mrad": (motion.rotation_rad * 1e3).tolist(),
                "translation_mm": motion.t_mm.tolist(),
                "left_mm": (to_mm @ left_px).tolist(),
            }
        )
    return positions


def _image_cells(fit: Fit, site: Site) -> list[list[int]]:
    """How many corners the views of the lens have in each cell of the sub image."""
    lens_views = fit.views.lens
    points = [view.board.view.points_px for view in lens_views]
    poses = fit.adjustment.poses[len(fit.views.all) - len(lens_views) :]
    cells: list[list[int]] = lens_coverage(points, poses, site.sub).cells.tolist()
    return cells
