"""The quality ledger in plain JSON types: for `--json` and for the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime

from core.site import MAIN
from daemon.store.ledger.entries import LedgerEntry, excluded_spans


def entry_fields(entry: LedgerEntry, gone: Mapping[int, LedgerEntry]) -> dict[str, object]:
    """One entry; `gone` is what `undone` gives."""
    undo = None if entry.id is None else gone.get(entry.id)
    return {
        "id": entry.id,
        "kind": entry.kind.value,
        "author": entry.author,
        "created_utc": entry.created_utc,
        "since_utc": entry.since_utc,
        "until_utc": entry.until_utc,
        "point": entry.point,
        "entry": entry.entry_id,
        "text": entry.text,
        "undone_by": None if undo is None else undo.id,
    }


def span_fields(entries: Sequence[LedgerEntry]) -> dict[str, list[dict[str, datetime]]]:
    """The merged excluded spans of each point that some entry names, and of the main target."""
    points = dict.fromkeys([MAIN, *(one.point for one in entries if one.point)])
    return {
        point: [
            {"since_utc": since, "until_utc": until}
            for since, until in excluded_spans(entries, point)
        ]
        for point in points
    }
