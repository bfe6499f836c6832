"""Arrays of times, apart from `times`: numpy takes longer to load than many a command runs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

TimeArray = npt.NDArray[np.datetime64]
"""Moments in UTC, of numpy, which knows no zone."""


def utc_array(texts: Sequence[str | None]) -> TimeArray:
    """(n,) of times as `daemon.times` writes them, to the microsecond; NaT for None."""
    plain = ["NaT" if text is None else text.removesuffix("Z") for text in texts]
    return np.array(plain, dtype="datetime64[us]")
