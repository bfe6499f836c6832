"""Long rows of cases: some of them with all tests, every one by `make exhaustive`."""

from __future__ import annotations

import os

IS_ASKED = bool(os.environ.get("DCAM_EXHAUSTIVE"))


def one_of(count: int) -> int:
    """Of so many cases in a row try the first; of each, where every one is asked for."""
    return 1 if IS_ASKED else count
