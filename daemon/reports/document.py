"""A report as plain pieces, so that HTML and PDF say the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar


@dataclass(frozen=True, slots=True)
class Heading:
    """A heading; level 2 begins a section."""

    kind: ClassVar[str] = "heading"
    text: str
    level: int = 2


@dataclass(frozen=True, slots=True)
class Text:
    """A paragraph."""

    kind: ClassVar[str] = "text"
    text: str
    is_strong: bool = False


@dataclass(frozen=True, slots=True)
class Formula:
    """A line of mathematics."""

    kind: ClassVar[str] = "formula"
    text: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """A word that says how things are: OK, WARNING, CRITICAL, UNKNOWN."""

    kind: ClassVar[str] = "verdict"
    level: str
    text: str


@dataclass(frozen=True, slots=True)
class Bullets:
    """A list."""

    kind: ClassVar[str] = "bullets"
    items: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Table:
    """A table; every row has as many cells as the header."""

    kind: ClassVar[str] = "table"
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    numbers: frozenset[int] = frozenset()
    """Columns that are aligned to the right."""


@dataclass(frozen=True, slots=True)
class Picture:
    """A vector figure, once for screens and once for print."""

    kind: ClassVar[str] = "picture"
    svg: bytes
    pdf: bytes
    alt: str


Block = Heading | Text | Formula | Verdict | Bullets | Table | Picture


@dataclass(frozen=True, slots=True)
class Document:
    """A whole report."""

    site: str
    title: str
    blocks: tuple[Block, ...]


def table(
    header: Sequence[str], rows: Sequence[Sequence[object]], numbers: Sequence[int] = ()
) -> Table:
    """Make a table of anything that can be written."""
    cells = tuple(tuple(str(cell) for cell in row) for row in rows)
    return Table(tuple(header), cells, frozenset(numbers))
