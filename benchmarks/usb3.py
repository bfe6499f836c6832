"""A real `dcamd` on two USB3 Vision cameras that fail at random: `python -m benchmarks.usb3`.

The bus is the tests' stand-in for libusb, the cameras are processes; the slots are a second apart.
Every slot must be a row or a gap with its cause; without a fault each must be a row. Handles,
threads and memory of `dcamd` must stay what they were.

The cameras show night: the rows say that no target was found, which costs the least time.
"""

from __future__ import annotations

import argparse
import random
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path

from benchmarks.memory import resident_mb
from tests.drivers.genicam.gige.bench import running
from tests.drivers.genicam.usb3.bench import Usb3Process, environment, write_night
from tests.laboratory import laboratory

SERIALS = {"main": "15290000", "sub": "15290001"}
PERIOD_S = 1
LOOK_EVERY_S = 0.1
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
    rows_before: int
    """Slots run before the first fault; each must have its row, or the computer was too slow."""
    lost_before: int
    """Of these, slots without a row for a camera's sake."""
    lost_after: int
    """The same of the last slots, after the last fault and its recovery."""
    settled: tuple[int, int, float]
    end: tuple[int, int, float]
    """Open files, threads, resident MB of dcamd before the faults and at the end."""
    log: list[str] = field(repr=False)


class Site:
    """A site on the bus and its dcamd."""

    def __init__(self, directory: Path) -> None:
        self.state = directory / "state"
        config = directory / "dcam.toml"
        config.write_text(laboratory(WIDTH_PX, "aravis") + f"\n[schedule]\nperiod_s = {PERIOD_S}\n")
        image = write_night(directory, WIDTH_PX * 5 // 8, WIDTH_PX)
        self.cameras = {
            role: Usb3Process(role, serial, [image]) for role, serial in SERIALS.items()
        }
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
            subprocess.Popen(self._command, stderr=log, env=environment()) as process,
        ):
            try:
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

    def wait(self, condition: Callable[[], bool], what: str, usual_s: float = 0.0) -> None:
        """Look until it holds; RuntimeError if it does not, long after it usually does."""
        give_up_s = time.monotonic() + PATIENCE_S + 2.0 * usual_s
        while not condition():
            if time.monotonic() > give_up_s:
                msg = f"waited in vain for {what}:\n" + "\n".join(self.log()[-20:])
                raise RuntimeError(msg)
            time.sleep(LOOK_EVERY_S)

    def wait_for_rows(self, n: int) -> None:
        """Wait for so many more slots with a row."""
        before = sum(kind == "row" for kind in self.slots().values())
        self.wait(
            lambda: sum(kind == "row" for kind in self.slots().values()) >= before + n, "rows"
        )


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


def measure_usb3(directory: Path, n_before: int, n_faults: int, seed: int) -> Outcome:
    """Run dcamd through slots without a fault, then through faults at random."""
    choose = random.Random(seed)
    site, faults = Site(directory), Counter[str]()
    with running(*site.cameras.values()), site.daemon() as dcamd:
        site.wait_for_rows(2)
        before = site.slots()
        site.wait(lambda: len(site.slots()) >= len(before) + n_before, "slots", n_before)
        quiet = {slot: kind for slot, kind in site.slots().items() if slot not in before}
        settled = _use(dcamd.pid)
        for _ in range(n_faults):
            role, fault = choose.choice(sorted(SERIALS)), choose.choice(FAULTS)
            faults[fault] += 1
            fail(site.cameras[role], fault, choose.uniform(0.0, 2.0))
            time.sleep(choose.uniform(0.0, 2.0))
        site.wait_for_rows(3)
        recovered = max(site.slots())
        enough = recovered + timedelta(seconds=5 * PERIOD_S)
        site.wait(lambda: max(site.slots()) >= enough, "slots after the last fault")
        end = _use(dcamd.pid)
    slots = site.slots()
    step = timedelta(seconds=PERIOD_S)
    span = (max(slots) - min(slots)) // step + 1
    return Outcome(
        rows=sum(kind == "row" for kind in slots.values()),
        missed=Counter(kind for kind in slots.values() if kind != "row"),
        unexplained=span - len(slots),
        faults=faults,
        rows_before=len(quiet),
        lost_before=sum(kind in OF_CAMERAS for kind in quiet.values()),
        lost_after=sum(kind in OF_CAMERAS for slot, kind in slots.items() if slot > recovered),
        settled=settled,
        end=end,
        log=site.log(),
    )


def _use(pid: int) -> tuple[int, int, float]:
    """Open files, threads, resident MB."""
    files, threads = (len(list(Path(f"/proc/{pid}/{name}").iterdir())) for name in ("fd", "task"))
    return files, threads, resident_mb(pid)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.usb3", description=__doc__)
    parser.add_argument("--slots", type=int, default=3000, help="without a fault")
    parser.add_argument("--faults", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="dcam-usb3-") as directory:
        print(measure_usb3(Path(directory), options.slots, options.faults, options.seed))


if __name__ == "__main__":
    main()
