"""The verdict on what fixed targets show, and on each further target."""

from __future__ import annotations

from datetime import datetime

from core.results import Displacement, Reason
from daemon.status.facts import Facts
from daemon.status.item import Item, Level
from daemon.store.queries.overview import TargetSummary
from daemon.text import span_text
from daemon.value_text import displacement_text

LARGE_CLOSURE = 3.0
"""Closures of a day over their sigma, both rms, before that is a warning."""
LOST_ROWS = 10
"""Rows of a day with a value of the main target: from so many on a further one should have some."""


def judge_targets(facts: Facts) -> list[Item]:
    """Give the closure and each further target its level and a line; none without any."""
    each = [_target(target, facts.now_utc) for target in facts.targets]
    return each if facts.closure_30d is None else [_closure(facts), *each]


def _closure(facts: Facts) -> Item:
    month, day = facts.closure_30d, facts.closure_24h
    text = f"{month.rms_mm:.2f} mm over 30 d, sigma {month.sigma_mm:.2f}" if month else ""
    if day is None or day.rms_mm <= LARGE_CLOSURE * day.sigma_mm:
        return Item("closure", Level.OK, text)
    text += (
        f"; {day.rms_mm:.2f} mm over 24 h, sigma {day.sigma_mm:.2f}: something came loose or was "
        "knocked; look at rig, board and targets, and at dcam-ctl stability"
    )
    return Item("closure", Level.WARNING, text)


def _target(target: TargetSummary, now_utc: datetime) -> Item:
    now = target.now
    name, why = f"target {now.name}", "+".join(now.reasons)
    text = f"{now.role}, {_value(now.corrected)}"
    if why:
        text += f" ({now.flag.name.lower()}: {why})"
    if Reason.TARGET_NOT_CALIBRATED in now.reasons:
        return Item(name, Level.WARNING, f"{text}: calibrate again with it in view")
    if target.rows >= LOST_ROWS and not target.rows_with_value:
        text += f"; no value in 24 h, in none of {target.rows} rows: is it hidden, or gone?"
        return Item(name, Level.WARNING, text)
    if Reason.FIXED_TARGET_MOVED in now.reasons:
        return Item(name, Level.WARNING, f"{text}: fasten it, then calibrate again")
    if now.corrected is None and target.last_value_utc is not None:
        age_s = (now_utc - target.last_value_utc).total_seconds()
        text += f", last value {span_text(age_s)} ago"
    return Item(name, Level.OK, text)


def _value(corrected: Displacement | None) -> str:
    return "no value" if corrected is None else displacement_text(corrected)
