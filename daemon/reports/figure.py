"""One picture of a record: raw and corrected displacement, its error if known, and rig motion."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from core.arrays import FloatArray
from core.results import Flag, Measurement
from drivers.errors import MissingLibraryError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

RAW, CORRECTED, TRUE, SUSPECT, BAD = "#9a9a9a", "#0072b2", "#111111", "#e69f00", "#d55e00"
AXES = ("#0072b2", "#e69f00", "#009e73")


@dataclass(frozen=True, slots=True)
class Series:
    """What the figure shows, slot by slot; NaN where there is no value."""

    times: tuple[datetime, ...]
    flags: tuple[Flag, ...]
    raw_mm: FloatArray
    """(n, 2) x, y of the main camera alone."""
    corrected_mm: FloatArray
    """(n, 2)."""
    sigma_mm: FloatArray
    """(n, 2) 1 sigma of `corrected_mm`."""
    rotation_mrad: FloatArray
    """(n, 3)."""
    translation_mm: FloatArray
    """(n, 3)."""
    true_mm: FloatArray | None = None
    """(n, 2) true displacement, where a simulation knows it."""


@dataclass(frozen=True, slots=True)
class GapSpan:
    """Slots without a measurement."""

    start: datetime
    end: datetime
    cause: str


def series_of(
    rows: Sequence[tuple[datetime, Measurement]], true_mm: FloatArray | None = None
) -> Series:
    """Put measurements into arrays."""
    measured = [measurement for _, measurement in rows]
    none = (math.nan, math.nan, math.nan)

    def column(values: list[Any], width: int) -> FloatArray:
        return np.array(values, dtype=np.float64).reshape(-1, width)

    return Series(
        times=tuple(when for when, _ in rows),
        flags=tuple(m.flag for m in measured),
        raw_mm=column([m.raw.mm if m.raw else none[:2] for m in measured], 2),
        corrected_mm=column([m.corrected.mm if m.corrected else none[:2] for m in measured], 2),
        sigma_mm=column(
            [
                np.sqrt(np.diag(m.corrected.covariance_mm2)) if m.corrected else none[:2]
                for m in measured
            ],
            2,
        ),
        rotation_mrad=1e3
        * column([m.motion.rotation_rad if m.motion else none for m in measured], 3),
        translation_mm=column([m.motion.translation_mm if m.motion else none for m in measured], 3),
        true_mm=true_mm,
    )


def require_matplotlib() -> None:
    """Raise MissingLibraryError, which says how to install it, unless matplotlib is there."""
    if importlib.util.find_spec("matplotlib") is None:
        msg = "no figure: matplotlib is not installed; pip install 'dcam[plot]'"
        raise MissingLibraryError(msg)


def draw(
    series: Series,
    gaps: Sequence[GapSpan],
    title: str,
    output: Path | BinaryIO,
    file_format: str = "png",
) -> None:
    """Write the figure as `png` or `svg`. Raises MissingLibraryError."""
    require_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
    from matplotlib.figure import Figure

    series = _broken_at_gaps(series, gaps)
    known = series.true_mm is not None
    figure = Figure(figsize=(11.0, 12.0 if known else 10.0), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=12)
    panels = list(figure.subplots(5 if known else 4, 1, sharex=True))
    _displacement(panels[0], series, 1, "vertical y (mm)")
    _displacement(panels[1], series, 0, "horizontal x (mm)")
    if known:
        _error(panels[2], series)
    _motion(panels[-2], series, series.rotation_mrad, "rotation (mrad)", "r")
    _motion(panels[-1], series, series.translation_mm, "translation (mm)", "t")
    for panel in panels:
        _mark_gaps(panel, gaps)
        panel.grid(alpha=0.25, linewidth=0.5)
        panel.legend(loc="upper left", bbox_to_anchor=(1.005, 1.0), fontsize=8, frameon=False)
    locator = AutoDateLocator()  # type: ignore[no-untyped-call]
    panels[-1].xaxis.set_major_locator(locator)
    panels[-1].xaxis.set_major_formatter(ConciseDateFormatter(locator))  # type: ignore[no-untyped-call]
    panels[-1].set_xlabel("UTC")
    figure.savefig(output, dpi=110, format=file_format)


def _broken_at_gaps(series: Series, gaps: Sequence[GapSpan]) -> Series:
    """Put a row without values into each gap, so that no line is drawn across it."""
    at = [index for index in (_index_of(series, gap) for gap in gaps) if index]
    times = list(series.times)
    flags = list(series.flags)
    for index in reversed(at):
        times.insert(index, times[index - 1])
        flags.insert(index, Flag.MISSING)

    def broken(values: FloatArray) -> FloatArray:
        return np.insert(values, at, np.nan, axis=0)

    return Series(
        times=tuple(times),
        flags=tuple(flags),
        raw_mm=broken(series.raw_mm),
        corrected_mm=broken(series.corrected_mm),
        sigma_mm=broken(series.sigma_mm),
        rotation_mrad=broken(series.rotation_mrad),
        translation_mm=broken(series.translation_mm),
        true_mm=None if series.true_mm is None else broken(series.true_mm),
    )


def _index_of(series: Series, gap: GapSpan) -> int:
    return sum(when < gap.start for when in series.times)


def _displacement(panel: Axes, series: Series, axis: int, label: str) -> None:
    times: Any = list(series.times)
    value, sigma = series.corrected_mm[:, axis], series.sigma_mm[:, axis]
    panel.plot(times, series.raw_mm[:, axis], color=RAW, linewidth=1.0, label="raw")
    if series.true_mm is not None:
        panel.plot(times, series.true_mm[:, axis], color=TRUE, linestyle="--", label="true")
    panel.plot(times, value, color=CORRECTED, linewidth=1.4, label="corrected")
    panel.fill_between(
        times, value - sigma, value + sigma, color=CORRECTED, alpha=0.25, label="± 1 sigma"
    )
    _mark_flags(panel, series, value)
    panel.set_ylabel(label)


def _error(panel: Axes, series: Series) -> None:
    times: Any = list(series.times)
    true = series.true_mm
    if true is None:
        return
    for axis, name, colour in ((1, "y", CORRECTED), (0, "x", AXES[2])):
        error = series.corrected_mm[:, axis] - true[:, axis]
        sigma = series.sigma_mm[:, axis]
        panel.plot(times, error, color=colour, marker=".", linewidth=0.8, label=f"{name} error")
        panel.fill_between(times, -sigma, sigma, color=colour, alpha=0.12)
    panel.plot([], [], color=RAW, linewidth=6, alpha=0.4, label="± 1 sigma")
    panel.set_ylabel("corrected - true (mm)")


def _motion(panel: Axes, series: Series, values: FloatArray, label: str, symbol: str) -> None:
    times: Any = list(series.times)
    for axis, name in enumerate("xyz"):
        panel.plot(times, values[:, axis], color=AXES[axis], linewidth=1.2, label=f"{symbol}{name}")
    panel.set_ylabel(f"rig {label}")


def _mark_flags(panel: Axes, series: Series, value: FloatArray) -> None:
    """Mark suspect values where they are, and withheld ones on the panel's lower edge."""
    suspect = [i for i, flag in enumerate(series.flags) if flag is Flag.SUSPECT]
    bad = [i for i, flag in enumerate(series.flags) if flag is Flag.BAD]
    if suspect:
        times: Any = [series.times[i] for i in suspect]
        panel.plot(times, value[suspect], "o", color=SUSPECT, fillstyle="none", label="suspect")
    if bad:
        times = [series.times[i] for i in bad]
        panel.plot(
            times,
            [0.03] * len(bad),
            "x",
            color=BAD,
            markersize=6,
            transform=panel.get_xaxis_transform(),
            label="bad, withheld",
        )


def _mark_gaps(panel: Axes, gaps: Sequence[GapSpan]) -> None:
    named: set[str] = set()
    for gap in gaps:
        label = f"gap: {gap.cause}" if gap.cause not in named else None
        named.add(gap.cause)
        start: Any = gap.start
        end: Any = gap.end
        panel.axvspan(start, end, color=BAD, alpha=0.15, linewidth=0, label=label)
