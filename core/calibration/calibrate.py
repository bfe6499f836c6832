"""From calibration views to a calibration: lens, board, reference, rig, and how far to trust it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from core.calibration.joint_fit import (
    Method,
    Recipe,
    setup_of,
    validate,
    without_misfits,
    without_moved_targets,
)
from core.calibration.lens_selection import fit_chosen, start_from_views
from core.calibration.reference_index import place_reference
from core.calibration.report import write_report
from core.calibration.views import CalibrationView, ViewRole, look, relocate
from core.checkerboard.board import Board
from core.errors import CalibrationError
from core.results import CalibrationReport
from core.rig.calibrated_site import Setup
from core.site import Site

_FORMAT = 3
"""Formats 1 and 2 kept no joint covariance of the board's corners, which every row now needs."""


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
                msg = (
                    f"calibration of format {data['format']}, this version of dcam needs format "
                    f"{_FORMAT}; calibrate again, from the same frames if they were kept "
                    "(dcam-ctl calibrate --from)"
                )
                raise CalibrationError(msg)
            return cls(Method(data["method"]), Setup.from_dict(data["setup"]))
        except (KeyError, ValueError, TypeError) as error:
            msg = f"calibration: not readable ({error!r}); calibrate again"
            raise CalibrationError(msg) from error


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
    recipe = Recipe(site, Board.nominal(site.sub_target), method, skew)
    seen, rejected = look(views, site, recipe.board)
    start, misfits = start_from_views(seen, recipe)
    seen = seen.without({name for name, _ in misfits})
    seen = relocate(seen, start.lens, recipe.board)
    placed = place_reference(seen, start.lens, site, recipe.board)
    if placed is not seen:
        seen = relocate(placed, start.lens, recipe.board)
    fit, choice = fit_chosen(seen, start, recipe)
    fit, bad = without_misfits(fit, recipe)
    fit, moved = without_moved_targets(fit, recipe)
    setup = setup_of(fit, recipe)
    report = write_report(
        fit, setup, recipe, choice, [*rejected, *misfits, *bad, *moved], validate(fit, recipe)
    )
    return Calibration(method, setup), report


__all__ = [
    "Calibration",
    "CalibrationReport",
    "CalibrationView",
    "Method",
    "ViewRole",
    "calibrate",
]
