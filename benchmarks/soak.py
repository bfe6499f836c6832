"""Months of slots in accelerated time: `python -m benchmarks.soak --days 145`.

The real `dcamd` on a small simulated site, with nights, snow, insects, lost cameras, calibrations
and a power failure of two weeks: it is killed without a stop, and comes back in another boot.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from datetime import datetime, timedelta
from pathlib import Path

from benchmarks.memory import resident_mb
from benchmarks.soak_history import START_UTC, History
from daemon.control.control_socket import paused_daemon
from daemon.store.database import Store, open_store_readonly
from daemon.store.records import GapCause

PAUSED_SLOTS = 20
"""At least so many slots pass during a calibration."""
SETTLED_DAYS = 2
"""By then every kind of weather has been, or nearly, and every cache has been filled once."""
STATUS_RUNS = 5
FAIR_MIN = 10
"""How long the same image is shown on end in fair weather."""
TWENTY_YEARS = timedelta(days=20 * 365.25)


@dataclass
class Life:
    """One run of `dcamd`, from its start to its end."""

    rows: set[datetime] = field(default_factory=set)
    """Slots that were acknowledged."""
    memory_mb: list[float] = field(default_factory=list)
    """Resident memory at the end of each day."""


@dataclass(frozen=True, slots=True)
class Result:
    """What the soak showed."""

    days: int
    slots: int
    powered: int
    rows: int
    flags: dict[str, int]
    gaps: dict[str, int]
    """Slots without a row, by cause."""
    wrong: list[str]
    """What is not as it must be; empty when all is well."""
    memory_mb: list[list[float]]
    """Of each life: after SETTLED_DAYS, the most after that, at its end."""
    status_s: float
    status_cpu_s: float
    database_mb: float
    database_20_years_gb: float
    frames_mb: float
    cpu_ms_per_slot: float
    hours: float

    @property
    def growth_mb(self) -> float:
        """Memory beyond what it was once settled, in the worst of the lives."""
        return max((most - settled for settled, most, _ in self.memory_mb), default=0.0)


class Site:
    """The simulated site and the processes that run it."""

    def __init__(
        self, directory: Path, history: History, measure_every: int, fair_min: int
    ) -> None:
        self.state = directory / "state"
        self._config = directory / "dcam.toml"
        self._history = history
        self._looks = [str(measure_every), str(fair_min)]
        self._options = ["--config", str(self._config), "--state", str(self.state)]

    def calibrate(self) -> None:
        """Calibrate the site at rest, before the first slot."""
        self._configure(START_UTC)
        self.ctl("calibrate", "--pan-tilt", "--accept")

    def ctl(self, *arguments: str) -> int:
        """Run `dcam-ctl`; give its exit code. Raises RuntimeError when it fails."""
        command = [sys.executable, "-m", "daemon.ctl", *self._options, *arguments]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode and arguments[0] != "status":
            raise RuntimeError(done.stderr)
        return done.returncode

    def live(self, boot_id: str, begin_utc: datetime, end_utc: datetime, *, cut: bool) -> Life:
        """Run `dcamd` until a slot is reached, and cut its power there, or let it end."""
        self._configure(begin_utc)
        command = [sys.executable, "-m", "benchmarks.soak_daemon", boot_id, *self._looks]
        command += self._options
        if not cut:
            command += ["--max-slots", str((end_utc - begin_utc) // self._history.period)]
        life, last_but_one = Life(), timedelta(days=1) - 2 * self._history.period
        pauses = [slot for slot in self._history.pauses() if begin_utc <= slot < end_utc]
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as dcamd:
            for slot, is_row in _ended(dcamd):
                if is_row:
                    life.rows.add(slot)
                if (slot - begin_utc) % timedelta(days=1) == last_but_one:
                    life.memory_mb.append(resident_mb(dcamd.pid))
                    _say(f"{slot:%Y-%m-%d}: {life.memory_mb[-1]:.1f} MB")
                if pauses and slot >= pauses[0]:
                    self._pause(pauses.pop(0))
                if cut and slot >= end_utc:
                    dcamd.kill()
                    cut = False
        if dcamd.returncode not in {0, -9}:
            msg = f"dcamd ended with {dcamd.returncode}"
            raise RuntimeError(msg)
        return life

    def _configure(self, clock_start_utc: datetime) -> None:
        self._config.write_text(self._history.config(clock_start_utc), encoding="utf-8")

    def _pause(self, since: datetime) -> None:
        with (
            paused_daemon(self.state, "the soak's calibration"),
            open_store_readonly(self.state) as store,
        ):
            while _paused_slots(store, since) < PAUSED_SLOTS:
                time.sleep(0.01)


def run(history: History, directory: Path, measure_every: int, fair_min: int = FAIR_MIN) -> Result:
    """Run a whole history below a directory, and look at what has become of it."""
    site = Site(directory, history, measure_every, fair_min)
    site.calibrate()
    began_s, cpu_s = time.monotonic(), _children_cpu_s()
    first = site.live("boot-1", START_UTC, history.dark_from, cut=True)
    second = site.live("boot-2", history.dark_until, history.end_utc, cut=False)
    hours, cpu_s = (time.monotonic() - began_s) / 3600.0, _children_cpu_s() - cpu_s
    status_s, status_cpu_s = _status_time(site, history.end_utc)
    size_mb = (site.state / "dcam.db").stat().st_size / 1e6
    frames_mb = sum(f.stat().st_size for f in (site.state / "frames").rglob("*.*")) / 1e6
    with open_store_readonly(site.state) as store:
        covered = store.coverage(
            START_UTC, history.end_utc, period_s=int(history.period.total_seconds())
        )
        wrong = _faults(store, history, first.rows | second.rows)
    powered = len(history.powered())
    return Result(
        days=history.days,
        slots=history.slots,
        powered=powered,
        rows=covered.measured,
        flags={name: getattr(covered, name) for name in ("good", "suspect", "bad")},
        gaps={cause.value: count for cause, count in covered.gaps.items()},
        wrong=wrong,
        memory_mb=[_memory(life) for life in (first, second) if len(life.memory_mb) > SETTLED_DAYS],
        status_s=status_s,
        status_cpu_s=status_cpu_s,
        database_mb=size_mb,
        database_20_years_gb=size_mb / powered * (TWENTY_YEARS / history.period) / 1e3,
        frames_mb=frames_mb,
        cpu_ms_per_slot=1e3 * cpu_s / powered,
        hours=hours,
    )


def _faults(store: Store, history: History, acknowledged: set[datetime]) -> list[str]:
    """Hold every slot against what is known to have happened."""
    rows = store.measured_slots()
    causes = {}
    for gap in store.gaps():
        for number in range(gap.slots):
            causes[gap.first_slot_utc + number * history.period] = gap.cause
    wrong: Counter[str] = Counter()
    paused = 0
    for number in range(history.slots):
        slot = START_UTC + number * history.period
        if slot in rows and slot in causes:
            wrong["slots with a row and in a gap"] += 1
        if slot not in rows and slot not in causes:
            wrong["slots unaccounted for"] += 1
        cause = causes.get(slot)
        paused += cause is GapCause.CALIBRATION
        if cause is GapCause.CALIBRATION or cause is _expected(history, slot):
            continue
        # Killed, it may have been a few slots further than what was read of it.
        if not (cause is None and history.dark(slot) and slot in acknowledged):
            wrong[f"slots with {cause} instead of {_expected(history, slot)}"] += 1
    if len(acknowledged - rows):
        wrong["acknowledged rows lost"] = len(acknowledged - rows)
    if paused < PAUSED_SLOTS * len(history.pauses()):
        wrong["pauses that were no gap"] += 1
    return [f"{count} {what}" for what, count in wrong.items()]


def _expected(history: History, slot: datetime) -> GapCause | None:
    if history.dark(slot):
        return GapCause.POWER_LOSS
    return GapCause.CAMERA_LOST if history.camera_lost(slot) else None


def _ended(dcamd: subprocess.Popen[str]) -> Iterator[tuple[datetime, bool]]:
    """Slots that the log says are done or missed, and whether they are done."""
    for line in dcamd.stderr or ():
        done = "event=slot_done" in line
        if done or "event=slot_missed" in line:
            yield datetime.fromisoformat(line.partition(" slot=")[2].split(" ", 1)[0]), done
        elif "level=" not in line or "level=error" in line:
            _say(line.rstrip())


def _paused_slots(store: Store, since: datetime) -> int:
    return sum(gap.slots for gap in store.gaps(since) if gap.cause is GapCause.CALIBRATION)


def _status_time(site: Site, at_utc: datetime) -> tuple[float, float]:
    """Median wall and CPU time of `dcam-ctl status`."""
    walls, cpus = [], []
    for _ in range(STATUS_RUNS):
        began_s, cpu_s = time.monotonic(), _children_cpu_s()
        site.ctl("status", "--at", f"{at_utc:%Y-%m-%dT%H:%M:%SZ}")
        walls.append(time.monotonic() - began_s)
        cpus.append(_children_cpu_s() - cpu_s)
    return statistics.median(walls), statistics.median(cpus)


def _children_cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _memory(life: Life) -> list[float]:
    settled = life.memory_mb[SETTLED_DAYS - 1]
    return [settled, max(life.memory_mb[SETTLED_DAYS:]), life.memory_mb[-1]]


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


@contextmanager
def _directory(given: Path | None) -> Iterator[Path]:
    if given is not None:
        given.mkdir(parents=True)
        yield given
        return
    # In memory, where there is room: with a disk's syncs it would take as long as the disk does.
    fast = Path("/dev/shm")
    with tempfile.TemporaryDirectory("dcam-soak", dir=fast if fast.is_dir() else None) as made:
        yield Path(made)


def main() -> int:
    """Run the soak and print its result; exit code 1 when something is not as it must be."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.soak", description=__doc__)
    parser.add_argument("--days", type=int, default=145)
    parser.add_argument("--dark-days", type=float, default=15.0, help="days without power of them")
    parser.add_argument("--directory", type=Path, help="to keep; default: a temporary one")
    parser.add_argument(
        "--measure-every",
        type=int,
        default=1,
        metavar="N",
        help="measure the same images again at every Nth look only, to save time",
    )
    options = parser.parse_args()
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    with _directory(options.directory) as directory:
        history = History.of(options.days, options.dark_days)
        result = run(history, directory, options.measure_every)
    print(json.dumps(asdict(result) | {"growth_mb": result.growth_mb}, indent=2))
    return 1 if result.wrong else 0


if __name__ == "__main__":
    sys.exit(main())
