"""What is armed, raised, acknowledged and silenced, for `alarm list`, `status` and the page."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

from daemon.alarm.memory import Memory, read_memory
from daemon.alarm.operator_actions import OperatorActions, read_operator_actions
from daemon.alarm.wrong import level_of
from daemon.config.alarm import WATCHED, RateAlarm, ReadingAlarm, ValueAlarm
from daemon.config.model import Config
from daemon.status.facts import Facts
from daemon.status.item import Item, Level
from daemon.status.verdict import judge
from daemon.text import utc_text

State = Literal["armed", "raised", "acknowledged", "silenced", "raised and silenced"]


@dataclass(frozen=True, slots=True)
class ArmedAlarm:
    """One alarm of a site, as it is now."""

    name: str
    state: State
    level: Level
    """Of a raised one its own; of another the lowest that it is raised for."""
    about: str
    """What it watches."""
    since_utc: datetime | None = None
    """When it became wrong."""
    text: str = ""
    """What was wrong when it was raised."""
    acknowledged_by: str = ""
    note: str = ""
    silent_until_utc: datetime | None = None

    def fields(self) -> dict[str, Any]:
        """Plain JSON types."""
        return {
            "name": self.name,
            "state": self.state,
            "level": self.level.name.lower(),
            "about": self.about,
            "since_utc": utc_text(self.since_utc) if self.since_utc else None,
            "text": self.text,
            "acknowledged_by": self.acknowledged_by,
            "note": self.note,
            "silent_until_utc": utc_text(self.silent_until_utc) if self.silent_until_utc else None,
        }


def armed_alarms(config: Config, state: Path, now_utc: datetime) -> list[ArmedAlarm]:
    """All alarms of a site, those that are raised first; from small files, never the database."""
    memory, _ = read_memory(state)
    actions, _ = read_operator_actions(state)
    watched = _watched(config)
    for name, one in memory.raised.items():  # of another config, or a status that fails
        watched.setdefault(name, (one.level, "the whole site"))
    found = [_one(*(name, *what), memory, actions, now_utc) for name, what in watched.items()]
    return sorted(found, key=lambda one: one.since_utc is None)


def all_items(config: Config, state: Path, facts: Facts) -> list[Item]:
    """The whole verdict: what `judge` finds, and the alarms."""
    return [*judge(facts), alarm_item(config, state, facts.now_utc)]


def alarm_item(config: Config, state: Path, now_utc: datetime) -> Item:
    """What `status` says of alarms: how many are armed, and which are raised.

    A raised alarm of the site's own is as bad as its severity; of the others the items themselves
    say how bad they are, and an acknowledged one is known.
    """
    found = armed_alarms(config, state, now_utc)
    own = {one.name for one in config.alarm.own}
    raised = [one for one in found if one.since_utc is not None]
    silent = [one for one in found if one.silent_until_utc is not None]
    text = f"{len(found)} armed"
    if not (config.alarm.urls or config.alarm.command):
        text += ", nobody to tell"
    if raised:
        text += ", " + ", ".join(f"{one.name} {one.state}" for one in raised)
    if silent:
        until_utc = max(one.silent_until_utc or now_utc for one in silent)
        text += f", {len(silent)} silent until {utc_text(until_utc.replace(microsecond=0))}"
    sent = [one.level for one in raised if one.name in own and one.state == "raised"]
    return Item("alarms", max(sent, default=Level.OK), text)


def _watched(config: Config) -> dict[str, tuple[Level, str]]:
    """Each alarm with the lowest level that is sent, and what it watches."""
    settings = config.alarm
    found: dict[str, tuple[Level, str]] = {}
    targets = [f"target-{extra.name}" for extra in config.target.extra]
    for name in (*WATCHED, *targets):
        if name == "calibration-age" and settings.calibration_age_days is None:
            continue
        warns = settings.level == "warning" or name in settings.warnings
        found[name] = (Level.WARNING if warns else Level.CRITICAL, "as in dcam-ctl status")
    for one in settings.own:
        found[one.name] = (level_of(one.severity), about(one))
    return found


def about(one: ValueAlarm | RateAlarm | ReadingAlarm) -> str:
    """What an alarm of the site's own watches, in a few words."""
    if isinstance(one, RateAlarm):
        return (
            f"{one.target} {one.axis} beyond {one.limit_mm_per_day:g} mm/d over {one.window_h:g} h"
        )
    if isinstance(one, ValueAlarm):
        what, above, below, unit = f"{one.target} {one.axis}", one.above_mm, one.below_mm, " mm"
    else:
        what, above, below, unit = one.reading, one.above, one.below, ""
    sides = (("above", above), ("below", below))
    limits = [f"{side} {limit:g}{unit}" for side, limit in sides if limit is not None]
    return f"{what} {' or '.join(limits)} over {one.dwell_min:g} min"


def _one(
    name: str, level: Level, about: str, memory: Memory, actions: OperatorActions, now_utc: datetime
) -> ArmedAlarm:
    silence = actions.silence_of(name, now_utc)
    until_utc = silence.until_utc if silence else None
    raised = memory.raised.get(name)
    if raised is None:
        state: State = "silenced" if silence else "armed"
        note = silence.note if silence else ""
        return ArmedAlarm(name, state, level, about, note=note, silent_until_utc=until_utc)
    ack = actions.ack_of(name, raised)
    state = "acknowledged" if ack else "raised and silenced" if silence else "raised"
    return ArmedAlarm(
        *(name, state, raised.level, about),
        since_utc=memory.since.get(name, raised.at_utc),
        text="; ".join(filter(None, (raised.text, raised.confirmation))),
        acknowledged_by=ack.by if ack else "",
        note=ack.note if ack else silence.note if silence else "",
        silent_until_utc=until_utc,
    )
