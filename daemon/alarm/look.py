"""One look at a site: what is wrong, who must hear of it, and what is remembered at which moment.

What is raised is durable before anything is sent, so that no end of this forgets it. That a message
is being sent is noted before, that it has arrived after it: where all ends between the two, nobody
knows, and it is sent once more, with the same number and words that say so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path

from daemon.alarm.confirmation import Outcome, SecondMeasurement
from daemon.alarm.history import Happened, Kind, note_history
from daemon.alarm.memory import Memory, keep_memory
from daemon.alarm.operator_actions import read_operator_actions
from daemon.alarm.receivers import NotAcceptedError, Receiver
from daemon.alarm.rules import (
    Message,
    changes,
    due,
    seen,
    text,
    title,
    with_attempt,
    with_sent,
    without_attempt,
)
from daemon.alarm.values import Verdict, judge_values
from daemon.alarm.wrong import Wrong, level_of, of_calibration_age, of_status, warned_of
from daemon.config.alarm import AlarmSection, ValueAlarm
from daemon.config.model import Config
from daemon.error_report import lines_of
from daemon.errors import ConfigError
from daemon.status.facts import collect_facts
from daemon.status.item import Level
from daemon.status.verdict import judge, no_verdict

MOST_HELD = 2
"""Looks in a row for which a contradicted alarm is held back; then it goes out all the same."""


@dataclass(frozen=True, slots=True)
class Place:
    """The site, as far as its config can be read."""

    site: str
    settings: AlarmSection
    state: Path
    config: Config | ConfigError


@dataclass(frozen=True, slots=True)
class Found:
    """What a look has found wrong."""

    wrong: list[Wrong]
    whole: bool
    """Whether everything could be looked at."""
    verdicts: list[Verdict] = field(default_factory=list)
    warned: dict[str, str] = field(default_factory=dict)
    """What `status` warns of and is not sent."""

    @property
    def unknown(self) -> set[str]:
        """The alarms of values of which the rows say nothing."""
        return {one.alarm.name for one in self.verdicts if not one.is_known}


@dataclass(slots=True)
class Outcomes:
    """What was said of a look, and whether all went well."""

    lines: list[str] = field(default_factory=list)
    failed: bool = False


def find_wrong(place: Place, memory: Memory, now_utc: datetime) -> Found:
    """Look at the whole site; never raises: what hides how the site is, is itself wrong."""
    if isinstance(place.config, ConfigError):
        return Found([_of_error(place.config)], whole=False)
    settings = place.settings
    try:
        facts = collect_facts(place.config, place.state, now_utc, with_budget=False)
        items = judge(facts)
        wrong = of_status(items, settings) + of_calibration_age(facts, settings)
    except Exception as error:  # noqa: BLE001 - whatever hides how the site is must be sent
        return Found([_of_error(error)], whole=False)
    try:
        period_s = place.config.schedule.period_s
        verdicts = judge_values(settings, place.state, period_s, now_utc, memory.limits)
    except Exception as error:  # noqa: BLE001 - likewise
        why = "; ".join(lines_of(error))
        said = f"the values cannot be judged: {why}; dcam-ctl verify"
        return Found([*wrong, Wrong("alarms", Level.CRITICAL, said)], whole=False)
    wrong += [verdict.wrong for verdict in verdicts if verdict.wrong]
    return Found(wrong, whole=True, verdicts=verdicts, warned=warned_of(items, settings))


def look(
    place: Place, everyone: Sequence[Receiver], found: Found, kept: Memory, now_utc: datetime
) -> Outcomes:
    """Remember what was found, and tell each receiver what is due."""
    outcomes = Outcomes()
    actions, complaint = read_operator_actions(place.state)
    if complaint:
        outcomes.lines.append(complaint)
    settings, keys = place.settings, {receiver.key for receiver in everyone}
    found, held, confirmations = _confirmed(place, found, kept, now_utc)
    memory = seen(
        *(kept, found.wrong, now_utc, keys, settings), unknown=found.unknown, whole=found.whole
    )
    raised = {
        name: one.model_copy(update={"confirmation": confirmations[name]})
        if name in confirmations
        else one
        for name, one in memory.raised.items()
    }
    limits = {v.alarm.name: v.limit for v in found.verdicts if v.limit is not None}
    if not found.whole:
        limits = kept.limits | limits
    memory = memory.model_copy(update={"raised": raised, "limits": limits, "held": held})
    for happened in changes(kept, memory, now_utc):
        note_history(place.state, happened)
    kept = _keep(place.state, kept, memory, outcomes)
    for receiver in everyone:
        message = due(memory, receiver.key, actions, settings, now_utc, warned=found.warned)
        if message is None:
            continue
        words = text(
            *(memory, message, found.wrong, actions, now_utc),
            warned=found.warned,
            again=memory.sending.get(receiver.key) == message.id,
        )
        memory = with_attempt(memory, receiver.key, message)
        kept = _keep(place.state, kept, memory, outcomes)
        memory = _tell(place, receiver, message, words, memory, now_utc, outcomes)
        kept = _keep(place.state, kept, memory, outcomes)
    return outcomes


def _confirmed(
    place: Place, found: Found, kept: Memory, now_utc: datetime
) -> tuple[Found, dict[str, int], dict[str, str]]:
    """Ask for a second measurement where a new alarm wants it; hold back what it contradicts."""
    second = SecondMeasurement(place.state)
    held: dict[str, int] = {}
    said: dict[str, str] = {}
    answers: list[Verdict] = []
    for one in found.verdicts:
        alarm, name, wrong = one.alarm, one.alarm.name, one.wrong
        is_new = wrong is not None and name not in kept.raised
        if not isinstance(alarm, ValueAlarm) or not alarm.confirm or not is_new:
            answers.append(one)
            continue
        answer = second.confirm(alarm, one.limit or 0.0)
        times = kept.held.get(name, 0) + 1
        if answer.outcome is Outcome.CONTRADICTED and times <= MOST_HELD:
            held[name] = times
            level = level_of(alarm.severity)
            note_history(place.state, Happened(now_utc, "contradicted", name, level, answer.text))
            answers.append(Verdict(alarm, None, is_known=True, now=one.now))
        else:
            said[name] = answer.text
            answers.append(one)
    left = [one for one in found.wrong if one.name not in held]
    return replace(found, wrong=left, verdicts=answers), held, said


def _tell(
    place: Place,
    receiver: Receiver,
    message: Message,
    words: str,
    memory: Memory,
    now_utc: datetime,
    outcomes: Outcomes,
) -> Memory:
    headline = title(message, place.site)
    try:
        receiver.send(headline, words)
    except NotAcceptedError as error:
        outcomes.failed = True
        outcomes.lines.append(f"alarm.{receiver.name} did not accept {headline!r}: {error}")
        if memory.failed.get(receiver.key) != message.id:  # not at each look
            _note(place, "failed", receiver, message, f"{headline}: {error}", now_utc)
        return without_attempt(memory, receiver.key, failed=message.id)
    outcomes.lines.append(f"alarm.{receiver.name} accepted {headline!r}")
    _note(place, "sent", receiver, message, headline, now_utc)
    return with_sent(memory, receiver.key, message, now_utc)


def _note(
    place: Place, kind: Kind, receiver: Receiver, message: Message, said: str, now_utc: datetime
) -> None:
    level = max((one.level for one in message.listed.values()), default=Level.OK)
    happened = Happened(
        *(now_utc, kind, message.names, level, said), by=receiver.name, id=message.id
    )
    note_history(place.state, happened)


def _keep(state: Path, kept: Memory, memory: Memory, outcomes: Outcomes) -> Memory:
    """Write the memory if it has changed; what cannot be kept is said."""
    if memory == kept:
        return kept
    try:
        keep_memory(state, memory)
    except OSError as error:
        said = "; ".join(lines_of(error)) + ": what was sent is forgotten, and sent again"
        if said not in outcomes.lines:
            outcomes.lines.append(said)
        outcomes.failed = True
        return kept
    return memory


def _of_error(error: Exception) -> Wrong:
    item = no_verdict(error)
    return Wrong(item.name, item.level, item.text)
