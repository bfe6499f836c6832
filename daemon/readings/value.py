"""From what a sensor says to what is stored: scale, offset, limits."""

from __future__ import annotations

from daemon.config.readings import ReadingSection
from daemon.store.records import Reading
from drivers.errors import DriverError
from drivers.protocols import Sensor

OUTSIDE = "outside limits"
"""Begins the cause of a value that `min` or `max` forbids."""
_DIGITS = 12
"""Of a scaled value: 21562 * 0.001 is 21.562."""


def read_now(section: ReadingSection, sensor: Sensor) -> Reading:
    """Read a sensor; whatever goes wrong is the cause of a reading without a value."""
    try:
        number = sensor.read(section.timeout_s)
    except DriverError as error:
        return without_value(section, str(error))
    except Exception as error:  # noqa: BLE001 - a fault of ours costs this value, nothing else
        return without_value(section, f"{type(error).__name__}: {error}")
    return reading_of(section, number)


def reading_of(section: ReadingSection, number: float) -> Reading:
    """Scale a sensor's number and hold it against the limits."""
    value = float(f"{section.scale * number + section.offset:.{_DIGITS}g}")
    low, high = section.min, section.max
    if (low is not None and value < low) or (high is not None and value > high):
        return without_value(section, f"{OUTSIDE} ({value:g} {section.unit})")
    return Reading(section.name, section.unit, value)


def without_value(section: ReadingSection, cause: str) -> Reading:
    """A reading that there is not, and why."""
    return Reading(section.name, section.unit, None, " ".join(cause.split()))
