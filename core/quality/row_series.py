"""What later rows need of a row, one by one and as arrays over many."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from core.arrays import FloatArray
from core.geometry.pose import Pose
from core.quality.residual_ratio import residual_ratio
from core.results import Measurement, Reason
from core.rig.calibrated_site import CalibratedSite
from core.rig.propagation import predict_shift

_ACROSS_ROWS = frozenset({Reason.BOARD_SLIPPED, Reason.CAMERA_BUMPED, Reason.CALIBRATION_DRIFTING})
"""Reasons that other rows give; a row with no further one is good in itself."""


@dataclass(frozen=True, slots=True)
class RowSummary:
    """What later rows need of a row."""

    time_s: float
    mm: FloatArray
    """(2,) corrected displacement."""
    false_mm: FloatArray
    """(2,) false displacement."""
    slide_mm: FloatArray
    """(2,) the part of it that comes from the rig's translation: that of a board that slides."""
    sigma_mm: FloatArray
    """(3,) 1 sigma of the largest axis of the three."""
    residual_ratio: float
    """rms of the corners over what it was at calibration."""
    trusted: bool
    """Good in itself."""
    closure_mm: FloatArray | None = None
    """(2,) what a plate at rest in the main image seems to move by; None without one in view."""
    closure_sigma_mm: float | None = None
    """1 sigma of its larger axis."""


Quantity = Literal["mm", "false_mm", "slide_mm", "closure_mm"]
_PLACE: dict[Quantity, slice] = {
    "mm": slice(1, 3),
    "false_mm": slice(3, 5),
    "slide_mm": slice(5, 7),
    "closure_mm": slice(7, 9),
}
"""Columns of a series that hold the x and y of a quantity."""
_SIGMA_PLACE: dict[Quantity, int] = {"mm": 9, "false_mm": 10, "slide_mm": 11, "closure_mm": 12}
"""The column of its sigma."""
_RATIO_PLACE = 13
"""Column of the residual ratio, behind time, quantities and sigmas."""
_WIDTH = 14
"""Columns of a series: as many as there are of these."""


@dataclass(frozen=True, slots=True)
class RowSeries:
    """Rows in order, as one array."""

    table: FloatArray
    """(n, 14): time, the four quantities (x, y), their sigmas, residual ratio; nan is not known."""

    @classmethod
    def of(cls, *rows: RowSummary) -> RowSeries:
        """Put rows into an array."""
        table = np.full((len(rows), _WIDTH), np.nan)
        for line, row in zip(table, rows, strict=True):
            line[0], line[_RATIO_PLACE] = row.time_s, row.residual_ratio
            for name, place in _PLACE.items():
                line[place] = np.nan if getattr(row, name) is None else getattr(row, name)
            line[9:12] = row.sigma_mm
            line[12] = np.nan if row.closure_sigma_mm is None else row.closure_sigma_mm
        return cls(table)

    @classmethod
    def of_columns(
        cls,
        time_s: FloatArray,
        values_mm: Mapping[Quantity, FloatArray],
        sigmas_mm: Mapping[Quantity, FloatArray],
        residual_ratio: FloatArray,
    ) -> RowSeries:
        """Put columns together: times (n,), values (n, 2) and sigmas (n,) as far as known."""
        table = np.full((len(time_s), _WIDTH), np.nan)
        table[:, 0], table[:, _RATIO_PLACE] = time_s, residual_ratio
        for name, values in values_mm.items():
            table[:, _PLACE[name]] = values
        for name, sigma in sigmas_mm.items():
            table[:, _SIGMA_PLACE[name]] = sigma
        return cls(table)

    @property
    def time_s(self) -> FloatArray:
        """(n,)."""
        return self.table[:, 0]

    @property
    def residual_ratio(self) -> FloatArray:
        """(n,)."""
        return self.table[:, _RATIO_PLACE]

    def values_mm(self, name: Quantity) -> FloatArray:
        """(n, 2)."""
        return self.table[:, _PLACE[name]]

    def sigma_mm(self, name: Quantity) -> FloatArray:
        """(n,) 1 sigma of the larger axis."""
        return self.table[:, _SIGMA_PLACE[name]]

    def __len__(self) -> int:
        """The number of rows."""
        return len(self.table)

    def __getitem__(self, rows: slice) -> RowSeries:
        """Some of the rows."""
        return RowSeries(self.table[rows])

    def followed_by(self, later: RowSeries) -> RowSeries:
        """These rows and later ones."""
        return RowSeries(np.concatenate([self.table, later.table]))


def summarise_row(
    calibrated: CalibratedSite, measurement: Measurement, time_s: float
) -> RowSummary | None:
    """Give what later rows need of a row, or None if it has no value."""
    corrected, raw, motion = measurement.corrected, measurement.raw, measurement.motion
    if corrected is None or raw is None or motion is None:
        return None
    slide_mm = slide_by_translation(calibrated)
    slide_mm2 = slide_mm @ motion.covariance[3:, 3:] @ slide_mm.T
    # A step is judged by what pixels and calibration leave open: rows side by side have aged alike.
    variances = (corrected.by_image_mm2, corrected.by_image_mm2, slide_mm2)
    closure = measurement.closure
    rig_mm = corrected.mm if closure is None else corrected.mm + closure.mm
    seen_px, contrast = (
        measurement.diagnostics.sub_residual_px,
        measurement.diagnostics.sub_contrast_dn,
    )
    baseline = calibrated.baseline
    return RowSummary(
        time_s,
        corrected.mm,
        raw.mm - rig_mm,
        slide_mm @ motion.translation_mm,
        np.sqrt([float(np.diag(variance).max()) for variance in variances]),
        residual_ratio(
            baseline.sub_rms_px, baseline.sub_contrast_dn, seen_px or 0.0, contrast or 0.0
        ),
        _ACROSS_ROWS.issuperset(measurement.reasons),
        None if closure is None else closure.mm,
        None if closure is None else float(np.sqrt(np.diag(closure.by_image_mm2).max())),
    )


def slide_by_translation(calibrated: CalibratedSite) -> FloatArray:
    """Give d(false displacement, mm) / d(translation of the rig, mm), (2, 3), at the reference.

    A milliradian of rig motion changes it by a thousandth.
    """
    seen = calibrated.reference_discs_px[np.isfinite(calibrated.reference_discs_px).all(axis=1)]
    by_motion = predict_shift(calibrated.model, seen, Pose.identity()).by_motion.mean(axis=0)
    return np.asarray(np.linalg.solve(calibrated.B, by_motion[:, 3:]))
