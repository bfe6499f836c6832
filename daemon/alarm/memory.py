"""What must outlive a look, and a reboot: what is wrong, and who knows of it."""

from __future__ import annotations

from pathlib import Path

from pydantic import AwareDatetime, BaseModel, ConfigDict

from daemon.alarm.kept import keep, read_kept
from daemon.status.item import Level

FILE_NAME = "alarm.json"


class Raised(BaseModel):
    """An alarm, from when it had lasted long enough until it is over."""

    model_config = ConfigDict(frozen=True, strict=True)

    id: str
    """Of this time: the next one of the same name has another."""
    level: Level
    """The worst of late: a lower one counts once it has lasted as long as an alarm must."""
    text: str
    """As it was when it was raised, or changed its level."""
    at_utc: AwareDatetime
    confirmation: str = ""
    """What a second measurement said."""
    milder_since_utc: AwareDatetime | None = None
    """Since when it has been less bad than its level."""


class Sent(BaseModel):
    """What one receiver knows of; it has not heard yet that it is over."""

    model_config = ConfigDict(frozen=True, strict=True)

    levels: dict[str, Level]
    """Of what was wrong when it was sent, by name."""
    at_utc: AwareDatetime


class Memory(BaseModel):
    """What must outlive a look, and a reboot."""

    model_config = ConfigDict(frozen=True, strict=True)

    since: dict[str, AwareDatetime] = {}
    """When each thing that is wrong was first seen so."""
    raised: dict[str, Raised] = {}
    """Those that have lasted long enough."""
    limits: dict[str, float] = {}
    """By the name of a value's alarm, the limit that is exceeded."""
    held: dict[str, int] = {}
    """How often in a row a second measurement contradicted an alarm."""
    sent: dict[str, Sent] = {}
    """By receiver."""
    sending: dict[str, str] = {}
    """By receiver, the message that was begun: whether it arrived is not known."""
    failed: dict[str, str] = {}
    """By receiver, the message that it did not take."""


def read_memory(state: Path) -> tuple[Memory, str | None]:
    """Give what was kept last, and what was wrong with it: a broken memory is an empty one."""
    return read_kept(state, FILE_NAME, Memory)


def keep_memory(state: Path, memory: Memory) -> None:
    """Keep it. Raises OSError."""
    keep(state, FILE_NAME, memory)
