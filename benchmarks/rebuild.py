"""Rows of a record made once more from their frames: `python -m benchmarks.rebuild`.

The real `dcamd` on a small simulated site on a stepped clock, through most of a day with a
midnight, at which what its fixed target taught begins to count; then `dcam-ctl verify --rebuild`.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

from benchmarks.reprocess import PLATE, SMALL, arguments, dcam_ctl
from daemon.store.database import open_store_readonly

SLOTS, REBUILT = 1300, 1000
DONE = "record-is-whole"
HISTORY = """
[simulation]
seed = 11
start_utc = 2026-03-01T10:00:00Z
clock = "stepped"

[[simulation.plates]]
name = "abutment"
offset_mm = [53.0, 0.0]
hidden_min = [[200.0, 260.0], [900.0, 1100.0]]

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


def main() -> None:
    """Run dcamd, rebuild, and say what came of it."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.rebuild", description=__doc__)
    parser.add_argument("--slots", type=int, default=SLOTS)
    parser.add_argument("--rows", type=int, default=REBUILT)
    parser.add_argument("--directory", type=Path, help="where the record is, or is to be made")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="dcam-rebuild-") as scratch:
        directory = options.directory or Path(scratch)
        directory.mkdir(parents=True, exist_ok=True)
        if not (directory / "state").is_dir():
            make_record(directory, options.slots)
        elif not (directory / DONE).exists():
            parser.error(f"{directory}: its record was cut; remove it, or give another directory")
        print(flags(directory / "state"))
        words = arguments(directory, "verify", "--rebuild", options.rows, "--json")
        ran = subprocess.run(words, stdout=subprocess.PIPE, text=True, check=False)
    document = json.loads(ran.stdout)
    print(document["rebuilt"])
    for finding in document["findings"]:
        print(finding["where"], finding["text"])
    print(len(document["findings"]), "findings")


def make_record(directory: Path, slots: int) -> None:
    """Calibrate with the simulated head, and let dcamd run."""
    (directory / "dcam.toml").write_text(SMALL.read_text() + PLATE + HISTORY)
    dcam_ctl(directory, "calibrate", "--pan-tilt", "--accept")
    site = ("--config", directory / "dcam.toml", "--state", directory / "state")
    words = [sys.executable, "-m", "daemon.main", *map(str, site), "--max-slots", str(slots)]
    with (directory / "dcamd.log").open("w") as log:
        subprocess.run(words, stderr=log, check=True)
    (directory / DONE).touch()


def flags(state: Path) -> dict[str, int]:
    """How many rows there are of each flag and reason, and how many with what was learnt."""
    counts: Counter[str] = Counter()
    with open_store_readonly(state) as store:
        for row in store.measurements():
            counts[row.measurement.flag.name.lower()] += 1
            counts.update(reason.value for reason in row.measurement.reasons)
            counts["with a closure"] += row.measurement.closure is not None
    return dict(counts)


if __name__ == "__main__":
    main()
