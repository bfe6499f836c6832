"""One picture of a study: the days, what is left after temperature, steps and trend, and creep."""

from __future__ import annotations

from datetime import UTC, tzinfo
from pathlib import Path
from typing import Any

import numpy as np

from core.arrays import FloatArray
from daemon.analysis.fields import moment
from daemon.analysis.study import Study
from drivers.libraries import require_library

_VALUE, _TREND, _STEP, _BAND = "#0072b2", "#d55e00", "#009e73", "#9a9a9a"


def draw_study(
    study: Study, title: str, path: Path, *, file_format: str, zone: tzinfo = UTC
) -> None:
    """Draw days above, and below them the hourly means less temperature with steps and trend."""
    require_library("matplotlib", "figure")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 8), layout="constrained")
    panels: Any = figure.subplots(2, 1, sharex=True)
    _days(panels[0], study)
    if study.trend is not None:
        _rest(panels[1], study)
    for panel in panels:
        panel.set_ylabel(f"{study.axis} (mm)")
        panel.grid(alpha=0.3)
        if panel.get_legend_handles_labels()[0]:
            panel.legend(loc="upper left", fontsize="small")
        panel.xaxis.axis_date(zone)
    figure.suptitle(title)
    figure.savefig(path, format=file_format, dpi=100)


def _days(panel: Any, study: Study) -> None:
    days = [np.datetime64(day.day, "h") + np.timedelta64(12, "h") for day in study.days]
    lowest = np.array([day.lowest_mm for day in study.days])
    highest = np.array([day.highest_mm for day in study.days])
    mean = [day.mean_mm for day in study.days]
    panel.fill_between(days, lowest, highest, color=_BAND, alpha=0.4, label="daily min to max")
    panel.plot(days, mean, color=_VALUE, marker=".", label="daily mean")


def _rest(panel: Any, study: Study) -> None:
    times = _times(study.hours.times_s[study.used])
    trend = study.trend
    if trend is None:
        return
    panel.plot(
        times[trend.keep],
        trend.rest_mm[trend.keep],
        ".",
        markersize=2,
        color=_VALUE,
        label="hourly mean less temperature, season and steps",
    )
    panel.plot(times, trend.line_mm, color=_TREND, label="trend")
    for step in study.steps.steps if study.steps else ():
        at = moment(step.time_s).replace(tzinfo=None)
        panel.axvline(at, color=_STEP, label=f"step {step.mm.value:+.3f} mm")


def _times(times_s: FloatArray) -> Any:
    return (times_s * 1e3).astype("datetime64[ms]")
