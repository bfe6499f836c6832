"""`dcam-ctl backup`: whole, checked, beside a running daemon, and never over something else."""

import json
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from daemon.store.database import Store, open_store, open_store_readonly
from tests.daemon.commands.conftest import Ctl
from tests.daemon.rows import add_rows
from tests.daemon.store.examples import calibration, full_record, record, slot

ROOT = Path(__file__).parents[3]
ROWS = 40


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Store]:
    """A database that a daemon has open, with rows still in the log."""
    with open_store(tmp_path / "state") as store:
        store.add_calibration(calibration(), activate=True)
        add_rows(store, [full_record(slot(number), calibration_id=1) for number in range(ROWS)])
        yield store


def test_the_copy_holds_every_row_and_is_checked(running: Store, ctl: Ctl, tmp_path: Path) -> None:
    ran = ctl("--state", running.path.parent, "backup", tmp_path / "copy.db")
    assert (ran.code, ran.err) == (0, "")
    size_kb = (tmp_path / "copy.db").stat().st_size / 1000
    assert ran.out == (
        f"{tmp_path}/copy.db: 40 rows until 2026-03-01T00:39:00Z, {size_kb:.3g} kB, checked\n"
    )
    assert {path.name for path in tmp_path.iterdir()} == {"state", "copy.db"}

    restored = tmp_path / "restored"
    restored.mkdir()
    (tmp_path / "copy.db").rename(restored / "dcam.db")
    with open_store_readonly(restored) as copy:
        assert list(map(repr, copy.measurements())) == list(map(repr, running.measurements()))
        assert copy.active_calibration() == running.active_calibration()


def test_a_program_reads_rows_and_size(running: Store, ctl: Ctl, tmp_path: Path) -> None:
    ran = ctl("--state", running.path.parent, "backup", tmp_path / "copy.db", "--json")
    reported = json.loads(ran.out)
    assert (reported["schema"], reported["command"], reported["rows"]) == (1, "backup", ROWS)
    assert reported["file"] == str(tmp_path / "copy.db")
    assert reported["size_bytes"] == (tmp_path / "copy.db").stat().st_size
    assert reported["last_slot_utc"] == "2026-03-01T00:39:00Z"


def test_rows_written_meanwhile_neither_wait_nor_begin_the_copy_again(
    running: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A slot ends between any two steps; the copy goes on and shows the moment of its beginning."""
    monkeypatch.setattr("daemon.store.copying.PAGES_A_STEP", 4)
    seen = []

    def slot_ends(done: int, total: int) -> None:
        seen.append((done, total))
        running.add_measurement(record(slot(ROWS + len(seen))))

    copied = running.backup(tmp_path / "copy.db", slot_ends)

    assert copied.rows == ROWS
    (total,) = {total for _, total in seen}
    assert [done for done, _ in seen] == [*range(4, total, 4), total]
    assert len(list(running.measurements())) == ROWS + len(seen)


def test_an_older_backup_is_replaced_and_nothing_else(
    running: Store, ctl: Ctl, tmp_path: Path
) -> None:
    command = ("--state", running.path.parent, "backup")
    copy, letter = tmp_path / "copy.db", tmp_path / "letter.txt"
    assert ctl(*command, copy).code == 0
    running.add_measurement(record(slot(ROWS)))
    assert "41 rows" in ctl(*command, copy).out

    letter.write_text("Dear bridge\n")
    ran = ctl(*command, letter)
    assert ran.code == 5
    assert ran.err == (
        f"dcam-ctl: error: {letter}: exists and is no backup: choose another name, or say --force\n"
    )
    assert letter.read_text() == "Dear bridge\n"
    assert ctl(*command, letter, "--force").code == 0
    assert letter.read_bytes() == copy.read_bytes()


def test_a_database_in_use_and_a_directory_are_refused_even_with_force(
    running: Store, ctl: Ctl, tmp_path: Path
) -> None:
    command = ("--state", running.path.parent, "backup", "--force")
    with open_store(tmp_path / "other") as other:
        other.add_measurement(record(slot(7)))
        assert "other/dcam.db: a database in use: choose" in ctl(*command, other.path).err
        assert other.last_slot() == slot(7)
    assert "a database in use" in ctl(*command, running.path).err
    assert "not a file: name the file" in ctl(*command, tmp_path).err
    link = tmp_path / "link.db"
    link.symlink_to("/dev/null")
    assert "not a file" in ctl(*command, link).err


def test_a_place_that_is_not_there_is_no_error_of_the_database(
    running: Store, ctl: Ctl, tmp_path: Path
) -> None:
    copy = tmp_path / "nowhere" / "copy.db"
    ran = ctl("--state", running.path.parent, "backup", copy)
    assert ran.code == 4
    assert ran.err.startswith(f"dcam-ctl: error: {copy}: cannot write the backup (No such file")
    assert len(ran.err.splitlines()) == 1


def test_a_damaged_original_is_reported_and_the_older_backup_stays(
    running: Store, ctl: Ctl, tmp_path: Path
) -> None:
    state, copy = running.path.parent, tmp_path / "copy.db"
    assert ctl("--state", state, "backup", copy).code == 0
    before = copy.read_bytes()
    running.close()
    with closing(sqlite3.connect(state / "dcam.db")) as connection:
        query = "SELECT rootpage FROM sqlite_master WHERE name = 'measurement'"
        (page,) = connection.execute(query).fetchone()
    with (state / "dcam.db").open("r+b") as file:
        file.seek(4096 * (page - 1))
        file.write(bytes(4096))

    ran = ctl("--state", state, "backup", copy)

    assert ran.code == 5
    assert ran.err.startswith(f"dcam-ctl: error: {state}/dcam.db: damaged (")
    assert len(ran.err.splitlines()) == 1
    assert copy.read_bytes() == before
    assert {path.name for path in tmp_path.iterdir()} == {"state", "copy.db"}


def test_a_full_disk_is_reported_and_the_older_backup_stays(running: Store, tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    script = (
        'mount -t tmpfs -o size=150k tmpfs "$0" || exit 77; older="$1"; shift;'
        ' cp "$older" "$0/copy.db"; "$@"; code=$?;'
        ' ls -A "$0" >&2; cmp "$0/copy.db" "$older" >&2; exit $code'
    )
    with open_store(tmp_path / "small") as small:
        small.backup(tmp_path / "older.db")
    command = [sys.executable, "-m", "daemon.ctl", "--state", str(running.path.parent), "backup"]
    ran = subprocess.run(
        [
            *("unshare", "-Urm", "sh", "-c", script),
            *(str(tmp_path / "disk"), str(tmp_path / "older.db")),
            *(*command, str(tmp_path / "disk" / "copy.db")),
        ],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    if ran.returncode == 77 or "unshare" in ran.stderr:
        pytest.skip(f"no mount without root here: {ran.stderr.strip()}")
    reported, *there = ran.stderr.splitlines()
    assert ran.returncode == 4
    assert reported.endswith("disk/copy.db: the disk is full: free some space")
    assert there == ["copy.db"]
