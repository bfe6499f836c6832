"""The last gate for a frame: whatever a driver hands over, only a whole and new one goes on."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from drivers.errors import IncompleteFrameError
from drivers.protocols import CapturedFrame

LOWEST_BITS, HIGHEST_BITS = 8, 16


def require_frame(found: object, size_px: tuple[int, int] | None, name: str) -> CapturedFrame:
    """Give the frame if it is one of grey pixels, of this width and height where they are known.

    What a driver says of exposure, gain and temperature is left out if it is no number. Raises
    IncompleteFrameError, which says of this camera what came instead.
    """
    if not isinstance(found, CapturedFrame):
        msg = f"{name}: gave {type(found).__name__} instead of a frame"
        raise IncompleteFrameError(msg)
    pixels: object = found.pixels
    if not isinstance(pixels, np.ndarray) or pixels.ndim != 2 or pixels.size == 0:
        shape = getattr(pixels, "shape", type(pixels).__name__)
        msg = f"{name}: gave pixels of shape {shape} instead of rows and columns"
        raise IncompleteFrameError(msg)
    if not LOWEST_BITS <= found.bits <= HIGHEST_BITS or pixels.dtype != _type_of(found.bits):
        msg = f"{name}: gave pixels of type {pixels.dtype} said to have {found.bits} bits"
        raise IncompleteFrameError(msg)
    height, width = pixels.shape
    if size_px is not None and (width, height) != size_px:
        msg = f"{name}: gave {width} x {height} px instead of {size_px[0]} x {size_px[1]}"
        if (height, width) == size_px:
            msg += "; they look swapped, exchange its width_px and height_px in the config"
        raise IncompleteFrameError(msg)
    return replace(
        found,
        exposure_us=_number(found.exposure_us),
        gain_db=_number(found.gain_db),
        temperature_c=_number(found.temperature_c),
    )


def _type_of(bits: int) -> type[np.uint8 | np.uint16]:
    return np.uint8 if bits == LOWEST_BITS else np.uint16


def _number(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
