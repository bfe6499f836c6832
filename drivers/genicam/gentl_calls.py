"""What `drivers.genicam.gentl` and its workers say to each other, over a socket, pickled."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from drivers.errors import DriverError
from drivers.protocols import CameraSettings


@dataclass(frozen=True, slots=True)
class Setup:
    """What a worker needs to know of its camera: the first thing sent to it."""

    serial: str
    settings: CameraSettings
    producer: Path


@dataclass(frozen=True, slots=True)
class Call:
    """One call of the session's."""

    name: str
    arguments: tuple[float | None, ...]
    deadline_s: float


@dataclass(frozen=True, slots=True)
class Reply:
    """What a call gave, and what it said to the log."""

    value: object = None
    error: DriverError | None = None
    log: list[dict[str, Any]] = field(default_factory=list)
