"""From calibration views to a calibration: lens, board, reference, rig, and how far to trust it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from core.adjustment import Adjusted, AdjustmentPriors, adjust
from core.board import Board
from core.compensation import affine, affine_error_px, predict_shift
from core.corners import LocatedBoard, detect_board, locate_board, refine_board
from core.discs import Discs, find_discs
from core.errors import CalibrationError, ImageError, TargetNotFoundError
from core.frames import GreyImage, require_size
from core.intrinsics import lens_prior, start_lens
from core.lens import Lens
from core.observability import (
    determined_share,
    drift_errors,
    model_sentence,
    require_motion,
)
from core.paper import PaperModel, fit_paper
from core.pose import Pose
from core.resection import resect
from core.rig import MainView, Rig
from core.setup import Levels, Setup
from core.site import FloatArray, Site

_DISC_SIGMA_PX = 0.005
_SCALE_SIGMA = 2e-3
"""Relative: the target may be tilted, and printed to a part in a thousand."""
_MISFIT_FACTOR = 4.0
_HOLD_OUT_EVERY = 4
_FORMAT = 1


class ViewRole(StrEnum):
    """What a calibration view is for (the `role` column of frames.csv)."""

    INTRINSICS = "intrinsics"
    REFERENCE = "reference"
    RIG = "rig"


class Method(StrEnum):
    """The dual calibration's model."""

    RIGID = "rigid"
    PAPER = "paper"


@dataclass(frozen=True, slots=True)
class CalibrationView:
    """One view given to `calibrate`."""

    name: str
    """How messages call it, e.g. the slot or the file name."""
    role: ViewRole
    main: GreyImage | None
    sub: GreyImage


@dataclass(frozen=True, slots=True)
class Calibration:
    """Everything that `measure_pair` needs; immutable; round-trips through plain JSON types."""

    method: Method
    setup: Setup

    def to_dict(self) -> dict[str, Any]:
        """Give plain JSON types."""
        return {"format": _FORMAT, "method": self.method.value, "setup": self.setup.to_dict()}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Calibration:
        """Read what `to_dict` gave. Raises CalibrationError."""
        try:
            if data["format"] != _FORMAT:
                msg = f"calibration of format {data['format']}, this version reads {_FORMAT}"
                raise CalibrationError(msg)
            return cls(Method(data["method"]), Setup.from_dict(data["setup"]))
        except (KeyError, ValueError, TypeError) as error:
            msg = f"calibration: not readable ({error!r}); calibrate again"
            raise CalibrationError(msg) from error


@dataclass(frozen=True, slots=True)
class CalibrationReport:
    """What an engineer needs to decide whether to trust a calibration."""

    passed: bool
    lines: tuple[str, ...]
    """Plain sentences, the verdict first."""
    figures: dict[str, Any]
    """The numbers behind them, plain JSON types."""


@dataclass(frozen=True, slots=True)
class _Seen:
    """One view with its targets found."""

    view: CalibrationView
    board: LocatedBoard
    discs: Discs | None


@dataclass(frozen=True, slots=True)
class _Fit:
    """A fitted model of the whole site, and the views it rests on (the reference first)."""

    seen: tuple[_Seen, ...]
    adjusted: Adjusted
    B: FloatArray
    model: Rig | PaperModel
    covariance: FloatArray

    @property
    def reference_px(self) -> FloatArray:
        """(discs, 2) in the reference view."""
        discs = self.seen[0].discs
        assert discs is not None  # noqa: S101 - the reference always has discs, see _look
        return discs.points_px


def calibrate(
    views: Sequence[CalibrationView],
    site: Site,
    method: Method = Method.RIGID,
    *,
    skew: bool = False,
) -> tuple[Calibration, CalibrationReport]:
    """Calibrate a site from its views: lens views, one reference, rig positions.

    `rigid` adjusts lens, board, poses and rig jointly with the survey as prior; `paper` fits
    the lens alone to the nominal board, then the nine parameters of Eq. 18. `skew` lets the
    lens's gamma of Eq. 10 vary. Views that cannot be used are named in the report.
    Raises CalibrationError, and NotObservableError if the motions determine too little.
    """
    board = Board.nominal(site.sub_target)
    seen, rejected = _look(views, site, board)
    start, bad_lens_views = _start_lens(seen, board, site)
    rejected += [(seen[k].view.name, "does not fit the other lens views") for k in bad_lens_views]
    seen = [s for k, s in enumerate(seen) if k not in bad_lens_views]
    fit = _fit(_relocate(seen, start, board), start, board, site, method, skew=skew)
    fit, misfits = _without_misfits(fit, board, site, method, skew=skew)
    rejected += misfits
    setup = _setup(fit, board)
    held_out = _validate(fit, board, site, method, skew=skew)
    return Calibration(method, setup), _report(fit, setup, site, method, rejected, held_out)


def _look(
    views: Sequence[CalibrationView], site: Site, board: Board
) -> tuple[list[_Seen], list[tuple[str, str]]]:
    """Find the targets in all views; the reference comes first and must be usable."""
    _require_roles(views)
    order = {ViewRole.REFERENCE: 0, ViewRole.RIG: 1, ViewRole.INTRINSICS: 2}
    seen: list[_Seen] = []
    rejected: list[tuple[str, str]] = []
    for view in sorted(views, key=lambda v: order[v.role]):
        try:
            seen.append(_look_at(view, site, board))
        except (TargetNotFoundError, ImageError) as error:
            if view.role is ViewRole.REFERENCE:
                msg = f"reference view {view.name}: {error}; take the reference again"
                raise CalibrationError(msg) from error
            rejected.append((view.name, str(error)))
    return seen, rejected


def _require_roles(views: Sequence[CalibrationView]) -> None:
    references = sum(v.role is ViewRole.REFERENCE for v in views)
    if references != 1:
        msg = f"calibration: {references} reference views given, exactly one is needed"
        raise CalibrationError(msg)
    if not any(v.role is ViewRole.RIG for v in views):
        msg = "calibration: no rig views; move the rig with both targets at rest and take some"
        raise CalibrationError(msg)


def _look_at(view: CalibrationView, site: Site, board: Board) -> _Seen:
    require_size(view.sub, site.sub, f"{view.name}, sub image")
    located = detect_board(view.sub, board)
    if view.role is ViewRole.INTRINSICS:
        return _Seen(view, located, None)
    if view.main is None:
        msg = f"{view.name}: no main image"
        raise TargetNotFoundError(msg)
    require_size(view.main, site.main, f"{view.name}, main image")
    return _Seen(view, located, find_discs(view.main, site.main_target, _expected_scale(site)))


def _expected_scale(site: Site) -> float:
    return site.main.focal_px / site.main_target.distance_mm


def _start_lens(seen: Sequence[_Seen], board: Board, site: Site) -> tuple[Lens, frozenset[int]]:
    """A lens to start from, and the indices of lens views that do not fit."""
    which = [k for k, s in enumerate(seen) if s.view.role is ViewRole.INTRINSICS]
    which = which if len(which) >= 3 else list(range(len(seen)))
    start = start_lens([seen[k].board.view for k in [0, *which]], board, site.sub)
    bad = frozenset(([0, *which])[v] for v in start.rejected)
    if 0 in bad:
        msg = "calibration: the reference view does not fit the lens views; is it the same lens?"
        raise CalibrationError(msg)
    return start.lens, bad


def _relocate(seen: Sequence[_Seen], lens: Lens, board: Board) -> list[_Seen]:
    """Locate all corners again, now with the lens; rig views are named by the reference."""
    reference = resect(lens, board.corners_mm, seen[0].board.view).pose
    relocated = []
    for s in seen:
        if s.view.role is ViewRole.RIG:
            located = locate_board(s.view.sub, lens, board, board.corners_mm, reference)
        else:
            pose = resect(lens, board.corners_mm, s.board.view).pose
            located = refine_board(s.view.sub, lens, pose, board, board.corners_mm)
        relocated.append(replace(s, board=located))
    return relocated


def _fit(
    seen: Sequence[_Seen],
    start: Lens,
    board: Board,
    site: Site,
    method: Method,
    *,
    skew: bool,
) -> _Fit:
    reference = seen[0].discs
    assert reference is not None  # noqa: S101 - see _look
    found = reference.found
    B, _ = affine(site.main_target.centres_mm[found], reference.points_px[found])
    poses = [resect(start, board.corners_mm, s.board.view).pose for s in seen]
    rig_views = [v for v, s in enumerate(seen) if s.view.role is ViewRole.RIG]
    require_motion([poses[v].compose(poses[0].inverse()) for v in rig_views])
    views = [s.board.view for s in seen]
    drawn = drawn_rig(site, B)
    if method is Method.RIGID:
        priors = AdjustmentPriors(lens=lens_prior(site.sub, skew=skew), rig=rig_prior(site))
        main = [_main_view(s.discs, reference) for s in seen]
        adjusted = adjust(board, views, start, poses, priors, drawn, main)
        assert adjusted.rig is not None  # noqa: S101 - a rig went in
        return _Fit(tuple(seen), adjusted, B, adjusted.rig, adjusted.covariance)
    perfect = AdjustmentPriors(
        lens=lens_prior(site.sub, skew=skew), scale=0.0, bow_mm=(0.0, 0.0, 0.0), corner_mm=0.0
    )
    adjusted = adjust(board, views, start, poses, perfect)
    model = _fit_paper(seen, adjusted, rig_views, drawn)
    covariance = np.zeros((38, 38))
    covariance[:23, :23] = adjusted.covariance[:23, :23]
    covariance[23:32, 23:32] = model.covariance
    covariance[32:, 32:] = adjusted.covariance[31:, 31:]
    covariance[:23, 32:] = adjusted.covariance[:23, 31:]
    covariance[32:, :23] = adjusted.covariance[31:, :23]
    return _Fit(tuple(seen), adjusted, B, model, covariance)


def _fit_paper(
    seen: Sequence[_Seen], adjusted: Adjusted, rig_views: Sequence[int], drawn: Rig
) -> PaperModel:
    """Eq. 17-19 on the mean of the discs, started from the drawing."""
    reference = seen[0].discs
    assert reference is not None  # noqa: S101 - see _look
    motions, shifts = [], []
    for v in rig_views:
        main = _main_view(seen[v].discs, reference)
        if main is not None:
            motions.append(adjusted.poses[v].compose(adjusted.poses[0].inverse()))
            shifts.append((main.points_px - main.reference_px).mean(axis=0))
    middle = reference.points_px[reference.found].mean(axis=0)
    p_CS1 = drawn.T_CM_CS.inverse().apply(drawn.target_points_CM1(middle[None]))[0]
    start_B = drawn.scale_px_per_mm * drawn.T_CM_CS.R[:2]
    return fit_paper(motions, np.array(shifts), start_B, p_CS1)


def drawn_rig(site: Site, B: FloatArray) -> Rig:
    """The rig as drawn, with the scale measured on the target (largest singular value of B~)."""
    angles = site.rig.rotation_main_sub_deg
    return Rig(
        Pose(
            np.asarray(Rotation.from_euler("xyz", angles, degrees=True).as_matrix()),
            np.asarray(site.rig.offset_main_sub_mm, dtype=float),
        ),
        site.main_target.distance_mm,
        float(np.linalg.svd(B, compute_uv=False)[0]),
        np.array([0.5 * (site.main.width_px - 1), 0.5 * (site.main.height_px - 1)]),
    )


def rig_prior(site: Site) -> FloatArray:
    """(8,) 1-sigma of the rig parameters: drawing, survey, and the measured scale."""
    target = site.main_target
    return np.array(
        [np.radians(site.rig.rotation_sigma_deg)] * 3
        + [site.rig.offset_sigma_mm] * 3
        + [target.distance_sigma_mm / target.distance_mm, _SCALE_SIGMA]
    )


def _main_view(discs: Discs | None, reference: Discs) -> MainView | None:
    if discs is None:
        return None
    common = discs.found & reference.found & (discs.clean > 0.9)
    if not common.any():
        return None
    return MainView(discs.points_px[common], reference.points_px[common], _DISC_SIGMA_PX)


def _without_misfits(
    fit: _Fit, board: Board, site: Site, method: Method, *, skew: bool
) -> tuple[_Fit, list[tuple[str, str]]]:
    """Fit again without the views whose corners fit far worse than the others'."""
    rms = np.array(fit.adjusted.view_rms_px)
    limit = _MISFIT_FACTOR * max(float(np.median(rms)), 0.003)
    bad = rms > limit
    if not bad.any():
        return fit, []
    if bad[0] or bad.sum() > 0.4 * len(bad):
        msg = (
            f"calibration: {int(bad.sum())} of {len(bad)} views do not fit together (the "
            f"reference {'too' if bad[0] else 'does'}); was the lens or the board touched?"
        )
        raise CalibrationError(msg)
    reasons = [
        (s.view.name, f"corners off by {r:.3f} px rms, the others by {np.median(rms):.3f} px")
        for s, r, b in zip(fit.seen, rms, bad, strict=True)
        if b
    ]
    kept = [s for s, b in zip(fit.seen, bad, strict=True) if not b]
    return _fit(kept, fit.adjusted.lens, board, site, method, skew=skew), reasons


def _setup(fit: _Fit, board: Board) -> Setup:
    reference = fit.seen[0]
    assert reference.discs is not None  # noqa: S101 - see _look
    motions = [
        p.compose(fit.adjusted.poses[0].inverse())
        for s, p in zip(fit.seen, fit.adjusted.poses, strict=True)
        if s.view.role is ViewRole.RIG
    ]
    levels = Levels(
        float(np.median(fit.adjusted.view_rms_px)),
        reference.board.contrast_dn,
        reference.board.blur_px,
        reference.discs.contrast_dn,
        reference.discs.blur_px,
        max(float(np.linalg.norm(m.rotation_rad)) for m in motions),
        max(float(np.linalg.norm(m.t_mm)) for m in motions),
    )
    return Setup(
        board,
        fit.adjusted.corners_mm,
        fit.adjusted.lens,
        fit.adjusted.poses[0],
        fit.reference_px,
        fit.B,
        fit.model,
        fit.covariance,
        levels,
    )


def _validate(fit: _Fit, board: Board, site: Site, method: Method, *, skew: bool) -> FloatArray:
    """Errors (n, 2) mm of rig positions that were held out of a second fit; the truth is 0."""
    rig = [v for v, s in enumerate(fit.seen) if s.view.role is ViewRole.RIG]
    held = set(rig[1::_HOLD_OUT_EVERY])
    if len(rig) - len(held) < 4:
        return np.zeros((0, 2))
    kept = [s for v, s in enumerate(fit.seen) if v not in held]
    try:
        trial = _fit(kept, fit.adjusted.lens, board, site, method, skew=skew)
    except CalibrationError:
        return np.zeros((0, 2))
    setup = _setup(trial, board)
    errors = []
    for v in sorted(held):
        board_pose = resect(setup.lens, setup.corners_mm, fit.seen[v].board.view)
        main = _main_view(fit.seen[v].discs, fit.seen[0].discs)  # type: ignore[arg-type]
        if main is None:
            continue
        motion = board_pose.pose.compose(setup.reference_pose.inverse())
        predicted = predict_shift(setup.model, main.reference_px, motion).shift_px
        miss = (main.points_px - main.reference_px - predicted).mean(axis=0)
        errors.append(np.linalg.solve(setup.B, miss))
    return np.array(errors).reshape(-1, 2)


def _report(
    fit: _Fit,
    setup: Setup,
    site: Site,
    method: Method,
    rejected: Sequence[tuple[str, str]],
    held_out: FloatArray,
) -> CalibrationReport:
    drift = drift_errors(setup, site.quality)
    worst = max(drift, key=lambda d: d.sigma_mm)
    held_rms = float(np.sqrt((held_out**2).sum(axis=1).mean())) if len(held_out) else None
    limit = site.quality.max_sigma_mm
    problems = []
    if worst.sigma_mm > limit:
        problems.append(
            f"a {worst.motion} of the expected drift would be corrected to {worst.sigma_mm:.3f} mm "
            f"(1 sigma) only, the limit is {limit:g} mm"
        )
    if held_rms is not None and held_rms > limit:
        problems.append(f"held-out positions are wrong by {held_rms:.3f} mm rms")
    if isinstance(setup.model, PaperModel) and setup.model.null_directions:
        problems.append(
            f"{setup.model.null_directions} of the paper's nine parameters are not determined by "
            "the motions; use --method rigid"
        )
    roles = [s.view.role for s in fit.seen]
    figures = _figures(fit, setup, site, method, drift, held_out)
    figures["rejected"] = [{"view": name, "reason": reason} for name, reason in rejected]
    figures["problems"] = problems
    lines = [
        "calibration passed" if not problems else "calibration NOT passed: " + "; ".join(problems),
        (
            f"views used: {roles.count(ViewRole.INTRINSICS)} lens, 1 reference, "
            f"{roles.count(ViewRole.RIG)} rig; rejected: {len(rejected)}"
        ),
        *(f"rejected {name}: {reason}" for name, reason in rejected),
        (
            f"corners fit to {figures['sub_rms_px']:.4f} px rms, main discs to "
            f"{figures['main_rms_px']:.4f} px rms"
        ),
        model_sentence(setup.model),
        "expected error after correction (1 sigma, from the calibration alone): "
        + ", ".join(f"{d.motion} {d.sigma_mm:.3f} mm" for d in drift),
    ]
    if held_rms is not None:
        lines.append(
            f"validated on {len(held_out)} held-out positions: {held_rms:.4f} mm rms, "
            f"{float(np.hypot(*held_out.T).max()):.4f} mm at most"
        )
    if roles.count(ViewRole.INTRINSICS) < 3:
        lines.append("warning: no lens views; take 12 or more with the board in the hand")
    if not fit.seen[0].board.certain:
        lines.append(
            "warning: which part of the board the reference shows is not certain; let at least "
            "one border of the board into the sub image in each direction"
        )
    if figures["affine_error_px"] > 1.0:
        lines.append(
            f"warning: Eq. 5 fails ({figures['affine_error_px']:.1f} px for the expected drift); "
            "the paper's affine camera does not hold here, the rigid method does not need it"
        )
    return CalibrationReport(not problems, tuple(lines), figures)


def _figures(
    fit: _Fit,
    setup: Setup,
    site: Site,
    method: Method,
    drift: Sequence[Any],
    held_out: FloatArray,
) -> dict[str, Any]:
    deviation = np.sqrt(np.diag(setup.covariance))
    figures: dict[str, Any] = {
        "method": method.value,
        "sub_rms_px": setup.levels.sub_rms_px,
        "main_rms_px": _main_rms(fit, setup),
        "view_rms_px": {
            s.view.name: round(r, 5)
            for s, r in zip(fit.seen, fit.adjusted.view_rms_px, strict=True)
        },
        "lens": setup.lens.parameters.tolist(),
        "lens_sigma": deviation[:10].tolist(),
        "board_scale": fit.adjusted.shape[:2].tolist(),
        "board_bow_mm": float(np.ptp(setup.corners_mm[:, 2])),
        "px_per_mm": float(np.linalg.svd(setup.B, compute_uv=False)[0]),
        "expected_error_mm": {d.motion: d.sigma_mm for d in drift},
        "held_out_mm": held_out.tolist(),
        "affine_error_px": affine_error_px(
            site.main_target.distance_mm,
            site.quality.expected_drift_mm,
            float(
                np.nanmax(
                    np.abs(
                        setup.reference_discs_px
                        - [0.5 * (site.main.width_px - 1), 0.5 * (site.main.height_px - 1)]
                    )
                )
            ),
        ),
        "max_rotation_mrad": setup.levels.max_rotation_rad * 1e3,
    }
    if isinstance(setup.model, Rig):
        figures["determined_by_views"] = determined_share(setup, rig_prior(site)).tolist()
        figures["depth_mm"] = setup.model.depth_mm
    else:
        figures["singular_values"] = setup.model.singular_values.tolist()
    return figures


def _main_rms(fit: _Fit, setup: Setup) -> float:
    """Root mean square, px, of the main discs about the fitted model over the rig views."""
    misses = []
    for s, pose in zip(fit.seen, fit.adjusted.poses, strict=True):
        if s.view.role is ViewRole.RIG:
            main = _main_view(s.discs, fit.seen[0].discs)  # type: ignore[arg-type]
            if main is not None:
                motion = pose.compose(fit.adjusted.poses[0].inverse())
                shift = predict_shift(setup.model, main.reference_px, motion).shift_px
                misses.append(main.points_px - main.reference_px - shift)
    return float(np.sqrt(np.mean(np.concatenate(misses) ** 2)))
