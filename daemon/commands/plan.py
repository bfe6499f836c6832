"""`dcam-ctl plan`: what a site will see and how well it will measure, from its config alone."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any

import click
import numpy as np

from core.calibration.observability import suggest_motion
from core.errors import CoreError
from core.geometry.pose import Pose
from core.planning.field_of_view import (
    FieldOfView,
    FurtherView,
    field_of_view,
    further_views,
    further_warnings,
    planning_warnings,
)
from core.planning.planned_site import CalibrationPlan, ImageQuality, PlannedSite
from core.planning.predicted_accuracy import (
    ErrorCause,
    Improvement,
    PredictedAccuracy,
    drift_rows,
    error_causes,
    improvements,
    possible_changes,
    predict_accuracy,
    predict_calibration,
    require_in_view,
)
from core.rig.stability import season_sentence
from core.site import Site
from daemon.calibration.positions import Limits, planned_positions
from daemon.commands.options import Options, common_options, json_option, pass_options
from daemon.commands.output import print_json, print_table, say
from daemon.errors import ExitCode, WorkFailedError

LENS_VIEWS = 12
HEAD_LIMITS = Limits(pan_deg=180.0, tilt_deg=90.0)
"""The head is not asked: the image's edge limits the positions."""
_QUALITY = ImageQuality()
_TOLD_SHARE = 0.01


@dataclass(frozen=True, slots=True)
class Plan:
    """Everything that is reported."""

    site: Site
    calibration_plan: CalibrationPlan
    view: FieldOfView
    predicted: PredictedAccuracy | None
    """None where the plan cannot be calibrated."""
    limits: tuple[ErrorCause, ...]
    improvements: tuple[Improvement, ...]
    further: str | None
    warnings: tuple[str, ...]
    failure: str | None = None
    """Why it cannot be calibrated."""


@click.command("plan", epilog="\b\nExample:\n  dcam-ctl --config dcam.toml plan --lens-views 20")
@click.option(
    "--lens-views",
    type=click.IntRange(3, 100),
    default=LENS_VIEWS,
    show_default=True,
    help="Views of the board in the hand.",
)
@click.option(
    "--reach-deg",
    type=(click.FloatRange(0.0, 45.0), click.FloatRange(0.0, 45.0)),
    metavar="PAN TILT",
    help="How far the head turns either way; default: what calibrate does.",
)
@click.option(
    "--contrast-dn",
    type=click.FloatRange(5.0, 255.0),
    default=_QUALITY.contrast_dn,
    show_default=True,
    help="White less black on the board, grey values of 8 bits.",
)
@click.option(
    "--noise-dn",
    type=click.FloatRange(0.1, 50.0),
    default=_QUALITY.noise_dn,
    show_default=True,
    help="Noise of a grey value of 8 bits, 1 sigma.",
)
@click.option(
    "--blur-px",
    type=click.FloatRange(0.3, 6.0),
    default=_QUALITY.blur_px,
    show_default=True,
    help="Width of a blurred edge, 1 sigma, as capture tells it.",
)
@json_option
@common_options
@pass_options
def command(
    options: Options,
    lens_views: int,
    reach_deg: tuple[float, float] | None,
    contrast_dn: float,
    noise_dn: float,
    blur_px: float,
    as_json: bool,
) -> int:
    """Say what this site will see and how well it will measure; needs no images.

    Scales, fields of view, room to move, Eq. 5; the 1-sigma of a corrected displacement by a
    planned pan-tilt calibration, what limits it, what would improve it. The calibration's own
    equations tell it, for views projected from the drawing. Exit code 1 where such a site cannot
    be calibrated.
    """
    quality = ImageQuality(contrast_dn=contrast_dn, noise_dn=noise_dn, blur_px=blur_px)
    plan = make_plan(options.config.site(), quality, lens_views, reach_deg)
    if as_json:
        print_json({"command": "plan", **plan_fields(plan)})
    else:
        say_plan(plan)
    if plan.failure is not None:
        msg = f"plan: this site cannot be calibrated: {plan.failure}"
        raise WorkFailedError(msg)
    return ExitCode.DONE


def make_plan(
    site: Site,
    quality: ImageQuality,
    lens_views: int = LENS_VIEWS,
    reach_deg: tuple[float, float] | None = None,
) -> Plan:
    """Plan a site."""
    planned = PlannedSite(site, quality)
    view = field_of_view(planned)
    calibration_plan = CalibrationPlan(lens_views, ())
    try:
        require_in_view(planned)
        calibration_plan = CalibrationPlan(lens_views, _positions(planned, reach_deg))
        calibrated = predict_calibration(planned, calibration_plan)
        rows = drift_rows(planned, calibrated)
    except CoreError as error:
        warnings = _warnings(planned, calibration_plan, view)
        return Plan(site, calibration_plan, view, None, (), (), None, warnings, str(error))
    predicted = predict_accuracy(rows, calibrated.posterior)
    warnings = (
        *_warnings(planned, calibration_plan, view),
        *_sigma_warnings(predicted, site),
    )
    return Plan(
        site,
        calibration_plan,
        view,
        predicted,
        error_causes(planned, calibrated, rows),
        improvements(predicted, possible_changes(planned, calibration_plan)),
        suggest_motion(calibrated, site),
        warnings,
    )


def _warnings(
    planned: PlannedSite, calibration_plan: CalibrationPlan, view: FieldOfView
) -> tuple[str, ...]:
    drawn = planning_warnings(planned, calibration_plan, view)
    return (*drawn, *further_warnings(planned.site))


def _sigma_warnings(predicted: PredictedAccuracy, site: Site) -> tuple[str, ...]:
    limit_mm = site.quality.max_sigma_mm
    if predicted.worst_mm <= limit_mm:
        return ()
    text = (
        f"a corrected displacement will have a sigma of up to {predicted.worst_mm:.2f} mm and be "
        f"flagged: [quality] max_sigma_mm is {limit_mm:g} mm"
    )
    return (text,)


def _positions(
    planned: PlannedSite, reach_deg: tuple[float, float] | None
) -> tuple[tuple[float, float], ...]:
    """Head positions: those of `calibrate --pan-tilt`, or the same grid reaching further."""
    if reach_deg is None:
        discs = planned.predict_discs(Pose.identity())
        return tuple(planned_positions(planned.site, discs, HEAD_LIMITS))
    pan, tilt = reach_deg
    return tuple(
        (float(p), float(t)) for t in np.linspace(-tilt, tilt, 3) for p in np.linspace(-pan, pan, 7)
    )


def say_plan(plan: Plan) -> None:
    """Print a plan for a person."""
    print_table(("as drawn", "main camera", "sub-camera"), _camera_rows(plan))
    say()
    if plan.site.extra_targets:
        columns = ("further target", "distance", "scale", "field of view", "discs", "room")
        print_table(columns, [_further_row(view) for view in further_views(plan.site)])
        say()
    for line in _room_lines(plan):
        say(line)
    if plan.predicted is not None:
        say()
        _say_predicted(plan, plan.predicted)
        say()
        _say_limits(plan, plan.predicted)
        say()
        _say_better(plan, plan.predicted)
    if plan.warnings:
        say()
    for text in plan.warnings:
        say(f"warning: {text}")


def _camera_rows(plan: Plan) -> list[tuple[str, str, str]]:
    view, site = plan.view, plan.site
    return [
        ("distance", f"{site.main_target.distance_mm:g} mm", f"{site.sub_target.distance_mm:g} mm"),
        ("scale", f"{view.main_px_per_mm:.3g} px/mm", f"{view.sub_px_per_mm:.3g} px/mm"),
        (
            "pixel",
            f"{1.0 / view.main_px_per_mm:.3g} mm",
            f"{1.0 / view.sub_px_per_mm:.3g} mm",
        ),
        ("field of view", _times(view.main_field_mm), _times(view.sub_field_mm)),
        ("target", f"discs of {view.disc_px:.0f} px", f"squares of {view.square_px:.1f} px"),
        (
            "in view",
            f"{len(site.main_target.centres_mm)} discs",
            f"{view.corners_seen} of {view.corners} corners",
        ),
    ]


def _further_row(view: FurtherView) -> tuple[str, ...]:
    return (
        f"{view.name}, {view.role}",
        f"{view.distance_mm:g} mm",
        f"{view.px_per_mm:.3g} px/mm",
        _times(view.field_mm),
        f"{view.disc_px:.0f} px",
        "no position_px" if view.travel_mm is None else _pair(view.travel_mm),
    )


def _times(size_mm: Any) -> str:
    return f"{size_mm[0]:.0f} x {size_mm[1]:.0f} mm"


def _room_lines(plan: Plan) -> list[str]:
    view, positions = plan.view, plan.calibration_plan.positions_deg
    drift_mm = plan.site.quality.expected_drift_mm
    turn = _pair(view.rig_turn_mrad, "mrad of pan", "mrad of tilt", 1)
    eq5 = f"Eq. 5, error of the paper's model: {view.affine_error_px:.2g} px, 1 px at most,"
    lines = [
        f"room of the main target: {_pair(view.target_travel_mm)} before it leaves its image;",
        f"  {view.drift_mm:.0f} mm of it for the expected drift of the rig, the rest the bridge's",
        f"room of the rig: {turn} before the main target leaves;",
        f"  {_pair(view.rig_shift_mm)} before half of the board has left",
        f"{eq5} where the rig drifts {drift_mm:g} mm along the view",
    ]
    if positions:
        reach = np.abs(np.array(positions)).max(axis=0)
        lines.append(
            f"calibration: {plan.calibration_plan.lens_views} lens views, "
            f"{len(positions)} positions of the head within "
            f"{_pair(reach, 'deg of pan', 'deg of tilt', 2)}"
        )
    return lines


def _pair(values: Any, x: str = "mm in x", y: str = "mm in y", digits: int = 0) -> str:
    return f"+-{values[0]:.{digits}f} {x} and +-{values[1]:.{digits}f} {y}"


def _say_predicted(plan: Plan, predicted: PredictedAccuracy) -> None:
    limits = plan.site.quality
    amounts = {
        "rotation": f"{limits.expected_drift_mrad:g} mrad",
        "translation": f"{limits.expected_drift_mm:g} mm",
    }
    drift = f"within {' and '.join(amounts.values())}"
    motions = [
        (f"{m.motion}, {amounts[m.motion.split()[0]]}", m.row_mm, m.calibration_mm)
        for m in predicted.motions
    ]
    say(f"predicted: 1 sigma of {predicted.typical_mm:.2g} mm, for the rig anywhere {drift}")
    say()
    rows = [
        ("nowhere, as at the reference", f"{predicted.still_mm.max():.4f}", ""),
        (f"anywhere {drift}", f"{predicted.typical_mm:.4f}", ""),
        *((name, f"{row_mm:.4f}", f"{own_mm:.4f}") for name, row_mm, own_mm in motions),
    ]
    print_table(("rig moved", "1 sigma of a row, mm", "the calibration's part, mm"), rows)
    say(season_sentence(plan.site, plan.site.nominal_px_per_mm, predicted.typical_mm))


def _say_limits(plan: Plan, predicted: PredictedAccuracy) -> None:
    rows = []
    for limit in plan.limits:
        share = 1.0 - (limit.without_mm / predicted.typical_mm) ** 2
        if share >= _TOLD_SHARE:
            rows.append((limit.cause, f"{limit.without_mm:.4f}", f"{100.0 * share:.0f} %"))
    print_table(("what limits it", "1 sigma without, mm", "share of sigma squared"), rows)


def _say_better(plan: Plan, predicted: PredictedAccuracy) -> None:
    if not plan.improvements and plan.further is None:
        say("no single change would improve it by a tenth")
        return
    if plan.improvements:
        say(f"what would improve it, from {predicted.typical_mm:.4f} mm:")
        rows = [(f"{x.typical_mm:.4f}", x.what) for x in plan.improvements]
        print_table(("1 sigma then, mm", "change"), rows)
    if plan.further is not None:
        say(plan.further)


def plan_fields(plan: Plan) -> dict[str, Any]:
    """A plan in plain JSON types."""
    view = {f.name: _plain(getattr(plan.view, f.name)) for f in fields(plan.view)}
    predicted = None
    if plan.predicted is not None:
        predicted = {
            "still_mm": plan.predicted.still_mm.tolist(),
            "drifted_mm": plan.predicted.drifted_mm.tolist(),
            "typical_mm": plan.predicted.typical_mm,
            "worst_mm": plan.predicted.worst_mm,
            "motions": [asdict(motion) for motion in plan.predicted.motions],
        }
    return {
        **view,
        "further_targets": [
            {f.name: _plain(getattr(further, f.name)) for f in fields(further)}
            for further in further_views(plan.site)
        ],
        "lens_views": plan.calibration_plan.lens_views,
        "positions_deg": [list(position) for position in plan.calibration_plan.positions_deg],
        "predicted": predicted,
        "limits": [asdict(limit) for limit in plan.limits],
        "improvements": [asdict(improvement) for improvement in plan.improvements],
        "further_motion": plan.further,
        "warnings": list(plan.warnings),
        "failure": plan.failure,
    }


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else value
