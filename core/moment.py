"""When a pair was taken, and how warm it was: what drift is a function of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True, slots=True)
class Moment:
    """When a pair was taken, how warm the main camera was, and what the site's sensors said."""

    utc_s: float
    """Seconds since 1970."""
    temperature_c: float | None = None
    readings: Mapping[str, float] = field(default_factory=dict)
    """Of sensors, by name; those without a value are left out."""

    def to_dict(self) -> dict[str, Any]:
        """Give plain JSON types."""
        readings = {"readings": dict(self.readings)} if self.readings else {}
        return {"utc_s": self.utc_s, "temperature_c": self.temperature_c, **readings}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Moment:
        """Read what `to_dict` gave. Raises KeyError, TypeError or ValueError on anything else."""
        celsius = data["temperature_c"]
        readings = {name: float(value) for name, value in data.get("readings", {}).items()}
        return cls(float(data["utc_s"]), None if celsius is None else float(celsius), readings)
