"""Damage: named, set aside, never deleted; what proves itself is carried over, nothing else is."""

from __future__ import annotations

import random
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
from alembic import command

from daemon.errors import DatabaseDamagedError, DatabaseNewerError, DatabaseUnwritableError
from daemon.store.damage_note import databases_set_aside, note_damage, read_note
from daemon.store.database import open_store, open_store_readonly
from daemon.store.engine import make_engine
from daemon.store.ledger.entries import LedgerEntry, LedgerKind
from daemon.store.migrate import alembic_config
from daemon.store.opening import damage_noted, open_checked_store
from daemon.store.records import GapCause, Mark
from daemon.store.salvage import damage, salvage
from daemon.store.sqlite import connect_readonly
from tests.daemon.store.examples import (
    PERIOD_S,
    START,
    calibration,
    datum,
    full_record,
    record,
    slot,
)
from tests.exhaustive import one_of

ROWS = 120
BIG = {"method": "rigid", "numbers": list(range(3000))}
"""A calibration that needs several pages."""
EVERYTHING = (
    *("measurement", "gap", "calibration", "calibration_activation", "datum", "ledger"),
    *("event", "mark"),
)

Row = tuple[object, ...]


def rows_of(path: Path) -> dict[str, set[Row]]:
    """Each table's rows, past the program; gaps without the number that they are given again."""
    with closing(sqlite3.connect(path)) as connection:
        found = {table: set(connection.execute(f"SELECT * FROM {table}")) for table in EVERYTHING}
    found["gap"] = {row[1:-1] for row in found["gap"]}
    return found


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The state of a site with rows of every kind, stopped in order; not to be changed."""
    state = tmp_path_factory.mktemp("sound") / "state"
    with open_store(state) as store:
        store.add_calibration(calibration(BIG), activate=True)
        store.add_calibration(calibration(), datum(1.0, 2.0), activate=True)
        for number in range(ROWS):
            store.add_measurement(full_record(slot(number), calibration_id=1 + number // 60))
        for number in range(6):
            first = ROWS + 100 * number
            store.record_gap(slot(first), slot(first + 9), GapCause.CRASH, period_s=PERIOD_S)
        for number in range(40):
            store.add_event(START, "happened", f"number {number}")
        note = LedgerEntry(LedgerKind.EXCLUDE, "eve", START, "paint", slot(3), slot(9))
        store.add_ledger_entry(note)
        store.set_mark(Mark.BOOT_ID, "boot-1")
        store.set_mark(Mark.CLEAN_STOP_UTC, "2026-03-01T02:00:00.000000Z")
    return state


@pytest.fixture
def state(sound: Path, tmp_path: Path) -> Path:
    """A copy that a test may damage."""
    return Path(shutil.copytree(sound, tmp_path / "state"))


def flip(content: bytearray, at: int, rng: random.Random) -> None:
    """One bit of one byte."""
    content[at] ^= 1 << rng.randrange(8)


def zero(size: int) -> Callable[[bytearray, int, random.Random], None]:
    """A whole block of the disk."""

    def harm(content: bytearray, at: int, _rng: random.Random) -> None:
        start = at // size * size
        content[start : start + size] = bytes(size)

    return harm


def opened_and_read(state: Path) -> None:
    """As the daemon's life: started again, with a note, when it meets damage while it reads."""
    for _ in range(2):
        try:
            with open_checked_store(state) as store, damage_noted(store):
                list(store.measurements())
                store.gaps()
                store.calibrations()
                store.events()
                list(map(store.get_mark, Mark))
        except DatabaseDamagedError:
            continue
        return
    pytest.fail("the damage was not dealt with at the second start")


@pytest.mark.parametrize(
    ("harm", "places", "kept"),
    [(flip, 40, 0.995), (zero(512), 30, 0.99), (zero(4096), 30, 0.97)],
    ids=["bits", "blocks", "pages"],
)
def test_a_hundred_random_places(
    sound: Path, tmp_path: Path, harm: Callable[..., None], places: int, kept: float
) -> None:
    """One place after the other: what is lost is what lay there, and nothing is ever wrong.

    Damage that changes what is read is noticed each time; what hits an unused byte need not be.
    """
    content = (sound / "dcam.db").read_bytes()
    true = rows_of(sound / "dcam.db")
    rng = random.Random(5)
    counted = dict.fromkeys(("kept", "lost", "wrong", "changed", "unnoticed"), 0)
    places //= one_of(3)
    for place in range(places):
        state = tmp_path / str(place)
        state.mkdir()
        damaged = bytearray(content)
        harm(damaged, rng.randrange(len(content)), rng)
        (state / "dcam.db").write_bytes(damaged)
        changed = reads_otherwise(state / "dcam.db", true)
        opened_and_read(state)
        found = rows_of(state / "dcam.db")
        aside = databases_set_aside(state)
        assert [path.read_bytes() for path in aside] in ([], [bytes(damaged)])
        counted["changed"] += changed
        counted["unnoticed"] += changed and not aside
        counted["kept"] += len(found["measurement"])
        counted["lost"] += ROWS - len(found["measurement"])
        counted["wrong"] += wrong(found, true)
        shutil.rmtree(state)
    assert counted["wrong"] == 0
    assert counted["kept"] > kept * ROWS * places
    assert counted["unnoticed"] == 0
    assert counted["changed"] > places / 4


def reads_otherwise(path: Path, true: dict[str, set[Row]]) -> bool:
    """Whether SQLite, without the program, gives other rows than were written, or none at all."""
    try:
        return rows_of(path) != true
    except sqlite3.Error:
        return True


def wrong(found: dict[str, set[Row]], true: dict[str, set[Row]]) -> int:
    """How many rows say what nobody wrote; that a calibration is lost, and the rest, is said."""
    said = {row for row in found["calibration"] if row[2] == salvage.LOST}
    said |= {row for row in found["event"] if row[2] == "database_salvaged"}
    said |= {row for row in found["mark"] if row[0] in {"salvaged", "schema", "identity"}}
    wrong = {table: found[table] - true[table] - said for table in found}
    # An activation may be given again: its calibration is the one that rows were measured with.
    wrong["calibration_activation"] = {
        row for row in wrong["calibration_activation"] if row[1] != 2
    }
    # Of a gap that was lost in part nothing else may come back.
    return sum(map(len, wrong.values()))


def test_a_hundred_places_at_once(sound: Path, tmp_path: Path) -> None:
    """Half of a small file's pages are hit: what is whole is kept, and nothing is wrong."""
    true = rows_of(sound / "dcam.db")
    damaged = bytearray((sound / "dcam.db").read_bytes())
    rng = random.Random(6)
    for _ in range(100):
        flip(damaged, rng.randrange(len(damaged)), rng)
    (tmp_path / "dcam.db").write_bytes(damaged)
    opened_and_read(tmp_path)
    found = rows_of(tmp_path / "dcam.db")
    assert wrong(found, true) == 0
    assert ROWS / 2 < len(found["measurement"]) < ROWS


def test_everything_that_is_whole_is_carried_over(state: Path, sound: Path) -> None:
    """The page that all of SQLite's ways lead through is gone: not one row is lost by that."""
    true = rows_of(sound / "dcam.db")
    with (state / "dcam.db").open("r+b") as file:
        file.write(bytes(4096))
    opened_and_read(state)
    found = rows_of(state / "dcam.db")
    assert wrong(found, true) == 0
    assert {table: len(rows) for table, rows in found.items() if rows < true[table]} == {}
    with open_store_readonly(state) as store:
        active = store.active_calibration()
        assert active is not None
        assert active.id == 2
        reported = store.events(kind="database_salvaged")[0].detail
        (aside,) = databases_set_aside(state)
        assert reported == (
            f"not a SQLite database; set aside as {aside.name}; "
            "kept 120 rows, 6 gaps, 2 calibrations; no row before the last one kept is missing"
        )
        assert store.get_mark(Mark.SALVAGED) == reported
    assert open_checked_store(state).damage is None
    assert len(databases_set_aside(state)) == 1


@pytest.mark.parametrize(
    ("make", "why"),
    [
        (lambda path: path.write_bytes(b"Dear bridge\n" * 999), "not a SQLite database"),
        (lambda path: path.write_bytes(path.read_bytes()[:40_000]), "malformed"),
        (lambda path: path.write_bytes(b"SQLite format 3\0" + bytes(9000)), "not a database"),
        (lambda path: (path.write_bytes(b""), (path.parent / "frames").mkdir()), "empty"),
        (lambda path: (path.unlink(), path.mkdir(), (path / "x").touch()), "not a file"),
    ],
    ids=["text", "truncated", "header only", "empty", "directory"],
)
def test_what_is_no_database_is_set_aside_and_reported(
    state: Path, make: Callable[[Path], object], why: str
) -> None:
    make(state / "dcam.db")
    for opener in (open_store, open_store_readonly):
        if why != "empty":
            with pytest.raises(DatabaseDamagedError, match="restart dcamd, it sets"):
                opener(state).close()
    with open_checked_store(state) as store:
        (event,) = store.events(kind="database_salvaged")
        assert event.detail.startswith(why) or why in event.detail
        store.add_measurement(record(slot(9000)))
    (aside,) = databases_set_aside(state)
    assert aside.is_dir() == (why == "not a file")


def test_an_empty_file_where_there_was_nothing_is_no_damage(tmp_path: Path) -> None:
    (tmp_path / "dcam.db").touch()
    with open_checked_store(tmp_path) as store:
        assert store.events() == []
    assert databases_set_aside(tmp_path) == []


def test_a_sound_database_is_left_alone(state: Path) -> None:
    before = rows_of(state / "dcam.db")
    with open_checked_store(state) as store:
        store.set_mark(Mark.CLEAN_STOP_UTC, None)
    note_damage(state, "somebody thought so")
    open_checked_store(state).close()
    after = rows_of(state / "dcam.db")
    assert all(after[table] == before[table] for table in EVERYTHING if table != "mark")
    assert databases_set_aside(state) == []
    assert read_note(state) is None


def test_a_database_of_a_newer_version_is_never_set_aside(state: Path) -> None:
    with closing(sqlite3.connect(state / "dcam.db")) as connection:
        connection.execute("UPDATE alembic_version SET version_num = '9999'")
        connection.execute("DELETE FROM mark WHERE name = 'schema'")
        connection.commit()
    with pytest.raises(DatabaseNewerError, match="newer version"):
        open_checked_store(state)
    assert databases_set_aside(state) == []


@pytest.mark.parametrize(
    "change",
    [
        "UPDATE alembic_version SET version_num = '0015'",
        "UPDATE sqlite_master SET sql = replace(sql, 'a slot of', 'b slot of')",
        "UPDATE sqlite_master SET sql = replace(sql, 'start_utc', 'start_utd') WHERE name = 'gap'",
    ],
    ids=["revision", "trigger", "table"],
)
def test_a_definition_that_nobody_wrote_is_damage(state: Path, sound: Path, change: str) -> None:
    """SQLite finds nothing wrong with these; the daemon would fail at every slot, or for ever."""
    with closing(sqlite3.connect(state / "dcam.db")) as connection:
        connection.execute("PRAGMA writable_schema=ON")
        connection.execute(change)
        connection.commit()
    open_checked_store(state).close()
    assert len(databases_set_aside(state)) == 1
    assert wrong(rows_of(state / "dcam.db"), rows_of(sound / "dcam.db")) == 0


@contextmanager
def killed_while_it_ran(state: Path, more: int) -> Iterator[list[int]]:
    """A database whose last rows are in its log only; gives where each commit ends in it."""
    ends = []
    with open_store(state / "live") as store:
        store.add_measurement(record(slot(0)))
        for number in range(1, more):
            store.add_measurement(record(slot(number)))
            ends.append((state / "live" / "dcam.db-wal").stat().st_size)
        for path in (state / "live").iterdir():
            shutil.copy(path, state)
    yield ends


def test_rows_behind_a_damaged_part_of_the_log_are_not_lost(tmp_path: Path) -> None:
    """SQLite alone would drop them without a word."""
    with killed_while_it_ran(tmp_path, 30) as ends:
        log = bytearray((tmp_path / "dcam.db-wal").read_bytes())
        log[ends[9] + 2000] ^= 4
        (tmp_path / "dcam.db-wal").write_bytes(log)
    with open_checked_store(tmp_path) as store:
        (event,) = store.events(kind="database_salvaged")
        assert "the log is damaged: SQLite would drop" in event.detail
        assert len(store.measured_slots()) >= 29
    assert (tmp_path / f"{databases_set_aside(tmp_path)[0].name}-wal").read_bytes() == log


def test_a_commit_that_a_cut_left_half_done_is_no_damage(tmp_path: Path) -> None:
    with killed_while_it_ran(tmp_path, 30) as ends:
        log = (tmp_path / "dcam.db-wal").read_bytes()
        (tmp_path / "dcam.db-wal").write_bytes(log[: ends[-2] + 4200] + bytes(9000))
    with open_checked_store(tmp_path) as store:
        assert store.measured_slots() == {slot(number) for number in range(29)}
        assert store.events(kind="database_salvaged") == []


def test_a_rollback_journal_that_a_cut_left_is_undone_and_no_damage(
    state: Path, sound: Path, tmp_path: Path
) -> None:
    """A copy of a database, or one that is just being made, has a journal before it has a log."""
    cut = tmp_path / "cut"
    cut.mkdir()
    with closing(sqlite3.connect(state / "dcam.db", isolation_level=None)) as connection:
        connection.execute("PRAGMA journal_mode=DELETE")
        connection.execute("PRAGMA cache_size=1")
        connection.execute("BEGIN")
        connection.execute("UPDATE measurement SET version = 'half done'")
        for name in ("dcam.db", "dcam.db-journal"):
            shutil.copy(state / name, cut)
    for opener in (open_store, open_checked_store):
        again = Path(shutil.copytree(cut, tmp_path / opener.__name__))
        opener(again).close()
        assert (
            rows_of(again / "dcam.db")["measurement"] == rows_of(sound / "dcam.db")["measurement"]
        )
        assert databases_set_aside(again) == []


def test_the_log_of_another_database_takes_nothing_away(state: Path, sound: Path) -> None:
    """A file was put in place, the old one's log stayed: SQLite would write that over the file."""
    with open_store(state / "other") as other:
        for number in range(5000, 5040):
            other.add_measurement(record(slot(number)))
        shutil.copy(other.path.with_name("dcam.db-wal"), state)
    true = rows_of(sound / "dcam.db")
    opened_and_read(state)
    found = rows_of(state / "dcam.db")
    assert wrong(found, true) == 0
    assert found["measurement"] == true["measurement"]
    assert len(databases_set_aside(state)) == 1


def test_a_lost_calibration_leaves_its_number_and_never_an_older_one_in_use(
    state: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows were measured with calibration 2; 1 must not measure the next, nor 3 be called 2."""
    with closing(sqlite3.connect(state / "dcam.db")) as connection:
        connection.execute("DROP TRIGGER calibration_no_delete")
        connection.execute("DROP TRIGGER calibration_activation_no_delete")
        connection.execute("DELETE FROM calibration WHERE id = 2")
        connection.execute("DELETE FROM calibration_activation WHERE calibration_id = 2")
        connection.commit()
    with open_checked_store(state) as store:
        active = store.active_calibration()
        assert active is not None
        assert active.id == 2
        assert active.content == {"method": "lost"}
        assert not active.report.passed
        assert store.add_calibration(calibration()) == 3


def test_a_database_of_an_older_version_is_salvaged_and_migrated(tmp_path: Path) -> None:
    """Its rows have no checksums: those that make sense are kept, and signed from now on."""
    engine = make_engine(tmp_path / "dcam.db")
    config = alembic_config()
    with engine.begin() as connection:
        config.attributes["connection"] = connection
        command.upgrade(config, "0002")
        for number in range(60):
            connection.exec_driver_sql(
                "INSERT INTO measurement (slot_utc, flag, reasons, x_mm, discs_found, corners_used,"
                " recorded_late, config_hash, version) VALUES (?, 1, '', ?, 5, 900, 0, 'c', ?)",
                (f"2026-03-01T00:{number:02}:00Z", number / 8, "0.1" * 50),
            )
        connection.exec_driver_sql(
            "INSERT INTO event VALUES (1, '2026-03-01T00:00:00.000000Z', 'started', '')"
        )
    engine.dispose()
    with (tmp_path / "dcam.db").open("r+b") as file:
        file.seek(100)
        file.write(bytes(500))
    open_checked_store(tmp_path).close()
    with closing(sqlite3.connect(tmp_path / "dcam.db")) as connection:
        found = connection.execute("SELECT slot_utc, x_mm, digest IS NULL FROM measurement")
        rows = [(f"2026-03-01T00:{number:02}:00Z", number / 8, 0) for number in range(60)]
        assert list(found) == rows
        assert connection.execute("SELECT kind FROM event").fetchall()[0] == ("started",)


def test_a_failing_disk_is_reported_first_and_salvaged_at_the_second_start(
    state: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A bad sector does not go away; a cable that was loose does."""

    def failing(path: Path) -> sqlite3.Connection:
        if path.name == "dcam.db":
            error = sqlite3.OperationalError("disk I/O error")
            error.sqlite_errorcode = sqlite3.SQLITE_IOERR_READ
            raise error
        return connect_readonly(path)

    monkeypatch.setattr(damage, "connect_readonly", failing)
    with pytest.raises(DatabaseUnwritableError, match="disk I/O error"):
        open_checked_store(state)
    assert databases_set_aside(state) == []
    monkeypatch.undo()
    open_checked_store(state).close()
    assert (databases_set_aside(state), read_note(state)) == ([], None)

    monkeypatch.setattr(damage, "connect_readonly", failing)
    with pytest.raises(DatabaseUnwritableError):
        open_checked_store(state)
    with open_checked_store(state) as store:
        assert len(store.measured_slots()) == ROWS
    assert len(databases_set_aside(state)) == 1


class Cut(BaseException):
    """The power goes."""


def test_cut_off_anywhere_a_salvage_goes_on_at_the_next_start(
    sound: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At every name that is made, changed or removed; meanwhile nobody else opens the database."""
    damaged = bytearray((sound / "dcam.db").read_bytes())
    damaged[:4096] = bytes(4096)
    true = rows_of(sound / "dcam.db")
    steps, cuts = 0, 0
    while True:
        state = tmp_path / str(cuts)
        state.mkdir()
        (state / "dcam.db").write_bytes(damaged)
        left = cuts

        def step(function: Callable[..., object]) -> Callable[..., object]:
            def counted(*arguments: object, **options: object) -> object:
                nonlocal left
                if left == 0:
                    raise Cut
                left -= 1
                return function(*arguments, **options)

            return counted

        with monkeypatch.context() as patched:
            for name in ("rename", "replace", "unlink"):
                patched.setattr(Path, name, step(getattr(Path, name)))
            try:
                open_checked_store(state).close()
                break
            except Cut:
                cuts += 1
        note = read_note(state)
        if note is not None and note.aside is not None:
            with pytest.raises(DatabaseDamagedError, match="salvage is not complete"):
                open_store(state)
        opened_and_read(state)
        steps += 1
        found = rows_of(state / "dcam.db")
        assert wrong(found, true) == 0
        assert found["measurement"] == true["measurement"]
        assert [path.read_bytes() for path in databases_set_aside(state)] == [bytes(damaged)]
        left_over = {path.name for path in state.iterdir()}
        assert left_over <= {"dcam.db", databases_set_aside(state)[0].name}
        shutil.rmtree(state)
    assert steps >= 4
