"""The end of `dcam-ctl demo`: a season on steel that bends, without and with a fixed target."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import numpy as np

from core.arrays import FloatArray
from core.calibration.calibrate import Method
from core.results import Displacement
from core.site import Site
from daemon.calibration.run import calibrate_frames, views_in
from daemon.commands.output import print_table, progress, say
from daemon.commands.simulate_site import season_plan, write_season_of
from daemon.config.reading import load_config
from daemon.errors import WorkFailedError
from daemon.reports.season_figure import SeasonSeries, draw_season
from daemon.reprocessing.frames import SetFrames, measure_alone
from daemon.slots.measuring import ActiveCalibration
from drivers.frameset import FrameSet, format_slot, read_frame_set

ADDED = Path(__file__).parents[1] / "demo_season.toml"
"""What is added to the demo's site."""
DAYS, ROWS = 145.0, 36
SMALLER = (("1920", "960"), ("1200\npixel", "600\npixel"), ("5.86", "11.72"))
"""Sensors of the same size with a quarter of the pixels: rendered in a quarter of the time."""
LIMIT_MM = 0.05
"""What a row with the fixed target in view must be true to, rms. Chosen: ten times what it is."""


@dataclass(frozen=True, slots=True)
class _Rig:
    """One way to measure the season, and what came of it."""

    name: str
    series: SeasonSeries


def season(site_text: str, directory: Path, figure: Path | None) -> None:
    """Render the season below an empty directory, measure it twice, print errors, draw the figure.

    Raises WorkFailedError when the fixed target does not help.
    """
    directory.mkdir(parents=True)
    text = site_text + ADDED.read_text(encoding="utf-8")
    for whole, part in SMALLER:
        text = text.replace(whole, part)
    (directory / "dcam.toml").write_text(text, encoding="utf-8")
    config = load_config(directory / "dcam.toml")
    with progress(3, "a season") as steps:
        (frames,) = write_season_of(config, directory, season_plan(DAYS, ROWS, rebond=False))
        steps.next("rendered")
        site = config.site()
        rigs = []
        for name, seen in (("without", replace(site, extra_targets=())), ("with", site)):
            rigs.append(_Rig(f"{name} a fixed target", _measured(frames, seen)))
            steps.next(name)
    print_table(
        ("", "rows", "max", "rms", "sigma at the end", "within 1 sigma"),
        [_line(rig) for rig in rigs],
    )
    if figure is not None:
        draw_season({rig.name: rig.series for rig in rigs}, figure)
        say(f"Figure: {figure}")
    error_mm = _rms(rigs[1].series.error_mm)
    if not error_mm < LIMIT_MM:
        msg = f"with the fixed target the season is {error_mm:.3f} mm rms off, above {LIMIT_MM} mm"
        raise WorkFailedError(msg)


def _measured(directory: Path, site: Site) -> SeasonSeries:
    """Calibrate on a frame set, measure its rows and compare with its truth."""
    frames = read_frame_set(directory)
    calibration = calibrate_frames(views_in(directory), site, Method.RIGID).calibration
    slots, values = [], []
    for slot in SetFrames((directory,)).slots():
        corrected = measure_alone(slot, site, ActiveCalibration(1, calibration)).corrected
        slots.append(slot.slot_utc)
        values.append(_NO_VALUE if corrected is None else _value(corrected))
    mm, sigma_mm = np.moveaxis(np.array(values), 1, 0)
    return SeasonSeries(slots, mm, sigma_mm, _true_mm(directory, slots), _camera_c(frames))


_NO_VALUE = np.full((2, 2), np.nan)


def _value(corrected: Displacement) -> FloatArray:
    """The displacement and below it its sigma, (2, 2)."""
    return np.array([corrected.mm, np.sqrt(np.diag(corrected.covariance_mm2))])


def _true_mm(directory: Path, slots: Sequence[datetime]) -> FloatArray:
    """(n, 2), from the table that the simulation writes."""
    with (directory / "truth.csv").open(newline="", encoding="utf-8") as table:
        true = {row["slot_utc"]: (row["x_mm"], row["y_mm"]) for row in csv.DictReader(table)}
    return np.array([true[format_slot(slot)] for slot in slots], dtype=np.float64)


def _camera_c(frames: FrameSet) -> FloatArray:
    """(n,) temperature of the main camera at the measure rows."""
    warm = [row.main_temperature_c for row in frames.rows_of("measure")]
    return np.array(warm, dtype=np.float64)


def _line(rig: _Rig) -> tuple[str, ...]:
    series = rig.series
    length_mm = np.linalg.norm(series.error_mm, axis=1)
    within = np.abs(series.error_mm) < series.sigma_mm
    return (
        rig.name,
        str(int(np.isfinite(length_mm).sum())),
        f"{np.nanmax(length_mm):.3f}",
        f"{_rms(series.error_mm):.3f}",
        f"{series.sigma_mm[-1].max():.3f}",
        f"{within[np.isfinite(length_mm)].mean():.0%}",
    )


def _rms(error_mm: FloatArray) -> float:
    """Of the lengths of the errors (n, 2) that are known; mm."""
    return float(np.sqrt(np.nanmean((error_mm**2).sum(axis=1))))
