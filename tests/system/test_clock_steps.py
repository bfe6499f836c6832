"""A live dcamd whose clock is stepped under it: it goes on, accounts for all slots, says so."""

from __future__ import annotations

import os
import re
import signal
import socket
from collections.abc import Iterator
from contextlib import closing
from datetime import datetime, timedelta
from multiprocessing import forkserver
from pathlib import Path

import libfaketime
import pytest

from daemon.store.database import ALWAYS, open_store
from tests.daemon.commands.conftest import SMALL
from tests.exhaustive import one_of
from tests.programs import PRELOADED, Program
from tests.waiting import PATIENCE_S

LIBRARY = next(Path(libfaketime.__file__).parent.rglob("libfaketime.so.1"))
SECONDS = SMALL.replace("[simulation]", '[schedule]\nperiod_s = 1\n[simulation]\nclock = "system"')
DAY_S, HOUR_S = 86_400, 3_600
BUILD_DATE_S = -1_400 * DAY_S
"""About where a computer without a battery wakes: at the day its systemd was built."""


class FakedClock:
    """The clock of all programs that are started meanwhile, which a test sets."""

    def __init__(self, directory: Path) -> None:
        self._shift = directory / "shift"
        self.set(0)
        self._programs = forkserver.ForkServer()
        self._programs.set_forkserver_preload(PRELOADED)

    def set(self, shift_s: int) -> None:
        """Step the clock: so far from the true time from now on."""
        new = self._shift.with_suffix(".new")
        new.write_text(f"{shift_s:+d}s\n", encoding="ascii")
        new.replace(self._shift)

    def start(self, patch: pytest.MonkeyPatch) -> None:
        """Have programs forked from one that runs under this clock."""
        for name, value in {
            "LD_PRELOAD": str(LIBRARY),
            "FAKETIME_TIMESTAMP_FILE": str(self._shift),
            "FAKETIME_NO_CACHE": "1",
            "FAKETIME_DONT_FAKE_MONOTONIC": "1",
        }.items():
            patch.setenv(name, value)
        self._programs.ensure_running()
        patch.setattr(forkserver, "connect_to_new_process", self._programs.connect_to_new_process)

    def close(self) -> None:
        self._programs._stop()


@pytest.fixture(scope="module")
def clock(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FakedClock]:
    with (
        closing(FakedClock(tmp_path_factory.mktemp("clock"))) as clock,
        pytest.MonkeyPatch.context() as patch,
    ):
        clock.start(patch)
        yield clock


class Station:
    """A dcamd with a slot every second, under a clock that the test sets."""

    def __init__(self, directory: Path, clock: FakedClock) -> None:
        self.state, self.log = directory / "state", directory / "log"
        self.config, self.set_clock = directory / "dcam.toml", clock.set
        self.config.write_text(SECONDS, encoding="utf-8")
        self._manager = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._manager.bind(str(directory / "notify"))
        self._manager.settimeout(PATIENCE_S)
        self._environ = os.environ | {"NOTIFY_SOCKET": str(directory / "notify")}

    def start(self) -> Program:
        where = ("--config", self.config, "--state", self.state)
        self._dcamd = Program("daemon.main", *where, env=self._environ, stderr=self.log)
        return self._dcamd

    def slots(self, count: int, since: datetime | None = None) -> datetime:
        """Wait until so many cycles have ended; gives the last one's slot."""
        done = 0
        while done < count:
            reported = self._manager.recv(4096).decode()
            found = re.search(r"STATUS=slot (\S+) ", reported)
            if found and (since is None or datetime.fromisoformat(found[1]) > since):
                done += 1
                last = datetime.fromisoformat(found[1])
        return last

    def close(self) -> None:
        self._dcamd.kill()
        self._dcamd.wait()
        self._manager.close()


@pytest.fixture
def station(tmp_path: Path, clock: FakedClock) -> Iterator[Station]:
    station = Station(tmp_path, clock)
    yield station
    station.close()


@pytest.mark.parametrize("step_s", [HOUR_S, DAY_S][:: one_of(2)])
def test_a_step_forward_and_back_again(station: Station, step_s: int) -> None:
    """The hour is a gap that names the clock; what comes after the step back is kept apart."""
    station.set_clock(0)
    dcamd = station.start()
    before = station.slots(2)
    station.set_clock(step_s)
    ahead = station.slots(2, since=before + timedelta(seconds=step_s // 2))
    station.set_clock(0)
    station.slots(3)
    dcamd.send_signal(signal.SIGTERM)
    assert dcamd.wait(PATIENCE_S) == 0
    with open_store(station.state, create=False) as store:
        rows = [row.slot_utc for row in store.measurements()]
        gap = next(gap for gap in store.gaps() if gap.slots > step_s // 2)
        apart = store.undated()
        first, last = store.accounted()
        found = store.coverage(first, last + timedelta(seconds=1), period_s=1)
    assert rows == sorted(set(rows))
    assert ahead in rows
    assert gap.cause == "clock_wrong"
    assert "the clock was stepped by +" in gap.detail
    assert found.unaccounted == 0
    assert len(apart) >= 1
    assert "clock_wrong" in station.log.read_text()


@pytest.mark.parametrize("step_s", [-HOUR_S, -DAY_S, BUILD_DATE_S][:: one_of(2)])
def test_a_step_back_and_forth_again(station: Station, step_s: int) -> None:
    """The record goes on where it was; nothing lies before its beginning."""
    station.set_clock(0)
    dcamd = station.start()
    before = station.slots(2)
    station.set_clock(step_s)
    station.slots(3)
    station.set_clock(0)
    after = station.slots(2, since=before)
    dcamd.send_signal(signal.SIGTERM)
    assert dcamd.wait(PATIENCE_S) == 0
    with open_store(station.state, create=False) as store:
        rows = [row.slot_utc for row in store.measurements(ALWAYS)]
        first, last = store.accounted()
        found = store.coverage(first, last + timedelta(seconds=1), period_s=1)
        missed = [gap for gap in store.gaps() if gap.cause == "clock_wrong"]
        apart = store.undated()
    assert rows == sorted(set(rows))
    assert min(rows) <= before
    assert max(rows) >= after
    assert found.unaccounted == 0
    assert last - first < timedelta(hours=1)
    # Where the kernel says that the clock is disciplined, the pairs have their slots again.
    assert apart or not missed or len(rows) > 4


def test_a_wake_in_the_past_loses_no_acknowledged_row(station: Station) -> None:
    """Killed, and up again with the clock of systemd's build date; then the clock is set."""
    station.set_clock(0)
    dcamd = station.start()
    station.slots(3)
    dcamd.kill()
    dcamd.wait()
    acknowledged = set(re.findall(r"event=slot_done slot=(\S+)", station.log.read_text()))
    station.set_clock(BUILD_DATE_S)
    dcamd = station.start()
    station.slots(3)
    with open_store(station.state, create=False) as store:
        first, _ = store.accounted()
    station.set_clock(0)
    station.slots(2, since=first)
    dcamd.send_signal(signal.SIGTERM)
    assert dcamd.wait(PATIENCE_S) == 0
    with open_store(station.state, create=False) as store:
        rows = {f"{row.slot_utc:%Y-%m-%dT%H:%M:%SZ}" for row in store.measurements()}
        start, last = store.accounted()
        found = store.coverage(start, last + timedelta(seconds=1), period_s=1)
    assert acknowledged <= rows
    assert start == first
    assert found.unaccounted == 0
