"""Whether each sensor answers: all are read once."""

from __future__ import annotations

from collections.abc import Iterator

from daemon.checks.finding import Finding
from daemon.config.reading import Config
from daemon.readings.sampler import open_sampler
from daemon.times import EPOCH


def check_readings(config: Config) -> Iterator[Finding]:
    """Read each sensor once, as dcamd does, and no longer than it would wait."""
    sampler = open_sampler(config, patient=True)
    try:
        sampler.ahead(EPOCH, 0.0)
        readings = sampler.collect(EPOCH)
    finally:
        sampler.close()
    for reading in readings:
        name = f"reading {reading.name}"
        if reading.value is not None:
            yield Finding(name, "ok", f"{reading.value:g} {reading.unit}")
        else:
            text = f"{reading.cause}: look at the sensor and at [[reading]] in {config.path}"
            yield Finding(name, "warning", text)
