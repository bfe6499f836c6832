"""The quality ledger: what people say of spans of the record. Measured rows are never touched.

Entries are only added. One that was wrong is taken back by another, which can be taken back itself.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from core.arrays import IntArray
from core.site import MAIN
from daemon.store.integrity.reading import whole_rows
from daemon.store.rows.convert import stored_time
from daemon.store.sqlite import connect_readonly, said_plainly
from daemon.time_arrays import TimeArray, utc_array

ALL_POINTS = "all"


class LedgerKind(StrEnum):
    """What an entry does: a closed list."""

    ANNOTATE = "annotate"
    """Says what happened in a span."""
    EXCLUDE = "exclude"
    """Leaves a span's values out of figures and sums that are said to be without them."""
    COMMENT = "comment"
    """Adds to another entry."""
    UNDO = "undo"
    """Takes another entry back."""


@dataclass(frozen=True, slots=True)
class LedgerEntry:
    """One thing that a person said of the record."""

    kind: LedgerKind
    author: str
    created_utc: datetime
    text: str
    since_utc: datetime | None = None
    until_utc: datetime | None = None
    """since <= slot < until; None of a comment and of an undo."""
    point: str | None = None
    """`main` or a further target's name; None: all."""
    entry_id: int | None = None
    """The entry that is commented or taken back."""
    id: int | None = None
    """Given by the database."""


Span = tuple[datetime, datetime]
"""since <= slot < until."""


def read_ledger(path: Path) -> list[LedgerEntry]:
    """All entries of a database, oldest first. Raises StoreError."""
    with said_plainly(path), closing(connect_readonly(path)) as connection:
        return ledger_entries(connection)


def ledger_entries(connection: sqlite3.Connection) -> list[LedgerEntry]:
    """All entries, oldest first."""
    return [entry_of(row) for row in whole_rows(connection, "ledger", _QUERY)]


_QUERY = "SELECT * FROM ledger ORDER BY id"


def undone(entries: Sequence[LedgerEntry]) -> dict[int, LedgerEntry]:
    """The entries that do not hold, by number, each with the undo that took it back.

    An undo that was taken back itself takes nothing back.
    """
    found: dict[int, LedgerEntry] = {}
    for entry in reversed(entries):  # an undo is younger than what it takes back
        if entry.kind is LedgerKind.UNDO and entry.id not in found and entry.entry_id is not None:
            found.setdefault(entry.entry_id, entry)
    return found


def in_force(entries: Sequence[LedgerEntry]) -> list[LedgerEntry]:
    """The annotations and exclusions that hold, in the order of their spans."""
    gone = undone(entries)
    spans = [one for one in entries if one.since_utc is not None and one.id not in gone]
    return sorted(spans, key=lambda one: (str(one.since_utc), one.id))


def excluded_spans(entries: Sequence[LedgerEntry], point: str = MAIN) -> list[Span]:
    """The spans whose values of a point are left out: in order, none touching another."""
    spans: list[Span] = []
    for entry in in_force(entries):
        if entry.kind is not LedgerKind.EXCLUDE or entry.point not in {None, point}:
            continue
        if entry.since_utc is None or entry.until_utc is None:
            continue
        if spans and entry.since_utc <= spans[-1][1]:
            spans[-1] = spans[-1][0], max(spans[-1][1], entry.until_utc)
        else:
            spans.append((entry.since_utc, entry.until_utc))
    return spans


def span_numbers(times: TimeArray, spans: Sequence[Span]) -> IntArray:
    """(n,) which of the spans holds each time (n,), UTC; -1 where none does.

    The one place that says what a span takes in. Spans are in order and apart, as `excluded_spans`
    gives them.
    """
    if not spans:
        return np.full(len(times), -1, dtype=np.int64)
    limits = [[when.replace(tzinfo=None) for when in span] for span in spans]
    begins, ends = np.array(limits, dtype="datetime64[us]").T
    last = np.searchsorted(begins, times, side="right") - 1  # the last that has begun
    found: IntArray = np.where((last >= 0) & (times < ends[last]), last, -1)
    return found


def excluded_points(slots: Sequence[str], entries: Sequence[LedgerEntry]) -> list[str | None]:
    """Of each slot the points whose values are left out, joined by +; `all` is every one."""
    found, times = [""] * len(slots), utc_array(slots)
    for entry in in_force(entries):
        if entry.kind is LedgerKind.EXCLUDE and entry.since_utc and entry.until_utc:
            within = span_numbers(times, [(entry.since_utc, entry.until_utc)])
            for place in np.flatnonzero(within >= 0).tolist():
                names = {*found[place].split("+"), entry.point or ALL_POINTS} - {""}
                found[place] = ALL_POINTS if ALL_POINTS in names else "+".join(sorted(names))
    return [names or None for names in found]


def entry_of(row: Mapping[str, Any]) -> LedgerEntry:
    """An entry of the columns of its row, whose times are text or times."""
    since, until = (
        stored_time(when) if isinstance(when, str) else when
        for when in (row["since_utc"], row["until_utc"])
    )
    created = row["created_utc"]
    return LedgerEntry(
        kind=LedgerKind(row["kind"]),
        author=row["author"],
        created_utc=stored_time(created) if isinstance(created, str) else created,
        text=row["text"],
        since_utc=since,
        until_utc=until,
        point=row["point"],
        entry_id=row["entry_id"],
        id=row["id"],
    )
