"""Damage: named, set aside, never deleted; what proves itself is carried over, nothing else is."""

from __future__ import annotations

import random
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from daemon.errors import DatabaseDamagedError, DatabaseUnwritableError
from daemon.store.damage_note import databases_set_aside, read_note
from daemon.store.database import open_store, open_store_readonly
from daemon.store.opening import open_checked_store
from daemon.store.records import Mark
from daemon.store.salvage import damage
from daemon.store.sqlite import connect_readonly
from tests.daemon.store.damaged import ROWS, Row, opened_and_read, rows_of, wrong
from tests.daemon.store.examples import calibration, full_record, slot
from tests.exhaustive import one_of


def flip(content: bytearray, at: int, rng: random.Random) -> None:
    """One bit of one byte."""
    content[at] ^= 1 << rng.randrange(8)


def zero(size: int) -> Callable[[bytearray, int, random.Random], None]:
    """A whole block of the disk."""

    def harm(content: bytearray, at: int, _rng: random.Random) -> None:
        start = at // size * size
        content[start : start + size] = bytes(size)

    return harm


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


def test_a_row_of_a_wrong_clock_does_not_come_back_under_its_wrong_slot(tmp_path: Path) -> None:
    """The log has the page with the row as it was first, too."""
    state = tmp_path / "left"
    with open_store(tmp_path / "live") as store:
        for number in range(5):
            store.add_measurement(full_record(slot(number), calibration_id=None))
        row = store.measurement(slot(0))
        store.move_row(slot(0), replace(row, slot_utc=slot(300), redated_from_utc=slot(0)))
        number, _ = store.next_to_measure_again()
        again = replace(store.measurement(slot(300)), recorded_late=True)
        store.measured_again(number, again)
        shutil.copytree(tmp_path / "live", state)  # as a cut of the power leaves it
    with (state / "dcam.db").open("r+b") as file:
        file.write(bytes(4096))
    (state / "dcam.db-shm").unlink(missing_ok=True)
    opened_and_read(state)
    assert databases_set_aside(state)
    with open_store_readonly(state) as store:
        assert store.measured_slots() == {slot(number) for number in (1, 2, 3, 4, 300)}
        assert store.measurement(slot(300)).recorded_late


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
