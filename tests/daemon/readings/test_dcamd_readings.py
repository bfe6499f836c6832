"""dcamd with sensors: a process on the simulated rig, real files, real programs."""

from __future__ import annotations

import json
import os
import re
import signal
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from daemon.store.database import Store, open_store
from daemon.store.records import MeasurementRecord
from drivers.frameset import read_frame_set
from tests.laboratory import laboratory
from tests.programs import Program, ran
from tests.waiting import PATIENCE_S, wait_for

SITE = laboratory(320, "simulated")
REAL_TIME = '[schedule]\nperiod_s = 4\n[simulation]\nclock = "system"\n'


def reading(name: str, source: str, more: str = "") -> str:
    return f'[[reading]]\nname = "{name}"\nunit = "degC"\n{source}\n{more}\n'


def file_of(path: Path) -> str:
    return f'file = "{path}"\nscale = 0.001'


def script(text: str) -> str:
    return f"command = {json.dumps(['/bin/sh', '-c', text])}"


def where(directory: Path) -> tuple[object, ...]:
    return "--config", directory / "dcam.toml", "--state", directory / "state"


def run(directory: Path, config: str, *more: str) -> str:
    """A daemon's life from beginning to end; gives its log."""
    (directory / "dcam.toml").write_text(SITE + config)
    done = ran("daemon.main", *where(directory), *more)
    assert done.returncode == 0, done.stderr
    return done.stderr


COUNTS_THREADS = """
import sys, threading
from daemon import main
from daemon.readings.sampler import Sampler

def collect_and_count(sampler, slot_utc, collect=Sampler.collect):
    found = collect(sampler, slot_utc)
    names = [thread.name for thread in threading.enumerate()]
    sys.stderr.write(f"threads {names.count('readings')}\\n")
    return found

Sampler.collect = collect_and_count
sys.exit(main.main())
"""
"""dcamd that says after each slot how many threads read."""


@contextmanager
def running(directory: Path, config: str, module: str | Path = "daemon.main") -> Iterator[Program]:
    (directory / "dcam.toml").write_text(SITE + config)
    process = Program(module, *where(directory), stderr=directory / "log")
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def done_slots(directory: Path) -> int:
    return len(re.findall("event=slot_done", (directory / "log").read_text()))


SLOW = ("sh: no answer within 1 s", "no answer for 1 s")
"""Whichever of the two that wait for it is first on a busy computer."""


def rows(store: Store) -> list[MeasurementRecord]:
    return list(store.measurements())


@pytest.fixture
def warm(tmp_path: Path) -> Path:
    path = tmp_path / "temp1_input"
    path.write_text("21562\n")
    return path


def test_readings_stand_with_each_row_and_beside_its_frames(tmp_path: Path, warm: Path) -> None:
    config = (
        reading("air", file_of(warm))
        + reading("deck", script("echo 3.5"))
        + reading("hot", script("echo 85"), "max = 60.0")
    )
    run(tmp_path, config, "--max-slots", "3")
    with open_store(tmp_path / "state", create=False) as store:
        for row in rows(store):
            assert row.reading_values == {"air": 21.562, "deck": 3.5}
            assert [(one.name, one.unit) for one in row.readings] == [
                ("air", "degC"),
                ("deck", "degC"),
                ("hot", "degC"),
            ]
            assert row.readings[2].cause == "outside limits (85 degC)"
    day = tmp_path / "state/frames/2026/03/01"
    lines = read_frame_set(day).rows
    assert [line.readings for line in lines] == [{"air": 21.562, "deck": 3.5}] * 3


def test_sensors_that_hang_cost_no_slot(tmp_path: Path, warm: Path) -> None:
    """A file that the kernel does not give, and a program that never ends, in real time."""
    os.mkfifo(tmp_path / "stuck")
    config = (
        reading("air", file_of(warm), "timeout_s = 1.0")
        + reading("stuck", file_of(tmp_path / "stuck"), "timeout_s = 1.0")
        + reading("slow", script(f"echo $$ >> {tmp_path}/pids; exec sleep 1000"), "timeout_s = 1.0")
        + REAL_TIME
    )
    counting = tmp_path / "dcamd.py"
    counting.write_text(COUNTS_THREADS)
    with running(tmp_path, config, counting) as process:
        wait_for(lambda: done_slots(tmp_path) >= 6, "six slots")
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 0
    threads = re.findall(r"^threads (\d+)$", (tmp_path / "log").read_text(), re.MULTILINE)
    assert max(map(int, threads)) == 3, threads
    pids = (tmp_path / "pids").read_text().split()
    assert len(pids) >= 4
    assert not [pid for pid in pids if Path(f"/proc/{pid}").exists()]
    with open_store(tmp_path / "state", create=False) as store:
        first, last = rows(store)[0], rows(store)[-1]
        assert [gap for gap in store.gaps() if gap.last_slot_utc > first.slot_utc] == []
        assert last.reading_values == {"air": 21.562}
        late = [(row.captured_utc - row.slot_utc).total_seconds() for row in rows(store)]
        assert max(late) < 2.0
        causes = {one.name: one.cause for one in last.readings}
        assert causes["stuck"].startswith("no answer for")
        assert causes["slow"] in SLOW
        failed = [event.detail for event in store.events(kind="reading_failed")]
        assert sorted(detail.partition(":")[0] for detail in failed) == ["slow", "stuck"]
    log = (tmp_path / "log").read_text()
    assert log.count("event=reading_failed") == 2


def test_a_failure_is_told_once_and_its_end_once(tmp_path: Path, warm: Path) -> None:
    """Also over a restart; a loose contact is one fault."""
    config = reading("air", script(f"cat {warm}"), "scale = 0.001")
    warm.unlink()
    log = run(tmp_path, config, "--max-slots", "3")
    assert log.count("event=reading_failed") == 1
    assert "sh: ended with code 1 (cat: " in log
    assert "reading_failed" not in run(tmp_path, config, "--max-slots", "2")
    warm.write_text("20000")
    log = run(tmp_path, config, "--max-slots", "4")
    assert log.count("event=reading_back") == 1
    with open_store(tmp_path / "state", create=False) as store:
        events = [event for event in store.events() if event.kind.startswith("reading_")]
        assert [event.kind for event in events] == ["reading_failed", "reading_back"]
        assert [row.reading_values.get("air") for row in rows(store)] == [None] * 5 + [20.0] * 4


def test_a_late_row_has_the_readings_that_its_frames_had(tmp_path: Path, warm: Path) -> None:
    """The row is lost, the frames are not."""
    config = reading("air", file_of(warm)) + reading("deck", script("exit 1"))
    run(tmp_path, config, "--max-slots", "2")
    with closing(sqlite3.connect(tmp_path / "state" / "dcam.db")) as database, database:
        database.execute("DELETE FROM measurement WHERE slot_utc LIKE '%00:01:00Z'")
    warm.write_text("99000")
    run(tmp_path, config, "--max-slots", "1")
    with open_store(tmp_path / "state", create=False) as store:
        late = rows(store)[1]
        assert late.recorded_late
        assert late.reading_values == {"air": 21.562}
        assert late.readings[1].cause == "not known: the row was made from its frames"


def test_a_reload_takes_sensors_in_and_out(tmp_path: Path, warm: Path) -> None:
    config = reading("air", file_of(warm), "timeout_s = 1.0") + REAL_TIME
    with running(tmp_path, config) as process:
        wait_for(lambda: done_slots(tmp_path) >= 1, "a slot")
        config = config.replace('"air"', '"deck"').replace('"degC"', '"K"')
        (tmp_path / "dcam.toml").write_text(SITE + config)
        process.send_signal(signal.SIGHUP)
        wait_for(lambda: "event=reloaded" in (tmp_path / "log").read_text(), "the reload")
        before = done_slots(tmp_path)
        wait_for(lambda: done_slots(tmp_path) >= before + 2, "two slots")
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 0
    with open_store(tmp_path / "state", create=False) as store:
        first, *_, last = rows(store)
        assert [one.name for one in first.readings] == ["air"]
        assert [(one.name, one.unit, one.value) for one in last.readings] == [("deck", "K", 21.562)]
