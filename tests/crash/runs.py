"""What is recorded: everything that the daemon and its commands write."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

from alembic import command

from daemon.retention.rules import Rules
from daemon.slots.pipeline import record_late
from daemon.slots.recovery import mark_finished, mark_stop
from daemon.store.engine import make_engine
from daemon.store.migrate import alembic_config
from daemon.store.records import GapCause
from daemon.store.sqlite import FILE_NAME
from daemon.times import slot_text
from drivers.errors import DeviceLostError
from tests.crash.disk import Tree, read_tree
from tests.crash.promises import STEP, Promises, read_database
from tests.crash.recording import STATE, Run, Scribe
from tests.crash.station import PERIOD_S, daemon, heard
from tests.daemon.store.examples import calibration, datum

START = datetime(2026, 3, 1, 23, 57, 30, tzinfo=UTC)
FIRST = START + STEP / 2
POWER_LOSS = frozenset({"power_loss"})
STOPPED = frozenset({"stopped"})
SHRINKING = Rules(every_slot_days=1, hourly_days=2, frames_days=3, min_free_gb=0.0, reserve_mb=0)


def two_days(scribe: Scribe) -> datetime:
    """A first start shortly before midnight, and everything that a daemon may meet until it ends.

    Two slots; a calibration; two slots on the next day, of which one has no camera; a slot that
    takes too long, and the next one; another calibration; a slot; a backup; a clean stop.
    """

    def lose_camera() -> None:
        msg = "the camera is gone"
        raise DeviceLostError(msg)

    def dawdle() -> None:
        station.clock.advance(70)

    orders: dict[datetime, Callable[[], None]] = {
        FIRST + 3 * STEP: lose_camera,
        FIRST + 4 * STEP: dawdle,
    }
    with daemon(scribe.state, START, "boot-1", orders) as (station, runner):
        scribe.tell(first_slot_utc=FIRST)
        runner.run(2)
        station.store.add_calibration(calibration(), activate=True)
        scribe.settled(station.store)
        runner.run(4)
        station.store.add_calibration(
            calibration({"method": "another"}), datum(0.3, 2.7), activate=True
        )
        scribe.settled(station.store)
        runner.run(1)
        station.store.backup(scribe.directory / "copy.db")
        scribe.tell(backups={"copy.db": scribe.promises[-1].rows})
        scribe.tell(absence=POWER_LOSS | STOPPED)
        mark_stop(station.store, station.clock.now_utc())
        scribe.tell(absence=STOPPED)
        return station.clock.now_utc()


def two_slots(scribe: Scribe) -> datetime:
    """A first start, two slots, the end of the power."""
    with daemon(scribe.state, START, "boot-1") as (station, runner):
        scribe.tell(first_slot_utc=scribe.promises[0].first_slot_utc or FIRST)
        runner.run(2)
        return station.clock.now_utc()


def wrong_clock(scribe: Scribe) -> datetime:
    """Two slots; the power fails; the clock wakes a year back, and is put right two slots later."""
    two_slots(scribe)
    past = timedelta(days=365)

    def ntp() -> None:
        station.clock.set_utc(station.clock.now_utc() + past)
        station.synchronised = True

    scribe.clock_is_wrong = True
    scribe.tell(absence=POWER_LOSS | {"clock_wrong"})
    woken_utc = START + 10 * STEP - past
    orders = {woken_utc + STEP / 2 + 2 * STEP: ntp}
    with daemon(scribe.state, woken_utc, "boot-2", orders) as (station, runner):
        station.synchronised = False
        runner.run(5)
        scribe.settled(station.store)
        return station.clock.now_utc()


def ageing(scratch: Path) -> tuple[Tree, Promises]:
    """A state directory with four slots on each of three days, and a gap between any two."""
    state = scratch / "ageing" / STATE
    slots = [
        FIRST + day * timedelta(days=1) + hour * timedelta(hours=3)
        for day in range(-3, 0)
        for hour in range(-4, 0)
    ]
    last = FIRST - STEP
    with heard(lambda _: None), daemon(state, slots[0] - STEP, "boot-0") as (station, _):
        station.store.record_gap(slots[0], last, GapCause.POWER_LOSS, period_s=PERIOD_S)
        for slot in slots:
            station.archive.store(slot, station.source.capture(slot), slot)
            record_late(station.context, slot)
        mark_finished(station.store, last)
    tree = read_tree(state.parent)
    gaps = read_database(state / FILE_NAME).causes
    return tree, Promises(slots[0], frozenset(slots), gaps=gaps)


def thinning(scribe: Scribe) -> datetime:
    """Two slots, after each of which the oldest frames go."""
    with daemon(scribe.state, START, "boot-1", rules=SHRINKING) as (station, runner):
        runner.run(2)
        scribe.settled(station.store)
        return station.clock.now_utc()


def damaged(scratch: Path) -> tuple[Tree, Promises]:
    """The state directory of the older site, of whose database the page of the gaps is lost."""
    tree, promised = ageing(scratch / "damaged")
    path = f"{STATE}/{FILE_NAME}"
    content = tree[path]
    assert content is not None
    with closing(sqlite3.connect(scratch / "damaged" / "ageing" / path)) as connection:
        (page,) = connection.execute(
            "SELECT rootpage FROM sqlite_master WHERE name = 'ix_event_time_utc'"
        ).fetchone()
    lost = content[: 4096 * (page - 1)] + b"\x55" * 4096 + content[4096 * page :]
    return {**tree, path: lost}, replace(promised, damaged=True)


def salvaging(scribe: Scribe) -> datetime:
    """The start after the damage, and a slot."""
    with daemon(scribe.state, START, "boot-1") as (station, runner):
        runner.run(1)
        scribe.settled(station.store)
        return station.clock.now_utc()


def coming_back(now_utc: datetime) -> Run:
    """A recovery, and the slot after it."""

    def run(scribe: Scribe) -> datetime:
        scribe.tell(absence=POWER_LOSS | scribe.promises[-1].absence)
        with daemon(scribe.state, now_utc, "boot-2") as (station, runner):
            scribe.settled(station.store)
            scribe.tell(absence=POWER_LOSS)
            runner.run(1)
            return station.clock.now_utc()

    return run


def older_database(scratch: Path) -> tuple[Tree, Promises]:
    """A state directory of the first version, with rows and a gap."""
    path = scratch / "dcam.db"
    slots = [FIRST - number * STEP for number in range(5, 0, -1)]
    engine = make_engine(path)
    config = alembic_config()
    with engine.execution_options(dcam_begin="IMMEDIATE").begin() as connection:
        config.attributes["connection"] = connection
        command.upgrade(config, "0001")
        for number, slot in enumerate(slots[:-1]):
            connection.exec_driver_sql(
                "INSERT INTO measurement (slot_utc, flag, reasons, x_mm, y_mm, sigma_x_mm,"
                " sigma_y_mm, cov_xy_mm2, discs_found, corners_used, recorded_late, config_hash,"
                " version) VALUES (?, 1, '', ?, 0.5, 0.1, 0.1, 0.0, 5, 900, 0, 'c0ffee', '0.1')",
                (slot_text(slot), number / 8),
            )
        connection.exec_driver_sql(
            "INSERT INTO gap (start_utc, end_utc, slots, period_s, cause, detail)"
            " VALUES (?, ?, 1, 60, 'camera_lost', '')",
            (slot_text(slots[-1]), slot_text(slots[-1])),
        )
        marks = {"heartbeat_utc": slot_text(slots[-1]), "boot_id": "boot-0"}
        for mark in marks.items():
            connection.exec_driver_sql("INSERT INTO mark (name, value) VALUES (?, ?)", mark)
    engine.dispose()
    promised = Promises(slots[0], frozenset(slots[:-1]), gaps={slots[-1]: "camera_lost"})
    return {STATE: None, f"{STATE}/dcam.db": path.read_bytes()}, promised
