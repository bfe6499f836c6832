"""One thing that is wrong, under the name by which people acknowledge and silence it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

from daemon.config.alarm import AlarmSection
from daemon.status.facts import Facts
from daemon.status.item import Item, Level
from daemon.text import span_text


@dataclass(frozen=True, slots=True)
class Wrong:
    """One thing that is wrong."""

    name: str
    level: Level
    text: str
    """What, where, how much, and what to do."""
    at_once: bool = False
    """It has lasted for its own dwell time, and does not wait for after_min."""


def alarm_name(item: str) -> str:
    """The name of an item of `status` on a command line: `coverage-24-h`."""
    return item.replace(" ", "-")


def of_status(items: Sequence[Item], settings: AlarmSection) -> list[Wrong]:
    """Give the items that are bad enough; what is unknown is never an item of a status."""
    bad = {Level.CRITICAL} | ({Level.WARNING} if settings.level == "warning" else set())
    return [
        Wrong(name, item.level, item.text)
        for item in items
        for name in (alarm_name(item.name),)
        if item.level in bad or (item.level is Level.WARNING and name in settings.warnings)
    ]


def warned_of(items: Sequence[Item], settings: AlarmSection) -> dict[str, str]:
    """What `status` warns of and is not sent: texts by name."""
    sent = {one.name for one in of_status(items, settings)}
    warnings = {alarm_name(one.name): one.text for one in items if one.level is Level.WARNING}
    return {name: said for name, said in warnings.items() if name not in sent}


def of_calibration_age(facts: Facts, settings: AlarmSection) -> list[Wrong]:
    """A calibration that is older than the site wants it."""
    limit_days, record = settings.calibration_age_days, facts.calibration
    if limit_days is None or record is None:
        return []
    age_s = (facts.now_utc - record.created_utc).total_seconds()
    if age_s <= limit_days * 86_400:
        return []
    text = (
        f"calibration {record.id} is {span_text(age_s)} old, more than {limit_days:g} d: "
        "calibrate again"
    )
    return [Wrong("calibration-age", Level.WARNING, text)]


def level_of(severity: str) -> Level:
    """The level of a severity in the config."""
    return Level.CRITICAL if severity == "critical" else Level.WARNING


def since_text(utc: datetime) -> str:
    """A moment to the second, as messages write it."""
    return utc.replace(microsecond=0).isoformat().replace("+00:00", "Z")
