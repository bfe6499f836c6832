"""A damaged database, as the operator of a running site meets it: reported, and slots go on."""

import re
import shutil
import sqlite3
from contextlib import closing
from datetime import timedelta
from pathlib import Path

import pytest

from daemon.errors import DatabaseDamagedError
from daemon.store.damage_note import databases_set_aside
from daemon.store.database import open_store
from daemon.store.records import GapCause
from tests.daemon.slots.test_dcamd import MARCH, REAL_TIME, Site, state_after, unaccounted
from tests.daemon.store.examples import calibration
from tests.programs import ran
from tests.waiting import PATIENCE_S

SMALL_DISK = """
mount -t tmpfs -o size=208k tmpfs "$0" && cp "$1"/dcam.db "$0" || exit 77
shift; "$@"; code=$?; ls "$0" >&2; exit $code
"""
"""A command on a copy of a state that takes up most of its disk."""


@pytest.fixture
def site(tmp_path):
    with closing(Site(tmp_path)) as site:
        site.configure()
        yield site


@pytest.fixture(scope="module")
def after_four_slots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return state_after(tmp_path_factory.mktemp("four"), 4)


@pytest.fixture(scope="module")
def after_a_slot_in_real_time(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return state_after(tmp_path_factory.mktemp("real"), 1, REAL_TIME)


def change(site: Site, *statements: str) -> None:
    """Change the file as a failing disk does: past every checksum."""
    with closing(sqlite3.connect(site.state / "dcam.db")) as connection:
        for statement in statements:
            connection.execute(statement)
        connection.commit()


def test_lost_rows_are_measured_again_or_become_a_gap(site: Site) -> None:
    """Three rows are damaged, the frames of one are gone too; a gap stays what it was."""
    site.configure(
        '[[simulation.scenarios]]\nkind = "camera_loss"\nrole = "sub"\nstart_min = 6\nend_min = 8\n'
    )
    assert site.run("--max-slots", "10").returncode == 0
    change(site, "UPDATE measurement SET discs_found = 99 WHERE id IN (3, 4, 5)")
    (site.state / "frames/2026/03/01/000400_sub.png").unlink()

    result = site.run("--max-slots", "2")

    assert result.returncode == 0, result.stderr
    assert "event=database_damaged" in result.stderr
    with site.store() as store:
        rows = {row.slot_utc: row for row in store.measurements()}
        minutes = [(slot - MARCH) // timedelta(minutes=1) for slot in rows]
        assert minutes == [0, 1, 2, 3, 5, 8, 9, 10, 11]
        assert [m for m, row in zip(minutes, rows.values(), strict=True) if row.recorded_late] == [
            *(2, 3)
        ]
        assert {row.measurement.diagnostics.discs_found for row in rows.values()} == {5}
        lost, camera = store.gaps()
        assert (lost.cause, lost.slots) == (GapCause.STORAGE_FAILED, 1)
        assert lost.first_slot_utc == MARCH + timedelta(minutes=4)
        assert "set aside as dcam.db.damaged-" in lost.detail
        assert (camera.cause, camera.slots) == (GapCause.CAMERA_LOST, 2)
        assert unaccounted(store) == 0
    again = site.run("--max-slots", "1")
    assert "database_damaged" not in again.stderr


def test_everything_lost_but_the_frames_is_measured_again(
    site: Site, after_four_slots: Path
) -> None:
    shutil.copytree(after_four_slots, site.state)
    (site.state / "dcam.db").write_bytes(b"")
    assert site.run("--max-slots", "1").returncode == 0
    with site.store() as store:
        late = [row.slot_utc for row in store.measurements() if row.recorded_late]
        assert late == [MARCH + timedelta(minutes=minute) for minute in range(4)]
        assert unaccounted(store) == 0


def test_damage_met_while_it_runs_ends_dcamd_and_the_next_start_saves_the_rest(
    site: Site, after_a_slot_in_real_time: Path
) -> None:
    site.configure(REAL_TIME)
    shutil.copytree(after_a_slot_in_real_time, site.state)
    with site.store() as store:
        store.add_calibration(calibration(), activate=True)
    process = site.start()
    site.notified(r"^STATUS=slot .* done")
    change(
        site,
        "DROP TRIGGER calibration_no_update",
        "UPDATE calibration SET content = replace(content, '1023', '1024')",
    )

    assert process.wait(PATIENCE_S) == 5

    log = site.log.read_text()
    (reported,) = [line for line in log.splitlines() if line.startswith("dcamd: error: ")]
    assert "dcam.db: damaged (a row of calibration, id 1, is not what was written)" in reported
    acknowledged = site.acknowledged(log)
    result = site.run("--max-slots", "1")
    assert result.returncode == 0, result.stderr
    with site.store() as store:
        assert store.measured_slots() >= acknowledged
        assert unaccounted(store, period_s=1) == 0
        assert [record.content for record in store.calibrations()] == [{"method": "lost"}]
        assert len(databases_set_aside(site.state)) == 1


@pytest.mark.parametrize("how", ["removed", "with its log", "renamed", "replaced"])
def test_a_database_that_loses_its_name_while_it_is_open_loses_no_row(
    site: Site, after_a_slot_in_real_time: Path, how: str
) -> None:
    """SQLite goes on writing into the removed file; what was acknowledged there comes back."""
    site.configure(REAL_TIME)
    shutil.copytree(after_a_slot_in_real_time, site.state)
    process = site.start()
    site.notified(r"^STATUS=slot .* done")
    database = site.state / "dcam.db"
    if how == "renamed":
        database.rename(site.state / "moved-away.db")
    else:
        shutil.copy(database, site.state.parent / "other.db")
        database.unlink()
    if how == "with its log":
        (site.state / "dcam.db-wal").unlink()
        (site.state / "dcam.db-shm").unlink()
    if how == "replaced":
        shutil.copy(site.state.parent / "other.db", database)

    assert process.wait(PATIENCE_S) == 5

    log = site.log.read_text()
    (said,) = [line for line in log.splitlines() if line.startswith("dcamd: error: ")]
    what = "replaced by another file" if how == "replaced" else "removed or renamed"
    assert f"dcam.db: {what} while it was in use" in said
    acknowledged = site.acknowledged(log)
    result = site.run("--max-slots", "1")
    assert result.returncode == 0, result.stderr
    with site.store() as store:
        assert store.measured_slots() >= acknowledged
        assert unaccounted(store, period_s=1) == 0
    # What was written into the file that was replaced is kept beside the one in its place.
    assert len(databases_set_aside(site.state)) == (how == "replaced")


@pytest.mark.parametrize("left", ["frames", "log"])
def test_a_missing_database_is_damage_where_it_has_left_traces(
    site: Site, after_four_slots: Path, left: str
) -> None:
    shutil.copytree(after_four_slots, site.state)
    if left == "log":
        with site.store() as store:
            store.add_event(MARCH, "happened", "known by the log alone")
            shutil.copytree(site.state, site.state.parent / "killed")
        shutil.rmtree(site.state)
        (site.state.parent / "killed").rename(site.state)
        shutil.rmtree(site.state / "frames")
    (site.state / "dcam.db").unlink()

    status = ran("daemon.ctl", "status", *site.where())
    result = site.run("--max-slots", "1")

    assert status.returncode >= 2
    assert result.returncode == 0, result.stderr
    assert f'why="missing beside its {left}"' in result.stderr
    with site.store() as store:
        assert len(store.events(kind="database_salvaged")) == 1
        if left == "log":
            assert [event.detail for event in store.events(kind="happened")]
        else:
            late = [row.slot_utc for row in store.measurements() if row.recorded_late]
            assert late == [MARCH + timedelta(minutes=minute) for minute in range(4)]
        assert unaccounted(store) == 0


def test_a_command_makes_no_new_database_beside_the_traces_of_a_lost_one(
    site: Site, after_four_slots: Path
) -> None:
    shutil.copytree(after_four_slots, site.state)
    (site.state / "dcam.db").unlink()
    with pytest.raises(DatabaseDamagedError, match="missing beside its frames: restart dcamd"):
        open_store(site.state)
    assert not (site.state / "dcam.db").exists()


def test_a_disk_without_room_for_the_saved_rows_is_reported(
    site: Site, after_four_slots: Path
) -> None:
    shutil.copytree(after_four_slots, site.state)
    change(site, "UPDATE measurement SET discs_found = 99 WHERE id = 2")
    shutil.copytree(site.state, site.state.parent / "damaged")
    places = (str(site.state), str(site.state.parent / "damaged"))
    result = site.run_below(
        ("unshare", "-Urm", "sh", "-c", SMALL_DISK, *places), "--max-slots", "1"
    )
    if result.returncode == 77 or "unshare" in result.stderr:
        pytest.skip(f"no mount without root here: {result.stderr.strip()}")
    assert result.returncode == 5
    assert re.search(r"dcamd: error: .*dcam\.db: the disk is full: free some", result.stderr)
    assert re.search(r"^dcam\.db\.damaged-\S+Z$", result.stderr, re.MULTILINE)
