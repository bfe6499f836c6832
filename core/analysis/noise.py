"""Noise that remembers: white noise and exponentially forgetting parts, fast at any length and gap.

The covariance of n values at times t is K = s^2 (W^-1 + sum_m g_m^2 exp(-|t_i - t_j| / tau_m)), W
diagonal with the values' weights: 1, or how many others each is the mean of. A part alone is an
Ornstein-Uhlenbeck process, whose inverse covariance Q_m is tridiagonal at any times. With the parts
as hidden states x, y = H x + e, Woodbury's formula gives

    K^-1 = (W - W H P^-1 H' W) / s^2,    P = Q + H' W H,    |K| = s^2n |P| / (|Q| |W|),

and P is banded, so that a product with K^-1 costs O(n) by LAPACK's banded Cholesky factor. It is
fitted by restricted maximum likelihood (Patterson & Thompson, Biometrika 58, 1971), which allows
for the coefficients that were fitted to the same values.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.linalg.lapack import dtbtrs
from scipy.optimize import minimize

from core.arrays import FloatArray

DAY_S = 86400.0
"""Times are counted in days within the fits."""
MEMORIES_DAYS = ((0.03, 1.5), (2.0, 60.0))
"""Bounds of the memory of each part: hours of weather and light, weeks of weather."""
_GAIN_LIMITS = (0.02, 50.0)
"""Bounds of a part's standard deviation over that of the white noise: none, and nothing else."""
_START_GAINS = (0.3, 1.0, 3.0)
"""Of each part, where a search may begin."""
_START_MEMORIES = (0.3, 0.7)
"""Places between the logarithms of a memory's bounds where a search may begin."""
_REACH = 1.5
"""How far a search may go at once, in logarithms: a leap may end on another hill."""
_STAGES = 5
"""Of the search, each within reach of the one before."""
_ITERATIONS = 40
"""Of the search; it ends after some 15 where the likelihood is well-behaved."""
_AT_BOUND = 0.05
"""A start so near a bound, in logarithms, is given up: the search would stay there."""
_ENOUGH = 0.01
"""Gain in log-likelihood below which a further step of the search is worth nothing: a hundredth of
what one standard deviation costs."""


_LEAST_MM = 1e-6
"""Noise that any series is taken to have at least: one that never moves must be fitted too."""


@dataclass(frozen=True, slots=True)
class Part:
    """A part of the noise that forgets exponentially."""

    sigma_mm: float
    memory_days: float


@dataclass(frozen=True, slots=True)
class Noise:
    """What is left after the fit, as a random process."""

    white_mm: float
    """Standard deviation of what no other value shares, of a value of weight 1."""
    parts: tuple[Part, ...]

    @property
    def sigma_mm(self) -> float:
        """Standard deviation of a value."""
        return float(np.sqrt(self.white_mm**2 + sum(part.sigma_mm**2 for part in self.parts)))


AT_ONCE = 32
"""Columns that are whitened at a time: of a year of hours they take some 20 MB on the way."""


class Whitening:
    """The inverse of a covariance, s^2 = 1, factorised once; applied to any number of columns."""

    def __init__(
        self,
        times_days: FloatArray,
        gains: FloatArray,
        memories_days: FloatArray,
        weights: FloatArray | None = None,
    ) -> None:
        """Factorise. `times_days`, `weights` (n,), the former increasing; the others (parts,)."""
        n, parts = len(times_days), len(gains)
        self.times_days = times_days
        self._weights = np.ones(n) if weights is None else weights
        self._n, self._parts = n, parts
        band = np.zeros((parts + 1, n, parts))  # lower: [distance, row, part]
        for distance in range(parts):  # H'WH couples the parts of one value
            band[distance, :, : parts - distance] = self._weights[:, None]
        log_Q = 0.0
        steps = np.diff(times_days)
        for part, (gain, memory) in enumerate(zip(gains, memories_days, strict=True)):
            left = np.exp(-steps / memory)
            new = -np.expm1(-2.0 * steps / memory)
            precision = np.ones(n)
            precision[1:] = 1.0 / new
            precision[:-1] += left**2 / new
            band[0, :, part] += precision / gain**2
            band[parts, :-1, part] = -left / new / gain**2
            log_Q -= 2 * n * np.log(gain) + float(np.log(new).sum())
        self._factor = cholesky_banded(band.reshape(parts + 1, n * parts), lower=True)
        self.log_determinant = 2.0 * float(np.log(self._factor[0]).sum()) - log_Q
        self.log_determinant -= float(np.log(self._weights).sum())
        """Of K with s^2 = 1."""

    def solve(self, columns: FloatArray) -> FloatArray:
        """K^-1 times columns (n, k), s^2 = 1."""
        weighted = self._weights[:, None] * columns
        hidden = np.repeat(weighted, self._parts, axis=0)
        smooth = cho_solve_banded((self._factor, True), hidden)
        shared = smooth.reshape(self._n, self._parts, -1).sum(axis=1)
        found: FloatArray = weighted - self._weights[:, None] * shared
        return found

    def half(self, hidden: FloatArray) -> FloatArray:
        """Of the Cholesky factor L of P, L^-1 times columns (n parts, k), each row repeated."""
        found, _ = dtbtrs(self._factor, hidden, uplo="L")
        return np.asarray(found, dtype=np.float64)

    def squares(self, columns: FloatArray) -> FloatArray:
        """(k,) c' K^-1 c of each of the columns c (n, k), s^2 = 1; in half the time of `solve`."""
        parts = (columns[:, at : at + AT_ONCE] for at in range(0, columns.shape[1], AT_ONCE))
        return np.concatenate([np.empty(0), *map(self._squares, parts)])

    def _squares(self, columns: FloatArray) -> FloatArray:
        weighted = self._weights[:, None] * columns
        half = self.half(np.asfortranarray(np.repeat(weighted, self._parts, axis=0)))
        found: FloatArray = np.sum(columns * weighted, axis=0) - np.sum(half**2, axis=0)
        return found


@dataclass(frozen=True, slots=True)
class Gls:
    """Generalised least squares with a given correlation."""

    coefficients: FloatArray
    """(p,)."""
    covariance: FloatArray
    """(p, p)."""
    residuals: FloatArray
    """(n,) values less the fit."""
    whitened: FloatArray
    """(n,) K^-1 times the residuals, K in mm2."""
    weighted_design: FloatArray
    """(n, p) K^-1 times the design."""
    variance_mm2: float
    """s^2."""
    minus_log_likelihood: float
    """Restricted, but for a constant."""


def gls(whitening: Whitening, design: FloatArray, values_mm: FloatArray) -> Gls:
    """Fit coefficients of a design (n, p) of full rank to values (n,)."""
    n, p = design.shape
    scale = np.maximum(np.linalg.norm(design, axis=0), np.finfo(float).tiny)
    solved = whitening.solve(np.column_stack([design / scale, values_mm]))
    weighted, solved_values = solved[:, :p], solved[:, p]
    normal = (design / scale).T @ weighted
    inverse = np.linalg.inv(normal)
    coefficients = inverse @ (weighted.T @ values_mm)
    residuals = values_mm - (design / scale) @ coefficients
    whitened = solved_values - weighted @ coefficients
    variance, minus_log = _restricted(whitening, normal, float(residuals @ whitened), n - p)
    return Gls(
        coefficients / scale,
        variance * inverse / np.outer(scale, scale),
        residuals,
        whitened / variance,
        weighted * scale / variance,
        variance,
        minus_log,
    )


def _restricted(
    whitening: Whitening, normal: FloatArray, squares: float, freedom: int
) -> tuple[float, float]:
    """s^2 of whitened squares, and minus the logarithm of the restricted likelihood at it."""
    variance = max(squares / freedom, _LEAST_MM**2)
    _, log_normal = np.linalg.slogdet(normal)
    logs = freedom * np.log(variance) + whitening.log_determinant + log_normal
    return variance, float(0.5 * logs)


class _Likelihood:
    """The restricted likelihood of a noise, for a search: without coefficients, so faster."""

    def __init__(
        self,
        times_days: FloatArray,
        design: FloatArray,
        values_mm: FloatArray,
        parts: int,
        weights: FloatArray | None,
    ) -> None:
        self._times_days, self._parts, self._weights = times_days, parts, weights
        basis, _ = np.linalg.qr(design)
        rest_mm = values_mm - basis @ (basis.T @ values_mm)  # as likely, and small
        self._columns = np.column_stack([basis, rest_mm])
        weighted = self._columns if weights is None else weights[:, None] * self._columns
        self._products = self._columns.T @ weighted
        self._hidden = np.asfortranarray(np.repeat(weighted, parts, axis=0))

    def minus_log(self, logs: NDArray[Any]) -> float:
        """Of gains and memories (2 parts,), in logarithms; but for a constant."""
        gains, memories = np.exp(logs[: self._parts]), np.exp(logs[self._parts :])
        whitening = Whitening(self._times_days, gains, memories, self._weights)
        half = whitening.half(self._hidden)
        weighted = self._products - half.T @ half  # the columns' own with K^-1
        normal, score = weighted[:-1, :-1], weighted[:-1, -1]
        squares = float(weighted[-1, -1] - score @ np.linalg.solve(normal, score))
        return _restricted(whitening, normal, squares, len(self._times_days) - len(normal))[1]


@dataclass(frozen=True, slots=True)
class NoiseFit:
    """Noise and coefficients that explain values best."""

    noise: Noise
    whitening: Whitening
    gls: Gls
    start: FloatArray
    """Where a search for a similar record may begin."""


def fit_noise(
    times_days: FloatArray,
    design: FloatArray,
    values_mm: FloatArray,
    memories_days: tuple[tuple[float, float], ...] = MEMORIES_DAYS,
    start: FloatArray | None = None,
    weights: FloatArray | None = None,
) -> NoiseFit:
    """Fit the noise by restricted maximum likelihood, with the coefficients of a design (n, p).

    `weights` (n,) are of the values' white parts; without them all are 1.
    """
    parts = len(memories_days)
    limits = [_GAIN_LIMITS] * parts + list(memories_days)
    bounds = [(float(np.log(low)), float(np.log(high))) for low, high in limits]

    likelihood = _Likelihood(times_days, design, values_mm, parts, weights)
    edges = np.array(bounds).T
    if start is None or (np.minimum(start - edges[0], edges[1] - start) < _AT_BOUND).any():
        tried = _starts(edges, parts)
        start = tried[int(np.argmin([likelihood.minus_log(logs) for logs in tried]))]
    best = start
    for _ in range(_STAGES):
        low, high = np.maximum(edges[0], best - _REACH), np.minimum(edges[1], best + _REACH)
        found = minimize(
            likelihood.minus_log,
            np.clip(best, low, high),
            method="L-BFGS-B",
            bounds=list(zip(low.tolist(), high.tolist(), strict=True)),
            options={"maxiter": _ITERATIONS, "ftol": _ENOUGH / len(values_mm), "eps": 1e-3},
        )
        best = found.x
        stopped = ((best <= low) & (low > edges[0])) | ((best >= high) & (high < edges[1]))
        if not stopped.any():
            break
    gains, memories = np.exp(best[:parts]), np.exp(best[parts:])
    whitening = Whitening(times_days, gains, memories, weights)
    fit = gls(whitening, design, values_mm)
    white_mm = float(np.sqrt(fit.variance_mm2))
    noise = Noise(
        white_mm,
        tuple(Part(float(white_mm * g), float(m)) for g, m in zip(gains, memories, strict=True)),
    )
    return NoiseFit(noise, whitening, fit, best)


def _starts(edges: FloatArray, parts: int) -> list[FloatArray]:
    """Where a search may begin: the likelihood has more than one hill."""
    found = []
    for gains in product(np.log(_START_GAINS), repeat=parts):
        for place in _START_MEMORIES:
            memories = (1.0 - place) * edges[0, parts:] + place * edges[1, parts:]
            found.append(np.concatenate([gains, memories]))
    return found


def other_noises(
    fit: NoiseFit,
    times_days: FloatArray,
    design: FloatArray,
    values_mm: FloatArray,
    memories_days: tuple[tuple[float, float], ...] = MEMORIES_DAYS,
) -> tuple[tuple[Gls, ...], FloatArray]:
    """The fit, and others with a weaker, stronger, shorter or longer slow part; their shares.

    A record of a few memories does not determine its slow part: what it may be belongs in the
    interval. Equally likely beforehand by the logarithms of size and memory.
    """
    parts = len(memories_days)
    gains, memories = np.exp(fit.start[:parts]), np.exp(fit.start[parts:])
    without = 1.0 + float(np.sum(gains[:-1] ** 2))
    total = np.sqrt(without + gains[-1] ** 2)
    found = [fit.gls]
    for memory in np.geomspace(*memories_days[-1], _MEMORIES):
        for share in _SHARES:
            gain = min(share * total, _GAIN_LIMITS[1])
            whitening = Whitening(
                times_days, np.append(gains[:-1], gain), np.append(memories[:-1], memory)
            )
            found.append(gls(whitening, design, values_mm))
    logs = np.array([-one.minus_log_likelihood for one in found])
    weights = np.exp(logs - logs.max())
    likely = weights > _UNLIKELY * weights.sum()
    kept = tuple(one for one, there in zip(found, likely, strict=True) if there)
    return kept, weights[likely] / weights[likely].sum()


_SHARES = (0.1, 0.2, 0.4, 0.7, 1.0, 2.0)
"""Standard deviations of a slow part that are tried, over that of all noise."""
_MEMORIES = 5
"""Memories of a slow part that are tried."""
_UNLIKELY = 1e-4
"""Share below which another noise does not matter."""
