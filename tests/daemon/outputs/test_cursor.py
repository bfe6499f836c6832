"""Nothing is skipped, nothing sent twice: restarts, late rows, times put right, ids used again."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from contextlib import closing, suppress
from dataclasses import replace

import pytest

from daemon.outputs.cursor import CursorError
from daemon.outputs.output import NotTakenError
from daemon.outputs.sender import Sender, cursor_path
from daemon.store.database import open_store
from daemon.store.queries.arrivals import Arrival
from daemon.store.sqlite import FILE_NAME
from tests.daemon.outputs.conftest import Follow, Record, text_of
from tests.daemon.store.examples import full_measurement, record, slot
from tests.waiting import wait_for


class Notebook:
    """An output that writes down what it is given; it takes so many rows before it fails."""

    name = "notebook"

    def __init__(self, *, takes: int = 10**9, batch: int = 7, history: bool = True) -> None:
        self.slots: list[str] = []
        self.takes, self.batch, self.history = takes, batch, history

    def send(self, rows: Sequence[Arrival], latest: Arrival | None) -> None:
        taken = rows[: self.takes]
        self.slots += [row.slot for row in taken]
        self.takes -= len(taken)
        if len(taken) < len(rows):
            msg = "full"
            raise NotTakenError(msg, len(taken))

    def close(self) -> None:
        pass


def sent(kept: Record, **more: object) -> list[str]:
    """What a new sender passes on."""
    output = Notebook(**more)
    with suppress(NotTakenError):
        Sender(kept.state, output).send_all()
    return output.slots


def test_a_sender_that_is_started_again_goes_on_where_it_was(kept: Record) -> None:
    kept.add(20)
    first = sent(kept, takes=10)
    assert first == kept.slots[:10]  # in the middle of a batch
    assert first + sent(kept) == kept.slots
    assert sent(kept) == []


def test_a_late_row_is_sent_when_it_is_written(kept: Record) -> None:
    kept.add(5)
    sent(kept)
    kept.add(at=slot(-50))
    kept.add()
    assert sent(kept) == kept.slots[5:]


def test_a_row_whose_time_was_put_right_is_sent_under_its_true_slot(kept: Record) -> None:
    kept.add(45)
    sent(kept)
    with open_store(kept.state) as store:
        for minute in (3, 42):
            moved = replace(
                record(slot(minute + 1000), full_measurement()), redated_from_utc=slot(minute)
            )
            store.move_row(slot(minute), moved)
    assert sent(kept) == [text_of(slot(1003)), text_of(slot(1042))]
    assert sent(kept) == []


def test_rows_that_take_the_ids_of_removed_ones_are_sent(kept: Record) -> None:
    """SQLite gives the id of a removed last row to the next one."""
    kept.add(60)
    sent(kept)
    remove_after(kept, 50)
    kept.add(20)
    again = sent(kept)
    assert kept.slots[60:] == again[-20:]
    assert len(again) == 20


def test_a_record_put_back_from_a_copy_is_sent_from_where_it_differs(kept: Record) -> None:
    """Far back one row of two, four, eight ... is remembered: some are sent twice, none never."""
    kept.add(200)
    sent(kept)
    remove_after(kept, 120)
    kept.add(100)
    again = sent(kept)
    assert kept.slots[200:] == again[-100:]
    assert len(again) < 100 + 120 / 2


def remove_after(kept: Record, row_id: int) -> None:
    with closing(sqlite3.connect(kept.state / FILE_NAME)) as connection, connection:
        connection.execute("DELETE FROM measurement WHERE id > ?", (row_id,))


def test_without_history_it_begins_with_what_comes(kept: Record) -> None:
    kept.add(5)
    assert sent(kept, history=False) == []
    kept.add(2)
    assert sent(kept, history=False) == kept.slots[5:]


def test_again_since_sends_from_a_slot_on(kept: Record) -> None:
    kept.add(20)
    sent(kept)
    output = Notebook()
    Sender(kept.state, output, again_since=slot(15)).send_all()
    assert output.slots == kept.slots[15:]
    assert sent(kept) == []


def test_it_waits_for_a_database(kept: Record, follow: Follow) -> None:
    output = Notebook()
    follow(kept, output)
    kept.add(3)
    wait_for(lambda: output.slots == kept.slots, "the rows")


def test_a_damaged_cursor_is_named(kept: Record) -> None:
    kept.add(2)
    sent(kept)
    cursor_path(kept.state, "notebook").write_text("{")
    with pytest.raises(CursorError, match=r"notebook.json: damaged: remove it"):
        sent(kept)
