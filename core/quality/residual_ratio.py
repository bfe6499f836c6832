"""How well the corners fit, against what they did at calibration; no image is needed for it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

WINDOW_ROWS = 200
"""Rows that say what is usual."""
_LEAST_PX = 0.002
"""No calibration fits better than this in a later image."""
_FEW = 20


def contrast_noise_factor(calibrated_contrast_dn: float, contrast_dn: float) -> float:
    """How much larger residuals may be because the contrast is lower than at calibration."""
    return max(1.0, calibrated_contrast_dn / max(contrast_dn, 1.0))


def residual_ratio(
    calibrated_px: float, calibrated_contrast_dn: float, seen_px: float, contrast_dn: float
) -> float:
    """Rms of a row's corners (px) over what it would be if nothing had changed."""
    level_px = max(calibrated_px, _LEAST_PX) * contrast_noise_factor(
        calibrated_contrast_dn, contrast_dn
    )
    return seen_px / level_px


def median_residual_ratio(residual_ratios: Sequence[float]) -> float | None:
    """The median over many rows; None of too few to tell."""
    return float(np.median(residual_ratios)) if len(residual_ratios) >= _FEW else None
