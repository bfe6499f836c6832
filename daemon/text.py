"""Times, spans and sizes as people read them, and text where a locale knows few letters."""

from __future__ import annotations

import codecs
import io
import re
import sys
import unicodedata
from datetime import UTC, datetime

_IN_ASCII = {"±": "+/-", "°": "deg"}
_READABLE = "dcam.readable"
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
"""What a terminal obeys instead of showing it, but for tab and line end."""


def utc_text(when: datetime) -> str:
    """Write a time as `2026-03-01T00:00:00Z`; fractions of a second only if there are any."""
    return when.astimezone(UTC).isoformat().replace("+00:00", "Z")


def span_text(seconds: float) -> str:
    """Write a duration with its two leading units: `42 s`, `3 min 5 s`, `2 d 4 h`."""
    left = round(abs(seconds))
    parts = []
    for unit, size in (("d", 86400), ("h", 3600), ("min", 60), ("s", 1)):
        count, left = divmod(left, size)
        if count:
            parts.append(f"{count} {unit}")
        elif parts:
            break
    return " ".join(parts[:2]) or "0 s"


def count_of(count: int, what: str) -> str:
    """Write how many: `1 row`, `2 rows`; of a word that takes an s."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def visible(text: str) -> str:
    r"""Write control characters as their numbers (`\x1b`): names and reasons may hold any."""
    return _CONTROL.sub(lambda sign: ascii(sign[0])[1:-1], text)


def bytes_text(count: float) -> str:
    """Write a number of bytes in decimal units, as disks are sold."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} TB"


def write_readably() -> None:
    r"""Let stdout and stderr take any text: what the locale has no letter for is written in ASCII.

    `±` becomes `+/-`, `é` becomes `e`, other signs their number (`\u6865`). Bytes of a file name
    that are no text are written as they are.
    """
    codecs.register_error(_READABLE, _readable)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors=_READABLE)


def _readable(error: UnicodeError) -> tuple[str | bytes, int]:
    """Replace what cannot be encoded, as `codecs.register_error` wants it."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    sign = error.object[error.start]
    return _in_ascii(sign), error.start + 1


def _in_ascii(sign: str) -> str | bytes:
    if "\udc80" <= sign <= "\udcff":  # a byte of a file name, as `os.fsdecode` hides it
        return bytes([ord(sign) - 0xDC00])
    if sign in _IN_ASCII:
        return _IN_ASCII[sign]
    plain = unicodedata.normalize("NFKD", sign).encode("ascii", "ignore")
    return (plain or sign.encode("ascii", "backslashreplace")).decode()
