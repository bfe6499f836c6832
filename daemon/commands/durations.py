"""Durations as people write them: 90s, 10m, 6h, 2d, 4w."""

from __future__ import annotations

import re

_DURATION = re.compile(r"(?P<count>\d+(\.\d+)?) ?(?P<unit>s|m|min|h|d|w)")
_UNIT_S = {"s": 1, "m": 60, "min": 60, "h": 3600, "d": 86_400, "w": 604_800}
_LONGEST_S = 1e10
"""Three hundred years; beyond it, dates end."""


def duration_s(text: str) -> float | None:
    """Read a duration in seconds; None where the text is none.

    >>> duration_s("90m"), duration_s("1.5 h"), duration_s("soon")
    (5400.0, 5400.0, None)
    """
    found = _DURATION.fullmatch(text.strip())
    if found is None:
        return None
    seconds = float(found["count"]) * _UNIT_S[found["unit"]]
    return seconds if seconds < _LONGEST_S else None
