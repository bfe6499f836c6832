"""What is recorded: everything that the daemon and its commands write."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

from alembic import command

from daemon.recovery import mark_stop
from daemon.store.engine import make_engine
from daemon.store.migrate import alembic_config
from daemon.store.times import slot_text
from drivers.errors import DeviceLostError
from tests.crash.disk import Tree
from tests.crash.promises import STEP, Promises
from tests.crash.recording import STATE, Run, Scribe
from tests.crash.station import daemon
from tests.store.examples import calibration

START = datetime(2026, 3, 1, 23, 57, 30, tzinfo=UTC)
FIRST = START + STEP / 2
POWER_LOSS = frozenset({"power_loss"})
STOPPED = frozenset({"stopped"})


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
        station.store.add_calibration(calibration({"method": "another"}), activate=True)
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
