"""Who must be notified of what, and when: from what is wrong now, what was sent, and the time."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from datetime import datetime, timedelta
from enum import Enum

from pydantic import AwareDatetime, BaseModel, ConfigDict

from daemon.config.alarm import AlarmSection
from daemon.status.item import Item, Level, worst
from daemon.text import span_text, utc_text


class News(Enum):
    """Why a message is sent, as its title says it."""

    RAISED = ""
    REPEATED = "still "
    CLEARED = "all well again"


class Sent(BaseModel):
    """What one receiver knows of; it has not heard yet that all is well again."""

    model_config = ConfigDict(frozen=True, strict=True)

    levels: dict[str, Level]
    """Of what was wrong when it was sent, as far as it still is."""
    at_utc: AwareDatetime


class Memory(BaseModel):
    """What must outlive a look, and a reboot."""

    model_config = ConfigDict(frozen=True, strict=True)

    since: dict[str, AwareDatetime] = {}
    """When each item that is wrong was first seen so."""
    sent: dict[str, Sent] = {}
    """By receiver."""


def wrong(items: Sequence[Item], settings: AlarmSection) -> list[Item]:
    """Give the items that are bad enough; what is unknown is never an item of a status."""
    bad = {Level.CRITICAL} | ({Level.WARNING} if settings.level == "warning" else set())
    return [item for item in items if item.level in bad]


def seen(
    memory: Memory,
    items: Sequence[Item],
    now_utc: datetime,
    receivers: Collection[str],
    *,
    whole: bool,
) -> Memory:
    """Remember what is wrong now, and forget what is not.

    Where not the whole site could be looked at, nothing is known of the rest. A clock that was
    set back starts the time again.
    """
    now = {item.name for item in items}

    def kept(name: str) -> bool:
        return name in now or not whole

    since = {name: min(time, now_utc) for name, time in memory.since.items() if kept(name)}
    sent = {
        receiver: Sent(
            levels={name: level for name, level in known.levels.items() if kept(name)},
            at_utc=min(known.at_utc, now_utc),
        )
        for receiver, known in memory.sent.items()
        if receiver in receivers
    }
    return Memory(since=dict.fromkeys(now, now_utc) | since, sent=sent)


def due(
    memory: Memory, receiver: str, items: Sequence[Item], settings: AlarmSection, now_utc: datetime
) -> News | None:
    """Tell whether a receiver must hear something now; `memory` has seen the items."""
    after = timedelta(minutes=settings.after_min)
    lasting = [item for item in items if now_utc - memory.since[item.name] >= after]
    sent = memory.sent.get(receiver)
    known = sent.levels if sent else {}
    if any(item.level > known.get(item.name, Level.OK) for item in lasting):
        return News.RAISED
    if sent is None:
        return None
    if not items:
        return News.CLEARED
    if lasting and now_utc - sent.at_utc >= timedelta(hours=settings.repeat_h):
        return News.REPEATED
    return None


def with_sent(memory: Memory, receiver: str, items: Sequence[Item], now_utc: datetime) -> Memory:
    """Remember that a receiver has heard of the items; of none, that all is well again."""
    others = {name: known for name, known in memory.sent.items() if name != receiver}
    if items:
        known = memory.sent[receiver].levels if receiver in memory.sent else {}
        levels = known | {item.name: item.level for item in items}
        others[receiver] = Sent(levels=levels, at_utc=now_utc)
    return Memory(since=memory.since, sent=others)


def title(news: News, site: str, items: Sequence[Item]) -> str:
    """The line that is read first, or alone."""
    level = worst(list(items)).name if items else ""
    return f"dcam {site}: {news.value}{level}"


def text(memory: Memory, items: Sequence[Item], now_utc: datetime) -> str:
    """What is wrong, since when, and what to do about it, as `status` says it."""
    if not items:
        return f"Nothing is wrong any more, {utc_text(now_utc.replace(microsecond=0))}."
    lines = []
    for item in items:
        since = memory.since[item.name].replace(microsecond=0)
        lasted = span_text((now_utc - since).total_seconds())
        level = item.level.name.lower()
        lines.append(f"{item.name}: {level} since {utc_text(since)} ({lasted}): {item.text}")
    return "\n".join(lines)
