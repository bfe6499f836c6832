"""One picture of a record: raw and corrected displacement, its error if known, and rig motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, tzinfo
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
import numpy.typing as npt

from core.arrays import FloatArray
from daemon.reports.series import Series
from daemon.text import span_text
from daemon.zones import zone_name
from drivers.libraries import require_library

if TYPE_CHECKING:
    from matplotlib.axes import Axes

RAW, CORRECTED, TRUE, SUSPECT, BAD = "#9a9a9a", "#0072b2", "#111111", "#e69f00", "#d55e00"
AXES = ("#0072b2", "#e69f00", "#009e73")
FURTHER = ("#009e73", "#cc79a7", "#56b4e9", "#7a5c00")
"""Of further targets, in turn."""

_EPOCH = np.datetime64(0, "us")
"""What matplotlib counts its days from."""


@dataclass(frozen=True, slots=True)
class GapSpan:
    """Slots without a measurement."""

    start: datetime
    end: datetime
    cause: str


@dataclass(frozen=True, slots=True)
class ReferenceMarks:
    """A reference on one axis of one point, in the record's zero."""

    point: str
    axis: str
    times: npt.NDArray[np.datetime64]
    """(n,) UTC."""
    values_mm: FloatArray
    """(n,)."""
    expanded_mm: FloatArray
    """(n,) expanded uncertainty, k = 2."""


def draw(
    series: Series,
    gaps: Sequence[GapSpan],
    title: str,
    output: Path | BinaryIO,
    file_format: str = "png",
    reference: Sequence[ReferenceMarks] = (),
    zone: tzinfo = UTC,
    excluded: Sequence[tuple[datetime, datetime]] = (),
) -> None:
    """Write the figure as `png` or `svg`, its time in a zone. Raises MissingLibraryError.

    `excluded` are spans that the quality ledger leaves out.
    """
    require_library("matplotlib", "figure")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
    from matplotlib.figure import Figure

    if series.bin_s is None:
        series = _broken_at_gaps(series, gaps)
    else:
        title = f"{title}, lowest and highest of every {span_text(series.bin_s)}"
    known, closed = series.true_mm is not None, bool(np.isfinite(series.closure_mm).any())
    units = _units(series)
    count = 4 + known + closed + len(units)
    figure = Figure(figsize=(11.0, 2.0 + 2.0 * count), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=12)
    panels = list(figure.subplots(count, 1, sharex=True))
    _displacement(panels[0], series, 1, "vertical y (mm)")
    _displacement(panels[1], series, 0, "horizontal x (mm)")
    for marks in reference:
        _reference(panels[0 if marks.axis == "y" else 1], series, marks)
    if known:
        _error(panels[2], series)
    if closed:
        _closure(panels[2 + known], series)
    rotation, translation, *readings = panels[2 + known + closed :]
    _motion(rotation, series, series.rotation_mrad, "rotation (mrad)", "r")
    _motion(translation, series, series.translation_mm, "translation (mm)", "t")
    for panel, unit in zip(readings, units, strict=True):
        _readings(panel, series, unit)
    for panel in panels[:2]:
        _mark_excluded(panel, series, excluded)
    for panel in panels:
        _mark_gaps(panel, gaps)
        panel.grid(alpha=0.25, linewidth=0.5)
        panel.legend(loc="upper left", bbox_to_anchor=(1.005, 1.0), fontsize=8, frameon=False)
    locator = AutoDateLocator(tz=zone)  # type: ignore[no-untyped-call]
    panels[-1].xaxis.set_major_locator(locator)
    panels[-1].xaxis.set_major_formatter(ConciseDateFormatter(locator, tz=zone))  # type: ignore[no-untyped-call]
    panels[-1].set_xlabel(zone_name(zone))
    figure.savefig(output, dpi=110, format=file_format)


def _broken_at_gaps(series: Series, gaps: Sequence[GapSpan]) -> Series:
    """Put a point without values into each gap, so that no line is drawn across it."""
    starts = np.array([_time(gap.start) for gap in gaps], dtype="datetime64[us]")
    at = np.searchsorted(series.times, starts)
    at = at[at > 0]

    def broken(values: FloatArray) -> FloatArray:
        return np.insert(values, at, np.nan, axis=0)

    return replace(
        series,
        times=np.insert(series.times, at, series.times[at - 1]),
        raw_mm=broken(series.raw_mm),
        corrected_mm=broken(series.corrected_mm),
        lower_mm=broken(series.lower_mm),
        upper_mm=broken(series.upper_mm),
        rotation_mrad=broken(series.rotation_mrad),
        translation_mm=broken(series.translation_mm),
        suspect_mm=broken(series.suspect_mm),
        withheld=np.insert(series.withheld, at, values=False),
        closure_mm=broken(series.closure_mm),
        closure_sigma_mm=broken(series.closure_sigma_mm),
        targets_mm={name: broken(mm) for name, mm in series.targets_mm.items()},
        true_mm=None if series.true_mm is None else broken(series.true_mm),
        readings=broken(series.readings),
    )


def _time(when: datetime) -> np.datetime64:
    return np.datetime64(when.astimezone(UTC).replace(tzinfo=None), "us")


def _displacement(panel: Axes, series: Series, axis: int, label: str) -> None:
    times: Any = series.times
    _line(panel, series, series.raw_mm[:, axis], color=RAW, linewidth=1.0, label="raw")
    if series.true_mm is not None:
        panel.plot(times, series.true_mm[:, axis], color=TRUE, linestyle="--", label="true")
    corrected_mm = series.corrected_mm[:, axis]
    _line(panel, series, corrected_mm, color=CORRECTED, linewidth=1.4, label="corrected")
    panel.fill_between(
        times,
        series.lower_mm[:, axis],
        series.upper_mm[:, axis],
        color=CORRECTED,
        alpha=0.25,
        label="± 1 sigma",
    )
    for number, (name, mm) in enumerate(series.targets_mm.items()):
        colour = FURTHER[number % len(FURTHER)]
        _line(panel, series, mm[:, axis], color=colour, linewidth=1.0, label=name)
    _mark_flags(panel, series, axis)
    panel.set_ylabel(label)


def _reference(panel: Axes, series: Series, marks: ReferenceMarks) -> None:
    """Draw a reference over the line that it belongs to, with its expanded uncertainty."""
    names = list(series.targets_mm)
    own = marks.point in names
    colour = FURTHER[names.index(marks.point) % len(FURTHER)] if own else TRUE
    times: Any = marks.times
    panel.errorbar(
        times,
        marks.values_mm,
        yerr=marks.expanded_mm,
        fmt="D",
        color=colour,
        markersize=3.5,
        markerfacecolor="white",
        capsize=2.0,
        linewidth=0.9,
        zorder=5,
        label=f"reference{f', {marks.point}' if own else ''} (k = 2)",
    )


def _line(panel: Axes, series: Series, values: FloatArray, **style: Any) -> None:
    """Draw a line, and as dots the values that stand alone, which a line does not show."""
    times: Any = series.times
    panel.plot(times, values, **style)
    steps = np.diff(values, prepend=np.nan, append=np.nan)
    later = np.diff(series.times) > np.timedelta64(0)
    has_length = np.isfinite(steps) & ((steps != 0.0) | np.concatenate([[False], later, [False]]))
    alone = np.isfinite(values) & ~has_length[:-1] & ~has_length[1:]
    if alone.any():
        panel.plot(times[alone], values[alone], ".", color=style["color"], markersize=2.0)


def _error(panel: Axes, series: Series) -> None:
    times: Any = series.times
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


def _closure(panel: Axes, series: Series) -> None:
    """What fixed targets show of the rig's error, and within what its sigma lets expect it."""
    times: Any = series.times
    for axis, name, colour in ((1, "y", CORRECTED), (0, "x", AXES[2])):
        style = {"color": colour, "linewidth": 1.0, "label": f"closure {name}"}
        _line(panel, series, series.closure_mm[:, axis], **style)
        sigma = series.closure_sigma_mm[:, axis]
        panel.fill_between(times, -sigma, sigma, color=colour, alpha=0.12)
    panel.plot([], [], color=RAW, linewidth=6, alpha=0.4, label="± 1 sigma")
    panel.set_ylabel("closure (mm)")


def _motion(panel: Axes, series: Series, values: FloatArray, label: str, symbol: str) -> None:
    for axis, name in enumerate("xyz"):
        style = {"color": AXES[axis], "linewidth": 1.2, "label": f"{symbol}{name}"}
        _line(panel, series, values[:, axis], **style)
    panel.set_ylabel(f"rig {label}")


def _units(series: Series) -> list[str]:
    """The units of the readings that have a value, each once."""
    return list(
        dict.fromkeys(
            channel.unit
            for number, channel in enumerate(series.channels)
            if np.isfinite(series.readings[:, number]).any()
        )
    )


def _readings(panel: Axes, series: Series, unit: str) -> None:
    """Draw the readings of one unit."""
    from matplotlib import colormaps

    colours = colormaps["tab10"].colors  # type: ignore[attr-defined]
    shown = [number for number, channel in enumerate(series.channels) if channel.unit == unit]
    for number in shown:
        values = series.readings[:, number]
        if np.isfinite(values).any():
            colour = colours[number % len(colours)]
            label = series.channels[number].label
            _line(panel, series, values, color=colour, linewidth=1.2, label=label)
    panel.set_ylabel({"degC": "temperature (°C)"}.get(unit, unit))


def _mark_flags(panel: Axes, series: Series, axis: int) -> None:
    """Mark suspect values where they are, and withheld ones on the panel's lower edge."""
    times: Any = series.times
    suspect_mm = series.suspect_mm[:, axis]
    suspect = np.isfinite(suspect_mm)
    if suspect.any():
        at, mm = times[suspect], suspect_mm[suspect]
        panel.plot(at, mm, "o", color=SUSPECT, fillstyle="none", label="suspect")
    if series.withheld.any():
        bad = times[series.withheld]
        panel.plot(
            bad,
            np.full(len(bad), 0.03),
            "x",
            color=BAD,
            markersize=6,
            transform=panel.get_xaxis_transform(),
            label="bad, withheld",
        )


def _mark_gaps(panel: Axes, gaps: Sequence[GapSpan]) -> None:
    """Shade the gaps, those of one cause as one object: a season has thousands."""
    day = np.timedelta64(1, "D")
    for cause in dict.fromkeys(gap.cause for gap in gaps):
        spans = [(_time(gap.start), _time(gap.end)) for gap in gaps if gap.cause == cause]
        panel.broken_barh(
            [((start - _EPOCH) / day, (end - start) / day) for start, end in spans],
            (0.0, 1.0),
            transform=panel.get_xaxis_transform(),
            facecolor=BAD,
            alpha=0.15,
            linewidth=0,
            label=f"gap: {cause}",
        )


def _mark_excluded(
    panel: Axes, series: Series, excluded: Sequence[tuple[datetime, datetime]]
) -> None:
    """Hatch the spans that the ledger leaves out, as far as the series reaches."""
    if not excluded or not len(series.times):
        return
    first, last = series.times[0], series.times[-1]
    spans = [(max(_time(since), first), min(_time(until), last)) for since, until in excluded]
    day = np.timedelta64(1, "D")
    panel.broken_barh(
        [
            ((since - _EPOCH) / day, (until - since) / day)
            for since, until in spans
            if since < until
        ],
        (0.0, 1.0),
        transform=panel.get_xaxis_transform(),
        facecolor="none",
        edgecolor=RAW,
        hatch="///",
        linewidth=0,
        label="excluded",
    )
