"""Times as the clock of a place shows them: for people; files, JSON and the database stay UTC."""

from __future__ import annotations

import difflib
import re
import warnings
from datetime import UTC, datetime, tzinfo
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError, available_timezones

LOCAL = "local"
"""In place of a name: the zone of this computer."""

_UTC_TIME = re.compile(r"\b\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(?:\.\d+)?Z\b")
"""As our texts have them, whoever wrote them."""


def find_zone(name: str) -> tzinfo:
    """Give a zone by its IANA name, or that of this computer for `local`.

    Raises ValueError, which names the nearest names.
    """
    if name.upper() in {"UTC", "Z"}:
        return UTC
    if name.lower() == LOCAL:
        return _zone_of_this_computer()
    try:
        return ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError):  # OSError: the name of a folder
        pass
    names = {one.lower(): one for one in available_timezones()}
    if name.lower() in names:
        return ZoneInfo(names[name.lower()])
    cities = {one.rpartition("/")[2]: one for one in names}
    wanted = name.lower().replace(" ", "_")
    near = [cities[one] for one in difflib.get_close_matches(wanted, cities, n=2)]
    near += difflib.get_close_matches(wanted, names, n=2)
    shown = " or ".join(f'"{names[one]}"' for one in dict.fromkeys(near)) or '"Europe/Berlin"'
    msg = (
        f'"{name}" is no IANA time zone; did you mean {shown}? "{LOCAL}" is this computer\'s, "UTC"'
    )
    raise ValueError(msg)


def _zone_of_this_computer() -> tzinfo:
    import tzlocal

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            return tzlocal.reload_localzone()
    except (ZoneInfoNotFoundError, UserWarning, ValueError, OSError) as error:
        why = " ".join(str(error.args[0] if error.args else error).split())
        msg = f"this computer's time zone is not known ({why}): give a name such as Europe/Berlin"
        raise ValueError(msg) from None


def zone_name(zone: tzinfo) -> str:
    """What a zone is called in a heading: `UTC`, `Europe/Berlin`, `local time`."""
    return "UTC" if zone is UTC else getattr(zone, "key", None) or "local time"


def zone_text(when: datetime, zone: tzinfo) -> str:
    """Write a time with its offset: `2026-03-29T03:00:00+02:00`; with `Z` in UTC."""
    text = when.astimezone(zone).isoformat()
    return text.replace("+00:00", "Z") if zone is UTC else text


def in_zone(text: str, zone: tzinfo) -> str:
    """Write each UTC time within a text as the clock of a zone shows it, with its offset."""
    if zone is UTC:
        return text
    return _UTC_TIME.sub(lambda found: _converted(found[0], zone), text)


def _converted(written: str, zone: tzinfo) -> str:
    try:
        return zone_text(datetime.fromisoformat(written), zone)
    except (ValueError, OverflowError):  # looks like a time, is none
        return written
