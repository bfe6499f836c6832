"""From calibration views to a calibration: lens, board, reference, rig, and how far to trust it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from core.calibration.joint_fit import (
    FitOptions,
    Method,
    build_calibrated_site,
    held_out_errors_mm,
    reject_moved_targets,
    reject_outlier_views,
)
from core.calibration.lens_selection import fit_chosen, start_from_views
from core.calibration.mirrored_views import with_mirrored_named
from core.calibration.motion_check import compare_with_drawing
from core.calibration.reference_index import place_reference
from core.calibration.report import write_report
from core.calibration.survey_check import check_survey
from core.calibration.views import CalibrationView, ViewRole, find_targets, relocate_corners
from core.checkerboard.board import Board
from core.errors import CalibrationError
from core.images import GreyImage
from core.moment import Moment
from core.results import CalibrationReport
from core.rig.calibrated_site import CalibratedSite
from core.site import Site

_FORMAT = 3
"""Formats 1 and 2 kept no joint covariance of the board's corners, which every row now needs."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """Everything that `measure_pair` needs; immutable; round-trips through plain JSON types."""

    method: Method
    calibrated: CalibratedSite
    reference: Moment | None = None
    """When the reference was taken; None where that was not recorded."""

    def to_dict(self) -> dict[str, Any]:
        """Give plain JSON types."""
        content = {
            "format": _FORMAT,
            "method": self.method.value,
            "setup": self.calibrated.to_dict(),
        }
        if self.reference is not None:
            content["reference"] = self.reference.to_dict()
        return content

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Calibration:
        """Read what `to_dict` gave. Raises CalibrationError."""
        try:
            if data["format"] != _FORMAT:
                msg = (
                    f"calibration of format {data['format']}, this version of dcam needs format "
                    f"{_FORMAT}; calibrate again, from the same frames if they were kept "
                    "(dcam-ctl calibrate --from)"
                )
                raise CalibrationError(msg)
            reference = data.get("reference")
            return cls(
                Method(data["method"]),
                CalibratedSite.from_dict(data["setup"]),
                None if reference is None else Moment.from_dict(reference),
            )
        except (KeyError, ValueError, TypeError) as error:
            msg = f"calibration: not readable ({error!r}); calibrate again"
            raise CalibrationError(msg) from error


def calibrate(
    views: Sequence[CalibrationView],
    site: Site,
    method: Method = Method.RIGID,
    *,
    skew: bool = False,
    unreadable: Sequence[str] = (),
) -> tuple[Calibration, CalibrationReport]:
    """Calibrate a site from its views: lens views, one reference, rig positions.

    `rigid` adjusts lens, board, poses and rig jointly with the survey as prior:
    `u = pi(K_M, R_CM_CS (R_j p + T_j) + t_CM_CS)`; `paper` fits the lens alone to the nominal
    board, then the nine parameters of Eq. 18, `du_j = B [R_j - I, T_j] [p; 1]` (Lee et al. 2020;
    docs/method.md says how far to trust either, docs/functions.md has an example). `skew` lets the
    lens's gamma of Eq. 10 vary. Views that cannot be used are named in the report, and so are
    those that could not be read before: `unreadable` has the reason of each.
    Raises CalibrationError, and NotObservableError if the motions determine too little.
    """
    options = FitOptions(site, Board.nominal(site.sub_target), method, skew)
    found, rejected = find_targets(views, site)
    start, outliers = start_from_views(found, options)
    seen = found.without({name for name, _ in outliers})
    seen, unlike = relocate_corners(seen, start.lens, options.board)
    placed = place_reference(seen, start.lens, site, options.board)
    if placed is not seen:
        seen, more = relocate_corners(placed, start.lens, options.board)
        unlike += more
    factor = compare_with_drawing(seen, start.lens, options)
    fit, choice = fit_chosen(seen, start, options)
    fit, bad = reject_outlier_views(fit, options)
    fit, moved = reject_moved_targets(fit, options)
    unfit = with_mirrored_named([*outliers, *bad], found, fit, site, options.board)
    calibrated = build_calibrated_site(fit, options)
    report = write_report(
        fit,
        calibrated,
        options,
        choice,
        [*rejected, *unlike, *unfit, *moved],
        {view.name: view for view in views},
        held_out_errors_mm(fit, options),
        check_survey(fit, start.lens, options, factor, _reference_main(views)),
        unreadable,
    )
    return Calibration(method, calibrated, _reference(views).moment), report


def _reference(views: Sequence[CalibrationView]) -> CalibrationView:
    """The one reference, which `find_targets` requires."""
    (reference,) = (v for v in views if v.role is ViewRole.REFERENCE)
    return reference


def _reference_main(views: Sequence[CalibrationView]) -> GreyImage:
    """The main camera's reference image, which `find_targets` requires."""
    main = _reference(views).main
    assert main is not None  # noqa: S101 - as above
    return main


__all__ = [
    "Calibration",
    "CalibrationReport",
    "CalibrationView",
    "Method",
    "ViewRole",
    "calibrate",
]
