"""What a fixed target taught of this rig serves while it is hidden: the predicted turn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from core.arrays import FloatArray
from core.moment import Moment
from core.rig.learning import predictors
from core.rig.stability import STATE, Prior, Term, total_covariance
from core.site import Site

_DAY_S = 86_400.0
"""A day, s."""
FEWEST_DAYS = 7.0
"""That a fixed target was watched for. Chosen: a week of daily waves, and of creep."""
FEWEST_HOURS = 72
"""With a fixed target. Chosen: three whole days, or a row at ten hours of each day of a week."""
LEAST_K = 2.0
"""Of the temperature between its warmest and coldest hour. Chosen: well above a sensor's steps."""


@dataclass(frozen=True, slots=True)
class Learnt:
    """The turn of the rig (sideways, upwards) as last seen, and how it goes on."""

    utc_s: float
    """Of the last hour in which a fixed target was seen."""
    mean: FloatArray
    """(2, 2) of each axis: the turn at 0 degrees C (urad), and urad/K."""
    covariance: FloatArray
    """(2, 2, 2) of these, by axis."""
    creep_urad2_per_day: FloatArray
    """(2,) variance since."""
    noise_urad2: FloatArray
    """(2,) variance of an hour about this."""

    def turn(self, now: Moment) -> tuple[FloatArray, FloatArray] | None:
        """Mean (2, urad) and variance (2, urad2) at a moment; None without a temperature."""
        if now.temperature_c is None or now.utc_s < self.utc_s:
            return None
        h = np.array([1.0, now.temperature_c])
        days = (now.utc_s - self.utc_s) / _DAY_S
        variance = h @ self.covariance @ h + self.creep_urad2_per_day * days + self.noise_urad2
        return self.mean @ h, variance

    def prior(self, site: Site, B: FloatArray, terms: Sequence[Term], now: Moment) -> Prior | None:
        """The state with the shift as learnt, all else as the budget has it.

        B (2, 2, px/mm) is the main target's. None where the budget alone is no less certain.
        """
        turned = self.turn(now)
        if turned is None:
            return None
        px_per_urad = 1e-6 * site.main_target.distance_mm * B
        covariance = total_covariance(terms)
        shift_px2 = px_per_urad @ np.diag(turned[1]) @ px_per_urad.T
        if np.trace(shift_px2) >= np.trace(covariance[:2, :2]):
            return None
        covariance[:2] = covariance[:, :2] = 0.0
        covariance[:2, :2] = shift_px2
        mean = np.zeros(STATE)
        mean[:2] = px_per_urad @ turned[0]
        return Prior(mean, covariance)


def learn(hour_s: FloatArray, celsius: FloatArray, angle_urad: FloatArray) -> Learnt | None:
    """Learn from hours (n,) since the reference, ascending, in which a fixed target was seen.

    hour_s in seconds since 1970, celsius of the rig, angle_urad (n, 2) the closure over its
    distance. None where that is too little: fewer than 72 hours, 7 days, or 2 K.
    """
    if len(hour_s) < FEWEST_HOURS or np.ptp(hour_s) < FEWEST_DAYS * _DAY_S:
        return None
    if np.ptp(celsius) < LEAST_K:
        return None
    days = (hour_s - hour_s[0]) / _DAY_S
    axes = [predictors(days, celsius, angle_urad[:, axis]) for axis in (0, 1)]
    return Learnt(
        float(hour_s[-1]),
        np.array([axis.mean for axis in axes]),
        np.array([axis.covariance for axis in axes]),
        np.array([axis.creep_variance for axis in axes]),
        np.array([axis.noise_variance for axis in axes]),
    )
