"""`[alarm]`: whom to tell of what; read also from a config that is wrong elsewhere."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, Strict, ValidationError

from daemon.config.section import Section

if TYPE_CHECKING:
    from daemon.config.model import Config

Words = Annotated[tuple[Annotated[str, Field(min_length=1)], ...], Strict(strict=False)]
Name = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]{0,31}$")]
Severity = Literal["warning", "critical"]

MOST_ALARMS = 64
CAMERAS = ("temperature-main", "temperature-sub")
"""What `[[alarm.reading]]` calls the temperatures that the cameras say, in degC."""
WATCHED = (
    *("measurement", "last-good-value", "daemon", "supervision", "cameras", "readings"),
    *("calibration", "calibration-age", "closure", "zero", "coverage-24-h", "coverage-30-d"),
    *("disk", "database", "frames", "clock", "status", "alarms"),
)
"""The alarms that every site has, by their names; `status` uses a space for the dash."""


class ValueAlarm(Section):
    """`[[alarm.value]]`: a displacement beyond a level."""

    name: Name
    target: Name = "main"
    axis: Literal["x", "y"] = "y"
    above_mm: float | None = None
    below_mm: float | None = None
    hysteresis_mm: float = Field(default=0.1, ge=0)
    dwell_min: float = Field(default=5.0, gt=0, le=1440)
    sigmas: float = Field(default=3.0, ge=0, le=10)
    severity: Severity = "critical"
    confirm: bool = False


class RateAlarm(Section):
    """`[[alarm.rate]]`: a displacement that changes faster than a limit, either way."""

    name: Name
    target: Name = "main"
    axis: Literal["x", "y"] = "y"
    limit_mm_per_day: float = Field(gt=0)
    hysteresis_mm_per_day: float | None = Field(default=None, ge=0)
    window_h: float = Field(default=72.0, ge=1, le=720)
    sigmas: float = Field(default=3.0, ge=0, le=10)
    severity: Severity = "critical"

    @property
    def hysteresis(self) -> float:
        """In mm a day: a fifth of the limit where nothing is said."""
        given = self.hysteresis_mm_per_day
        return 0.2 * self.limit_mm_per_day if given is None else given


class ReadingAlarm(Section):
    """`[[alarm.reading]]`: a sensor, or a camera's temperature, beyond a level, in its own unit."""

    name: Name
    reading: Name
    above: float | None = None
    below: float | None = None
    hysteresis: float = Field(default=1.0, ge=0)
    dwell_min: float = Field(default=15.0, gt=0, le=1440)
    severity: Severity = "warning"


class AlarmSection(Section):
    """`[alarm]`."""

    urls: Words = ()
    command: Words = ()
    level: Severity = "critical"
    warnings: Annotated[tuple[Name, ...], Strict(strict=False)] = (
        *("closure", "calibration", "calibration-age", "disk", "clock"),
    )
    after_min: float = Field(default=15.0, ge=0)
    repeat_h: float = Field(default=24.0, gt=0)
    calibration_age_days: float | None = Field(default=None, gt=0)
    value: Annotated[
        tuple[ValueAlarm, ...], Strict(strict=False), Field(max_length=MOST_ALARMS)
    ] = ()
    rate: Annotated[tuple[RateAlarm, ...], Strict(strict=False), Field(max_length=MOST_ALARMS)] = ()
    reading: Annotated[
        tuple[ReadingAlarm, ...], Strict(strict=False), Field(max_length=MOST_ALARMS)
    ] = ()

    @property
    def own(self) -> tuple[ValueAlarm | RateAlarm | ReadingAlarm, ...]:
        """The alarms that the site defines."""
        return (*self.value, *self.rate, *self.reading)


def alarm_problems(config: Config) -> list[str]:
    """Name what contradicts itself in the alarms, or the rest of the config."""
    alarm = config.alarm
    problems = [
        f"alarm.warnings: {name!r} is no alarm of every site; they are {', '.join(WATCHED)}"
        for name in alarm.warnings
        if name not in WATCHED and not name.startswith("target-")
    ]
    names: set[str] = set(WATCHED)
    for kind in ("value", "rate", "reading"):
        for number, one in enumerate(getattr(alarm, kind)):
            found = (_name_problem(one.name, names), *_target_problems(config, one))
            problems += [f"alarm.{kind}[{number}].{problem}" for problem in found if problem]
            names.add(one.name)
    return problems


def _name_problem(name: str, names: set[str]) -> str:
    if name in names or name.startswith("target-"):
        return f"name: {name!r} is the name of another alarm; give each its own"
    return ""


def _target_problems(config: Config, one: ValueAlarm | RateAlarm | ReadingAlarm) -> Iterator[str]:
    if isinstance(one, ReadingAlarm):
        known = [*CAMERAS, *(reading.name for reading in config.reading)]
        if one.reading not in known:
            yield f"reading: there is no reading {one.reading!r}; known: {', '.join(known)}"
        yield _order_problem(one.above, one.below, "")
        return
    measured = [extra.name for extra in config.target.extra if extra.role == "measured"]
    if one.target not in ("main", *measured):
        known = ["main", *measured]
        fixed = one.target in {extra.name for extra in config.target.extra}
        what = "is fixed: its value is the rig's error" if fixed else "is no target"
        yield f"target: {one.target!r} {what}; measured are: {', '.join(known)}"
    if isinstance(one, ValueAlarm):
        yield _order_problem(one.above_mm, one.below_mm, "_mm")


def _order_problem(above: float | None, below: float | None, unit: str) -> str:
    if above is None and below is None:
        return f"above{unit}: missing; give above{unit}, below{unit} or both"
    if above is not None and below is not None and below >= above:
        return f"below{unit}: must be less than above{unit} = {above:g}, is {below:g}"
    return ""


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
    tables: dict[str, Any] = {}
    # One table each: another may be no TOML at all. [[...]] have what no message needs.
    for part in re.split(r"(?m)^(?=\s*\[)", text):
        if part.lstrip().startswith("[["):
            continue
        try:
            tables |= tomllib.loads(part)
        except tomllib.TOMLDecodeError:
            continue
    try:
        return Remains.model_validate(tables)
    except ValidationError:
        return None
