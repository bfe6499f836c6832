"""One number from what a file or a command says."""

from __future__ import annotations

import math

from drivers.errors import SensorError

_ONE_WIRE = " t="
"""What the value stands behind in the kernel's `w1_slave`."""
_SHOWN = 80


def parse_number(text: str) -> float:
    """Give a text's number; of 1-wire's two lines that behind `t=`, if its checksum is right.

    Raises SensorError.
    """
    text = text.strip()
    if _ONE_WIRE in text:
        if not text.splitlines()[0].rstrip().endswith("YES"):
            msg = "the 1-wire checksum is wrong: look at the wiring"
            raise SensorError(msg)
        text = text.rpartition(_ONE_WIRE)[2]
    if not text:
        msg = "says nothing, not a number"
        raise SensorError(msg)
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        msg = f"says {shortened(text)!r}, not a number"
        raise SensorError(msg)
    return value


def shortened(text: str) -> str:
    """The first words of a text, on one line."""
    line = " ".join(text.split())
    return line if len(line) <= _SHOWN else f"{line[:_SHOWN]}..."
