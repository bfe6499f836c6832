"""`[alarm]`: whom to tell of what is wrong; read also from a config that is wrong elsewhere."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, Strict, ValidationError

from daemon.config.site import Section

Words = Annotated[tuple[Annotated[str, Field(min_length=1)], ...], Strict(strict=False)]


class AlarmSection(Section):
    """`[alarm]`."""

    urls: Words = ()
    command: Words = ()
    level: Literal["warning", "critical"] = "critical"
    after_min: float = Field(default=15.0, ge=0)
    repeat_h: float = Field(default=24.0, gt=0)


class _Name(BaseModel):
    name: str = "?"
    timezone: str | None = None


class _Directory(BaseModel):
    directory: str | None = None


class Remains(BaseModel):
    """What an alarm needs of a config, whatever else is in it."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    alarm: AlarmSection = AlarmSection()
    site: _Name = _Name()
    storage: _Directory = _Directory()


def read_remains(path: Path) -> Remains | None:
    """Give what a config that is wrong says of alarms; None where that cannot be read either."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError):
        return None
    tables: dict[str, object] = {}
    for part in re.split(r"(?m)^(?=\[)", text):  # one table each: another may be no TOML at all
        try:
            tables |= tomllib.loads(part)
        except tomllib.TOMLDecodeError:
            continue
    try:
        return Remains.model_validate(tables)
    except ValidationError:
        return None
