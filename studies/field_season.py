"""The season of the field study, through the real programs on a stepped clock."""

from __future__ import annotations

import csv
import io
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from daemon.config.reading import load_config
from daemon.schedule import Schedule
from drivers.sim.frameset_writer import MINUTE, calibration_views, head_positions_deg, write_views
from drivers.sim.settings import ScenarioKind
from drivers.sim.world import World
from studies.keep import Keep

HERE = Path(__file__).parent
FIRST_DAY, LAST_DAY = 41.0, 186.0
"""Days of the paper's record; the last one ends at its midnight."""
POWER_FAILS, POWER_BACK, LIGHTING, RECALIBRATED = 45.0, 60.0, 64.0, 120.5
TENT_DAY = 44.0
CAST_DAY, CAST_MM, CREEP_MM = 95.0, -6.5, -8.0
SNOW = ((64.0, 65.0), (66.3, 67.3), (70.0, 72.0), (73.4, 74.4), (77.0, 78.0))
RAIN = ((101, 102), (112, 114), (126, 127), (139.5, 140.5), (151, 152), (160, 162), (170, 171))
INSECTS: tuple[tuple[float, ScenarioKind], ...] = (
    *((173.0, "insect_main"), (178.0, "insect_sub")),
    *((183.0, "insect_main"), (184.0, "insect_main")),
)
DUSK_H, DAWN_H = 17.0, 7.0
LENS_VIEWS, RIG_VIEWS = 12, 15
TALK = Callable[[str], None]


def minute_of(day: float) -> float:
    """Minutes after the start of the simulation, which is the morning of day 41."""
    return round((day - FIRST_DAY) * 1440.0, 1)


def history() -> str:
    """What happens in the season, as tables of the config."""
    events: list[tuple[str, float, float | None, str | None]] = [
        ("drift", FIRST_DAY, None, None),
        ("bridge", FIRST_DAY, None, None),
        *(("snow", *span, "main") for span in SNOW),
        *(("rain", *span, None) for span in RAIN),
        *((kind, day, day + 0.99, None) for day, kind in INSECTS),
    ]
    for day in range(int(FIRST_DAY) - 1, int(LIGHTING)):
        begin = max(day + DUSK_H / 24.0, FIRST_DAY)
        events.append(("night", begin, day + 1 + DAWN_H / 24.0, None))
    events += [  # low sun, until the tent is up
        ("glare", day + 9.0 / 24.0, day + 15.0 / 24.0, "sub")
        for day in range(int(FIRST_DAY), int(TENT_DAY))
    ]
    lines = []
    for kind, first, end, role in events:
        lines += ["[[simulation.scenarios]]", f'kind = "{kind}"', f"start_min = {minute_of(first)}"]
        lines += [] if end is None else [f"end_min = {minute_of(end)}"]
        lines += ["", ""] if role is None else [f'role = "{role}"', ""]
    return "\n".join(lines)


def course() -> str:
    """The bridge's course besides days and traffic: a slab is cast within hours, then it creeps."""
    days = np.linspace(0.0, 90.0, 19)
    creep_mm = CREEP_MM * np.log1p(days / 15.0) / np.log1p(90.0 / 15.0)
    points = [[0.0, 0.0], [minute_of(CAST_DAY), 0.0]]
    points += [
        [minute_of(CAST_DAY + 0.25 + float(day)), round(CAST_MM + float(mm), 4)]
        for day, mm in zip(days, creep_mm, strict=True)
    ]
    return f"bridge_course = {points}"


@dataclass(frozen=True, slots=True)
class Season:
    """One run of the season: with or without the fixed plate."""

    name: str
    plate: bool
    days: tuple[float, ...] = (FIRST_DAY, POWER_FAILS, POWER_BACK, RECALIBRATED, LAST_DAY)
    """Between each two the daemon runs, but for the second span: no power."""
    calibrations: tuple[float, ...] = (FIRST_DAY, RECALIBRATED)

    def write_config(self, directory: Path, clock_day: float | None = None) -> Path:
        """Write the config; the stepped clock begins at a day, or where the record ends."""
        text = (HERE / "field.toml").read_text(encoding="utf-8")
        clock = "" if clock_day is None else f'clock_start_utc = "{_iso(self.utc(clock_day))}"\n'
        text = text.replace("seed = 41\n", f"seed = 41\n{course()}\n{clock}")
        if self.plate:
            text += (HERE / "field_plate.toml").read_text(encoding="utf-8")
        path = directory / "dcam.toml"
        path.write_text(f"{text}\n{history()}", encoding="utf-8")
        return path

    def utc(self, day: float) -> datetime:
        """The instant of a day of the paper's count."""
        return START_UTC + timedelta(minutes=minute_of(day))


START_UTC = datetime.fromisoformat("2026-01-10T00:00:00+00:00")


def run_season(season: Season, keep: Keep, talk: TALK) -> dict[str, Any]:
    """Run the season part by part; each part goes on from the state that the one before left."""
    state: Path | None = None
    for number, (first, end) in enumerate(pairwise(season.days)):
        if (first, end) == (POWER_FAILS, POWER_BACK):
            continue
        now = keep.directory / f"{season.name}-{number}"
        parameters = {"text": _text_of(season)}
        compute = partial(_part, season, state, now, first, end)
        talk(f"{season.name}: days {first:g} to {end:g}")
        keep.block(now.name, parameters, compute)
        state = now
    assert state is not None
    given = {"of": _text_of(season)}
    outcome: dict[str, Any] = keep.block(f"{season.name}-rows", given, partial(_outcome, state))
    return outcome


def _text_of(season: Season) -> str:
    files = ("field.toml", "field_plate.toml")
    texts = [(HERE / name).read_text(encoding="utf-8") for name in files]
    return "\n".join([*texts, course(), history(), repr(season)])


def _part(season: Season, before: Path | None, now: Path, first: float, end: float) -> list[str]:
    """Copy the state before, calibrate if that is due, run the daemon to the end of the part."""
    shutil.rmtree(now, ignore_errors=True)
    if before is None:
        now.mkdir(parents=True)
    else:
        shutil.copytree(before, now)
    said = []
    config = season.write_config(now, first)
    if first in season.calibrations:
        frames = now / f"calibration-{first:g}"
        _write_calibration(config, frames, None if before is None else season.utc(first))
        # The board stays on the pier: the second reference is measured by the first calibration.
        untouched = [] if before is None else ["--board-untouched"]
        said.append(_ctl(config, "calibrate", "--from", str(frames), "--accept", *untouched))
        shutil.rmtree(frames)
    period_s = load_config(config).schedule.period_s
    slots = len(list(slots_between(period_s, season.utc(first), season.utc(end))))
    _run([sys.executable, "-m", "daemon.main", "--config", str(config), "--max-slots", str(slots)])
    return said


def _write_calibration(config: Path, directory: Path, held_utc: datetime | None) -> None:
    """Render a calibration's views, rig and bridge standing still."""
    loaded = load_config(config)
    world = World(loaded.site(), loaded.simulation.settings())
    rng = np.random.default_rng([loaded.simulation.seed, held_utc is not None])
    anywhere = head_positions_deg(world, rng, 0.8)
    rig_deg = [next(anywhere) for _ in range(RIG_VIEWS)]
    first_utc = (held_utc or START_UTC) - (LENS_VIEWS + RIG_VIEWS + 2) * MINUTE
    world.hold_still(held_utc)
    write_views(directory, world, calibration_views(first_utc, LENS_VIEWS, rig_deg))


def _outcome(state: Path) -> dict[str, Any]:
    """Rows with their truth, gaps and zeros, from the commands' own outputs."""
    config = state / "dcam.toml"
    exported = _ctl(config, "export", "--output", "-")
    lines = "\n".join(line for line in exported.splitlines() if not line.startswith("#"))
    loaded = load_config(config)
    world = World(loaded.site(), loaded.simulation.settings(), renders=False)
    rows = []
    for row in csv.DictReader(io.StringIO(lines)):
        slot_utc = datetime.fromisoformat(row["slot_utc"])
        truth = world.truth(slot_utc)
        kept = {name: row[name] for name in row if re.search(_WANTED, name)}
        true = [float(mm) for mm in truth.displacement_mm]
        cases, warm_c = list(truth.cases), truth.temperature.main_c
        rows.append({**kept, "true_mm": true, "cases": cases, "main_c": warm_c})
    gaps = json.loads(_ctl(config, "gaps", "--json"))
    datum = _ctl(config, "datum")
    return {"rows": rows, "gaps": gaps, "datum": datum}


_WANTED = r"^(slot_utc|flag|reasons|(sigma_|raw_)?[xy]_mm|r[xyz]_rad|t[xyz]_mm|closure_[xy]_mm)$"


def _ctl(config: Path, *arguments: str) -> str:
    given = ["--config", str(config)]
    return _run([sys.executable, "-m", "daemon.ctl", *arguments[:1], *given, *arguments[1:]])


def _run(command: list[str]) -> str:
    """Give what a program wrote to stdout. Raises RuntimeError with what it said."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        msg = f"{' '.join(command[1:])}: exit code {done.returncode}\n{done.stderr[-3000:]}"
        raise RuntimeError(msg + done.stdout[-3000:])
    return done.stdout


def _iso(utc: datetime) -> str:
    return utc.strftime("%Y-%m-%dT%H:%M:%SZ")


def slots_between(period_s: int, first_utc: datetime, end_utc: datetime) -> Iterator[datetime]:
    """Slots of the schedule from an instant until before another."""
    schedule = Schedule(period_s)
    at = schedule.first_from(first_utc)
    while at < end_utc:
        yield at
        at = schedule.first_after(at)
