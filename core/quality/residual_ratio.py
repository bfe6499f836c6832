"""How well the corners fit, against what they did at calibration; no image is needed for it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

WINDOW_ROWS = 200
"""Rows that say what is usual."""
LEAST_RMS_PX = 0.002
"""No calibration fits better than this in a later image."""
_LEAST_ROWS = 20
"""For a median that one bad hour does not decide. Chosen."""
_LEAST_CONTRAST_DN = 1.0
"""So that an image without contrast does not divide by zero."""


def contrast_noise_factor(calibrated_contrast_dn: float, contrast_dn: float) -> float:
    """How much larger residuals may be because the contrast is lower than at calibration.

    >>> contrast_noise_factor(calibrated_contrast_dn=150.0, contrast_dn=75.0)
    2.0
    """
    return max(1.0, calibrated_contrast_dn / max(contrast_dn, _LEAST_CONTRAST_DN))


def residual_ratio(
    calibrated_px: float, calibrated_contrast_dn: float, seen_px: float, contrast_dn: float
) -> float:
    """Rms of a row's corners (px) over what it would be if nothing had changed.

    >>> round(residual_ratio(0.01, 150.0, seen_px=0.06, contrast_dn=75.0), 3)
    3.0
    """
    level_px = max(calibrated_px, LEAST_RMS_PX) * contrast_noise_factor(
        calibrated_contrast_dn, contrast_dn
    )
    return seen_px / level_px


def median_residual_ratio(residual_ratios: Sequence[float]) -> float | None:
    """The median over many rows; None if they are too few."""
    return float(np.median(residual_ratios)) if len(residual_ratios) >= _LEAST_ROWS else None
