"""`dcam-ctl demo`: the whole system on a simulated rig, judged against the known truth."""

from __future__ import annotations

import math
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np

from core.arrays import FloatArray
from core.calibration.calibrate import Method
from core.results import Displacement, Flag
from daemon.alarm.armed import all_items
from daemon.commands.calibrate_head import calibrate_with_head
from daemon.commands.calibrate_result import judge_and_store
from daemon.commands.demo_season import DAYS, season
from daemon.commands.gaps import print_gaps
from daemon.commands.options import common_options
from daemon.commands.output import note, print_table, progress, say
from daemon.commands.status_here import print_status
from daemon.config.reading import Installation, find_installation
from daemon.devices import open_clock, open_simulated_rig
from daemon.errors import UsageError, WorkFailedError
from daemon.reports.figure import draw
from daemon.reports.history import gap_spans
from daemon.reports.series import series_of
from daemon.status.coverage import coverage_text
from daemon.status.facts import collect_facts
from daemon.store.database import Store, open_store, open_store_readonly
from daemon.store.records import GapRecord, MeasurementRecord
from daemon.text import span_text
from drivers.errors import MissingLibraryError
from drivers.libraries import require_library

SLOTS = 72
"""A day of the demo's schedule."""
SITE = Path(__file__).parents[1] / "demo.toml"
CONFIG, LOG, FIGURE = "dcam.toml", "dcamd.log", "demo.png"
SEASON, SEASON_FIGURE = "season", "season.png"


@click.command("demo", epilog="\b\nExample:\n  dcam-ctl demo --output /tmp/dcam-demo")
@click.option(
    "--output",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Where everything goes, an earlier demo there is replaced; default: a new directory in "
    "the temporary one.",
)
@common_options
def command(output: Path | None) -> None:
    """Calibrate, run dcamd for a day of 72 slots, then a season; compare with the truth.

    It takes a few minutes.

    The rig is simulated, 22 m from its target: it drifts, the bridge moves, a camera is lost for
    a while, insects sit on the targets, it snows, night comes. Everything else is the real
    thing: the commands, the daemon, the database.
    """
    has_figure = can_draw()
    directory = prepared(output)
    site = find_installation(directory / CONFIG, directory / "state")
    say(f"1. Calibration with the pan-tilt head, {site.config.name} site in {directory}")
    run, taken_utc = calibrate_with_head(
        site.config, site.state_directory, Method.RIGID, fresh=True
    )
    with open_store(site.state_directory) as store:
        judge_and_store(
            site.config, store, run, taken_utc, accept=True, as_json=False, keeps_page=True
        )
    say(f"\n2. dcamd, {SLOTS} slots, {span_text(site.config.schedule.period_s)} apart")
    run_dcamd(site, directory / LOG)
    with open_store_readonly(site.state_directory) as store:
        tell(site, store, directory / FIGURE if has_figure else None)
    say(f"\n8. The same rig for {DAYS:g} days on steel that bends, without and with a fixed target")
    season(
        SITE.read_text(encoding="utf-8"),
        directory / SEASON,
        directory / SEASON_FIGURE if has_figure else None,
    )
    say(f"\nLook around: dcam-ctl --config {site.config_path} export")


def can_draw() -> bool:
    """Tell whether a figure can be had; if not, say on stderr how to change that."""
    try:
        require_library("matplotlib", "figure")
    except MissingLibraryError as error:
        note(f"warning: {error}")
        return False
    return True


def prepared(output: Path | None) -> Path:
    """Make the directory and put the config there. Raises UsageError for one that is in use."""
    if output is None:
        output = Path(tempfile.mkdtemp(prefix="dcam-demo-"))
    elif output.exists() and any(output.iterdir()):
        written = output / CONFIG
        if not written.is_file() or written.read_bytes() != SITE.read_bytes():
            msg = f"{output}: holds something else than a demo; give an empty or a new directory"
            raise UsageError(msg)
        for earlier in ("state", SEASON):
            shutil.rmtree(output / earlier, ignore_errors=True)
    output.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(SITE, output / CONFIG)
    return output


def run_dcamd(site: Installation, log: Path) -> None:
    """Run the daemon as a program of its own. Raises WorkFailedError when it fails."""
    arguments = [
        *(sys.executable, "-m", "daemon.main", "--max-slots", str(SLOTS)),
        *("--config", str(site.config_path), "--state", str(site.state_directory)),
    ]
    with (
        log.open("w", encoding="utf-8") as file,
        progress(SLOTS, "running dcamd") as steps,
        subprocess.Popen(  # noqa: S603 - our own program, no shell
            arguments, stderr=subprocess.PIPE, text=True
        ) as dcamd,
    ):
        for line in dcamd.stderr or ():
            file.write(line)
            if slot := re.search(r"event=slot_(?:done|missed) slot=(\S+)", line):
                steps.next(f"slot {slot[1]}")
    if dcamd.returncode != 0:
        msg = f"dcamd ended with code {dcamd.returncode}; {log} tells why"
        raise WorkFailedError(msg)


@dataclass(frozen=True, slots=True)
class Errors:
    """How far values were from the truth, in the plane of the target."""

    name: str
    rows: int
    max_mm: float
    rms_mm: float


def tell(site: Installation, store: Store, figure: Path | None) -> None:
    """Print status, coverage, gaps and errors, and draw the figure.

    Raises WorkFailedError when a slot is unaccounted for or the corrected values are no good.
    """
    rows, gaps = list(store.measurements()), store.gaps()
    facts = collect_facts(site.config, site.state_directory, rows[-1].slot_utc)
    say("\n3. dcam-ctl status, at the last slot")
    print_status(facts, all_items(site.config, site.state_directory, facts))
    say(f"\n4. Coverage: {coverage_text(facts.coverage_24h)}")
    say("\n5. dcam-ctl gaps")
    print_gaps(gaps)
    true_mm = truth_mm(site, rows)
    errors = errors_of(rows, true_mm)
    say("\n6. Error against the simulator's truth, length of (x, y), mm")
    print_table(
        ("", "rows", "max", "rms"),
        [(e.name, str(e.rows), f"{e.max_mm:.3f}", f"{e.rms_mm:.3f}") for e in errors],
    )
    say(
        f"{within_sigma(rows, true_mm):.0%} of the corrected x and y are within 1 sigma by pixels "
        "and calibration (the steel of this rig does not bend)"
    )
    if figure is not None:
        draw_figure(rows, gaps, true_mm, figure)
        say(f"\n7. Figure: {figure}")
    _require_success(facts.coverage_24h.unaccounted, errors)


def truth_mm(site: Installation, rows: Sequence[MeasurementRecord]) -> FloatArray:
    """The true displacement (n, 2) in each row's slot; only the simulation knows it."""
    rig = open_simulated_rig(site.config, open_clock(site.config))
    with closing(rig.source):
        true = [rig.world.truth(row.slot_utc).displacement_mm for row in rows]
    return np.array(true, dtype=np.float64).reshape(-1, 2)


def errors_of(rows: Sequence[MeasurementRecord], true_mm: FloatArray) -> list[Errors]:
    """Errors of the main camera alone, and of the corrected values by their flags."""
    series = series_of([(row.slot_utc, row.measurement) for row in rows])
    good = np.array([row.measurement.flag is Flag.GOOD for row in rows])
    return [
        _errors("raw", series.raw_mm - true_mm),
        _errors("corrected", series.corrected_mm - true_mm),
        _errors("corrected, flag good", (series.corrected_mm - true_mm)[good]),
    ]


def _errors(name: str, error_mm: FloatArray) -> Errors:
    length_mm = np.linalg.norm(error_mm[np.isfinite(error_mm).all(axis=1)], axis=1)
    if not len(length_mm):
        return Errors(name, 0, math.nan, math.nan)
    rms_mm = float(np.sqrt(np.mean(length_mm**2)))
    return Errors(name, len(length_mm), float(length_mm.max()), rms_mm)


def within_sigma(rows: Sequence[MeasurementRecord], true_mm: FloatArray) -> float:
    """Share of corrected coordinates whose error is below their sigma by pixels and calibration.

    Two thirds is honest.
    """
    series = series_of([(row.slot_utc, row.measurement) for row in rows])
    sigma_mm = [_image_sigma_mm(row.measurement.corrected) for row in rows]
    ratio = np.abs(series.corrected_mm - true_mm) / np.array(sigma_mm)
    return float(np.mean(ratio[np.isfinite(ratio)] < 1.0))


def _image_sigma_mm(corrected: Displacement | None) -> FloatArray:
    """(2,) 1 sigma by pixels and calibration; nan without a value."""
    if corrected is None:
        return np.full(2, np.nan)
    return np.asarray(np.sqrt(np.diag(corrected.by_image_mm2)))


def draw_figure(
    rows: Sequence[MeasurementRecord],
    gaps: Sequence[GapRecord],
    true_mm: FloatArray,
    path: Path,
) -> None:
    """Draw raw, corrected and true displacement, its error, and the rig's motion."""
    series = series_of([(row.slot_utc, row.measurement) for row in rows], true_mm)
    draw(
        series, gap_spans(gaps), "Simulated rig 22 m from its target: raw, corrected and true", path
    )


def _require_success(unaccounted: int, errors: Sequence[Errors]) -> None:
    raw, corrected = errors[0], errors[1]
    if unaccounted:
        msg = f"{unaccounted} slots have neither row nor gap"
        raise WorkFailedError(msg)
    if not corrected.rms_mm < 0.1 * raw.rms_mm:
        msg = f"corrected values are {corrected.rms_mm:.3f} mm rms off, raw ones {raw.rms_mm:.3f}"
        raise WorkFailedError(msg)
