"""Parameters of a request, read strictly: what is not understood is one line, and status 400."""

from __future__ import annotations

import math
from collections.abc import Callable
from datetime import UTC, datetime

from starlette.datastructures import QueryParams

from daemon.times import EPOCH

FIRST = datetime(1970, 1, 1, tzinfo=UTC)
LAST = datetime(2200, 1, 1, tzinfo=UTC)


class AskedWronglyError(ValueError):
    """A parameter cannot be used; the message is one line."""


def only(query: QueryParams, *names: str) -> None:
    """Refuse parameters that there are not, and those given twice. Raises AskedWronglyError."""
    for name in query:
        if name not in names:
            msg = f"unknown parameter {_shown(name)}; there are {', '.join(names) or 'none'}"
            raise AskedWronglyError(msg)
        if len(query.getlist(name)) > 1:
            msg = f"{name}: given twice"
            raise AskedWronglyError(msg)


def moment(text: str, name: str) -> datetime:
    """A time as ISO 8601 with zone, as a date, or as epoch seconds. Raises AskedWronglyError."""
    try:
        when = datetime.fromisoformat(text)
        when = when.replace(tzinfo=UTC) if when.tzinfo is None else when.astimezone(UTC)
    except (ValueError, OverflowError):
        when = _of_seconds(text, name)
    return min(max(when, FIRST), LAST)


def _of_seconds(text: str, name: str) -> datetime:
    try:
        seconds = float(text)
        if not math.isfinite(seconds):
            raise ValueError  # noqa: TRY301 - one message for all that is no time
        return datetime.fromtimestamp(min(max(seconds, 0.0), LAST.timestamp()), UTC)
    except (ValueError, OverflowError):
        msg = f"{name}: {_shown(text)} is no time; write 2026-03-01T00:00:00Z or epoch seconds"
        raise AskedWronglyError(msg) from None


def slot(text: str) -> datetime:
    """A slot: a time in whole seconds. Raises AskedWronglyError."""
    when = moment(text, "slot")
    return when.replace(microsecond=0)


def span(
    query: QueryParams, default: Callable[[], tuple[datetime, datetime]]
) -> tuple[datetime, datetime]:
    """`since` and `until`; where one is missing, as by default. Raises AskedWronglyError."""
    given = {name: moment(query[name], name) for name in ("since", "until") if query.get(name)}
    if len(given) < 2:
        since, until = default()
        given = {"since": since, "until": until, **given}
    if given["since"] >= given["until"]:
        msg = "since: must be before until"
        raise AskedWronglyError(msg)
    return given["since"], given["until"]


def number(query: QueryParams, name: str, default: float, low: float, high: float) -> float:
    """A number within limits. Raises AskedWronglyError."""
    text = query.get(name)
    if text is None:
        return default
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        msg = f"{name}: must be a number from {low:g} to {high:g}, is {_shown(text)}"
        raise AskedWronglyError(msg)
    return value


def switch(query: QueryParams, name: str) -> bool:
    """Whether something is wanted: 1 or 0, which it is by default. Raises AskedWronglyError."""
    text = query.get(name, "0")
    if text not in {"0", "1"}:
        msg = f"{name}: must be 0 or 1, is {_shown(text)}"
        raise AskedWronglyError(msg)
    return text == "1"


def seconds(when: datetime) -> float:
    """Seconds since 1970."""
    return (when - EPOCH).total_seconds()


def _shown(text: str) -> str:
    return repr(text[:40])
