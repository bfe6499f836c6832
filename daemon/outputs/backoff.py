"""How long to wait after failures in a row: ever longer, and never all at the same time."""

from __future__ import annotations

import random
from dataclasses import dataclass

MOST_FAILURES = 32
"""Beyond them the wait does not grow, whatever its limits."""


@dataclass(slots=True)
class Backoff:
    """Doubles from failure to failure."""

    first_s: float = 1.0
    most_s: float = 300.0
    _failures: int = 0

    def next_s(self) -> float:
        """Seconds to wait after one more failure: between half and the whole of what is due."""
        due_s = min(self.first_s * 2.0**self._failures, self.most_s)
        self._failures = min(self._failures + 1, MOST_FAILURES)
        return due_s * random.uniform(0.5, 1.0)  # noqa: S311 - no secret: so that sites part

    def reset(self) -> None:
        """Begin again after a success."""
        self._failures = 0
