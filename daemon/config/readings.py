"""`[[reading]]`: sensors that are read at each slot, and whether what is said of them can be."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import Field, Strict

from daemon.config.section import Directory, Section
from drivers.sensors.modbus_url import ModbusAddress, parse_modbus

if TYPE_CHECKING:
    from daemon.config.model import Config

MOST_READINGS = 64
PERIOD_SHARE = 0.5
"""Of the period, for sensors to answer in, before the slot."""
TEMPERATURE_UNITS = ("degC", "K")
"""Of a reading that tells the site's temperature: only its changes count."""
_SOURCES = ("file", "command", "modbus")

Words = Annotated[tuple[Annotated[str, Field(min_length=1)], ...], Strict(strict=False)]


class ReadingSection(Section):
    """`[[reading]]`: a sensor; of the three sources exactly one."""

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9-]{0,31}$")
    unit: str = Field(min_length=1, max_length=16)
    file: Directory | None = None
    command: Annotated[Words, Field(min_length=1)] | None = None
    modbus: str | None = Field(default=None, min_length=1)
    scale: float = 1.0
    offset: float = 0.0
    min: float | None = None
    max: float | None = None
    timeout_s: float = Field(default=5.0, ge=0.1, le=60.0)

    @property
    def source(self) -> Path | tuple[str, ...] | ModbusAddress:
        """Where the number comes from. Raises ValueError for a Modbus address that is none."""
        if self.modbus is not None:
            return parse_modbus(self.modbus)
        return self.command if self.command is not None else self.file or Path()


def reading_problems(config: Config) -> list[str]:
    """Name what contradicts itself in the readings."""
    problems = []
    names = [reading.name for reading in config.reading]
    for number, reading in enumerate(config.reading):
        found = [
            f"name: {reading.name!r} is that of another reading too; give each its own"
            if reading.name in names[:number]
            else "",
            _source_problem(config, reading),
            _value_problem(config, reading),
        ]
        problems += [f"reading[{number}].{problem}" for problem in found if problem]
    named = config.stability.temperature_reading
    units = {reading.name: reading.unit for reading in config.reading}
    if named is not None and named not in units:
        known = ", ".join(units) or "none"
        problems.append(
            f"stability.temperature_reading: there is no reading {named!r}; known: {known}"
        )
    elif named is not None and units[named] not in TEMPERATURE_UNITS:
        problems.append(
            f"stability.temperature_reading: {named!r} is in {units[named]!r}; a temperature is in "
            f"{' or '.join(TEMPERATURE_UNITS)}"
        )
    return problems


def _source_problem(config: Config, reading: ReadingSection) -> str:
    given = [name for name in _SOURCES if getattr(reading, name) is not None]
    if len(given) != 1:
        what = f"gives {' and '.join(given)}" if given else "gives no source"
        return f"name: {reading.name!r} {what}; give one of file, command, modbus"
    if reading.modbus is None:
        return ""
    try:
        address = parse_modbus(reading.modbus)
    except ValueError as error:
        return f'modbus: "{reading.modbus}" {error}'
    if config.pan_tilt.is_serial and address.device and address.device == config.pan_tilt.port:
        return f"modbus: {address.device} is the pan-tilt head's port"
    return ""


def _value_problem(config: Config, reading: ReadingSection) -> str:
    if reading.scale == 0:
        return "scale: must not be 0: every value would be the offset"
    if reading.min is not None and reading.max is not None and reading.min >= reading.max:
        return f"min: must be less than max = {reading.max:g}, is {reading.min:g}"
    if not reading.unit.isprintable() or reading.unit != reading.unit.strip():
        return f"unit: must be a word such as degC, is {reading.unit!r}"
    room_s = PERIOD_SHARE * config.schedule.period_s
    if reading.timeout_s > room_s:
        return (
            f"timeout_s: must be at most half of schedule.period_s = {config.schedule.period_s}, "
            f"is {reading.timeout_s:g}"
        )
    return ""
