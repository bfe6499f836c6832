"""What the page gives of single slots, days, events and calibrations."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from typing import Any
from urllib.parse import quote

import numpy as np

from core.results import Flag
from daemon.config.reading import Config
from daemon.errors import StoreError
from daemon.plain import plain
from daemon.store.ledger.entries import (
    LedgerEntry,
    Span,
    excluded_spans,
    in_force,
    ledger_entries,
)
from daemon.store.queries.datum_fields import sigmas_mm
from daemon.store.queries.json_fields import result_fields
from daemon.store.queries.record_view import (
    calibration_views,
    events_within,
    gaps_within,
    neighbours,
    slot_view,
)
from daemon.store.rows.datum import read_links
from daemon.store.runs import next_second
from daemon.times import slot_text
from daemon.web.asking import seconds
from daemon.web.follower import day_text
from daemon.web.overview import points_of
from daemon.web.pyramid import DAY_S, EPOCH_S, LEVELS, Pyramid, merged
from daemon.web.record import Record
from daemon.web.series import entry_fields

MOST_DAYS = 400
_NOT_NUMBERS = {"id", "slot_utc", "flag", "reasons", "targets", "digest", "motion_covariance"}


def slot(record: Record, slot_utc: datetime) -> dict[str, Any] | None:
    """One slot: its row, or the gap that it lies in; None where the record knows nothing of it."""
    with record.reading() as connection:
        view = slot_view(connection, slot_utc)
        previous, following = neighbours(connection, slot_utc)
        begin, end = slot_text(slot_utc), slot_text(slot_utc + timedelta(seconds=1))
        gaps = [] if view else gaps_within(connection, begin, end)
        said = [one for one in in_force(ledger_entries(connection)) if _holds(one, slot_utc)]
    ends = {"slot": slot_utc, "previous": previous, "next": following}
    head = {"schema": 1, **ends, "ledger": [entry_fields(one) for one in said]}
    if view is None:
        if not gaps:
            return None
        gap = gaps[0]
        frames = {"main": None, "sub": None}
        reasons = [gap.cause.value, *([gap.detail] if gap.detail else [])]
        missing = {"flag": int(Flag.MISSING), "reasons": reasons}
        return {
            **head,
            **missing,
            "points": {},
            "numbers": {},
            "frames": frames,
            "calibration": None,
        }
    fields = result_fields(slot_utc, view.measurement)
    shown = {name: value for name, value in view.columns.items() if name not in _NOT_NUMBERS}
    numbers = {**shown, **{name: fields[name] for name in shown if name in fields}}
    return {
        **head,
        "flag": fields["flag"],
        "reasons": fields["reasons"],
        "points": points_of(fields),
        "numbers": plain(numbers),
        "frames": {role: frame_url(record, slot_utc, role) for role in ("main", "sub")},
        "calibration": view.columns["calibration_id"],
    }


def _holds(entry: LedgerEntry, slot_utc: datetime) -> bool:
    """Whether an entry speaks of a slot."""
    since, until = entry.since_utc, entry.until_utc
    return since is not None and until is not None and since <= slot_utc < until


def excluded(record: Record) -> list[Span]:
    """What the ledger excludes of the main target, in order; nothing where nothing can be read."""
    try:
        with record.reading() as connection:
            return excluded_spans(ledger_entries(connection))
    except StoreError:
        return []


def frame_url(record: Record, slot_utc: datetime, role: str) -> str | None:
    """Where a frame is given, if it is there."""
    there = record.frame(slot_utc, role)
    return None if there is None else f"/frames/{quote(slot_text(slot_utc))}/{role}"


def days(
    pyramid: Pyramid, config: Config, span: tuple[datetime, datetime] | None,
    since: datetime, until: datetime, now_utc: datetime,
    left_out: Sequence[Span], *, pictures: bool,
) -> dict[str, Any]:  # fmt: skip
    """Days of a span: extremes and mean of the main target, completeness, a picture if wanted.

    The numbers are of all rows; `excluded` says which share of the day the ledger leaves out.
    """
    first = (int(seconds(since)) - EPOCH_S) // DAY_S
    count = (int(seconds(until)) - EPOCH_S - 1) // DAY_S - first + 1
    known = pyramid.read_days(first, count)
    level = max(one for one in range(LEVELS) if DAY_S % pyramid.width_s(one) == 0)
    a_day = DAY_S // pyramid.width_s(level)
    axes = {}
    for axis in ("x_mm", "y_mm"):
        parts = pyramid.read(level, f"{axis}.main", first * a_day, count * a_day)
        axes[axis] = merged(parts, a_day)
    found = []
    for place, day in enumerate(known):
        begin_s = EPOCH_S + (first + place) * DAY_S
        expected = _expected(config.schedule.period_s, span, begin_s, now_utc)
        if not expected and not day["rows"]:
            continue
        text, frame_s = day_text(first + place), int(day["frame_s"])
        frame = slot_text(datetime.fromtimestamp(frame_s, UTC)) if frame_s else None
        found.append(
            {
                "day": text,
                **{axis: _extremes(buckets[place]) for axis, buckets in axes.items()},
                "completeness": min(int(day["rows"]) / expected, 1.0) if expected else 1.0,
                "good": min(int(day["good"]) / max(expected, int(day["rows"])), 1.0),
                "flag": int(day["worst"]) or int(Flag.MISSING),
                "excluded": _share_within(left_out, begin_s),
                "thumbnail": f"/frames/{frame}/main?width=160" if frame and pictures else None,
                "slot": frame,
            }
        )
    return {"schema": 1, "days": found}


def _expected(
    period_s: int, span: tuple[datetime, datetime] | None, begin_s: int, now_utc: datetime
) -> int:
    """Slots of a day from the record's first one on, up to now (or the record's end, if later)."""
    if span is None:
        return 0
    end_s = max(min(seconds(now_utc), begin_s + DAY_S), seconds(span[1]) + period_s)
    from_s, to_s = max(begin_s, seconds(span[0])), min(begin_s + DAY_S, end_s)
    return max(int((to_s - from_s) // period_s), 0)


def _share_within(spans: Sequence[Span], begin_s: int) -> float:
    """The share of a day that lies within spans, which are apart."""
    ends = [(max(seconds(a), begin_s), min(seconds(b), begin_s + DAY_S)) for a, b in spans]
    return sum(max(b - a, 0) for a, b in ends) / DAY_S


def _extremes(bucket: np.void) -> dict[str, float | None]:
    if not bucket["count"]:
        return dict.fromkeys(("min", "mean", "max"))
    return {name: round(float(bucket[name]), 5) for name in ("min", "mean", "max")}


def gaps(record: Record, since: datetime, until: datetime) -> dict[str, Any]:
    """Gaps of a span, newest first."""
    begin, end = (slot_text(next_second(time)) for time in (since, until))
    with record.reading() as connection:
        found = gaps_within(connection, begin, end)
    return {
        "schema": 1,
        "gaps": [
            {
                "start": gap.first_slot_utc,
                "end": gap.last_slot_utc + timedelta(seconds=gap.period_s),
                "slots": gap.slots,
                "cause": gap.cause.value,
                "detail": gap.detail,
            }
            for gap in reversed(found)
        ],
    }


def events(record: Record, since: datetime, until: datetime) -> dict[str, Any]:
    """Events of a span, newest first."""
    with record.reading() as connection:
        found = events_within(connection, since, until)
    return {
        "schema": 1,
        "events": [{"time": time, "kind": kind, "detail": detail} for time, kind, detail in found],
    }


def ledger(record: Record) -> dict[str, Any]:
    """What people have said of spans and has not been taken back, newest first."""
    with record.reading() as connection:
        found = in_force(ledger_entries(connection))
    return {"schema": 1, "ledger": [entry_fields(one) for one in reversed(found)]}


def calibrations(record: Record) -> dict[str, Any]:
    """All calibrations, newest first, with their reports."""
    with record.reading() as connection:
        found = calibration_views(connection)
    return {
        "schema": 1,
        "calibrations": [
            {
                "id": one.id,
                "created": one.created_utc,
                "method": one.method,
                "passed": one.passed,
                "active": one.is_active,
                "lines": one.lines,
                "figures": plain(one.figures),
            }
            for one in reversed(found)
        ],
    }


def datum(record: Record) -> dict[str, Any]:
    """All links of calibrations to the record's zero, newest first."""
    with record.reading() as connection:
        links = read_links(connection)
    newest = {link.calibration_id: link.id for link in links}
    return {
        "schema": 1,
        "datum": [
            {
                "calibration": link.calibration_id,
                "created": link.created_utc,
                "reference": link.reference_utc,
                "method": link.method.value,
                "x_mm": float(link.offset.mm[0]),
                "y_mm": float(link.offset.mm[1]),
                "sigma_x_mm": sigma_x_mm,
                "sigma_y_mm": sigma_y_mm,
                "detail": link.detail,
                "holds": link.id == newest[link.calibration_id],
            }
            for link in reversed(links)
            for sigma_x_mm, sigma_y_mm in [sigmas_mm(link.offset)]
        ],
    }
