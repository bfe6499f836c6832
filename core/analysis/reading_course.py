"""The best estimate of a reading at any time from values with noise, some minutes or an hour apart.

A noisy or merely interpolated reading as regressor makes its coefficient too small, and draws a lag
towards the slots. Put in its place what is to be expected of it, given the values, and neither
happens: what is then wrong with it is independent of it (regression calibration: Carroll et al.,
Measurement Error in Nonlinear Models, 2006, ch. 4). That is ordinary kriging (Cressie, Statistics
for Spatial Data, 1993, 3.2) from the nearest values, with the structure function that the values
themselves show: the mean square of their change over a time, of which noise is what remains of it
as the time goes to nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from core.arrays import BoolArray, FloatArray, IntArray

_SIDE = 6
"""Values on either side from which a value is estimated. Chosen: those beyond add nothing."""
_DAY = 144
"""Places of the grid in a day."""
_LAGS = np.unique(np.geomspace(1, _DAY, 40).astype(int))
"""Places of the grid over which changes are looked at: to a day."""
_LEAST_PAIRS = 50
"""Of values so far apart, below which they say little."""
_MEMORIES = np.geomspace(3.0, 40 * _DAY, 14)
"""Places of the grid in which a part may forget: half an hour to 40 days. What
forgets sooner cannot be told from noise."""
_HARMONICS = (1, 2, 3)
"""Of the day."""
_CHUNK = 4096
"""Values that are estimated at once: a matter of memory."""
_FIRM = 1e-6
"""Share of the variance within a day added to the values', so that equal ones can be solved."""


@dataclass(frozen=True, slots=True)
class Structure:
    """Mean square change of a reading over a time: of what it measures, and of its noise."""

    sizes: FloatArray
    """Of each part of `_parts`, in squares of the reading's unit."""
    noise: float
    """Variance of the noise of one value on the grid."""

    @classmethod
    def of(cls, values: FloatArray) -> Structure | None:
        """Of values (n,) on a regular grid, NaN where there is none; None for too few of them."""
        lags, squares = [], []
        for lag in _LAGS[len(values) > _LAGS].tolist():
            change = values[lag:] - values[:-lag]
            there = np.isfinite(change)
            if int(there.sum()) >= _LEAST_PAIRS:
                lags.append(lag)
                squares.append(float(np.mean(change[there] ** 2)))
        if len(lags) <= len(_HARMONICS) or not min(squares):
            return None
        wanted = np.array(squares)
        columns = np.column_stack([np.full(len(lags), 2.0), _parts(np.array(lags, float))])
        found, _ = nnls(columns / wanted[:, None], np.ones(len(lags)))
        return cls(found[1:], float(found[0]))

    def half_square(self, apart: IntArray) -> FloatArray:
        """Half the mean square change, without the noise, over whole places of the grid."""
        table = 0.5 * _parts(np.arange(float(apart.max()) + 1.0)) @ self.sizes
        found: FloatArray = table[apart]
        return found


def _parts(apart: FloatArray) -> FloatArray:
    """(n, parts) mean square changes of unit parts: rough, smooth, and repeating every day."""
    ratio = apart[:, None] / _MEMORIES
    left = np.exp(-ratio)
    angle = 2.0 * np.pi * apart[:, None] / _DAY * np.array(_HARMONICS)
    rough, smooth = -np.expm1(-ratio), 1.0 - (1.0 + ratio) * left
    return 2.0 * np.column_stack([rough, smooth, 1.0 - np.cos(angle)])


def estimated(values: FloatArray, wanted: BoolArray) -> FloatArray:
    """The values (n,) on a regular grid, those `wanted` (n,) as best estimated from all known ones.

    NaN is a value that is not known. Too few values to say how they change are left as they are.
    """
    structure = Structure.of(values)
    known = np.flatnonzero(np.isfinite(values))
    if structure is None or len(known) < 2 * _SIDE:
        return values
    found = values.copy()
    places = np.flatnonzero(wanted)
    for begin in range(0, len(places), _CHUNK):
        part = places[begin : begin + _CHUNK]
        found[part] = _kriged(values, known, part, structure)
    return found


def _kriged(
    values: FloatArray, known: IntArray, places: IntArray, structure: Structure
) -> FloatArray:
    """(k,) best estimates at places from the nearest known values, their weights summing to 1."""
    first = np.clip(np.searchsorted(known, places) - _SIDE, 0, len(known) - 2 * _SIDE)
    near = known[first[:, None] + np.arange(2 * _SIDE)]
    count = near.shape[1]
    matrix = np.zeros((len(places), count + 1, count + 1))
    matrix[:, :count, :count] = -structure.half_square(np.abs(near[:, :, None] - near[:, None]))
    firm = structure.noise + _FIRM * structure.half_square(np.array([_DAY]))[0]
    matrix[:, range(count), range(count)] += firm
    matrix[:, :count, count] = matrix[:, count, :count] = 1.0
    right = np.ones((len(places), count + 1))
    right[:, :count] = -structure.half_square(np.abs(near - places[:, None]))
    weights = np.linalg.solve(matrix, right[:, :, None])[:, :count, 0]
    found: FloatArray = np.sum(weights * values[near], axis=1)
    return found
