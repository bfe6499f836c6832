"""Opening: new, old, newer and damaged files; migrations after a backup."""

from __future__ import annotations

import os
import shutil
import signal
import sqlite3
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

import pytest
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Engine, create_engine, event, inspect

from benchmarks.migration import old_row, write_old
from daemon.errors import (
    DatabaseDamagedError,
    DatabaseForeignError,
    DatabaseMissingError,
    DatabaseNewerError,
    DatabaseOlderError,
    DatabaseUnwritableError,
    StoreError,
)
from daemon.store import migrate
from daemon.store.damage_note import databases_set_aside
from daemon.store.database import open_store, open_store_readonly
from daemon.store.engine import make_engine
from daemon.store.opening import open_checked_store
from daemon.store.revisions import REVISIONS, SCRIPTS
from daemon.store.schema import Base
from daemon.times import slot_text
from tests.daemon.store.examples import full_record, record, slot
from tests.daemon.store.writer import counted, die_at

NOW = datetime(2026, 3, 1, 12, 34, 56, tzinfo=UTC)

NEXT_REVISION = """
import sqlalchemy as sa
from alembic import op

revision = "9999"
down_revision = "{head}"

def upgrade():
    op.create_table("weather", sa.Column("id", sa.Integer(), primary_key=True))
    {then}
"""


def tables(path: Path) -> set[str]:
    with closing(sqlite3.connect(path)) as connection:
        found = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
        return {name for (name,) in found}


def next_version(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, then: str = "") -> None:
    """Let the program be one version further on."""
    scripts = tmp_path / "next version"
    shutil.copytree(SCRIPTS, scripts)
    text = NEXT_REVISION.format(head=migrate.head_revision(), then=then)
    (scripts / "versions" / "9999_weather.py").write_text(text)
    monkeypatch.setattr(migrate, "scripts", lambda: scripts)


@pytest.fixture
def state(tmp_path: Path) -> Path:
    """A state directory with one row."""
    with open_store(tmp_path / "state", now_utc=NOW) as store:
        store.add_measurement(full_record(slot(0)))
    return tmp_path / "state"


def test_a_new_directory_gets_an_empty_database(tmp_path: Path) -> None:
    with open_store(tmp_path / "var" / "lib" / "dcam") as store:
        assert list(store.measurements()) == []
        assert store.active_calibration() is None
        assert store.accounted() is None
    assert [path.name for path in store.path.parent.iterdir()] == ["dcam.db"]


def test_the_empty_file_of_an_interrupted_start_is_no_obstacle(tmp_path: Path) -> None:
    (tmp_path / "dcam.db").touch()
    with open_store(tmp_path) as store:
        assert store.last_slot() is None


def test_no_database_is_said_plainly(tmp_path: Path) -> None:
    for opener in (open_store_readonly, lambda path: open_store(path, create=False)):
        with pytest.raises(DatabaseMissingError, match=r"dcam\.db: no database: start dcamd once"):
            opener(tmp_path / "nowhere")
    assert not (tmp_path / "nowhere").exists()


def test_a_directory_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(DatabaseUnwritableError, match="state"):
        open_store(tmp_path / "file" / "state")


def test_migrations_make_what_the_program_expects(tmp_path: Path) -> None:
    """The declared tables and the migrated ones cannot drift apart, checks included."""
    open_store(tmp_path / "migrated").close()
    migrated = make_engine(tmp_path / "migrated" / "dcam.db")
    declared = create_engine(f"sqlite:///{tmp_path}/declared.db")
    Base.metadata.create_all(declared)
    try:
        with migrated.connect() as connection:
            context = MigrationContext.configure(connection, opts={"compare_type": True})
            assert compare_metadata(context, Base.metadata) == []
        for table in Base.metadata.tables:
            checks = [
                {check["name"]: check["sqltext"] for check in found.get_check_constraints(table)}
                for found in (inspect(migrated), inspect(declared))
            ]
            assert checks[0] == checks[1]
            primary = [
                inspect(one).get_pk_constraint(table)["constrained_columns"]
                for one in (migrated, declared)
            ]
            assert primary[0] == primary[1]
    finally:
        migrated.dispose()
        declared.dispose()


def test_the_names_of_all_migrations_are_known_without_loading_them() -> None:
    scripts = ScriptDirectory.from_config(migrate.alembic_config())
    assert list(REVISIONS) == [script.revision for script in scripts.walk_revisions()][::-1]


def test_an_old_database_is_saved_and_then_migrated(
    state: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    head = migrate.head_revision()
    next_version(tmp_path, monkeypatch)
    with pytest.raises(DatabaseOlderError, match=r"this one needs 9999\): start dcamd once"):
        open_store_readonly(state)
    with pytest.raises(DatabaseOlderError):
        open_store(state, migrate=False)
    with open_store(state, now_utc=NOW) as store:
        assert store.last_slot() == slot(0)
    assert "weather" in tables(state / "dcam.db")

    saved = state / f"dcam.db.revision-{head}.20260301T123456Z"
    assert "weather" not in tables(saved)
    with closing(sqlite3.connect(saved)) as connection:
        assert connection.execute("SELECT count(*) FROM measurement").fetchone() == (1,)

    with open_store(state, now_utc=NOW):
        pass
    assert len(list(state.glob("dcam.db.revision-*"))) == 1


def test_rows_from_before_bursts_rest_on_one_pair(tmp_path: Path) -> None:
    """A database of the first revision: values stay, and say that one pair was used."""
    engine = make_engine(tmp_path / "dcam.db")
    config = migrate.alembic_config()
    with engine.execution_options(dcam_begin="IMMEDIATE").begin() as connection:
        config.attributes["connection"] = connection
        command.upgrade(config, "0001")
        for minute, flag, x_mm in ((0, 1, 0.25), (1, 4, None)):
            connection.exec_driver_sql(
                "INSERT INTO measurement (slot_utc, flag, reasons, x_mm, y_mm, sigma_x_mm,"
                " sigma_y_mm, cov_xy_mm2, discs_found, corners_used, recorded_late, config_hash,"
                " version) VALUES (?, ?, '', ?, 0.5, 0.1, 0.1, 0.0, 5, 900, 0, 'c0ffee', '0.1')",
                (slot_text(slot(minute)), flag, x_mm),
            )
    engine.dispose()
    with open_store(tmp_path, now_utc=NOW) as store:
        first, second = (row.measurement for row in store.measurements())
    assert first.corrected is not None
    assert first.corrected.mm.tolist() == [0.25, 0.5]
    assert (first.spread_mm, first.frames_used, second.frames_used) == (None, 1, 0)


def test_rows_from_before_further_targets_stay_as_they_are(tmp_path: Path) -> None:
    """A database of revision 0006: values and digests stay; the image gives the whole sigma."""
    row = old_row(0, slot(0))
    write_old(tmp_path / "dcam.db", "0006", 1, slot(0))
    with open_store(tmp_path, now_utc=NOW) as store:
        (read,) = store.measurements()
        store.add_measurement(full_record(slot(1)))
    assert read.measurement.corrected is not None
    assert read.measurement.corrected.mm.tolist() == [0.25, 0.5]
    assert read.measurement.corrected.image_mm2 is None
    assert (read.measurement.closure, read.measurement.targets) == (None, ())
    with closing(sqlite3.connect(tmp_path / "dcam.db")) as connection:
        kept = connection.execute("SELECT digest FROM measurement WHERE id = 1").fetchone()
    assert kept == (row["digest"],)
    with open_checked_store(tmp_path) as store:
        assert store.last_slot() == slot(1)


@pytest.mark.parametrize(
    "failing",
    [
        ("op.execute('SELECT * FROM no_such_table')", "no such table: no_such_table"),
        ("op.execute('UPDATE measurement SET flag = 2')", "CHECK constraint failed"),
        ("op.execute('DROP TABLE event'); {}['key']", "key"),
        (
            "op.get_bind().connection.driver_connection.interrupt(); raise MemoryError",
            "MemoryError",
        ),
    ],
    ids=["statement", "constraint", "script", "memory"],
)
def test_a_failing_migration_changes_nothing(
    state: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: tuple[str, str]
) -> None:
    next_version(tmp_path, monkeypatch, then=failing[0])
    before = tables(state / "dcam.db")
    for _ in range(2):
        with pytest.raises(StoreError) as raised:
            open_store(state, now_utc=NOW)
        assert str(raised.value).startswith(
            f"{state}/dcam.db: cannot be brought to revision 9999 ("
        )
        assert failing[1] in str(raised.value)
        assert str(raised.value).endswith(
            "; nothing was changed: install the version before again, and report this"
        )
        assert "\n" not in str(raised.value)
    assert tables(state / "dcam.db") == before
    assert [path.name for path in state.iterdir()] == ["dcam.db"]
    monkeypatch.undo()
    with open_checked_store(state) as store:
        assert store.last_slot() == slot(0)
        store.add_measurement(record(slot(1)))


def test_killed_anywhere_in_a_migration_the_old_version_works_or_the_new_one_does(
    state: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SIGKILL before every statement, sync and rename: no row is lost, and no copies pile up."""
    whole = state.rename(tmp_path / "whole")
    next_version(tmp_path, monkeypatch, then="op.execute('UPDATE gap SET detail = 1')")
    step, killed = 0, True
    migrated = set()
    while killed:
        step += 1
        shutil.copytree(whole, state)
        child = os.fork()
        if child == 0:
            kill_at(step)
            open_store(state, now_utc=NOW)
            os._exit(0)
        killed = os.waitpid(child, 0)[1] == signal.SIGKILL
        is_new = "weather" in tables(state / "dcam.db")
        migrated.add(is_new)
        if not is_new:
            with monkeypatch.context() as old:
                old.setattr(migrate, "scripts", lambda: SCRIPTS)
                with open_store(state) as store:
                    assert store.last_slot() == slot(0)
        with open_checked_store(state, now_utc=NOW) as store:
            assert [row.slot_utc for row in store.measurements()] == [slot(0)]
        head = REVISIONS[-1]
        assert sorted(path.name for path in state.iterdir()) == [
            *("dcam.db", f"dcam.db.revision-{head}.20260301T123456Z")
        ]
        shutil.rmtree(state)
    assert step > 15
    assert migrated == {False, True}


def kill_at(last_step: int) -> None:
    """Have this process killed at its n-th statement, sync or rename."""
    step = die_at(last_step)
    os.fsync = counted(step, os.fsync)
    Path.replace = counted(step, Path.replace)
    Path.rename = counted(step, Path.rename)
    event.listen(Engine, "before_cursor_execute", step)
    event.listen(Engine, "commit", step)


def test_half_a_copy_that_a_cut_left_goes_with_the_next_migration(
    state: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for suffix in ("", "-wal", "-shm", "-journal"):
        (state / f".dcam.db.revision-0001.20260101T000000Z.tmp{suffix}").write_bytes(b"half")
    next_version(tmp_path, monkeypatch)
    open_store(state, now_utc=NOW).close()
    assert list(state.glob(".*")) == []


def test_a_database_of_a_newer_version_is_refused_and_left_alone(
    state: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    next_version(tmp_path, monkeypatch)
    open_store(state, now_utc=NOW).close()
    monkeypatch.undo()
    content = (state / "dcam.db").read_bytes()
    for opener in (open_store, open_store_readonly):
        with pytest.raises(DatabaseNewerError) as caught:
            opener(state)
        message = str(caught.value)
        assert "\n" not in message
        assert "dcam.db: written by a newer version (revision 9999, this one knows up" in message
        assert message.endswith(
            "install that version again, or restore "
            f"dcam.db.revision-{REVISIONS[-1]}.20260301T123456Z, which has no later rows"
        )
    assert (state / "dcam.db").read_bytes() == content


@pytest.mark.parametrize("content", [b"not a database\n" * 100, b"SQLite format 3\0" + b"x" * 9000])
def test_a_file_that_is_no_database_is_refused_and_left_alone(
    tmp_path: Path, content: bytes
) -> None:
    (tmp_path / "dcam.db").write_bytes(content)
    for opener in (open_store, open_store_readonly):
        with pytest.raises(DatabaseDamagedError, match=r"dcam\.db: .*: restart dcamd, it sets"):
            opener(tmp_path)
    assert (tmp_path / "dcam.db").read_bytes() == content


def test_damaged_pages_are_noticed_at_the_start(tmp_path: Path) -> None:
    with open_store(tmp_path) as store:
        for number in range(60):
            store.add_measurement(full_record(slot(number)))
    content = bytearray((tmp_path / "dcam.db").read_bytes())
    with closing(sqlite3.connect(tmp_path / "dcam.db")) as connection:
        (page,) = connection.execute(
            "SELECT rootpage FROM sqlite_master WHERE name = 'measurement'"
        ).fetchone()
    content[4096 * (page - 1) : 4096 * page] = bytes(4096)
    (tmp_path / "dcam.db").write_bytes(content)
    with pytest.raises(DatabaseDamagedError, match="damaged"):
        open_store(tmp_path)


def test_another_programs_database_is_refused(tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / "dcam.db")) as connection:
        connection.execute("CREATE TABLE notes (text)")
    for opener in (open_store, open_store_readonly, open_checked_store):
        with pytest.raises(DatabaseForeignError, match="not one of this program"):
            opener(tmp_path)
    assert tables(tmp_path / "dcam.db") == {"notes"}


@pytest.mark.parametrize(
    "tables",
    [
        "CREATE TABLE gap (text)",
        "CREATE TABLE alembic_version (version_num); CREATE TABLE notes (text)",
        "CREATE TABLE alembic_version (version_num); CREATE TABLE mark (text)",
    ],
)
def test_another_programs_database_with_tables_of_our_names_is_set_aside(
    tmp_path: Path, tables: str
) -> None:
    """Each start would end at it; so slots go on, and the file is kept."""
    with closing(sqlite3.connect(tmp_path / "dcam.db")) as connection:
        connection.executescript(tables)
    before = (tmp_path / "dcam.db").read_bytes()
    with open_checked_store(tmp_path) as store:
        store.add_measurement(record(slot(0)))
    (aside,) = databases_set_aside(tmp_path)
    assert aside.read_bytes() == before
    with open_checked_store(tmp_path) as store:
        assert store.last_slot() == slot(0)


def test_a_path_with_signs_that_mean_something_elsewhere(tmp_path: Path) -> None:
    odd = tmp_path / "100% öffen #1?mode=rw"
    with open_store(odd) as store:
        store.add_measurement(record(slot(0)))
    with open_store_readonly(odd) as store:
        assert store.last_slot() == slot(0)


def test_alembic_itself_finds_the_installed_scripts(tmp_path: Path) -> None:
    """A fresh database that Alembic upgrades by hand is one that the program takes."""
    engine = make_engine(tmp_path / "dcam.db")
    config = migrate.alembic_config()
    with engine.begin() as connection:
        config.attributes["connection"] = connection
        command.upgrade(config, "head")
    engine.dispose()
    with open_store(tmp_path, migrate=False) as store:
        assert store.last_slot() is None
