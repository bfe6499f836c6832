"""A real `dcamd` on two USB3 Vision cameras that fail at random: `python -m benchmarks.usb3`.

The bus is the tests' stand-in for libusb, the cameras are processes; the slots are a second apart,
the shortest that a config takes. So that 3000 slots do not take an hour, several rigs run side by
side, each with a bus, two cameras and a `dcamd` of its own. Every slot must be a row or a gap with
its cause; without a fault each must be a row. Handles, threads and memory of `dcamd` must stay what
they were. One more rig has a slot a minute, and shows what `dcamd` costs between slots.

Meanwhile a program that only counts keeps each core busy. `dcamd` has the priority of its unit, in
its session as in its group (sched_autogroup is Linux' way to share between sessions, in which a
process's own priority does not count); that needs root.

The cameras show night: the rows say that no target was found, which costs the least time.

`--directory DIRECTORY` is where the sites are; one in memory (/dev/shm) leaves the disk, and who
else waits for it, out of the figures. `--output FILE` keeps each rig's figures as a line of JSON,
and what is there is not run again.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, fields
from datetime import datetime, timedelta
from pathlib import Path

from benchmarks.busy_computer import all_cores_busy, give_priority, unit_niceness
from benchmarks.memory import resident_mb
from tests.drivers.genicam.gige.bench import running
from tests.drivers.genicam.usb3.bench import BUS, Usb3Process, environment, write_night
from tests.laboratory import laboratory

SERIALS = {"main": "15290000", "sub": "15290001"}
PERIOD_S = 1
LOOK_EVERY_S = 0.2
MEMORY_EVERY = 50
"""Slots, then faults, between two readings of the memory."""
IDLE_PERIOD_S = 60
IDLE_FOR_S = 40.0
TICKS_PER_S = os.sysconf("SC_CLK_TCK")
PATIENCE_S = 120.0
WIDTH_PX = 640
OF_CAMERAS = {"camera_lost", "capture_failed"}
"""Causes of gaps; others, as `overrun`, are the computer's."""
FAULTS = ("unplugged", "gone for a moment", "stalled", "short", "out of step", "twice", "busy")


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a run."""

    rows: int
    missed: Counter[str]
    """Slots in gaps, by cause."""
    unexplained: int
    """Slots that are neither; must be 0."""
    faults: Counter[str]
    slots_before: int
    """Slots until the first fault; each must have its row."""
    missed_before: Counter[str]
    """Of these, slots in gaps, by cause; `overrun` is the computer's, others a camera's."""
    took_before_s: list[float]
    """What these slots took: median, 99 in 100, the longest."""
    cpu_before_ms: float
    """Processor time of dcamd, for each of these slots."""
    lost_after: int
    """The same of the last slots, after the last fault and its recovery."""
    settled: tuple[int, int, float]
    end: tuple[int, int, float]
    """Open files, threads, resident MB of dcamd before the faults and at the end."""
    longest_lost: int
    """Most slots on end without a row for a camera's sake."""
    unnamed: int
    """Gaps without a detail; must be 0."""
    memory_mb: list[float]
    """Resident memory every MEMORY_EVERY slots, then every MEMORY_EVERY faults."""
    errors: list[str]
    """Lines of the log of an error's level."""
    log: list[str] = field(repr=False)


class Site:
    """A site on the bus and its dcamd."""

    def __init__(
        self,
        directory: Path,
        bus: Path | None = None,
        period_s: int = PERIOD_S,
        niceness: int | None = None,
    ) -> None:
        """`bus`: a directory of its own for the cameras; None: that of this process.

        `niceness`: that of dcamd and its session; None: as it comes.
        """
        self._niceness = niceness
        self.state = directory / "state"
        config = directory / "dcam.toml"
        config.write_text(laboratory(WIDTH_PX, "aravis") + f"\n[schedule]\nperiod_s = {period_s}\n")
        image = write_night(directory, WIDTH_PX * 5 // 8, WIDTH_PX)
        self.cameras = {
            role: Usb3Process(role, serial, [image], bus=bus) for role, serial in SERIALS.items()
        }
        self._environment = environment() | ({BUS: str(bus)} if bus else {})
        self._log = directory / "dcamd.log"
        self._command = [
            *(sys.executable, "-m", "daemon.main"),
            *("--config", str(config), "--state", str(self.state)),
        ]

    @contextmanager
    def daemon(self) -> Iterator[subprocess.Popen[bytes]]:
        """Run dcamd; it must end well."""
        with (
            self._log.open("w") as log,
            subprocess.Popen(
                self._command, stderr=log, env=self._environment, start_new_session=True
            ) as process,
        ):
            try:
                if self._niceness is not None:
                    give_priority(process.pid, self._niceness)
                yield process
                process.terminate()
                if process.wait(PATIENCE_S) != 0:
                    msg = f"dcamd ended with {process.returncode}: {self.log()[-1:]}"
                    raise RuntimeError(msg)
            finally:
                process.kill()

    def log(self) -> list[str]:
        """Its lines."""
        return self._log.read_text().splitlines()

    def query(self, sql: str) -> list[tuple[str, ...]]:
        """Ask the database, which may not be there yet."""
        if not (self.state / "dcam.db").exists():
            return []
        with closing(sqlite3.connect(f"file:{self.state}/dcam.db?mode=ro", uri=True)) as database:
            try:
                return database.execute(sql).fetchall()
            except sqlite3.OperationalError:  # not made yet
                return []

    def slots(self) -> dict[datetime, str]:
        """Each slot that is accounted for, with `row` or the cause of its gap."""
        found = {
            datetime.fromisoformat(slot): "row"
            for (slot,) in self.query("SELECT slot_utc FROM measurement")
        }
        for start, count, cause in self.query("SELECT start_utc, slots, cause FROM gap"):
            first = datetime.fromisoformat(start)
            found |= {first + timedelta(seconds=k * PERIOD_S): cause for k in range(int(count))}
        return found

    def accounted(self) -> int:
        """Count the slots that are rows or in gaps."""
        gaps = "SELECT COALESCE(SUM(slots), 0) FROM gap"
        counts = self.query(f"SELECT COUNT(*) + ({gaps}) FROM measurement")
        return int(counts[0][0]) if counts else 0

    def rows(self) -> int:
        """Count the rows."""
        counts = self.query("SELECT COUNT(*) FROM measurement")
        return int(counts[0][0]) if counts else 0

    def wait(self, condition: Callable[[], bool], what: str, usual_s: float = 0.0) -> None:
        """Look until it holds; RuntimeError if it does not, long after it usually does."""
        give_up_s = time.monotonic() + PATIENCE_S + 2.0 * usual_s
        while not condition():
            if time.monotonic() > give_up_s:
                msg = f"waited in vain for {what}:\n" + "\n".join(self.log()[-20:])
                raise RuntimeError(msg)
            time.sleep(LOOK_EVERY_S)

    def wait_for_slots(self, n: int) -> None:
        """Wait until so many slots are accounted for in all."""
        self.wait(lambda: self.accounted() >= n, "slots", MEMORY_EVERY * PERIOD_S)

    def wait_for_rows(self, n: int) -> None:
        """Wait for so many more slots with a row."""
        before = self.rows()
        self.wait(lambda: self.rows() >= before + n, "rows")


def fail(camera: Usb3Process, fault: str, seconds: float) -> None:
    """Have a camera fail in one way, and be sound again."""
    if fault == "unplugged":
        camera.kill()
        time.sleep(seconds)
        camera.start()
    elif fault == "gone for a moment":
        camera.command("power-cut")
    elif fault == "out of step":
        camera.command("skip")
    elif fault == "short":
        camera.command("lose 1")
        time.sleep(seconds)
        camera.command("lose 0")
    else:
        camera.command(f"fault {'duplicate' if fault == 'twice' else fault}")
        if fault == "busy":
            camera.command("power-cut")
        time.sleep(seconds)
        camera.command("fault none")


def measure_usb3(
    directory: Path,
    n_before: int,
    n_faults: int,
    seed: int,
    bus: Path | None = None,
    niceness: int | None = None,
) -> Outcome:
    """Run dcamd through slots without a fault, then through faults at random."""
    site, memory_mb = Site(directory, bus, niceness=niceness), list[float]()
    with running(*site.cameras.values()), site.daemon() as dcamd:
        site.wait_for_rows(2)
        before, cpu_s = site.slots(), _processor_s(dcamd.pid)
        for n in [*range(MEMORY_EVERY, n_before, MEMORY_EVERY), n_before]:
            site.wait_for_slots(len(before) + n)
            memory_mb.append(round(resident_mb(dcamd.pid), 1))
        cpu_s = _processor_s(dcamd.pid) - cpu_s
        quiet = {slot: kind for slot, kind in site.slots().items() if slot not in before}
        settled = _use(dcamd.pid)
        faults = Counter[str]()
        for fault in _faults(site, n_faults, seed):
            faults[fault] += 1
            if faults.total() % MEMORY_EVERY == 0:
                memory_mb.append(round(resident_mb(dcamd.pid), 1))
        site.wait_for_rows(3)
        recovered = max(site.slots())
        enough = recovered + timedelta(seconds=5 * PERIOD_S)
        site.wait(lambda: max(site.slots()) >= enough, "slots after the last fault")
        end = _use(dcamd.pid)
    slots, log = site.slots(), site.log()
    step = timedelta(seconds=PERIOD_S)
    span = (max(slots) - min(slots)) // step + 1
    return Outcome(
        rows=sum(kind == "row" for kind in slots.values()),
        missed=Counter(kind for kind in slots.values() if kind != "row"),
        unexplained=span - len(slots),
        faults=faults,
        slots_before=len(quiet),
        missed_before=Counter(kind for kind in quiet.values() if kind != "row"),
        took_before_s=_took_s(log, n_before),
        cpu_before_ms=round(1e3 * cpu_s / len(quiet), 1),
        lost_after=sum(kind in OF_CAMERAS for slot, kind in slots.items() if slot > recovered),
        settled=settled,
        end=end,
        longest_lost=_longest_lost(slots),
        unnamed=int(site.query("SELECT COUNT(*) FROM gap WHERE detail = ''")[0][0]),
        memory_mb=memory_mb,
        errors=[line for line in log if "level=error" in line or "level=critical" in line],
        log=log,
    )


def _faults(site: Site, n: int, seed: int) -> Iterator[str]:
    """Have cameras fail at random, and say how after each."""
    choose = random.Random(seed)
    for _ in range(n):
        role, fault = choose.choice(sorted(SERIALS)), choose.choice(FAULTS)
        fail(site.cameras[role], fault, choose.uniform(0.0, 2.0))
        time.sleep(choose.uniform(0.0, 2.0))
        yield fault


def _took_s(log: list[str], n: int) -> list[float]:
    """Of the first slots but those at the start: median, 99 in 100, the longest."""
    took_s = [float(found[1]) for line in log if (found := re.search(r"took_s=(\S+)", line))]
    measured = sorted(took_s[2 : n + 2])
    return [measured[int(share * (len(measured) - 1))] for share in (0.5, 0.99, 1.0)]


def _longest_lost(slots: dict[datetime, str]) -> int:
    longest = now = 0
    for slot in sorted(slots):
        now = now + 1 if slots[slot] in OF_CAMERAS else 0
        longest = max(longest, now)
    return longest


def measure_idle(directory: Path, bus: Path | None = None, niceness: int | None = None) -> float:
    """Share of one processor that dcamd takes between two slots, a minute apart."""
    site = Site(directory, bus, IDLE_PERIOD_S, niceness)
    with running(*site.cameras.values()), site.daemon() as dcamd:
        site.wait_for_rows(1)
        time.sleep((IDLE_PERIOD_S - IDLE_FOR_S) / 2)
        before_s, began_s = _processor_s(dcamd.pid), time.monotonic()
        time.sleep(IDLE_FOR_S)
        return (_processor_s(dcamd.pid) - before_s) / (time.monotonic() - began_s)


def _processor_s(pid: int) -> float:
    """Processor time so far, user and system (proc(5), fields 14 and 15 of stat)."""
    values = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(values[11]) + int(values[12])) / TICKS_PER_S


def _use(pid: int) -> tuple[int, int, float]:
    """Open files, threads, resident MB."""
    files, threads = (len(list(Path(f"/proc/{pid}/{name}").iterdir())) for name in ("fd", "task"))
    return files, threads, resident_mb(pid)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.usb3", description=__doc__)
    parser.add_argument("--slots", type=int, default=3000, help="without a fault, of all rigs")
    parser.add_argument("--faults", type=int, default=1000, help="of all rigs")
    parser.add_argument("--rigs", type=int, default=3, help="side by side")
    parser.add_argument("--seed", type=int, default=1, help="of the first rig")
    parser.add_argument("--directory", type=Path, help="for what is removed afterwards")
    parser.add_argument("--output", type=Path, default=Path("usb3.jsonl"))
    options = parser.parse_args()
    done = {line["seed"] for line in _of_kind(options.output, "seed")}
    seeds = range(options.seed, options.seed + options.rigs)
    share = (options.slots // options.rigs, options.faults // options.rigs)
    with all_cores_busy(), ThreadPoolExecutor(options.rigs + 1) as pool:
        runs = [
            pool.submit(_rig, options.directory, seed, *share) for seed in seeds if seed not in done
        ]
        if not _of_kind(options.output, "idle"):
            runs.append(pool.submit(_idle, options.directory))
        for run in as_completed(runs):
            _keep(options.output, run.result())
    for line in [*_of_kind(options.output, "idle"), *_of_kind(options.output, "seed")]:
        print(json.dumps(line))


@contextmanager
def _scratch(parent: Path | None) -> Iterator[Path]:
    # A short name: that of a socket has at most 107 characters.
    with tempfile.TemporaryDirectory(prefix="dcam-usb3-", dir=parent) as directory:
        yield Path(directory)


def _rig(parent: Path | None, seed: int, n_slots: int, n_faults: int) -> dict[str, object]:
    with _scratch(parent) as directory:
        outcome = measure_usb3(directory, n_slots, n_faults, seed, directory, unit_niceness())
    figures = {one.name: getattr(outcome, one.name) for one in fields(outcome)}
    del figures["log"]
    return {"seed": seed, **figures}


def _idle(parent: Path | None) -> dict[str, object]:
    with _scratch(parent) as directory:
        return {"idle": measure_idle(directory, directory, unit_niceness())}


def _keep(output: Path, line: dict[str, object]) -> None:
    with output.open("a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")


def _of_kind(output: Path, key: str) -> list[dict[str, object]]:
    text = output.read_text(encoding="utf-8") if output.exists() else ""
    return [line for line in map(json.loads, text.splitlines()) if key in line]


if __name__ == "__main__":
    main()
