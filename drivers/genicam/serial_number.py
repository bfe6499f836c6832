"""Serial numbers of cameras: the one place that knows how they are spelled, and compares them.

FLIR and Point Grey print the number in decimal on the label, as their software and GigE Vision give
it, but on USB the same camera gives it in hexadecimal, as 00E94E90 for 15290000 (aravis#492,
harvesters#408).
"""

from __future__ import annotations

import re
from collections.abc import Sequence

_FLIR_ON_LABEL = re.compile(r"[1-9][0-9]{6,9}")
_FLIR_ON_USB = re.compile(r"[0-9A-Fa-f]{8}")


def is_same_serial(one: str, other: str) -> bool:
    """Tell whether both are the number of one camera, each in either spelling."""
    return (
        _plain(one) == _plain(other) or _is_spelling_of(one, other) or _is_spelling_of(other, one)
    )


def places_of(wanted: str, given: Sequence[str]) -> list[int]:
    """Give the indices of the cameras of this number; another spelling counts if no same one is."""
    same = [i for i, serial in enumerate(given) if _plain(serial) == _plain(wanted)]
    return same or [i for i, serial in enumerate(given) if is_same_serial(wanted, serial)]


def as_on_usb(wanted: str) -> str:
    """Give a number of the config with the other spelling: `15290000 (on USB 00E94E90)`."""
    if _FLIR_ON_LABEL.fullmatch(wanted) and int(wanted) < 1 << 32:
        return f"{wanted} (on USB {int(wanted):08X})"
    return as_on_label(wanted)


def as_on_label(given: str) -> str:
    """Give a number that a camera gave with the other spelling: `00E94E90 (label 15290000)`."""
    is_flir_on_usb = _FLIR_ON_USB.fullmatch(given) and (given[0] == "0" or not given.isdecimal())
    return f"{given} (label {int(given, 16)})" if is_flir_on_usb else given


def _plain(serial: str) -> str:
    return serial.strip().lower().lstrip("0")


def _is_spelling_of(on_usb: str, on_label: str) -> bool:
    return bool(_FLIR_ON_USB.fullmatch(on_usb)) and str(int(on_usb, 16)) == _plain(on_label)
