"""What `/api/overview` gives: how the site is, and what there is to be drawn."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any

from core.site import MAIN, TargetRole
from daemon.alarm.armed import all_items, armed_alarms
from daemon.config.reading import Config
from daemon.errors import StoreError
from daemon.status.facts import Facts, collect_facts
from daemon.status.item import Item, Level, worst
from daemon.status.verdict import no_verdict
from daemon.store.queries.json_fields import result_fields
from daemon.store.queries.record_view import readings_named
from daemon.store.records import Coverage, MeasurementRecord
from daemon.version import VERSION
from daemon.web.follower import Follower
from daemon.web.record import Record
from daemon.web.settings import Settings

KEPT_S = 2.0
"""Readers within this time get the same answer: however many there are, it is worked out once."""
_WORDS = {
    Level.OK: "in order",
    Level.WARNING: "warning",
    Level.CRITICAL: "critical",
    Level.UNKNOWN: "unknown",
}


class Overviews:
    """Works the overview out, once for all who ask at a time."""

    def __init__(self, settings: Settings, follower: Follower) -> None:
        self._settings = settings
        self._follower = follower
        self._lock = threading.Lock()
        self._kept: dict[str, Any] | None = None
        self._kept_s = 0.0

    def fields(self) -> dict[str, Any]:
        """The overview."""
        with self._lock:
            if self._kept is None or time.monotonic() - self._kept_s > KEPT_S:
                self._kept = self._collected()
                self._kept_s = time.monotonic()
            return self._kept

    def site(self) -> dict[str, Any]:
        """What a figure needs to begin, as far as it is known: points, readings, span."""
        record, config = Record(self._settings.state), self._settings.site.config
        named = {one.name: one.unit for one in config.reading}
        with suppress(StoreError), record.reading() as connection:
            named |= readings_named(connection)
        found = record.span()
        return {
            **_head(config, datetime.now(UTC)),
            "readings": [{"name": name, "unit": unit} for name, unit in named.items()],
            "span": None if found is None else {"first": found[0], "last": found[1]},
            "building": self._building(),
            "reference": None if (file := config.report.reference) is None else file.name,
        }

    def _collected(self) -> dict[str, Any]:
        config, now_utc = self._settings.site.config, datetime.now(UTC)
        head = _head(config, now_utc)
        try:
            facts = collect_facts(config, self._settings.state, now_utc, with_budget=False)
            with Record(self._settings.state).reading() as connection:
                named = readings_named(connection)
        except (StoreError, OSError) as error:
            return {**head, **_judged([no_verdict(error)]), "span": None, "last": None}
        if config.has_stepped_clock and facts.last is not None:  # its time is not this machine's
            slot_utc = facts.last.slot_utc
            facts = collect_facts(config, self._settings.state, slot_utc, with_budget=False)
        named = {one.name: one.unit for one in config.reading} | named
        return {
            **head,
            **_judged(all_items(config, self._settings.state, facts)),
            "last": _last(facts),
            "points": _points(config, facts.last),
            "coverage": {"h24": _share(facts.coverage_24h), "d30": _share(facts.coverage_30d)},
            "disk": asdict(facts.disk),
            "alarms": alarm_fields(self._settings),
            "readings": [{"name": name, "unit": unit} for name, unit in named.items()],
            "span": self._span(facts),
            "building": self._building(),
        }

    def _span(self, facts: Facts) -> dict[str, datetime] | None:
        if facts.first_slot_utc is None:
            return None
        found = Record(self._settings.state).span()
        return None if found is None else {"first": found[0], "last": found[1]}

    def _building(self) -> float | None:
        """The share of the record that charts of long spans show already; None: all."""
        progress = self._follower.progress()
        return None if progress.complete else round(progress.share, 3)


def _head(config: Config, now_utc: datetime) -> dict[str, Any]:
    return {
        "schema": 1,
        "site": config.name,
        "now": now_utc,
        "timezone": config.site_section.timezone or "UTC",
        "version": VERSION,
        "refresh_s": max(5, min(config.schedule.period_s // 2, 60)),
        "points": _points(config, None),
        "readings": [{"name": one.name, "unit": one.unit} for one in config.reading],
    }


def alarm_fields(settings: Settings) -> list[dict[str, Any]]:
    """What is armed, raised, acknowledged and silenced, as `alarm list` says it."""
    found = armed_alarms(settings.site.config, settings.state, datetime.now(UTC))
    return [{**one.fields(), "since": one.since_utc} for one in found]


def _judged(items: list[Item]) -> dict[str, Any]:
    said = [{"name": one.name, "level": int(one.level), "text": one.text} for one in items]
    return verdict_fields(worst(items), said)


def verdict_fields(level: Level, items: list[dict[str, Any]]) -> dict[str, Any]:
    """A verdict and what it rests on."""
    return {"verdict": {"level": int(level), "word": _WORDS[level]}, "items": items}


def _last(facts: Facts) -> dict[str, Any] | None:
    if facts.last is None:
        return None
    slot_utc = facts.last.slot_utc
    return {
        "slot": slot_utc,
        "age_s": (facts.now_utc - slot_utc).total_seconds(),
        "points": points_of(result_fields(slot_utc, facts.last.measurement)),
    }


_POINT = ("x_mm", "y_mm", "sigma_x_mm", "sigma_y_mm", "raw_x_mm", "raw_y_mm", "flag", "reasons")


def points_of(fields: dict[str, Any]) -> dict[str, Any]:
    """The main target and the further ones of a row's fields, by name."""
    found = {MAIN: {name: fields[name] for name in _POINT}}
    for target in fields["targets"]:
        found[target["name"]] = {name: target[name] for name in _POINT} | {"role": target["role"]}
    return found


def _points(config: Config, last: MeasurementRecord | None) -> list[dict[str, str]]:
    roles = {MAIN: TargetRole.MEASURED.value}
    roles |= {extra.name: TargetRole(extra.role).value for extra in config.target.extra}
    if last is not None:
        roles |= {target.name: target.role.value for target in last.measurement.targets}
    return [{"name": name, "role": role} for name, role in roles.items()]


def _share(coverage: Coverage) -> float | None:
    return coverage.measured / coverage.expected if coverage.expected else None
