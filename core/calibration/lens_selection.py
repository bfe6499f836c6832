"""The sub-camera's lens in a dual calibration: where its fit starts, and which model it is of."""

from __future__ import annotations

from core.calibration.joint_fit import MIN_LENS_VIEWS, Fit, FitOptions, fit_views
from core.calibration.mirrored_views import mirrored_lens_views
from core.calibration.views import LensView, RejectedView, Views
from core.errors import CalibrationError
from core.lens.lens_choice import LensChoice, choose_lens
from core.lens.lens_start import StartLens, start_lens


def start_from_views(views: Views, options: FitOptions) -> tuple[StartLens, list[RejectedView]]:
    """A lens to start from, and the lens views that do not fit or are all mirrored.

    Without three lens views the rig views must do; they determine the focal length poorly.
    """
    among, camera = _views_of_lens(views), options.site.sub
    start = start_lens(
        [v.board.view for v in among],
        options.board,
        (camera.width_px, camera.height_px),
        camera.focal_px,
        options.site.lens_model,
    )
    reasons = dict(start.rejected)
    agreeing = views.without({among[v].name for v in reasons})
    mirrored = mirrored_lens_views(agreeing, start.lens, options.site, options.board)
    if mirrored:
        start, others = start_from_views(views.without({name for name, _ in mirrored}), options)
        return start, [*mirrored, *others]
    if 0 in reasons:
        msg = (
            "calibration: the reference view does not fit the lens views; is it the same lens? "
            f"({reasons[0]})"
        )
        raise CalibrationError(msg)
    return start, [(among[v].name, reason) for v, reason in reasons.items()]


def _views_of_lens(views: Views) -> list[LensView]:
    chosen = views.lens if len(views.lens) >= MIN_LENS_VIEWS else views.rig
    return [views.reference, *chosen]


def fit_chosen(views: Views, start: StartLens, options: FitOptions) -> tuple[Fit, LensChoice]:
    """Fit with the lens model that predicts held-out views best, on the board as fitted."""
    fit = fit_views(views, start.lens, options)
    choice = _choice(fit, options)
    if choice.lens.model is fit.adjustment.lens.model:
        return fit, choice
    fit = fit_views(views, choice.lens, options)
    again = _choice(fit, options)  # the board is another now, too
    return fit, again if again.lens.model is fit.adjustment.lens.model else choice


def _choice(fit: Fit, options: FitOptions) -> LensChoice:
    """Rig views are near the reference: they would tell of one part of the image, many times."""
    among = {view.name for view in _views_of_lens(fit.views)}
    own = [k for k, view in enumerate(fit.views.all) if view.name in among]
    return choose_lens(
        fit.adjustment.lens,
        fit.adjustment.corners_mm,
        [fit.views.all[k].board.view for k in own],
        [fit.adjustment.poses[k] for k in own],
        options.site.lens_model,
    )
