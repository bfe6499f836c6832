"""The paper's season at its bridge, through the real daemon: without and with a fixed plate."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from core.arrays import BoolArray, FloatArray
from daemon.commands.output import progress
from studies.field_season import (
    FIRST_DAY,
    LIGHTING,
    POWER_BACK,
    POWER_FAILS,
    START_UTC,
    Season,
    run_season,
)
from studies.figure import COLOURS, new_figure
from studies.keep import Keep
from studies.page import Claim, Report, Table

CODE = ("studies/field_season.py", "daemon")
GOOD = "1"
LIMIT_MM = 0.03
"""rms of the good rows with the fixed plate."""
LIDAR_MM, LIDAR_DAYS, LIDAR_SEED = 1.0, 7.0, 5
"""1 sigma of a reading, and how far they are apart."""
HONEST = (0.5, 0.999)
"""Share of the errors without the plate that may be within 1 sigma: one rig bends one way all
season, so that single seasons are from half to all (docs/method.md)."""


@dataclass(frozen=True, slots=True)
class Record:
    """The rows of a season."""

    days: FloatArray
    """(n,) of the paper's count."""
    rows: Sequence[Mapping[str, Any]]

    @classmethod
    def of(cls, outcome: Mapping[str, Any]) -> Record:
        """Take what `run_season` gave."""
        rows = outcome["rows"]
        start_s = START_UTC.timestamp()
        times = [datetime.fromisoformat(row["slot_utc"]).astimezone(UTC) for row in rows]
        return cls(
            np.array([FIRST_DAY + (time.timestamp() - start_s) / 86400.0 for time in times]), rows
        )

    def column(self, name: str) -> FloatArray:
        """(n,) numbers; NaN where there is none."""
        return np.array([float(row[name]) if row[name] else math.nan for row in self.rows])

    def pair(self, name: str) -> FloatArray:
        """(n, 2) x and y, `name` with {} for the axis."""
        return np.column_stack([self.column(name.format(axis)) for axis in "xy"])

    @property
    def true_mm(self) -> FloatArray:
        """(n, 2)."""
        return np.array([row["true_mm"] for row in self.rows])

    @property
    def error_mm(self) -> FloatArray:
        """(n, 2)."""
        return self.pair("{}_mm") - self.true_mm

    @property
    def good(self) -> BoolArray:
        """(n,)."""
        return np.array([row["flag"] == GOOD for row in self.rows])

    @property
    def taken(self) -> BoolArray:
        """(n,) slots that have a row: pictures were taken, whatever they show."""
        return np.array([row["flag"] != "9" for row in self.rows])

    @property
    def powered_and_lit(self) -> BoolArray:
        """(n,)."""
        power = ~((self.days >= POWER_FAILS) & (self.days < POWER_BACK))
        dark = np.array(["night" in row["cases"] for row in self.rows])
        return np.asarray(power & ~dark)


def run(keep: Keep, *, seasons: Sequence[Season] | None = None) -> Report:
    """Run the seasons and judge."""
    seasons = seasons or (Season("without", plate=False), Season("with", plate=True))
    outcomes = {}
    with progress(None, "field") as steps:
        for season in seasons:
            outcomes[season.name] = run_season(season, keep, steps.next)
    return report(outcomes)


def report(outcomes: Mapping[str, Mapping[str, Any]]) -> Report:
    """Write the page."""
    records = {name: Record.of(outcome) for name, outcome in outcomes.items()}
    with_plate, without = records["with"], records["without"]
    rms_mm, share = _rms(with_plate.error_mm[with_plate.good]), _within(without)
    complete = min(_complete(record) for record in records.values())
    claims = [
        Claim(
            f"with the fixed plate good rows are within {LIMIT_MM} mm rms: {rms_mm:.4f} mm",
            rms_mm <= LIMIT_MM,
        ),
        Claim(
            f"without it sigma is honest: {share:.0%} of good rows' errors are within 1 sigma",
            HONEST[0] <= share <= HONEST[1],
        ),
        Claim(
            f"of the powered, lit slots {complete:.0%} have a row",
            complete == 1.0,
        ),
    ]
    names = {"without": "without a fixed plate", "with": "with a fixed plate"}
    rows = [_row(names[name], record) for name, record in records.items()]
    tables = {
        "errors": Table(_COLUMNS, tuple(rows)),
        "history": Table(_HISTORY_COLUMNS, tuple(_history(with_plate, without))),
        "gaps": Table(("from", "to", "slots", "cause"), tuple(_gaps(outcomes["with"]))),
    }
    text = Path(__file__).with_suffix(".md").read_text(encoding="utf-8")
    for name in ("without", "with"):
        text = text.replace("{datum " + name + "}", outcomes[name]["datum"].strip())
    figures = {
        "field-motion.png": partial(draw_motion, with_plate),
        "field-displacement.png": partial(draw_displacement, records),
        "field-errors.png": partial(draw_errors, records),
    }
    return Report("field", "Field", text, tables, claims, figures)


_COLUMNS = (
    *("", "rows", "good", "raw error, largest mm", "good rows, rms mm", "largest mm"),
    *("sigma, median mm", "within 1 sigma", "within 2 sigma"),
)
_HISTORY_COLUMNS = (
    *("days", "what", "slots", "good", "suspect", "withheld", "missing"),
    *("rms with mm", "rms without mm"),
)
_HISTORY = (
    ("41 to 45", 41.0, 45.0, "nights without light, low sun until the tent"),
    ("45 to 60", 45.0, 60.0, "no power"),
    ("60 to 64", 60.0, 64.0, "nights without light"),
    ("64 to 78", 64.0, 78.0, "lit; snow on five days or so"),
    ("78 to 95", 78.0, 95.0, "nothing"),
    ("95 to 120.5", 95.0, 120.5, "slab cast, -6.5 mm; creep; rain"),
    ("120.5 to 173", 120.5, 173.0, "calibrated again; creep; rain"),
    ("173 to 186", 173.0, 186.0, "insects on days 173, 178, 183, 184"),
)


def _row(name: str, record: Record) -> tuple[str, ...]:
    good, error = record.good, record.error_mm
    raw = np.hypot(*(record.pair("raw_{}_mm") - record.true_mm)[record.good].T)
    sigma = record.pair("sigma_{}_mm")[good]
    return (
        *(name, str(int(record.taken.sum())), str(int(good.sum())), f"{raw.max():.1f}"),
        *(f"{_rms(error[good]):.4f}", f"{np.hypot(*error[good].T).max():.4f}"),
        *(f"{np.median(sigma):.4f}", f"{_within(record):.0%}", f"{_within(record, 2.0):.0%}"),
    )


def _history(with_plate: Record, without: Record) -> list[tuple[str, ...]]:
    rows = []
    for days, first, end, what in _HISTORY:
        inside = (with_plate.days >= first) & (with_plate.days < end)
        flags = [row["flag"] for row, take in zip(with_plate.rows, inside, strict=True) if take]
        counts = [str(sum(flag == wanted for flag in flags)) for wanted in "1349"]
        errors = []
        for record in (with_plate, without):
            chosen = (record.days >= first) & (record.days < end) & record.good
            errors.append(f"{_rms(record.error_mm[chosen]):.4f}" if chosen.any() else "")
        if inside.any():
            rows.append((days, what, str(len(flags)), *counts, *errors))
    return rows


def _gaps(outcome: Mapping[str, Any]) -> list[tuple[str, ...]]:
    return [
        (gap["start_utc"], gap["end_utc"], str(gap["slots"]), gap["cause"])
        for gap in outcome["gaps"]["gaps"]
    ]


def _rms(error_mm: FloatArray) -> float:
    return float(np.sqrt(np.mean((error_mm**2).sum(axis=1))))


def _within(record: Record, sigmas: float = 1.0) -> float:
    good = record.good
    return float((np.abs(record.error_mm[good]) < sigmas * record.pair("sigma_{}_mm")[good]).mean())


def _complete(record: Record) -> float:
    return float(record.taken[record.powered_and_lit].mean())


# ------------------------------------------------------------------------------------- figures


def _marked(panels: Any) -> None:
    """Shade what the season brought; the axis is in the paper's days."""
    spans = ((POWER_FAILS, POWER_BACK, "no power"), (LIGHTING, 78.0, "snow"))
    for panel in panels:
        for first, end, _ in spans:
            panel.axvspan(first, end, color="0.9", linewidth=0)
        panel.axvline(95.0, color="0.5", linewidth=0.8, linestyle=":")
        panel.axvline(120.5, color="0.5", linewidth=0.8, linestyle="--")
        panel.grid(alpha=0.25, linewidth=0.5)
        panel.legend(loc="upper left", bbox_to_anchor=(1.005, 1.0), fontsize=8, frameon=False)
    for first, _, name in spans:
        panels[0].annotate(name, (first, 1.0), xycoords=("data", "axes fraction"), fontsize=7)
    panels[0].annotate("slab cast", (95.0, 1.0), xycoords=("data", "axes fraction"), fontsize=7)
    panels[0].annotate("calibrated", (120.5, 1.0), xycoords=("data", "axes fraction"), fontsize=7)
    panels[-1].set_xlabel("day")


def draw_motion(record: Record, output: Path) -> None:
    """The rig's motion and what the main camera alone sees, as the paper's Fig. 14 and 15."""
    figure, panels = new_figure(11.0, 8.0, rows=3, sharex=True)
    for axis, colour in zip("xyz", COLOURS, strict=False):
        turn_mrad = 1e3 * record.column(f"r{axis}_rad")
        panels[0].plot(record.days, turn_mrad, ".-", color=colour, linewidth=0.8, label=axis)
        shift_mm = record.column(f"t{axis}_mm")
        panels[1].plot(record.days, shift_mm, ".-", color=colour, linewidth=0.8, label=axis)
    raw = record.pair("raw_{}_mm")
    for column, name in enumerate("xy"):
        colour = COLOURS[column]
        panels[2].plot(record.days, raw[:, column], ".-", color=colour, linewidth=0.8, label=name)
    labels = ("turn of the rig (mrad)", "shift of the rig (mm)", "main camera alone (mm)")
    for panel, label in zip(panels, labels, strict=True):
        panel.set_ylabel(label)
    _marked(panels)
    figure.savefig(output, dpi=100)


def draw_displacement(records: Mapping[str, Record], output: Path) -> None:
    """Corrected displacement with the LiDAR over it, as the paper's Fig. 17 and 18."""
    figure, panels = new_figure(11.0, 7.0, rows=2)
    days, lidar_mm = lidar(records["with"])
    for panel in panels:
        true = records["with"]
        panel.plot(true.days, true.true_mm[:, 1], color=COLOURS[2], linewidth=0.8, label="true")
        for (name, record), colour in zip(records.items(), COLOURS, strict=False):
            y_mm, flags = record.pair("{}_mm")[:, 1], record.good
            label = f"{name} a fixed plate"
            panel.plot(record.days[flags], y_mm[flags], ".", color=colour, label=label)
        error = {"yerr": LIDAR_MM, "fmt": "D", "color": "black", "markersize": 3}
        panel.errorbar(days, lidar_mm, **error, linewidth=0.8, label="LiDAR, weekly")
        panel.set_ylabel("vertical displacement (mm)")
    _marked(panels)
    panels[1].set_xlim(88.0, 104.0)
    figure.savefig(output, dpi=100)


def lidar(record: Record) -> tuple[FloatArray, FloatArray]:
    """Weekly readings of the true vertical displacement, with their noise: days and mm."""
    wanted = np.arange(FIRST_DAY + 1.0, record.days[-1], LIDAR_DAYS)
    nearest = np.abs(record.days[None] - wanted[:, None]).argmin(axis=1)
    noise_mm = LIDAR_MM * np.random.default_rng(LIDAR_SEED).standard_normal(len(wanted))
    return record.days[nearest], record.true_mm[nearest, 1] + noise_mm


def draw_errors(records: Mapping[str, Record], output: Path) -> None:
    """Errors against the truth, with their sigma."""
    figure, panels = new_figure(11.0, 8.0, rows=3, sharex=True)
    for panel, (name, record), colour in zip(panels[:2], records.items(), COLOURS, strict=False):
        good = record.good
        sigma_mm = record.pair("sigma_{}_mm")[good]
        for column, mark in ((1, "."), (0, "x")):
            error_mm, label = record.error_mm[good][:, column], f"{name} a plate, {'xy'[column]}"
            alpha = 1.0 if column else 0.5
            panel.plot(record.days[good], error_mm, mark, color=colour, alpha=alpha, label=label)
        band = {"color": colour, "alpha": 0.15, "linewidth": 0, "label": "± 1 sigma, y"}
        panel.fill_between(record.days[good], -sigma_mm[:, 1], sigma_mm[:, 1], **band)
        panel.set_ylabel("error (mm)")
    warm_c = [row["main_c"] for row in records["with"].rows]
    panels[2].plot(records["with"].days, warm_c, ".-", color=COLOURS[2], label="main camera")
    panels[2].set_ylabel("temperature (°C)")
    _marked(panels)
    figure.savefig(output, dpi=100)
