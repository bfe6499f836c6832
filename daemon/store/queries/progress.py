"""How far somebody has come in the record: whoever keeps it passes each row on once.

It moves over the order of writing, not that of slots, so that late rows are passed on too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from daemon.store.queries.arrivals import Arrival, Arrivals

SCHEMA = 1
DENSE = 32
"""Of the rows passed on last each is remembered, of those before one in two, in four ..."""


@dataclass(slots=True)
class Progress:
    """What somebody was given of a record."""

    row_id: int = 0
    """All rows up to this were passed on."""
    passed: dict[int, str] = field(default_factory=dict)
    """Slots of some of them by id, the last ones and fewer the older: to know the record again."""
    redated: dict[int, str] = field(default_factory=dict)
    """Slots under which rows whose time was put right were passed on, by id."""

    def start(self, arrivals: Arrivals, *, history: bool) -> None:
        """Begin for the first time: at the record's beginning, or at its end."""
        self.row_id = 0 if history else arrivals.newest_id()
        self.redated = dict(arrivals.redated(self.row_id))
        self._remember(arrivals)

    def pending(self, arrivals: Arrivals, limit: int) -> list[Arrival]:
        """The next rows to pass on, in order; first those whose time was put right since."""
        self._go_back(arrivals)
        moved = [
            row_id
            for row_id, slot in arrivals.redated(self.row_id)
            if self.redated.get(row_id) != slot
        ]
        if moved:
            return arrivals.with_ids(moved[:limit])
        return arrivals.after(self.row_id, limit)

    def note(self, rows: Sequence[Arrival]) -> None:
        """Note that rows, the first of the pending ones, were passed on."""
        for row in rows:
            self.row_id = max(self.row_id, row.row_id)
            self.passed[row.row_id] = row.slot
            if row.values["redated_from_utc"] is not None:
                self.redated[row.row_id] = row.slot
        self._thin_out()

    def content(self) -> dict[str, Any]:
        """What to keep of it, as JSON has it."""
        return {
            "schema": SCHEMA,
            "row_id": self.row_id,
            "passed": self.passed,
            "redated": self.redated,
        }

    def take(self, content: Mapping[str, Any]) -> None:
        """Go on from what was kept. Raises KeyError, TypeError, ValueError, AttributeError."""
        self.row_id = int(content["row_id"])
        self.passed = {int(key): str(slot) for key, slot in content["passed"].items()}
        self.redated = {int(key): str(slot) for key, slot in content["redated"].items()}

    def _go_back(self, arrivals: Arrivals) -> None:
        """Go back to where the record still is what was passed on."""
        known = sorted(self.passed, reverse=True)
        for row_id in known:
            found = arrivals.slot_of(row_id)
            if found is not None and (found[0] == self.passed[row_id] or found[1]):
                break
            del self.passed[row_id]
        else:
            row_id = 0
        if known and row_id != known[0]:
            self.row_id = row_id
            self.redated = {key: slot for key, slot in self.redated.items() if key <= row_id}

    def _remember(self, arrivals: Arrivals) -> None:
        """Remember rows that were there before the first was passed on."""
        for back in (*range(DENSE), *(DENSE << power for power in range(32))):
            found = arrivals.slot_of(self.row_id - back)
            if found is not None:
                self.passed[self.row_id - back] = found[0]

    def _thin_out(self) -> None:
        """Keep the last ones, and of older ones one of each span of twice as many rows."""
        kept: dict[int, int] = {}
        for row_id in sorted(self.passed):
            back = self.row_id - row_id
            span = -back if back < DENSE else back.bit_length()
            kept.setdefault(span, row_id)
        self.passed = {row_id: self.passed[row_id] for row_id in sorted(kept.values())}
