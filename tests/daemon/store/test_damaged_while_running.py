"""A damaged database, as the operator of a running site meets it: told, and slots go on."""

import re
import shutil
import sqlite3
from contextlib import closing
from datetime import timedelta

import pytest

from daemon.store.records import GapCause
from daemon.store.salvage.damage_note import databases_set_aside
from tests.daemon.slots.test_dcamd import MARCH, REAL_TIME, Site, unaccounted
from tests.daemon.store.examples import calibration

SMALL_DISK = """
mount -t tmpfs -o size=200k tmpfs "$0" && cp "$1"/dcam.db "$0" || exit 77
shift; "$@"; code=$?; ls "$0" >&2; exit $code
"""
"""A command on a copy of a state that takes up most of its disk."""


@pytest.fixture
def site(tmp_path):
    with closing(Site(tmp_path)) as site:
        site.configure()
        yield site


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
        assert {row.measurement.diagnostics.discs_found for row in rows.values()} == {0}
        lost, camera = store.gaps()
        assert (lost.cause, lost.slots) == (GapCause.STORAGE_FAILED, 1)
        assert lost.first_slot_utc == MARCH + timedelta(minutes=4)
        assert "set aside as dcam.db.damaged-" in lost.detail
        assert (camera.cause, camera.slots) == (GapCause.CAMERA_LOST, 2)
        assert unaccounted(store) == 0
    again = site.run("--max-slots", "1")
    assert "database_damaged" not in again.stderr


def test_everything_lost_but_the_frames_is_measured_again(site: Site) -> None:
    assert site.run("--max-slots", "4").returncode == 0
    (site.state / "dcam.db").write_bytes(b"")
    assert site.run("--max-slots", "1").returncode == 0
    with site.store() as store:
        late = [row.slot_utc for row in store.measurements() if row.recorded_late]
        assert late == [MARCH + timedelta(minutes=minute) for minute in range(4)]
        assert unaccounted(store) == 0


def test_damage_met_while_it_runs_ends_dcamd_and_the_next_start_saves_the_rest(site: Site) -> None:
    site.configure(REAL_TIME)
    assert site.run("--max-slots", "1").returncode == 0
    with site.store() as store:
        store.add_calibration(calibration(), activate=True)
    process = site.start()
    site.told(r"^STATUS=slot .* done")
    change(
        site,
        "DROP TRIGGER calibration_no_update",
        "UPDATE calibration SET content = replace(content, '1023', '1024')",
    )

    assert process.wait(60) == 5

    log = site.log.read_text()
    (told,) = [line for line in log.splitlines() if line.startswith("dcamd: error: ")]
    assert "dcam.db: damaged (a row of calibration, id 1, is not what was written)" in told
    acknowledged = site.acknowledged(log)
    result = site.run("--max-slots", "1")
    assert result.returncode == 0, result.stderr
    with site.store() as store:
        assert store.measured_slots() >= acknowledged
        assert unaccounted(store, period_s=1) == 0
        assert [record.content for record in store.calibrations()] == [{"method": "lost"}]
        assert len(databases_set_aside(site.state)) == 1


def test_a_disk_without_room_for_the_saved_rows_is_told(site: Site) -> None:
    assert site.run("--max-slots", "4").returncode == 0
    change(site, "UPDATE measurement SET discs_found = 99 WHERE id = 2")
    shutil.copytree(site.state, site.state.parent / "damaged")
    result = site.run(
        *("--max-slots", "1"),
        before=(
            *("unshare", "-Urm", "sh", "-c"),
            SMALL_DISK,
            *(str(site.state), str(site.state.parent / "damaged")),
        ),
    )
    if result.returncode == 77 or "unshare" in result.stderr:
        pytest.skip(f"no mount without root here: {result.stderr.strip()}")
    assert result.returncode == 5
    assert re.search(r"dcamd: error: .*dcam\.db: the disk is full: free some", result.stderr)
    assert re.search(r"^dcam\.db\.damaged-\S+Z$", result.stderr, re.MULTILINE)
