"""One picture of a simulated season: the error and its sigma, without and with a fixed target."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from core.arrays import FloatArray
from daemon.reports.figure import CORRECTED, RAW, SUSPECT, TRUE
from drivers.libraries import require_library

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS = (SUSPECT, CORRECTED)


@dataclass(frozen=True, slots=True)
class SeasonSeries:
    """Rows of one rig over a season."""

    times: Sequence[datetime]
    """(n,) slots, UTC."""
    mm: FloatArray
    """(n, 2) corrected displacement, nan where there is none."""
    sigma_mm: FloatArray
    """(n, 2) its 1 sigma, of all causes."""
    true_mm: FloatArray
    """(n, 2)."""
    camera_c: FloatArray
    """(n,) temperature of the main camera."""

    @property
    def error_mm(self) -> FloatArray:
        """(n, 2) corrected less true."""
        return self.mm - self.true_mm


def draw_season(rigs: Mapping[str, SeasonSeries], output: Path) -> None:
    """Write the figure of rigs that saw the same season, by their names, as PNG.

    Raises MissingLibraryError.
    """
    require_library("matplotlib", "figure")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 8.5), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle("A season on steel that bends: without and with a fixed target", fontsize=12)
    displacement, vertical, horizontal, temperature = figure.subplots(4, 1, sharex=True)
    first = next(iter(rigs.values()))
    times: Any = first.times
    displacement.plot(times, first.true_mm[:, 1], color=TRUE, linestyle="--", label="true")
    for (name, rig), colour in zip(rigs.items(), COLOURS, strict=True):
        style: dict[str, Any] = {"color": colour, "marker": ".", "linewidth": 1.0, "label": name}
        displacement.plot(times, rig.mm[:, 1], **style)
        for panel, axis in ((vertical, 1), (horizontal, 0)):
            _error(panel, rig, axis, style)
    temperature.plot(times, first.camera_c, color=RAW, marker=".", label="main camera")
    displacement.set_ylabel("vertical y (mm)")
    vertical.set_ylabel("error of y (mm)")
    horizontal.set_ylabel("error of x (mm)")
    temperature.set_ylabel("temperature (°C)")
    for panel in (displacement, vertical, horizontal, temperature):
        panel.grid(alpha=0.25, linewidth=0.5)
        panel.legend(loc="upper left", bbox_to_anchor=(1.005, 1.0), fontsize=8, frameon=False)
    locator = AutoDateLocator()  # type: ignore[no-untyped-call]
    temperature.xaxis.set_major_locator(locator)
    temperature.xaxis.set_major_formatter(ConciseDateFormatter(locator))  # type: ignore[no-untyped-call]
    temperature.set_xlabel("UTC")
    figure.savefig(output, dpi=110)


def _error(panel: Axes, rig: SeasonSeries, axis: int, style: Mapping[str, Any]) -> None:
    """Draw the error, and the band in which two of three errors are expected."""
    times: Any = rig.times
    sigma_mm = rig.sigma_mm[:, axis]
    panel.plot(times, rig.error_mm[:, axis], **style)
    panel.fill_between(
        times, -sigma_mm, sigma_mm, color=style["color"], alpha=0.15, label="± 1 sigma"
    )
