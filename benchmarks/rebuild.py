"""Rows of a record made once more from their frames: `python -m benchmarks.rebuild`.

The real `dcamd` on a small simulated site on a stepped clock, through twenty hours in which
happens what happens to a record: a fixed target that is hidden at times, and what it taught that
begins to count at midnight; insects; a second calibration; a gap; several pairs a slot. Then
`dcam-ctl verify --rebuild` of 1,000 rows at random. Ends with 1 if any row comes out otherwise,
or if there were fewer.

With `--wrong-clock` also pairs taken under a wrong clock, which get their slots later and are
measured again as of their true times: no exception is made of them.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections import Counter
from datetime import UTC, datetime, timedelta
from pathlib import Path

from benchmarks.reprocess import PLATE, SMALL, arguments, dcam_ctl
from daemon.store.database import open_store_readonly
from daemon.times import slot_text

REBUILT = 1000
DONE = "record-is-whole"
MINUTE = timedelta(minutes=1)
BEGIN = datetime(2026, 3, 1, 10, tzinfo=UTC)
SECOND_AT = BEGIN + 560 * MINUTE
"""Of the second calibration."""
CUT_AT, WRONG_SLOTS = BEGIN + 940 * MINUTE, 30
"""When the gap begins, and for how many slots dcamd runs under a wrong clock then."""
BURSTS_AT = CUT_AT + 45 * MINUTE
LAST_AT, END = BURSTS_AT + 60 * MINUTE, BURSTS_AT + 270 * MINUTE
BURST = "[schedule]\nburst = 2\nburst_spacing_s = 2.0\n"
HISTORY = """
[simulation]
seed = 11
start_utc = {start}
clock = "stepped"
{clock}

[[simulation.plates]]
name = "abutment"
offset_mm = [53.0, 0.0]
hidden_min = [[200.0, 260.0], [880.0, 930.0]]

[[simulation.scenarios]]
kind = "drift"

[[simulation.scenarios]]
kind = "bridge"

[[simulation.scenarios]]
kind = "insect_main"
start_min = 300
end_min = 330

[simulation.climate]
air_daily_k = 12.0

[simulation.breathing]
cameras_urad_per_k = [2.0, 3.0, 0.0]
"""
WHERE_THE_PLATE_IS = "position_px = [403, 150]\n"


def main() -> int:
    """Run dcamd, rebuild, and say what came of it."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.rebuild", description=__doc__)
    parser.add_argument("--rows", type=int, default=REBUILT)
    parser.add_argument("--directory", type=Path, help="where the record is, or is to be made")
    parser.add_argument("--wrong-clock", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="dcam-rebuild-") as scratch:
        directory = options.directory or Path(scratch)
        directory.mkdir(parents=True, exist_ok=True)
        if not (directory / "state").is_dir():
            make_record(directory, wrong_clock=options.wrong_clock)
        elif not (directory / DONE).exists():
            parser.error(f"{directory}: its record was cut; remove it, or give another directory")
        for name, count in conditions(directory / "state").items():
            print(f"{count:5d} {name}")
        words = arguments(directory, "verify", "--rebuild", options.rows, "--json")
        ran = subprocess.run(words, stdout=subprocess.PIPE, text=True, check=False)
    document = json.loads(ran.stdout)
    for finding in document["findings"]:
        print(finding["where"], finding["text"])
    rebuilt, findings = document["rebuilt"]["rows"], len(document["findings"])
    print(f"{rebuilt} of {options.rows} rows made once more, {findings} findings")
    return int(findings > 0 or rebuilt < options.rows)


def make_record(directory: Path, *, wrong_clock: bool) -> None:
    """Calibrate with the simulated head, and let dcamd run, twice; the rest of its history."""
    for begin_utc, until_utc in ((BEGIN, SECOND_AT), (SECOND_AT, CUT_AT)):
        configure(directory, start_utc=begin_utc)  # half an hour before the rig is at rest
        dcam_ctl(directory, "calibrate", "--pan-tilt", "--accept")
        configure(directory)
        run_until(directory, until_utc)
    if wrong_clock:
        configure(directory, clock_utc=BEGIN)
        run_dcamd(directory, WRONG_SLOTS)
    configure(directory, schedule=BURST, clock_utc=BURSTS_AT)
    run_until(directory, LAST_AT, since_utc=BURSTS_AT)
    if wrong_clock:
        shift_s = (CUT_AT + 5 * MINUTE - BEGIN).total_seconds()
        dcam_ctl(directory, "redate", "--boot", "this", "--shift", shift_s)
    configure(directory)
    run_until(directory, END)
    (directory / DONE).touch()


def configure(
    directory: Path,
    schedule: str = "",
    clock_utc: datetime | None = None,
    start_utc: datetime = BEGIN,
) -> None:
    """Write the config: the site is always the same, its clock and its schedule are not."""
    clock = "" if clock_utc is None else f"clock_start_utc = {slot_text(clock_utc)}"
    history = HISTORY.format(start=slot_text(start_utc), clock=clock)
    site = SMALL.read_text() + PLATE + WHERE_THE_PLATE_IS
    (directory / "dcam.toml").write_text(f"{site}\n{schedule}{history}")


def run_until(directory: Path, until_utc: datetime, since_utc: datetime | None = None) -> None:
    """Let dcamd run from the end of the record, or from when its clock begins."""
    if since_utc is None:
        with open_store_readonly(directory / "state") as store:
            last_utc = store.last_slot()
        since_utc = BEGIN if last_utc is None else last_utc
    run_dcamd(directory, round((until_utc - since_utc) / MINUTE))


def run_dcamd(directory: Path, slots: int) -> None:
    """Let dcamd run for so many slots."""
    site = ("--config", directory / "dcam.toml", "--state", directory / "state")
    words = [sys.executable, "-m", "daemon.main", *map(str, site), "--max-slots", str(slots)]
    with (directory / "dcamd.log").open("a") as log:
        subprocess.run(words, stderr=log, check=True)


def conditions(state: Path) -> dict[str, int]:
    """How many rows there are of each flag, reason and calibration, and of what else happened."""
    counts: Counter[str] = Counter()
    with open_store_readonly(state) as store:
        for row in store.measurements():
            counts["rows"] += 1
            counts[row.measurement.flag.name.lower()] += 1
            counts.update(reason.value for reason in row.measurement.reasons)
            counts[f"of calibration {row.calibration_id}"] += 1
            counts["with a closure"] += row.measurement.closure is not None
            counts["of two pairs"] += row.measurement.frames_used > 1
            dated = row.redated_from_utc is not None
            counts["of a wrong clock, dated later"] += dated
            counts["of these measured again"] += dated and row.recorded_late
    return dict(counts)


if __name__ == "__main__":
    sys.exit(main())
