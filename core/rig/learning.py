"""What a record of fixed targets tells of this very rig: turning with warmth, creep, the air.

A fixed target's closure over its distance is an angle, and that is modelled, for each axis, as
`angle(t) = offset + c (T(t) - T_ref) + w(t) + e(t)`: a coefficient, a random walk from the
reference on (creep), white noise. The offset is free for each calibration and each set of targets
seen. The covariance of the errors is estimated with the coefficient by restricted maximum
likelihood (Patterson and Thompson 1971); what is not certain of the one widens the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from core.arrays import BoolArray, FloatArray, IntArray
from core.moment import Moment
from core.rig.stability import DN_DT_PER_K, stability_terms
from core.site import Site

LAGS_H = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0)
"""Tried for the steel behind the camera's own temperature. Chosen: up to most of a daily wave."""
_LAG_GAIN = 6.0
"""Of the log-likelihood, from which a lag is shown. Chosen: six choices, and noise that is not
quite white."""
_RATIOS = np.logspace(-7.0, 6.0, 53)
"""Variance of a day's creep over that of an hour's noise, first look."""
_FINE = 81
"""Values of the ratio over which is averaged."""
_UNLIKELY = 12.0
"""Of the log-likelihood below its best, from which a ratio does not matter: 1 in 160,000."""
_NEAREST_DAYS = 1e-3
"""Least step of the walk between two hours, days."""
ALIKE = 1.1
"""Ratio of two distances from which the air is told from the steel. Chosen: below it a gradient is
ten times less certain than the angle."""
_DETERMINED = 2.0
"""Variance of the gradient over that of its noise, from which it is told. Chosen."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """A number and its 1 sigma."""

    value: float
    sigma: float


@dataclass(frozen=True, slots=True)
class TargetHours:
    """What fixed targets showed, hour by hour, of one or more calibrations."""

    calibration: IntArray
    """(n,) which one; the hours of one stand together."""
    days: FloatArray
    """(n,) since its reference, ascending within a calibration."""
    warmth_k: FloatArray
    """(n,) of the main camera."""
    mm: FloatArray
    """(n, targets, 2) closure of each; NaN where not seen."""
    noise_mm2: FloatArray
    """(n, targets, 2) variance of these by the pixels' noise."""
    distance_mm: FloatArray
    """(targets,)."""

    @property
    def visible(self) -> BoolArray:
        """(n, targets) whether a target was seen."""
        return np.asarray(np.isfinite(self.mm).all(axis=2))

    @property
    def seen(self) -> BoolArray:
        """(n,) whether any target was seen."""
        return np.asarray(self.visible.any(axis=1))

    def part(self, chosen: BoolArray) -> TargetHours:
        """Some of the hours (n,)."""
        return replace(
            self,
            calibration=self.calibration[chosen],
            days=self.days[chosen],
            warmth_k=self.warmth_k[chosen],
            mm=self.mm[chosen],
            noise_mm2=self.noise_mm2[chosen],
        )


@dataclass(frozen=True, slots=True)
class AxisFit:
    """One axis of the rig's turning."""

    urad_per_k: Estimate
    urad_per_sqrt_day: Estimate
    noise_urad: float
    """1 sigma of an hour."""
    log_likelihood: float


@dataclass(frozen=True, slots=True)
class RigFit:
    """Both axes, and the air."""

    axes: tuple[AxisFit, AxisFit]
    """Sideways (x) and upwards (y)."""
    lag_h: float
    """By which the steel follows the temperature; 0 where the record shows none."""
    air_k_per_m: Estimate | None
    """1 sigma of the gradient about its mean; None where the targets do not tell."""
    hours: int

    @property
    def urad_per_k(self) -> Estimate:
        """The rms of both axes: the budget's 1 sigma."""
        return _rms([axis.urad_per_k for axis in self.axes])

    @property
    def urad_per_sqrt_day(self) -> Estimate:
        """Likewise of the creep."""
        return _rms([axis.urad_per_sqrt_day for axis in self.axes])


def fit_rig(hours: TargetHours) -> RigFit:
    """Fit the record. At least three hours with a target in each calibration."""
    angle_urad, seen, air = _angles(hours)
    kept = seen >= 0
    fits = []
    for lag_h in LAGS_H:
        warmth_k = low_passed(hours.calibration, hours.days, hours.warmth_k, lag_h)[kept]
        X = np.column_stack([warmth_k, _offsets(hours.calibration[kept], seen[kept])])
        walk = _Walk(hours.calibration[kept], hours.days[kept])
        fits.append(tuple(_fit_axis(walk, X, angle_urad[kept, axis]) for axis in (0, 1)))
    gains = [sum(axis.log_likelihood for axis in fit) for fit in fits]
    best = int(np.argmax(gains))
    best = best if gains[best] > gains[0] + _LAG_GAIN else 0
    x, y = fits[best]
    return RigFit((x, y), LAGS_H[best], air, int(kept.sum()))


@dataclass(frozen=True, slots=True)
class Predictor:
    """What one axis of a single calibration lets expect after its last hour."""

    mean: FloatArray
    """(2,) the angle at temperature 0 as of the last hour (urad), and urad/K."""
    covariance: FloatArray
    """(2, 2) of these."""
    creep_variance: float
    """urad2 a day."""
    noise_variance: float
    """urad2 of an hour."""


def predictors(days: FloatArray, warmth_k: FloatArray, angle_urad: FloatArray) -> Predictor:
    """Fit one axis of one calibration, hours (n,), and give what holds at the last of them.

    The walk is conditioned on all hours: universal kriging (Matheron 1969) at the last one.
    """
    walk = _Walk(np.zeros(len(days), dtype=np.int64), days)
    X = np.column_stack([warmth_k, np.ones(len(days))])
    fit = _fit_axis(walk, X, angle_urad)
    ratio = fit.urad_per_sqrt_day.value**2 / fit.noise_urad**2
    noise = fit.noise_urad**2
    last = np.maximum(np.minimum(days, days[-1]), _NEAREST_DAYS) * ratio
    products, _ = walk.weighted(np.column_stack([X, angle_urad, last]), ratio)
    inverse = np.linalg.inv(products[:2, :2])
    c, offset = inverse @ products[:2, 2]
    walked = products[3, 2] - products[3, :2] @ np.array([c, offset])
    own = max(last[-1] - products[3, 3], 0.0)
    seen = np.array([[0.0, 1.0], [1.0, 0.0]]) - np.outer([1.0, 0.0], products[3, :2])
    covariance = noise * (seen @ inverse @ seen.T + np.diag([own, 0.0]))
    return Predictor(np.array([offset + walked, c]), covariance, noise * ratio, noise)


def low_passed(
    calibration: IntArray, days: FloatArray, warmth_k: FloatArray, lag_h: float
) -> FloatArray:
    """Temperatures (n,) behind a first-order lag, begun at the first of each calibration."""
    if lag_h == 0.0:
        return warmth_k
    passed = warmth_k.copy()
    for i in range(1, len(passed)):
        if calibration[i] == calibration[i - 1]:
            left = np.exp(-24.0 * (days[i] - days[i - 1]) / lag_h)
            passed[i] = warmth_k[i] + left * (passed[i - 1] - warmth_k[i])
    return passed


def allowed_urad_per_k(site: Site, scale_px_per_mm: float) -> float:
    """1 sigma that the budget allows a target to turn by with warmth, all its causes together."""
    terms = stability_terms(site, scale_px_per_mm, Moment(0.0, 0.0), Moment(0.0, 1.0))
    focal_px = scale_px_per_mm * site.main_target.distance_mm
    variance_px2 = sum(0.5 * np.trace(term.covariance[:2, :2]) for term in terms)
    return float(1e6 * np.sqrt(variance_px2) / focal_px)


def _rms(estimates: Sequence[Estimate]) -> Estimate:
    values = np.array([one.value for one in estimates])
    sigmas = np.array([one.sigma for one in estimates])
    rms = float(np.sqrt((values**2).mean()))
    share = np.abs(values) / max(float(np.linalg.norm(values)), 1e-12)
    return Estimate(rms, float(np.sqrt(((share * sigmas) ** 2).sum() / len(values))))


def _angles(hours: TargetHours) -> tuple[FloatArray, IntArray, Estimate | None]:
    """The angle (n, 2) of each hour, which set of targets it is by (n,), -1: none; the air."""
    visible = hours.visible
    which = np.where(hours.seen, visible @ (1 << np.arange(visible.shape[1])), -1)
    urad = 1e6 * hours.mm / hours.distance_mm[:, None]
    by_air = _both_distances(visible, hours.distance_mm)
    if 2 * by_air.sum() < hours.seen.sum():
        count = np.maximum(visible.sum(axis=1), 1)[:, None]
        return np.nansum(urad, axis=1) / count, which, None
    angle_urad = np.full((len(which), 2), np.nan)
    slope_per_m = np.full((len(which), 2), np.nan)
    noise = np.full(len(which), np.nan)
    for bits in np.unique(which[by_air]):
        rows = np.flatnonzero(which == bits)
        targets = np.flatnonzero(visible[rows[0]])
        metres = 1e-3 * hours.distance_mm[targets]
        inverse = np.linalg.pinv(np.column_stack([np.ones(len(targets)), metres]))
        seen_urad = urad[np.ix_(rows, targets)]
        angle_urad[rows], slope_per_m[rows] = np.einsum("pk,nka->pna", inverse, seen_urad)
        noise_urad2 = 1e6 * hours.noise_mm2[np.ix_(rows, targets)][:, :, 1] / metres**2
        noise[rows] = noise_urad2 @ inverse[1] ** 2
    air = _gradient(hours.calibration[by_air], slope_per_m[by_air, 1], noise[by_air])
    return angle_urad, np.where(by_air, which, -1), air


def _both_distances(visible: BoolArray, distance_mm: FloatArray) -> BoolArray:
    """Hours (n,) in which targets at clearly different distances are seen."""
    farthest = np.where(visible, distance_mm, -np.inf).max(axis=1)
    nearest = np.where(visible, distance_mm, np.inf).min(axis=1)
    return np.asarray(farthest > ALIKE * nearest)


def _gradient(calibration: IntArray, slope_per_m: FloatArray, noise: FloatArray) -> Estimate | None:
    """1 sigma of the air's gradient about its mean, K/m, from angles that grow with distance."""
    squares, free = 0.0, 0
    for one in np.unique(calibration):
        rows = slope_per_m[calibration == one]
        squares += float(((rows - rows.mean()) ** 2).sum())
        free += len(rows) - 1
    variance = squares / max(free, 1)
    if free < 1 or variance < _DETERMINED * float(noise.mean()):
        return None
    k_per_m = np.sqrt(variance - noise.mean()) / (0.5e6 * DN_DT_PER_K)
    days = max(free / 24.0, 1.0)  # hours side by side are alike
    return Estimate(float(k_per_m), float(k_per_m / np.sqrt(2.0 * days)))


def _offsets(calibration: IntArray, seen: IntArray) -> FloatArray:
    """(n, k) of 0 and 1: each calibration with each set of targets has an offset of its own."""
    _, which = np.unique(np.column_stack([calibration, seen]), axis=0, return_inverse=True)
    return np.asarray(which.reshape(-1, 1) == np.arange(which.max() + 1), dtype=np.float64)


class _Walk:
    """Random walks, one from each reference on, under white noise of variance 1.

    The inverse P of the walks' covariance has three diagonals, and that of the sum is
    `(P + r)^-1 P` with r the variance of a day: everything costs time in proportion to n.
    """

    def __init__(self, calibration: IntArray, days: FloatArray) -> None:
        first = np.ones(len(days), dtype=bool)
        first[1:] = calibration[1:] != calibration[:-1]
        steps = np.where(first, days, np.diff(days, prepend=0.0))
        steps = np.maximum(steps, _NEAREST_DAYS)
        inside = np.where(first, 0.0, 1.0 / steps)[1:]
        self._off = np.concatenate([[0.0], -inside])
        self._diagonal = 1.0 / steps + np.append(inside, 0.0)
        self._log_det = -float(np.log(steps).sum())

    def weighted(self, M: FloatArray, ratio: float) -> tuple[FloatArray, float]:
        """Products (k, k) of columns by the inverse covariance, and the covariance's log det."""
        root = cholesky_banded(np.stack([self._off, self._diagonal + ratio]))
        P_M = self._diagonal[:, None] * M
        P_M[:-1] += self._off[1:, None] * M[1:]
        P_M[1:] += self._off[1:, None] * M[:-1]
        log_det = 2.0 * float(np.log(root[1]).sum()) - self._log_det
        return np.asarray(M.T @ cho_solve_banded((root, False), P_M)), log_det


@dataclass(frozen=True, slots=True)
class _Given:
    """The fit for one ratio of creep to noise."""

    log_likelihood: float
    coefficient: float
    coefficient_variance: float
    noise_variance: float


def _fit_axis(walk: _Walk, X: FloatArray, y: FloatArray) -> AxisFit:
    """Average over the ratio of creep to noise, each creep (urad/sqrt(day)) as likely before."""
    M = np.column_stack([X, y])
    first = np.array([_given(walk, M, ratio).log_likelihood for ratio in _RATIOS])
    near = np.flatnonzero(first > first.max() - _UNLIKELY)
    low, high = max(near[0] - 1, 0), min(near[-1] + 1, len(_RATIOS) - 1)
    ratios = np.geomspace(_RATIOS[low], _RATIOS[high], _FINE)
    fits = [_given(walk, M, ratio) for ratio in ratios]
    likelihood = np.array([fit.log_likelihood for fit in fits])
    noise = np.array([fit.noise_variance for fit in fits])
    creep = np.sqrt(ratios * noise)
    weights = np.exp(likelihood - likelihood.max()) * creep
    weights /= weights.sum()
    c = np.array([fit.coefficient for fit in fits])
    own = np.array([fit.coefficient_variance for fit in fits])
    mean, step = float(weights @ c), float(weights @ creep)
    return AxisFit(
        Estimate(mean, float(np.sqrt(weights @ (own + (c - mean) ** 2)))),
        Estimate(step, float(np.sqrt(weights @ (creep - step) ** 2))),
        float(np.sqrt(weights @ noise)),
        float(likelihood.max()),
    )


def _given(walk: _Walk, M: FloatArray, ratio: float) -> _Given:
    """Least squares with a covariance known but for its scale; the restricted likelihood."""
    products, log_det = walk.weighted(M, ratio)
    normal, right = products[:-1, :-1], products[:-1, -1]
    inverse = np.linalg.pinv(normal)
    beta = inverse @ right
    free = max(len(M) - len(normal), 1)
    noise = max(float(products[-1, -1] - beta @ right), 1e-12) / free
    log_likelihood = -0.5 * (free * np.log(noise) + log_det + np.linalg.slogdet(normal)[1])
    return _Given(float(log_likelihood), float(beta[0]), float(noise * inverse[0, 0]), noise)
