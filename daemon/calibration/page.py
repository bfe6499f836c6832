"""The report of a calibration as files: text and JSON, and one HTML page with its figures."""

from __future__ import annotations

import io
import json
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jinja2 import Environment, StrictUndefined

from core.calibration.calibrate import CalibrationReport
from daemon.durable import write_durable
from daemon.text import utc_text
from daemon.version import VERSION
from drivers.libraries import has_library

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TEXT, DATA, PAGE = "report.txt", "report.json", "report.html"
_BLUE, _ORANGE, _GREY = "#0072b2", "#e69f00", "#9a9a9a"

_TEMPLATE = Path(__file__).with_name("report.html.j2")


def write_report_files(
    directory: Path,
    report: CalibrationReport,
    *,
    site: str,
    number: int,
    active: bool,
    created_utc: datetime,
) -> Path:
    """Write text, JSON and page beside the frames they speak of; give the page's path.

    Raises OSError.
    """
    facts: dict[str, Any] = {
        "site": site,
        "number": number,
        "active": active,
        "when": utc_text(created_utc),
        "version": VERSION,
        "frames": str(directory),
        "passed": report.passed,
        "lines": report.lines,
        "figures": report.figures,
    }
    environment = Environment(autoescape=True, undefined=StrictUndefined)
    template = environment.from_string(_TEMPLATE.read_text(encoding="utf-8"))
    page = template.render(**facts, pictures=_pictures(report.figures))
    write_durable(directory / TEXT, ("\n".join(report.lines) + "\n").encode())
    write_durable(directory / DATA, (json.dumps(facts, indent=2) + "\n").encode())
    write_durable(directory / PAGE, page.encode())
    return directory / PAGE


def _pictures(figures: dict[str, Any]) -> list[tuple[list[str], str]]:
    """The figures with their captions; none where matplotlib is not installed.

    Each panel is an SVG of its own: on a phone they stand below one another, with text that can be
    read.
    """
    if not has_library("matplotlib"):
        return []
    from matplotlib.figure import Figure

    turned, left_over = (Figure(figsize=(4.5, 3.6), layout="constrained") for _ in range(2))
    _draw_positions(turned.subplots(), figures["rig_views"])
    _draw_left_over(left_over.subplots(), figures["rig_views"], figures["held_out_mm"])
    cells = Figure(figsize=(4.5, 3.0), layout="constrained")
    _draw_cells(cells.subplots(), figures["image_cells"])
    positions = (
        "First: how the rig was turned at each position. Second: what is left of the false "
        "displacement there, and at positions held out of a second fit (orange). Points "
        "scattered about zero are noise; points that lie in a line or an arc are a motion "
        "of the target or a rig that is not rigid."
    )
    covered = (
        "Corners of the lens views in each part of the sub image. Where there are none the "
        "lens's distortion is guessed."
    )
    return [([_svg(turned), _svg(left_over)], positions), ([_svg(cells)], covered)]


def _svg(figure: Figure) -> str:
    """An SVG element, without the XML prologue that HTML does not take."""
    file = io.StringIO()
    figure.savefig(file, format="svg", metadata={"Date": None})
    text = file.getvalue()
    return text[text.index("<svg") :]


def _draw_positions(axes: Axes, views: list[dict[str, Any]]) -> None:
    turned = np.array([view["rotation_mrad"] for view in views]).reshape(-1, 3)
    axes.plot(turned[:, 1], turned[:, 0], "-", color=_GREY, linewidth=0.6)
    axes.plot(turned[:, 1], turned[:, 0], "o", color=_BLUE, markersize=4)
    axes.set(title="Rig positions", xlabel="pan, about y (mrad)", ylabel="tilt, about x (mrad)")


def _draw_left_over(axes: Axes, views: list[dict[str, Any]], held_out: list[list[float]]) -> None:
    left = np.array([view["left_mm"] for view in views]).reshape(-1, 2)
    out = np.array(held_out).reshape(-1, 2)
    axes.plot(left[:, 0], left[:, 1], "o", color=_BLUE, markersize=4, label="all positions")
    axes.plot(out[:, 0], out[:, 1], "s", color=_ORANGE, markersize=5, label="held out")
    axes.axhline(0.0, color=_GREY, linewidth=0.6)
    axes.axvline(0.0, color=_GREY, linewidth=0.6)
    axes.set(title="Left after correction", xlabel="x (mm)", ylabel="y (mm)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(fontsize="small")


def _draw_cells(axes: Axes, cells: list[list[int]]) -> None:
    counts = np.array(cells)
    axes.imshow(np.sqrt(counts), cmap="Blues", aspect="auto", vmin=0.0)
    for row, column in np.ndindex(counts.shape):
        shade = "white" if counts[row, column] > 0.5 * counts.max() else "black"
        axes.text(column, row, str(counts[row, column]), ha="center", va="center", color=shade)
    axes.set(title="Corners of the lens views", xticks=[], yticks=[])
