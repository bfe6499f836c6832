"""Which rows a new one is held against: those that were there, and whose time was believed."""

from __future__ import annotations

KNOWN = "+id < ? AND (redated_from_utc IS NULL OR recorded_late = 1)"
"""Of rows that a wrong clock had dated only those that were measured again since.

The sign keeps SQLite from going by the ids: slots are found by their index.
"""
NEWEST = 2**63 - 1
"""More than the id of any row."""
