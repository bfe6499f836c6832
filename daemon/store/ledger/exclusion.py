"""Leaving out of a point's good rows what the quality ledger excludes, and counting it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from core.arrays import BoolArray
from core.site import MAIN
from daemon.store.ledger.entries import LedgerEntry, excluded_spans, read_ledger, span_numbers
from daemon.time_arrays import utc_array


@dataclass(frozen=True, slots=True)
class ExcludedRows:
    """How many good rows of a point the quality ledger excludes."""

    rows: int = 0
    spans: int = 0
    """Excluded spans that hold at least one of these rows."""
    left_out: bool = True
    """Or taken in, as was asked."""

    def to_dict(self) -> dict[str, int | bool]:
        """For `--json`."""
        return {"rows": self.rows, "spans": self.spans, "left_out": self.left_out}

    def sentence(self) -> str:
        """What became of them, or nothing where there are none."""
        if not self.rows:
            return ""
        rows = f"{self.rows} good row{'s' * (self.rows != 1)}"
        spans = f"{self.spans} excluded span{'s' * (self.spans != 1)}"
        return f"quality ledger: {rows} in {spans} {'left out' if self.left_out else 'taken in'}"


class Exclusion:
    """Which good rows of a point stay; rows come in any number of batches, each row once."""

    def __init__(
        self, entries: Sequence[LedgerEntry], point: str = MAIN, *, with_excluded: bool
    ) -> None:
        self._excluded = excluded_spans(entries, point)
        self._with_excluded = with_excluded
        self._rows, self._spans = 0, set[int]()

    def keep(self, slots: Sequence[str | None], good: BoolArray) -> BoolArray:
        """(n,) the good rows that stay; slots (n,) as the database writes them, good (n,)."""
        number = span_numbers(utc_array(slots), self._excluded)
        out = good & (number >= 0)
        self._rows += int(out.sum())
        self._spans.update(number[out].tolist())
        return good if self._with_excluded else good & ~out

    def found(self) -> ExcludedRows:
        """What was excluded of all rows so far."""
        return ExcludedRows(self._rows, len(self._spans), not self._with_excluded)


def read_exclusion(path: Path, point: str = MAIN, *, with_excluded: bool) -> Exclusion:
    """What a database's ledger excludes of a point. Raises StoreError."""
    return Exclusion(read_ledger(path), point, with_excluded=with_excluded)
