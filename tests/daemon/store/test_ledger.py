"""The quality ledger: only added to, what is taken back stays readable, rows stay as they are."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from daemon.errors import UsageError
from daemon.store.database import Store, open_store
from daemon.store.ledger.entries import (
    LedgerEntry,
    LedgerKind,
    excluded_spans,
    in_force,
    read_ledger,
    span_numbers,
)
from daemon.time_arrays import utc_array
from daemon.times import slot_text
from tests.daemon.store.examples import START, full_record, slot


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with open_store(tmp_path / "state") as opened:
        yield opened


def said(kind: str, *span: int, point: str | None = None, of: int | None = None) -> LedgerEntry:
    """An entry of a span between two numbered slots, or of another entry."""
    since, until = map(slot, span) if span else (None, None)
    return LedgerEntry(
        LedgerKind(kind), "eve", START, f"{kind}: why", since, until, point, entry_id=of
    )


def test_entries_come_back_as_they_were_entered(store: Store) -> None:
    entered = [said("annotate", 1, 2), said("exclude", 3, 9, point="main"), said("comment", of=2)]
    numbers = [store.add_ledger_entry(entry) for entry in entered]
    assert numbers == [1, 2, 3]
    found = read_ledger(store.path)
    assert found == [replace(entry, id=n) for entry, n in zip(entered, numbers, strict=True)]


def test_excluded_spans_are_merged_and_only_of_their_point(store: Store) -> None:
    for entry in (
        *(said("exclude", 5, 9), said("exclude", 2, 5), said("exclude", 20, 30, point="pier")),
        *(said("exclude", 12, 14, point="main"), said("annotate", 40, 50)),
    ):
        store.add_ledger_entry(entry)
    entries = read_ledger(store.path)
    assert excluded_spans(entries) == [(slot(2), slot(9)), (slot(12), slot(14))]
    assert excluded_spans(entries, "pier") == [(slot(2), slot(9)), (slot(20), slot(30))]
    slots = utc_array([slot_text(slot(number)) for number in (1, 2, 8, 9, 13)])
    assert span_numbers(slots, excluded_spans(entries)).tolist() == [-1, 0, 0, -1, 1]
    assert span_numbers(slots, []).tolist() == [-1] * 5


def test_what_is_taken_back_holds_no_more_until_that_is_taken_back(store: Store) -> None:
    store.add_ledger_entry(said("exclude", 1, 5))
    store.add_ledger_entry(said("undo", of=1))
    assert excluded_spans(read_ledger(store.path)) == []
    store.add_ledger_entry(said("undo", of=2))
    assert excluded_spans(read_ledger(store.path)) == [(slot(1), slot(5))]
    store.add_ledger_entry(said("undo", of=1))
    assert in_force(read_ledger(store.path)) == []
    assert [entry.kind for entry in read_ledger(store.path)] == ["exclude", *["undo"] * 3]


def test_an_answer_to_nothing_is_refused(store: Store) -> None:
    with pytest.raises(UsageError, match="no entry 7"):
        store.add_ledger_entry(said("comment", of=7))
    store.add_ledger_entry(said("exclude", 1, 5))
    store.add_ledger_entry(said("undo", of=1))
    with pytest.raises(UsageError, match="taken back already"):
        store.add_ledger_entry(said("undo", of=1))
    assert len(read_ledger(store.path)) == 2


def test_rows_are_never_touched_and_entries_never_changed(store: Store) -> None:
    store.add_measurement(full_record(slot(1)))
    with closing(sqlite3.connect(store.path)) as connection:
        before = connection.execute("SELECT * FROM measurement").fetchall()
        store.add_ledger_entry(said("exclude", 0, 5))
        assert connection.execute("SELECT * FROM measurement").fetchall() == before
        for change in ("UPDATE ledger SET text = ''", "DELETE FROM ledger"):
            with pytest.raises(sqlite3.IntegrityError, match="ledger rows are immutable"):
                connection.execute(change)
