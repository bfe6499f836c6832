"""Who must be notified of what, and when: from what is wrong now, what was sent, and the time."""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from enum import Enum
from types import MappingProxyType

from daemon.alarm.history import Happened
from daemon.alarm.memory import Memory, Raised, Sent
from daemon.alarm.operator_actions import OperatorActions
from daemon.alarm.wrong import Wrong, since_text
from daemon.config.alarm import AlarmSection
from daemon.status.item import Level
from daemon.text import span_text, utc_text


class News(Enum):
    """Why a message is sent, as its title says it."""

    RAISED = ""
    REPEATED = "still "
    CLEARED = "cleared"
    EASED = "less bad"


@dataclass(frozen=True, slots=True)
class Message:
    """What one receiver must hear now."""

    news: News
    id: str
    """The same as long as the same is to be sent: a receiver can tell a second copy."""
    listed: dict[str, Raised]
    """All that is raised and not silenced, the worst first."""
    fresh: tuple[str, ...]
    """Of these, what the receiver does not know yet."""
    cleared: tuple[str, ...]
    eased: tuple[str, ...]
    """Of the listed, what is less bad than the receiver knows."""
    all_well: bool
    """Nothing is wrong any more; of what was cleared not even a warning is left."""

    @property
    def names(self) -> str:
        """Of the alarms that it is about, for the history."""
        about = [*self.fresh, *self.cleared, *self.eased] or list(self.listed)
        return ", ".join(about)


def seen(
    memory: Memory,
    found: Sequence[Wrong],
    now_utc: datetime,
    receivers: Collection[str],
    settings: AlarmSection,
    *,
    unknown: Collection[str] = (),
    whole: bool,
) -> Memory:
    """Remember what is wrong now, and forget what is not.

    Where not the whole site could be looked at, nothing is known of the rest; `unknown` names
    single alarms of which nothing is. A clock that was set back starts the time again.
    """
    now = {one.name: one for one in found}

    def kept(name: str) -> bool:
        return name in now or name in unknown or not whole

    since = {name: min(time, now_utc) for name, time in memory.since.items() if kept(name)}
    since = dict.fromkeys(now, now_utc) | since
    after = timedelta(minutes=settings.after_min)
    raised = {name: known for name, known in memory.raised.items() if kept(name)}
    for name, one in now.items():
        known = raised.get(name)
        if known is not None:
            raised[name] = _seen_again(known, one, now_utc, after)
        elif one.at_once or now_utc - since[name] >= after:
            number = secrets.token_hex(4)
            raised[name] = Raised(id=number, level=one.level, text=one.text, at_utc=now_utc)
    sent = {
        receiver: known.model_copy(update={"at_utc": min(known.at_utc, now_utc)})
        for receiver, known in memory.sent.items()
        if receiver in receivers
    }
    return memory.model_copy(update={"since": since, "raised": raised, "sent": sent})


def _seen_again(known: Raised, one: Wrong, now_utc: datetime, after: timedelta) -> Raised:
    """A raised alarm at another look: worse at once, less bad when that has lasted.

    A figure that goes to and fro across a limit is so one change, not one at each look.
    """
    milder_since_utc = None
    if one.level < known.level:
        milder_since_utc = min(known.milder_since_utc or now_utc, now_utc)
    changed: dict[str, object] = {"milder_since_utc": milder_since_utc}
    lasted = milder_since_utc is not None and now_utc - milder_since_utc >= after
    if one.level > known.level or lasted:
        changed = {"level": one.level, "text": one.text, "milder_since_utc": None}
    return known.model_copy(update=changed)


def changes(before: Memory, after: Memory, now_utc: datetime) -> list[Happened]:
    """What the history notes of a look."""
    noted = []
    for name, one in after.raised.items():
        known = before.raised.get(name)
        if known is None:
            text = "; ".join(filter(None, (one.text, one.confirmation)))
            noted.append(Happened(now_utc, "raised", name, one.level, text, id=one.id))
        elif known.level is not one.level:
            noted.append(Happened(now_utc, "changed", name, one.level, one.text, id=one.id))
    for name, known in before.raised.items():
        if name not in after.raised:
            lasted = span_text((now_utc - known.at_utc).total_seconds())
            text = f"after {lasted}"
            noted.append(Happened(now_utc, "cleared", name, known.level, text, id=known.id))
    return noted


def due(
    memory: Memory,
    receiver: str,
    actions: OperatorActions,
    settings: AlarmSection,
    now_utc: datetime,
    *,
    warned: Collection[str] = (),
) -> Message | None:
    """Tell what a receiver must hear now; `memory` has seen what is wrong.

    `warned` names what `status` warns of and is not sent.
    """
    sent = memory.sent.get(receiver)
    known = sent.levels if sent else {}
    listed = {
        name: one
        for name, one in sorted(memory.raised.items(), key=lambda pair: -pair[1].level)
        if actions.silence_of(name, now_utc) is None
    }
    open_ = {name: one for name, one in listed.items() if actions.ack_of(name, one) is None}
    fresh = tuple(n for n, one in open_.items() if one.level > known.get(n, Level.OK))
    cleared = tuple(
        name
        for name in known
        if name not in memory.raised and actions.silence_of(name, now_utc) is None
    )
    eased = tuple(n for n, one in open_.items() if one.level < known.get(n, Level.OK))
    if fresh:
        news = News.RAISED
    elif cleared:
        news = News.CLEARED
    elif eased:
        news = News.EASED
    elif sent and open_ and now_utc - sent.at_utc >= timedelta(hours=settings.repeat_h):
        news = News.REPEATED
    else:
        return None
    shown = listed if news is not News.CLEARED else {}
    began = utc_text(sent.at_utc) if sent else ""
    ids = sorted(f"{one.id}{one.level}" for one in shown.values())
    said = "\0".join([receiver, news.name, began, *ids, *fresh, *cleared, *eased])
    number = hashlib.sha256(said.encode()).hexdigest()[:8]
    all_well = not memory.since and not memory.raised and not {*cleared} & {*warned}
    return Message(news, number, listed, fresh, cleared, eased, all_well)


def with_sent(memory: Memory, receiver: str, message: Message, now_utc: datetime) -> Memory:
    """Remember that a receiver has heard a message."""
    known = memory.sent[receiver].levels if receiver in memory.sent else {}
    levels = {name: level for name, level in known.items() if name not in message.cleared}
    levels |= {name: one.level for name, one in message.listed.items()}
    sent = {name: one for name, one in memory.sent.items() if name != receiver}
    if levels:
        sent[receiver] = Sent(levels=levels, at_utc=now_utc)
    return without_attempt(memory, receiver).model_copy(update={"sent": sent})


def with_attempt(memory: Memory, receiver: str, message: Message) -> Memory:
    """Remember that a message is being sent: should all end now, it may have arrived."""
    return memory.model_copy(update={"sending": memory.sending | {receiver: message.id}})


def without_attempt(memory: Memory, receiver: str, failed: str | None = None) -> Memory:
    """Remember that it has arrived, or failed."""
    sending = {name: one for name, one in memory.sending.items() if name != receiver}
    failures = {name: one for name, one in memory.failed.items() if name != receiver}
    if failed is not None:
        failures[receiver] = failed
    return memory.model_copy(update={"sending": sending, "failed": failures})


def title(message: Message, site: str) -> str:
    """The line that is read first, or alone."""
    if message.news is News.CLEARED:
        said = "all well again" if message.all_well else f"cleared {', '.join(message.cleared)}"
        return f"dcam {site}: {said}"
    if message.news is News.EASED:
        return f"dcam {site}: {', '.join(message.eased)} no longer critical"
    level = max(one.level for one in message.listed.values())
    return f"dcam {site}: {message.news.value}{level.name}"


def text(
    memory: Memory,
    message: Message,
    found: Sequence[Wrong],
    actions: OperatorActions,
    now_utc: datetime,
    *,
    warned: Mapping[str, str] = MappingProxyType({}),
    again: bool,
) -> str:
    """What is wrong, since when, and what to do about it; what is over; how to tell a copy.

    `warned` says of what is not sent what `status` warns of.
    """
    now = {one.name: one.text for one in found}
    lines = []
    if message.news is News.CLEARED and message.all_well:
        lines.append(f"Nothing is wrong any more, {since_text(now_utc)}.")
    for name in message.cleared:
        left = f"; still a warning: {warned[name]}" if name in warned else ""
        lines.append(f"{name}: cleared, {since_text(now_utc)}{left}")
    for name, one in message.listed.items():
        since = memory.since.get(name, one.at_utc).replace(microsecond=0)
        lasted = span_text((now_utc - since).total_seconds())
        said = "; ".join(filter(None, (now.get(name, one.text), one.confirmation)))
        ack = actions.ack_of(name, one)
        known = f" (acknowledged by {ack.by})" if ack else ""
        level = one.level.name.lower()
        if name in message.eased:
            level = f"no longer critical, {level}"
        lines.append(f"{name}: {level} since {utc_text(since)} ({lasted}){known}: {said}")
    doubt = ", sent before perhaps: dcam ended while it was sent" if again else ""
    return "\n".join([*lines, f"(message {message.id}{doubt})"])
