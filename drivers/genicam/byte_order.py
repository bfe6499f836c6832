"""Whether the bytes of deep pixels came in the order that they should; seen from the image alone.

Point Grey's cameras are known to send Mono16 with the high byte first, although both standards want
the low byte first, and to say nothing of it (aravis#921, #924, #1029).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.protocols import Image

_EVERY_NTH_ROW = 8
_CLEARLY = 0.5
"""In the right order neighbours differ by less than this share of what they do when swapped."""


def is_swapped(pixels: Image, bits: int) -> bool | None:
    """Tell whether the bytes of each pixel are swapped; None where the image does not show it.

    pixels: (height, width), uint16. bits: significant ones, of 16. Three signs, the surest first:
    a value of more than `bits`; low bits that are never set in one order, as where 12 bits fill
    16; and that neighbours are alike, while swapped they differ by the noise of the low byte.
    """
    swapped = pixels.byteswap()
    used, used_swapped = (int(np.bitwise_or.reduce(view, axis=None)) for view in (pixels, swapped))
    fits, fits_swapped = used >> bits == 0, used_swapped >> bits == 0
    if fits != fits_swapped:
        return fits_swapped
    if used & 0xFF and used >> 8:
        empty, empty_swapped = (_n_never_set(mask) for mask in (used, used_swapped))
        if max(empty, empty_swapped) >= 2 and min(empty, empty_swapped) == 0:
            return empty_swapped > empty
    rough, rough_swapped = (_roughness(view[::_EVERY_NTH_ROW]) for view in (pixels, swapped))
    if rough < _CLEARLY * rough_swapped:
        return False
    return True if rough_swapped < _CLEARLY * rough else None


def _n_never_set(mask: int) -> int:
    """How many of the low bits no pixel has."""
    return (mask & -mask).bit_length() - 1


def _roughness(rows: NDArray[Any]) -> float:
    """Mean difference of neighbours in a row."""
    return float(np.mean(np.abs(np.diff(rows.astype(np.int32), axis=1)))) if rows.size > 1 else 0.0
