"""What a study ends in: a page with tables and figures, claims, and what differs from before."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

NOT_COMPARED = (" s", " min")
"""Ends of the columns that hold times: they differ from one computer to the next."""
_ROUNDING = 1.01
"""Units of the last digit by which a figure may differ: the rounding of both."""
_RELATIVE = 0.02
"""Share by which it may differ besides: sums in another order, on another processor."""


@dataclass(frozen=True, slots=True)
class Table:
    """A table as people read it: every cell is text."""

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def markdown(self) -> str:
        """Give it for a page."""
        lines = [self.columns, ("---",) * len(self.columns), *self.rows]
        return "\n".join(f"| {' | '.join(line)} |" for line in lines)

    def csv(self) -> str:
        """Give it for programs."""
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([self.columns, *self.rows])
        return text.getvalue()

    @classmethod
    def read(cls, text: str) -> Table:
        """Read what `csv` gave."""
        first, *rows = list(csv.reader(io.StringIO(text)))
        return cls(tuple(first), tuple(tuple(row) for row in rows))

    def differences(self, before: Table) -> list[str]:
        """Name the cells that differ from an earlier table by more than rounding."""
        if self.columns != before.columns or len(self.rows) != len(before.rows):
            return ["other rows or columns than before"]
        found = []
        for row, old_row in zip(self.rows, before.rows, strict=True):
            for column, new, old in zip(self.columns, row, old_row, strict=True):
                if not column.endswith(NOT_COMPARED) and _differs(new, old):
                    found.append(f"{row[0]}, {column}: {old} before, {new} now")
        return found


def _differs(new: str, old: str) -> bool:
    """Whether two cells differ by more than the rounding of their last digit."""
    if " / " in new and new.count(" / ") == old.count(" / "):
        return any(map(_differs, new.split(" / "), old.split(" / ")))
    try:
        a, b = float(new.rstrip(" %")), float(old.rstrip(" %"))
    except ValueError:
        return new != old
    if math.isnan(a) or math.isnan(b):
        return math.isnan(a) != math.isnan(b)
    step = max(10.0 ** -len(text.rstrip(" %").partition(".")[2]) for text in (new, old))
    return abs(a - b) > _ROUNDING * step + _RELATIVE * max(abs(a), abs(b))


@dataclass(frozen=True, slots=True)
class Claim:
    """What a study must show."""

    sentence: str
    holds: bool


@dataclass(frozen=True, slots=True)
class Report:
    """What came of a study."""

    name: str
    title: str
    text: str
    """Markdown; `{table NAME}` stands where a table belongs."""
    tables: Mapping[str, Table]
    claims: Sequence[Claim]
    figures: Mapping[str, Callable[[Path], None]] = field(default_factory=dict)
    """Draws each figure, by its file's name, into a file."""

    def write(self, directory: Path) -> list[str]:
        """Write page, tables and figures; name the cells that differ from those there before."""
        directory.mkdir(parents=True, exist_ok=True)
        text, changed = self.text, []
        for name, table in self.tables.items():
            path = directory / f"{self.name}-{name}.csv"
            if path.is_file():
                before = Table.read(path.read_text(encoding="utf-8"))
                changed += [f"{path.name}: {cell}" for cell in table.differences(before)]
            path.write_text(table.csv(), encoding="utf-8")
            text = text.replace("{table " + name + "}", table.markdown())
        for name, draw in self.figures.items():
            draw(directory / name)
        page = f"# {self.title}\n\n{self._verdicts()}\n\n{text.strip()}\n"
        (directory / f"{self.name}.md").write_text(page, encoding="utf-8")
        return changed

    def _verdicts(self) -> str:
        lines = [f"*Written by `python -m studies {self.name}`; seeds are fixed.*", ""]
        lines += [
            f"- **{'Shown' if claim.holds else 'NOT shown'}**: {claim.sentence}"
            for claim in self.claims
        ]
        return "\n".join(lines)
