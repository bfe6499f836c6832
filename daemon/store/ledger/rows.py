"""Entries of the quality ledger as they are written: only added, never changed."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import select
from sqlalchemy.orm import Session

from daemon.errors import UsageError
from daemon.store.ledger.entries import LedgerEntry, LedgerKind, entry_of, undone
from daemon.store.schema import LedgerRow


def add_entry(session: Session, entry: LedgerEntry) -> int:
    """Add an entry; give its number.

    Raises UsageError for an entry that answers one that is not there, or takes back what is
    taken back already.
    """
    rows = session.scalars(select(LedgerRow).order_by(LedgerRow.id))
    known = [entry_of({name: getattr(row, name) for name in _COLUMNS}) for row in rows]
    if entry.entry_id is not None:
        _require_answerable(known, entry)
    row = LedgerRow(**{name: getattr(entry, name) for name in _COLUMNS if name != "id"})
    session.add(row)
    session.flush()
    return row.id


_COLUMNS = (
    *("id", "created_utc", "author", "kind", "since_utc", "until_utc", "point", "entry_id"),
    "text",
)


def _require_answerable(known: Sequence[LedgerEntry], entry: LedgerEntry) -> None:
    if entry.entry_id not in {one.id for one in known}:
        msg = f"the ledger has no entry {entry.entry_id}; dcam-ctl ledger lists them"
        raise UsageError(msg)
    if entry.kind is LedgerKind.UNDO and entry.entry_id in undone(known):
        msg = f"entry {entry.entry_id} is taken back already"
        raise UsageError(msg)
