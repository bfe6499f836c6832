"""Reprocessing of an archive on workers: rate against one core, equality, and workers killed.

`python -m benchmarks.reprocess`: 2,000 pairs with a fixed target, whose rows hang on those
before.
Each run is `dcam-ctl reprocess` in a process of its own; its CPU time is that of all its processes.
"""

from __future__ import annotations

import argparse
import ctypes
import hashlib
import math
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path

from daemon.config.reading import load_config
from drivers.frameset import FrameSetRow, read_frame_set, write_table
from drivers.sim.frameset_writer import FrameSetPlan, write_frame_set
from drivers.sim.settings import SimPlate, SimSettings

SMALL = Path(__file__).with_name("small.toml")
FULL = Path(__file__).parents[1] / "config.example.toml"
PLATE = """
[[target.extra]]
name = "abutment"
role = "fixed"
kind = "circles"
centres_mm = [[-8.0, 10.0], [8.0, 10.0], [-3.0, -10.0]]
diameter_mm = 7.0
distance_mm = 11500.0
distance_sigma_mm = 20.0
"""
WHERE = SimPlate("abutment", offset_mm=(53.0, 0.0))
"""A fixed target, as the config and as the simulation have it; tests take it from here, too."""
SLOTS, RENDERED = 2000, 20
"""Slots, and the pairs that are rendered for them, over and over."""
KILLS = 3
SEED = 5
_PR_SET_CHILD_SUBREAPER = 36
DCAM_CTL = Path(sys.executable).with_name("dcam-ctl")


@dataclass(frozen=True, slots=True)
class Run:
    """One `dcam-ctl reprocess`."""

    wall_s: float
    cpu_s: float
    sha256: str
    killed: int

    @property
    def cores(self) -> float:
        """How many cores it had."""
        return self.cpu_s / self.wall_s


def main() -> None:
    """Make the frames, run, and say what came of it."""
    count_orphans_too()
    parser = argparse.ArgumentParser(prog="python -m benchmarks.reprocess", description=__doc__)
    parser.add_argument("--slots", type=int, default=SLOTS)
    parser.add_argument(
        "--full", action="store_true", help="images of 1920 x 1200 px, not 480 x 300"
    )
    parser.add_argument("--directory", type=Path, help="where the frames are, or are to be made")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="dcam-reprocess-") as scratch:
        directory = options.directory or Path(scratch)
        directory.mkdir(parents=True, exist_ok=True)
        if not (directory / "many").is_dir():
            make_frames(directory, options.slots, FULL if options.full else SMALL)
        reprocess(directory, "serial", RENDERED)  # compiles the loops
        serial = reprocess(directory, "serial")
        besides_s = side_by_side(directory)
        shared = reprocess(directory, "local")
        killed = reprocess(directory, "local", kills=KILLS, within_s=shared.wall_s)
    for name, run in (("serial", serial), ("workers", shared), ("workers killed", killed)):
        print(
            f"{name}: {run.wall_s:.1f} s, CPU {run.cpu_s:.1f} s = {run.cores:.2f} cores, "
            f"{run.killed} killed, {run.sha256[:16]}"
        )
    bound = cores() * serial.wall_s / besides_s
    gain = serial.wall_s / shared.wall_s
    print(f"rate of the workers over that of one core: {gain:.2f}")
    print(
        f"of {cores()} serial runs side by side: {bound:.2f}; the workers reach {gain / bound:.2f}"
    )
    print(f"on cores of their own, by CPU time: {idle_gain(serial, shared):.2f}")
    print("all the same bytes:", len({serial.sha256, shared.sha256, killed.sha256}) == 1)


def count_orphans_too() -> None:
    """Have processes whose parent has ended become children of this one, with their CPU time."""
    if ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl")


def wait_for_orphans() -> None:
    """Wait for what the process that was started has left: workers are forked from another one."""
    with suppress(ChildProcessError):
        while True:
            os.wait()


def idle_gain(serial: Run, shared: Run) -> float:
    """The gain on cores that nobody else uses, by CPU times."""
    return cores() * serial.cpu_s / shared.cpu_s


def cores() -> int:
    """How many this process may use."""
    return len(os.sched_getaffinity(0))


def side_by_side(directory: Path) -> float:
    """How long as many serial runs take at once as there are cores, s: what the cores can do.

    Two cores that a computer counts are often one with two threads, and faster by less than twice.
    """
    begun = time.monotonic()
    outputs = [directory / f"beside-{number}.csv" for number in range(cores())]
    words = ("reprocess", "--from", directory / "many", "--scheduler", "serial", "--output")
    runs = [subprocess.Popen(arguments(directory, *words, output)) for output in outputs]
    if sum([run.wait() for run in runs]) != 0:
        msg = "dcam-ctl reprocess --scheduler serial failed"
        raise RuntimeError(msg)
    for output in outputs:
        output.unlink()
    return time.monotonic() - begun


def make_frames(directory: Path, slots: int, site: Path) -> None:
    """Render a frame set, calibrate on it, and make a long one of its images."""
    config, rendered, many = (directory / name for name in ("dcam.toml", "set", "many"))
    config.write_text(site.read_text() + PLATE)
    settings = SimSettings(seed=SEED, plates=(WHERE,))
    plan = FrameSetPlan(intrinsics=8, rig=12, measure=RENDERED, measure_every_min=30.0)
    write_frame_set(rendered, load_config(config).site(), settings, plan)
    dcam_ctl(directory, "calibrate", "--from", rendered, "--accept")
    many.mkdir()
    shown = read_frame_set(rendered).rows_of("measure")
    rows = []
    for number in range(slots):
        row = shown[number % len(shown)]
        slot_utc = shown[0].slot_utc + timedelta(minutes=number)
        warm = f"{20.0 + 5.0 * math.sin(number / 229.0):.2f}"
        extra = {"temperature_main_c": warm, "temperature_sub_c": warm}
        rows.append(FrameSetRow(slot_utc, "measure", row.main, row.sub, extra=extra))
    for name in {str(name) for row in shown for name in (row.main, row.sub)}:
        os.link(rendered / name, many / name)
    write_table(many, rows)
    few = directory / "few"
    few.mkdir()
    for image in many.glob("*.png"):
        os.link(image, few / image.name)
    write_table(few, rows[:RENDERED])


def reprocess(
    directory: Path, scheduler: str, few: int = 0, *, kills: int = 0, within_s: float = 0.0
) -> Run:
    """Measure the long set once, and kill workers meanwhile."""
    output = directory / f"{scheduler}.csv"
    output.unlink(missing_ok=True)
    parts_of_an_ended_run = directory / f".{output.name}.parts"
    shutil.rmtree(parts_of_an_ended_run, ignore_errors=True)
    frames = directory / ("few" if few else "many")
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    begun = time.monotonic()
    process = subprocess.Popen(
        arguments(
            directory, "reprocess", "--from", frames, "--scheduler", scheduler, "--output", output
        )
    )
    killed = kill_workers(process, kills, within_s)
    if process.wait() != 0:
        msg = f"dcam-ctl reprocess --scheduler {scheduler} failed"
        raise RuntimeError(msg)
    wall_s = time.monotonic() - begun
    wait_for_orphans()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Run(wall_s, cpu_s, hashlib.sha256(output.read_bytes()).hexdigest(), killed)


def kill_workers(process: subprocess.Popen[bytes], kills: int, within_s: float) -> int:
    """Kill a worker at each of some random times; give how many were."""
    draw, begun, killed = random.Random(SEED), time.monotonic(), 0
    for at_s in sorted(draw.uniform(0.2, 0.7) * within_s for _ in range(kills)):
        time.sleep(max(0.0, begun + at_s - time.monotonic()))
        found = workers_of(process.pid)
        if found and process.poll() is None:
            os.kill(draw.choice(found), signal.SIGKILL)
            killed += 1
    return killed


def workers_of(pid: int) -> list[int]:
    """The processes of workers that a process has: children of the one they are forked from."""
    servers = [one for one in children_of(pid) if b"forkserver" in command_line(one)]
    return [worker for server in servers for worker in children_of(server)]


def children_of(pid: int) -> list[int]:
    """The processes that a process has started."""
    tasks = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(child) for task in tasks for child in task.read_text().split()]


def command_line(pid: int) -> bytes:
    """How a process was called."""
    return Path(f"/proc/{pid}/cmdline").read_bytes()


def dcam_ctl(directory: Path, *words: object) -> None:
    """Run it to its end."""
    subprocess.run(arguments(directory, *words), check=True)


def arguments(directory: Path, *words: object) -> list[str]:
    """The command line of `dcam-ctl` for this site."""
    site = ("--config", directory / "dcam.toml", "--state", directory / "state")
    return [str(word) for word in (DCAM_CTL, *site, *words)]


if __name__ == "__main__":
    main()
