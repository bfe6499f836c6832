"""What a figure shows of a record: every row of a short span, the envelope of a long one."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np
import numpy.typing as npt

from core.arrays import BoolArray, FloatArray
from core.results import Flag, Measurement
from daemon.store.queries.columns import Columns
from daemon.store.rows.targets import values_of_targets
from daemon.time_arrays import TimeArray, utc_array

BINS = 2400
"""Of an envelope: two for each column of the picture's pixels, so that a peak stays where it is."""

_VALUES = ("raw_x_mm", "raw_y_mm", "x_mm", "y_mm", "sigma_x_mm", "sigma_y_mm")
_MOTION = ("rx_rad", "ry_rad", "rz_rad", "tx_mm", "ty_mm", "tz_mm")
_CLOSURE = ("closure_x_mm", "closure_y_mm", "closure_sigma_x_mm", "closure_sigma_y_mm")


@dataclass(frozen=True, slots=True)
class Channel:
    """One of the readings that a figure shows."""

    label: str
    unit: str


CAMERAS = (Channel("main camera", "degC"), Channel("sub-camera", "degC"))
"""What the cameras say of their own temperatures: the first two readings of every record."""


@dataclass(frozen=True, slots=True)
class Series:
    """What the figure shows, point by point; NaN where there is no value.

    Of an envelope two points, lowest and highest, share a time.
    """

    times: TimeArray
    """(n,) UTC."""
    raw_mm: FloatArray
    """(n, 2) x, y of the main camera alone."""
    corrected_mm: FloatArray
    """(n, 2)."""
    lower_mm: FloatArray
    """(n, 2) `corrected_mm` less 1 sigma."""
    upper_mm: FloatArray
    """(n, 2) `corrected_mm` plus 1 sigma."""
    rotation_mrad: FloatArray
    """(n, 3)."""
    translation_mm: FloatArray
    """(n, 3)."""
    suspect_mm: FloatArray
    """(n, 2) `corrected_mm` of suspect rows."""
    withheld: BoolArray
    """(n,) a row that is bad."""
    closure_mm: FloatArray
    """(n, 2) what fixed targets show of the rig's error."""
    closure_sigma_mm: FloatArray
    """(n, 2)."""
    targets_mm: Mapping[str, FloatArray]
    """(n, 2) corrected, of each measured further target."""
    readings: FloatArray
    """(n, channels)."""
    channels: tuple[Channel, ...] = ()
    true_mm: FloatArray | None = None
    """(n, 2) true displacement, where a simulation knows it."""
    bin_s: float | None = None
    """What one column of an envelope spans; None where every row is a point."""

    @property
    def sigma_mm(self) -> FloatArray:
        """(n, 2) 1 sigma of `corrected_mm`, where every row is a point."""
        return 0.5 * (self.upper_mm - self.lower_mm)


def series_of(
    rows: Sequence[tuple[datetime, Measurement]], true_mm: FloatArray | None = None
) -> Series:
    """Put a few measurements of a site without further targets into a series."""
    measured = [measurement for _, measurement in rows]
    none = (math.nan, math.nan, math.nan)

    def column(values: list[Any], width: int) -> FloatArray:
        return np.array(values, dtype=np.float64).reshape(-1, width)

    corrected_mm = column([m.corrected.mm if m.corrected else none[:2] for m in measured], 2)
    variances = [np.diag(m.corrected.covariance_mm2) if m.corrected else none[:2] for m in measured]
    rotations = [m.motion.rotation_rad if m.motion else none for m in measured]
    translations = [m.motion.translation_mm if m.motion else none for m in measured]
    raw_mm = column([m.raw.mm if m.raw else none[:2] for m in measured], 2)
    values = np.hstack(
        [
            raw_mm,
            corrected_mm,
            np.sqrt(column(variances, 2)),
            column(rotations, 3),
            column(translations, 3),
            np.full((len(rows), len(_CLOSURE)), np.nan),
        ]
    )
    flags = np.array([m.flag for m in measured], dtype=np.int8)
    times = np.array([when.replace(tzinfo=None) for when, _ in rows], dtype="datetime64[us]")
    return _series(times, _shown(values, flags), flags == Flag.BAD, true_mm=true_mm)


class Points:
    """A series of every row, with some further targets."""

    def __init__(self, targets: Sequence[str] = (), channels: tuple[Channel, ...] = ()) -> None:
        self._targets, self._channels = tuple(targets), channels
        self._times: list[TimeArray] = []
        self._shown: list[FloatArray] = []
        self._withheld: list[BoolArray] = []

    def add(self, rows: Columns, readings: FloatArray) -> None:
        """Take rows, in the order of their slots, and their readings (rows, channels)."""
        flags = np.array(rows.values["flag"], dtype=np.int8)
        self._times.append(utc_array(rows.values["slot_utc"]))
        shown = _shown(_numbers(rows, self._targets), flags)
        self._shown.append(np.hstack([shown, readings]))
        self._withheld.append(flags == Flag.BAD)

    def series(self) -> Series:
        """What was taken."""
        times = np.concatenate([np.empty(0, "datetime64[us]"), *self._times])
        width = _width(self._targets) + len(self._channels)
        shown = np.concatenate([np.empty((0, width)), *self._shown])
        withheld = np.concatenate([np.empty(0, np.bool_), *self._withheld])
        return _series(times, shown, withheld, self._targets, self._channels)


class Envelope:
    """The lowest and the highest value of each of equal spans of time: no peak is lost."""

    def __init__(
        self,
        since_utc: datetime,
        until_utc: datetime,
        targets: Sequence[str] = (),
        channels: tuple[Channel, ...] = (),
    ) -> None:
        self._targets, self._channels = tuple(targets), channels
        self._begin = np.datetime64(since_utc.replace(tzinfo=None), "us")
        self._bin_s = (until_utc - since_utc).total_seconds() / BINS
        self._low = np.full((BINS, _width(self._targets) + len(channels)), np.nan)
        self._high = self._low.copy()
        self._withheld = np.zeros(BINS, dtype=np.bool_)

    def add(self, rows: Columns, readings: FloatArray) -> None:
        """Take rows, in the order of their slots, and their readings (rows, channels)."""
        flags = np.array(rows.values["flag"], dtype=np.int8)
        shown = np.hstack([_shown(_numbers(rows, self._targets), flags), readings])
        since_s = (utc_array(rows.values["slot_utc"]) - self._begin) / np.timedelta64(1, "s")
        bins = np.clip(since_s // self._bin_s, 0, BINS - 1).astype(np.int64)
        firsts = np.flatnonzero(np.diff(bins, prepend=-1))
        filled = bins[firsts]
        for whole, better in ((self._low, np.fmin), (self._high, np.fmax)):
            whole[filled] = better(whole[filled], better.reduceat(shown, firsts, axis=0))
        self._withheld[bins[flags == Flag.BAD]] = True

    def series(self) -> Series:
        """Two points for each span, at its middle."""
        middles = (np.arange(BINS) + 0.5) * self._bin_s * 1e6
        times = self._begin + middles.astype("timedelta64[us]")
        shown = np.stack([self._low, self._high], axis=1)
        shown[:, :, _LOWER] = self._low[:, None, _LOWER]
        for upper in (_UPPER, _CLOSURE_SIGMA):
            shown[:, :, upper] = self._high[:, None, upper]
        points, withheld = shown.reshape(2 * BINS, -1), np.repeat(self._withheld, 2)
        names = self._targets, self._channels
        return _series(np.repeat(times, 2), points, withheld, *names, bin_s=self._bin_s)


_RAW, _CORRECTED, _LOWER, _UPPER = slice(0, 2), slice(2, 4), slice(4, 6), slice(6, 8)
_ROTATION, _TRANSLATION, _SUSPECT = slice(8, 11), slice(11, 14), slice(14, 16)
_CLOSURES, _CLOSURE_SIGMA, _FURTHER = slice(16, 18), slice(18, 20), 20
"""Where the columns of a series stand in one array; two for each further target
follow, then the readings."""


def _width(targets: Sequence[str]) -> int:
    return _FURTHER + 2 * len(targets)


def _numbers(rows: Columns, targets: Sequence[str]) -> FloatArray:
    """(n, 16 + 2 targets) numbers of rows: `_VALUES`, `_MOTION`, `_CLOSURE`, further targets."""
    own = rows.numbers(*_VALUES, *_MOTION, *_CLOSURE)
    further = values_of_targets(rows.values["targets"], targets, ("x_mm", "y_mm"))
    return np.hstack([own, *(np.array([v], dtype=np.float64).T for v in further.values())])


def _shown(values: FloatArray, flags: npt.NDArray[np.int8]) -> FloatArray:
    """(n, 20 + 2 targets) what is drawn, of `_numbers`."""
    corrected_mm, sigma_mm = values[:, 2:4], values[:, 4:6]
    suspect_mm = np.where((flags == Flag.SUSPECT)[:, None], corrected_mm, np.nan)
    return np.hstack(
        [
            values[:, :4],
            corrected_mm - sigma_mm,
            corrected_mm + sigma_mm,
            1e3 * values[:, 6:9],
            values[:, 9:12],
            suspect_mm,
            values[:, 12:],
        ]
    )


def _series(
    times: TimeArray,
    shown: FloatArray,
    withheld: BoolArray,
    targets: Sequence[str] = (),
    channels: tuple[Channel, ...] = (),
    true_mm: FloatArray | None = None,
    bin_s: float | None = None,
) -> Series:
    return Series(
        times=times,
        raw_mm=shown[:, _RAW],
        corrected_mm=shown[:, _CORRECTED],
        lower_mm=shown[:, _LOWER],
        upper_mm=shown[:, _UPPER],
        rotation_mrad=shown[:, _ROTATION],
        translation_mm=shown[:, _TRANSLATION],
        suspect_mm=shown[:, _SUSPECT],
        withheld=withheld,
        closure_mm=shown[:, _CLOSURES],
        closure_sigma_mm=shown[:, _CLOSURE_SIGMA],
        targets_mm={
            name: shown[:, _FURTHER + 2 * k : _FURTHER + 2 * k + 2]
            for k, name in enumerate(targets)
        },
        readings=shown[:, _width(targets) :],
        channels=channels,
        true_mm=true_mm,
        bin_s=bin_s,
    )
