"""What one row alone cannot show: whether the board has slipped or the main camera was knocked.

Main and sub-camera are one rigid body. When the rig moves, both see it. A board that slips on the
pier looks to the sub-camera like a motion of the rig, but the main image does not move with it, so
that the corrected displacement jumps by just what the rig is said to have moved by:

    step of the false displacement + step of the displacement = step of the raw one, about 0.

The rows before it say how large a step is unusual.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from core.arrays import FloatArray
from core.geometry.pose import Pose
from core.quality.residual_ratio import WINDOW_ROWS, median_residual_ratio, residual_ratio
from core.quality.verdicts import flag_of
from core.results import Measurement, Reason
from core.rig.calibrated_site import CalibratedSite
from core.rig.propagation import predict_shift
from core.site import QualityLimits

_LEAST_SIGMAS = 4.5
"""Of the sum of two rows' sigmas: smaller steps between them are noise. Of two equal rows it is 6.4
standard deviations of their difference, by chance one row in a billion."""
_CANCELS = 0.6
"""Share of the step of the displacement that the step of the rig must leave unexplained."""
_UNUSUAL, _FEW_STEPS = 1.2, 1.5
"""A step is unusual beyond this times the largest of n steps before, and 1 + few / n times that."""
_ALONE = 1.6
"""And as often as this again if the displacement's own step is not unusual."""
_GAP_INTERVALS = 3.0
"""Rows further apart than so many usual intervals have a gap between them."""
_DRIFT_FACTOR = 2.0
"""Residuals so many times what they were at calibration, for so long, say that lens, board or focus
have changed. Chosen between noise of a few per cent and values that are visibly wrong."""
_LEAST_USUAL_MM = 1e-3
"""Of the steps that rows are compared by: below it is noise."""
_ACROSS_ROWS = frozenset({Reason.BOARD_SLIPPED, Reason.CAMERA_BUMPED, Reason.CALIBRATION_DRIFTING})

Channel = Literal["false_mm", "slide_mm"]
_CHANNELS: tuple[Channel, ...] = ("false_mm", "slide_mm")
_DIRECTIONS = (slice(0, 2), slice(0, 1), slice(1, 2))
"""In the plane of the target, and x and y alone: a bridge moves far less to the side than up."""
_ENOUGH_ROWS = 6
"""Rows from which on x and y alone are looked at: of fewer, one is soon unusual by chance."""


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


@dataclass(frozen=True, slots=True)
class BoardSlip:
    """A slip that is not undone."""

    channel: Channel
    by_mm: FloatArray
    """(2,) by how much the rig is wrongly said to have moved."""
    last: RowSummary
    """The last row with the slip."""


def summarise_row(
    calibrated: CalibratedSite, measurement: Measurement, time_s: float
) -> RowSummary | None:
    """Give what later rows need of a row, or None if it has no value."""
    corrected, raw, motion = measurement.corrected, measurement.raw, measurement.motion
    if corrected is None or raw is None or motion is None:
        return None
    seen = calibrated.reference_discs_px[np.isfinite(calibrated.reference_discs_px).all(axis=1)]
    pose = Pose.from_vectors(motion.rotation_rad, motion.translation_mm)
    by_motion = predict_shift(calibrated.model, seen, pose).by_motion.mean(axis=0)
    by_translation = np.linalg.solve(calibrated.B, by_motion[:, 3:])
    slide_mm2 = by_translation @ motion.covariance[3:, 3:] @ by_translation.T
    variances = (corrected.covariance_mm2, corrected.covariance_mm2, slide_mm2)
    seen_px, contrast = (
        measurement.diagnostics.sub_residual_px,
        measurement.diagnostics.sub_contrast_dn,
    )
    baseline = calibrated.baseline
    return RowSummary(
        time_s,
        corrected.mm,
        raw.mm - corrected.mm,
        by_translation @ motion.translation_mm,
        np.sqrt([float(np.diag(variance).max()) for variance in variances]),
        residual_ratio(
            baseline.sub_rms_px, baseline.sub_contrast_dn, seen_px or 0.0, contrast or 0.0
        ),
        _ACROSS_ROWS.issuperset(measurement.reasons),
    )


@dataclass(frozen=True, slots=True)
class StepDetector:
    """The rows of one calibration so far, and what they say of the next (immutable)."""

    history: tuple[RowSummary, ...] = ()
    """The last rows that are believed, in order."""
    slip: BoardSlip | None = None

    @classmethod
    def resumed(
        cls, history: tuple[RowSummary, ...], first: RowSummary | None, last: RowSummary | None
    ) -> StepDetector:
        """Continue from stored rows: those believed, and the first and last of a slip since."""
        state = cls(history[-WINDOW_ROWS:])
        if first is None or last is None or not state.history:
            return state
        slip = state._slipped(first)
        before = state.history[-1]
        by_mm = first.false_mm - before.false_mm
        return replace(state, slip=replace(slip or BoardSlip("false_mm", by_mm, last), last=last))

    def judge(
        self, now: RowSummary, limits: QualityLimits
    ) -> tuple[tuple[Reason, ...], StepDetector]:
        """Give what the rows before make of a row, and the state after it.

        A row that is not good in itself is neither judged nor remembered.
        """
        if not now.trusted:
            return (), self
        if self.slip is not None and not self._undone(self.slip, now):
            return (Reason.BOARD_SLIPPED,), replace(self, slip=replace(self.slip, last=now))
        slip = self._slipped(now) if self.slip is None else None
        if slip is not None:
            return (Reason.BOARD_SLIPPED,), replace(self, slip=slip)
        if self._too_fast(now, limits.max_step_mm):
            return (Reason.CAMERA_BUMPED,), replace(self, slip=None)
        after = StepDetector((*self.history, now)[-WINDOW_ROWS:])
        return ((Reason.CALIBRATION_DRIFTING,) if after.is_drifting else ()), after

    @property
    def residual_ratio(self) -> float | None:
        """The median residual of the last rows; None if they are too few."""
        return median_residual_ratio([row.residual_ratio for row in self.history])

    @property
    def is_drifting(self) -> bool:
        """Whether the corners fit so badly for so long that values are doubtful."""
        return self.residual_ratio is not None and self.residual_ratio > _DRIFT_FACTOR

    def _slipped(self, now: RowSummary) -> BoardSlip | None:
        rows = len(self.history)
        if rows < 2:
            return None
        said = {name: getattr(now, name) - getattr(self.history[-1], name) for name in _CHANNELS}
        for axes in _DIRECTIONS if rows >= _ENOUGH_ROWS else _DIRECTIONS[:1]:
            for sigma_index, channel in enumerate(_CHANNELS, start=1):
                if self._is_slip(now, channel, sigma_index, axes):
                    return BoardSlip(channel, said[channel], now)
        return None

    def _is_slip(self, now: RowSummary, channel: Channel, sigma_index: int, axes: slice) -> bool:
        """Whether a channel's step is unusual along some axes and the displacement undoes it."""
        before, steps = self.history[-1], len(self.history) - 1
        moved_mm = (now.mm - before.mm)[axes]
        said_mm = (getattr(now, channel) - getattr(before, channel))[axes]
        size, said = float(np.linalg.norm(moved_mm)), float(np.linalg.norm(said_mm))
        if float(np.linalg.norm(said_mm + moved_mm)) > _CANCELS * size:
            return False
        noise = _LEAST_SIGMAS * (now.sigma_mm + before.sigma_mm)
        if size < noise[0] or said < noise[sigma_index]:
            return False
        factor = _UNUSUAL * (1.0 + _FEW_STEPS / steps)
        strange = said / (factor * self._usual(channel, now, axes))
        return strange > _ALONE or (strange > 1.0 and size > factor * self._usual("mm", now, axes))

    def _undone(self, slip: BoardSlip, now: RowSummary) -> bool:
        """Whether a row is nearer to where the last one would be without the slip."""
        plane = _DIRECTIONS[0]
        scales = [
            max(self._usual(name, now, plane), _LEAST_USUAL_MM) for name in (slip.channel, "mm")
        ]

        def away(undone_mm: FloatArray) -> float:
            said = getattr(now, slip.channel) - getattr(slip.last, slip.channel) + undone_mm
            moved = now.mm - slip.last.mm - undone_mm
            return (
                float(np.hypot(*said) / scales[0]) ** 2 + float(np.hypot(*moved) / scales[1]) ** 2
            )

        return away(slip.by_mm) < away(np.zeros(2))

    def _too_fast(self, now: RowSummary, max_step_mm: float | None) -> bool:
        if max_step_mm is None or not self.history:
            return False
        before, interval_s = self.history[-1], self._interval_s
        slots = max(1.0, (now.time_s - before.time_s) / interval_s) if interval_s else 1.0
        return float(np.hypot(*(now.mm - before.mm))) > max_step_mm * slots

    @property
    def _interval_s(self) -> float:
        times = np.array([row.time_s for row in self.history])
        return float(np.median(np.diff(times))) if len(times) > 1 else 0.0

    def _usual(self, name: str, now: RowSummary, axes: slice) -> float:
        """The largest step of the rows so far; after a gap, or across one, their whole range.

        A gap that is longer than the rows so far leaves room for as many times that range.
        """
        baseline = np.array([getattr(row, name)[axes] for row in self.history])
        usual = float(np.linalg.norm(np.diff(baseline, axis=0), axis=1).max())
        gap_s = now.time_s - self.history[-1].time_s
        if gap_s > _GAP_INTERVALS * self._interval_s:
            spans = gap_s / max(self.history[-1].time_s - self.history[0].time_s, 1e-9)
            usual = max(usual, max(spans, 1.0) * float(np.linalg.norm(np.ptp(baseline, axis=0))))
        return max(usual, float(self.history[-1].sigma_mm.max()))


def add_reasons(measurement: Measurement, reasons: tuple[Reason, ...]) -> Measurement:
    """Add the reasons that other rows give; the flag follows."""
    if not reasons:
        return measurement
    together = (*measurement.reasons, *reasons)
    flag = flag_of(together, has_value=measurement.corrected is not None)
    return replace(measurement, flag=flag, reasons=together)
