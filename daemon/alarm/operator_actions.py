"""What people say to alarms: acknowledged, silenced for a while. In a file of its own.

The looks only read it, so that neither waits for the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timedelta
from pathlib import Path

from pydantic import AwareDatetime, BaseModel, ConfigDict

from daemon.alarm.history import Happened, note_history
from daemon.alarm.kept import keep, only_one, read_kept
from daemon.alarm.memory import Raised, read_memory
from daemon.errors import UsageError
from daemon.status.item import Level
from daemon.text import utc_text

FILE_NAME = "alarm-orders.json"
LOCK_NAME = "alarm-orders.lock"
LONGEST_SILENCE = timedelta(days=90)


class Ack(BaseModel):
    """Somebody knows of an alarm."""

    model_config = ConfigDict(frozen=True, strict=True)

    id: str
    """Of the alarm: the next one of the same name is not acknowledged."""
    level: Level
    """An alarm that has become worse since is not acknowledged either."""
    at_utc: AwareDatetime
    by: str
    note: str = ""


class Silence(BaseModel):
    """Nothing is sent for a while."""

    model_config = ConfigDict(frozen=True, strict=True)

    names: tuple[str, ...]
    """Of alarms; none is all."""
    from_utc: AwareDatetime
    minutes: float
    by: str
    note: str = ""

    @property
    def until_utc(self) -> datetime:
        """When it ends."""
        return self.from_utc + timedelta(minutes=self.minutes)

    def covers(self, name: str, now_utc: datetime) -> bool:
        """Tell whether it silences an alarm now.

        A clock that is set back makes it last at most twice as long.
        """
        is_on = abs(now_utc - self.from_utc) < timedelta(minutes=self.minutes)
        return is_on and (not self.names or name in self.names)


class OperatorActions(BaseModel):
    """All that people have said."""

    model_config = ConfigDict(frozen=True, strict=True)

    acks: dict[str, Ack] = {}
    silences: list[Silence] = []

    def ack_of(self, name: str, raised: Raised) -> Ack | None:
        """The acknowledgement of an alarm as it is now."""
        found = self.acks.get(name)
        if found is None or found.id != raised.id or raised.level > found.level:
            return None
        return found

    def silence_of(self, name: str, now_utc: datetime) -> Silence | None:
        """The silence that covers an alarm now, the one that lasts longest."""
        found = [one for one in self.silences if one.covers(name, now_utc)]
        return max(found, key=lambda one: one.until_utc, default=None)


def read_operator_actions(state: Path) -> tuple[OperatorActions, str | None]:
    """Give what was said, and what was wrong with the file: a broken one holds nothing."""
    return read_kept(state, FILE_NAME, OperatorActions)


def acknowledge(state: Path, names: Sequence[str], by: str, note: str, now_utc: datetime) -> None:
    """Acknowledge alarms that are raised. Raises UsageError, OSError."""
    memory, _ = read_memory(state)
    for name in names:
        if name not in memory.raised:
            known = ", ".join(sorted(memory.raised)) or "none"
            msg = f"{name!r} is not raised; raised now: {known}"
            raise UsageError(msg)
    with only_one(state, LOCK_NAME, wait=True):
        actions, _ = read_operator_actions(state)
        acks = {n: a for n, a in actions.acks.items() if n in memory.raised}
        for name in names:
            raised = memory.raised[name]
            acks[name] = Ack(id=raised.id, level=raised.level, at_utc=now_utc, by=by, note=note)
        keep(state, FILE_NAME, actions.model_copy(update={"acks": acks}))
    for name in names:
        level = memory.raised[name].level
        note_history(state, Happened(now_utc, "acknowledged", name, level, note, by))


def silence(
    state: Path, names: Sequence[str], span: timedelta, by: str, note: str, now_utc: datetime
) -> datetime:
    """Silence alarms, or all, for a while; gives when that ends. Raises UsageError, OSError."""
    if not timedelta(0) < span <= LONGEST_SILENCE:
        msg = f"a silence lasts at most {LONGEST_SILENCE.days} d; longer: take the alarm out"
        raise UsageError(msg)
    minutes = span.total_seconds() / 60
    added = Silence(names=tuple(names), from_utc=now_utc, minutes=minutes, by=by, note=note)
    with only_one(state, LOCK_NAME, wait=True):
        actions, _ = read_operator_actions(state)
        current = [one for one in actions.silences if abs(now_utc - one.from_utc) < LONGEST_SILENCE]
        current = [one for one in current if one.until_utc > now_utc]
        keep(state, FILE_NAME, actions.model_copy(update={"silences": [*current, added]}))
    text = " ".join(
        filter(None, (f"until {utc_text(added.until_utc.replace(microsecond=0))}", note))
    )
    for name in names or ("all",):
        note_history(state, Happened(now_utc, "silenced", name, Level.OK, text, by))
    return added.until_utc


def end_silence(state: Path, names: Sequence[str], by: str, now_utc: datetime) -> int:
    """End the silences of alarms, or all; gives how many there were. Raises OSError."""
    with only_one(state, LOCK_NAME, wait=True):
        actions, _ = read_operator_actions(state)
        left = [one for one in actions.silences if names and not set(one.names) & set(names)]
        keep(state, FILE_NAME, actions.model_copy(update={"silences": left}))
    ended = len(actions.silences) - len(left)
    if ended:
        for name in names or ("all",):
            note_history(state, Happened(now_utc, "silence_ended", name, Level.OK, "", by))
    return ended
