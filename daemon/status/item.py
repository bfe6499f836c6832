"""One thing that was looked at, and its level, as Nagios knows them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


class Level(IntEnum):
    """As Nagios plugins exit."""

    OK = 0
    WARNING = 1
    CRITICAL = 2
    UNKNOWN = 3


@dataclass(frozen=True, slots=True)
class Item:
    """One thing looked at."""

    name: str
    level: Level
    text: str


def worst(items: list[Item]) -> Level:
    """The worst of the levels known; what is unknown counts only if nothing is wrong."""
    bad = [item.level for item in items if item.level in {Level.WARNING, Level.CRITICAL}]
    return max(bad, default=max((item.level for item in items), default=Level.UNKNOWN))
