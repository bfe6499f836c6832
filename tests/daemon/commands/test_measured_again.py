"""A dcamd that woke with a wrong clock: its rows are measured again, and `verify` rebuilds all."""

from __future__ import annotations

import json
import os
import shutil
import signal
from collections import Counter
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import pytest
from sqlalchemy import Engine, event

from daemon.config.reading import find_installation
from daemon.main import serve
from daemon.store.database import open_store, open_store_readonly
from daemon.store.records import Again, MeasurementRecord
from daemon.store.rows.convert import measurement_columns
from daemon.times import slot_text
from tests.daemon.commands.conftest import FURTHER, RUNNING, SIMULATED, START, Ctl, Ran
from tests.daemon.store.examples import full_record
from tests.daemon.store.writer import counted, die_at
from tests.programs import ran
from tests.waiting import PATIENCE_S

MINUTE = timedelta(minutes=1)
CONFIG = SIMULATED.replace("[simulation]", f"{FURTHER}\n[simulation]") + RUNNING
WOKE, TRUE = START - timedelta(hours=5), START + 5 * MINUTE
"""What the clock said when the computer woke, and when that was."""
BEFORE, WRONG, AFTER = 2, 3, 2
"""Slots before the power failed, under the wrong clock, and under the right one."""


class Bridge:
    """A site with fixed targets: what is known of a row depends on its time and on others."""

    def __init__(self, directory: Path, ctl: Ctl | None = None) -> None:
        self.config, self.state, self._ctl = directory / "dcam.toml", directory / "state", ctl

    def run(self, slots: int, clock_utc: datetime | None = None) -> None:
        """One life of dcamd; it goes on at the end of the record unless its clock is set."""
        self.set_clock(clock_utc)
        serve(find_installation(self.config, self.state), max_slots=slots)

    def set_clock(self, clock_utc: datetime | None) -> None:
        clock = "" if clock_utc is None else f"\nclock_start_utc = {slot_text(clock_utc)}"
        self.config.write_text(CONFIG.replace("[simulation]", f"[simulation]{clock}", 1))

    def ctl(self, *arguments: object) -> Ran:
        assert self._ctl is not None
        return self._ctl("--config", self.config, "--state", self.state, *arguments)

    def date(self) -> Ran:
        """An operator knows by how much the clock was off."""
        self.set_clock(None)
        shift_s = (TRUE - WOKE).total_seconds()
        return self.ctl("redate", "--boot", "this", "--shift", shift_s)

    def left_to_measure_again(self) -> int:
        return json.loads(self.ctl("status", "--json").out)["to_measure_again"]

    def rows(self) -> list[MeasurementRecord]:
        with open_store_readonly(self.state) as store:
            return list(store.measurements())

    def redated(self) -> list[MeasurementRecord]:
        return [row for row in self.rows() if row.redated_from_utc is not None]


@pytest.fixture(scope="module")
def lived(further: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two rows; then three pairs of a wrong clock, two rows of the right one. Not to be changed."""
    directory = tmp_path_factory.mktemp("lived")
    shutil.copytree(further / "state", directory / "state")
    made = Bridge(directory)
    made.run(BEFORE)
    made.run(WRONG, WOKE)
    made.run(AFTER, TRUE + 10 * MINUTE)
    return directory


@pytest.fixture
def bridge(lived: Path, ctl: Ctl, tmp_path: Path) -> Bridge:
    """A site of its own with that record."""
    shutil.copytree(lived, tmp_path, dirs_exist_ok=True)
    return Bridge(tmp_path, ctl)


def sigmas_mm(rows: list[MeasurementRecord]) -> list[float]:
    return [float(row.measurement.corrected.covariance_mm2[1, 1]) ** 0.5 for row in rows]


def test_rows_of_a_wrong_clock_are_those_of_their_true_times_in_the_end(bridge: Bridge) -> None:
    """Dated by hand, measured again by dcamd, and from then on the same to the last bit."""
    assert len(bridge.rows()) == BEFORE + AFTER
    dated = bridge.date()
    assert dated.code == 0, dated.err
    assert "dcamd will measure them again" in dated.out
    first = bridge.redated()
    assert [row.slot_utc for row in first] == [TRUE + k * MINUTE for k in (0, 1, 2)]
    ran = bridge.ctl("verify", "--rebuild", 100)
    assert ran.code == 0, ran.out
    assert "\n4 rows made once more from their frames and compared to the last bit" in ran.out
    assert "\n3 rows that a wrong clock had dated, with values as of its time still" in ran.out
    assert "3 rows of a wrong clock: dcamd will measure them again" in ran.out
    assert bridge.left_to_measure_again() == WRONG
    shown = " ".join(bridge.ctl("status").out.split())
    assert "3 rows of a wrong clock left to measure again" in shown

    bridge.run(1)
    assert bridge.left_to_measure_again() == 0
    ran = bridge.ctl("verify", "--rebuild", 100)
    assert ran.code == 0, ran.out
    assert "\n8 rows made once more from their frames and compared to the last bit" in ran.out
    assert "wrong clock" not in ran.out
    again = bridge.redated()
    assert [row.slot_utc for row in again] == [row.slot_utc for row in first]
    assert all(row.recorded_late for row in again)
    assert [row.redated_from_utc for row in again] == [WOKE + k * MINUTE for k in (0, 1, 2)]
    assert sigmas_mm(again) != sigmas_mm(first)

    with open_store_readonly(bridge.state) as store:
        (told,) = store.events(kind="measured_again")
    assert "as of their true times, up to slot 2026-03-01T00:07:00Z: 3 rows, changed by" in (
        told.detail
    )
    done = json.loads(bridge.ctl("redate", "--done", "--json").out)["done"]
    assert [row["measured_again"] for row in done] == ["measured"] * WRONG
    for row, before, now in zip(done, sigmas_mm(first), sigmas_mm(again), strict=True):
        assert row["before_sigma_y_mm"] == pytest.approx(before, abs=1e-6)
        assert row["sigma_y_mm"] == pytest.approx(now, abs=1e-6)


def test_rows_without_their_images_stay_as_measured_and_verify_says_why(bridge: Bridge) -> None:
    bridge.date()
    first, (one, *_) = bridge.redated(), bridge.redated()
    for frame in (one.main_frame, one.sub_frame):
        (bridge.state / frame).unlink()
    bridge.run(1)
    assert bridge.redated()[0].measurement.corrected.mm.tolist() == (
        first[0].measurement.corrected.mm.tolist()
    )
    assert [row.recorded_late for row in bridge.redated()] == [False, True, True]
    ran = bridge.ctl("verify", "--rebuild", 100)
    assert "1 row of a wrong clock: with values as of its time, as their images" in ran.out
    assert "\n7 rows made once more from their frames and compared to the last bit" in ran.out


def test_rows_that_were_held_against_rows_in_wrong_slots_are_counted_apart(
    further: Path, ctl: Ctl, tmp_path: Path
) -> None:
    """Two of four rows are of ten minutes before: what the two others saw is nobody's any more."""
    shutil.copytree(further / "state", tmp_path / "state")
    bridge = Bridge(tmp_path, ctl)
    bridge.run(4)
    span = ("--since", slot_text(START), "--until", slot_text(START + 2 * MINUTE))
    moved = bridge.ctl("redate", *span, "--shift", -600)
    assert moved.code == 0, moved.err
    bridge.run(2)
    verified = bridge.ctl("verify", "--rebuild", 100)
    assert verified.code == 0, verified.out
    # The row after them may have been in work when they went: dcamd may run beside `redate`.
    assert "\n3 rows made once more from their frames and compared to" in verified.out
    assert "\n3 rows measured while rows of a wrong clock stood before them" in verified.out
    assert "as of its time" not in verified.out


def test_killed_while_it_measures_again_it_goes_on_at_the_next_start(bridge: Bridge) -> None:
    bridge.date()
    first = bridge.redated()
    words = ("tests.daemon.commands.killed_again", bridge.config, bridge.state)
    killed = ran(*words, 2, timeout=PATIENCE_S)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert [row.recorded_late for row in bridge.redated()] == [True, True, False]
    assert measurement_columns(bridge.redated()[2]) == measurement_columns(first[2])
    bridge.run(1)
    assert [row.recorded_late for row in bridge.redated()] == [True, True, True]
    verified = bridge.ctl("verify", "--rebuild", 100)
    assert verified.code == 0, verified.out
    assert "wrong clock" not in verified.out


def killed_at(state: Path, last_step: int) -> bool:
    """Replace a row in a process that is killed at a step; whether it came so far."""
    child = os.fork()
    if child == 0:
        with open_store(state) as store:
            number, slot_utc = store.next_to_measure_again()
            record = replace(store.measurement(slot_utc), version="again", recorded_late=True)
            step = die_at(last_step)
            os.fsync = counted(step, os.fsync)
            event.listen(Engine, "before_cursor_execute", step)
            event.listen(Engine, "commit", step)
            store.measured_again(number, record)
            os._exit(0)
    _, status = os.waitpid(child, 0)
    assert status in {0, signal.SIGKILL}
    return status != 0


def test_a_kill_leaves_the_row_as_dated_or_as_measured_again(tmp_path: Path) -> None:
    """At each statement: one row in the slot, and what it was first is kept in either case."""
    before = tmp_path / "before"
    first = replace(full_record(START, calibration_id=None), redated_from_utc=None)
    with open_store(before) as store:
        store.add_measurement(first)
        moved = replace(first, slot_utc=TRUE, redated_from_utc=START)
        store.move_row(START, moved)
    found: Counter[tuple[str, bool]] = Counter()
    for last_step in range(1, 100):
        state = Path(shutil.copytree(before, tmp_path / str(last_step)))
        was_killed = killed_at(state, last_step)
        with open_store(state) as store:
            (row,) = store.measurements()
            (kept,) = store.redated()
            assert row.slot_utc == kept.slot_utc == TRUE
            assert (kept.before.slot_utc, kept.before.version) == (START, first.version)
            assert (kept.again is Again.MEASURED) == (store.next_to_measure_again() is None)
            found[row.version, kept.again is Again.MEASURED] += 1
        if not was_killed:
            break
    assert set(found) == {(first.version, False), ("again", True)}
    assert found[first.version, False] >= 5
