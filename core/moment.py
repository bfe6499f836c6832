"""When a pair was taken, and how warm it was: what drift is a function of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Moment:
    """When a pair was taken, and how warm the main camera was."""

    utc_s: float
    """Seconds since 1970."""
    temperature_c: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """Give plain JSON types."""
        return {"utc_s": self.utc_s, "temperature_c": self.temperature_c}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Moment:
        """Read what `to_dict` gave. Raises KeyError, TypeError or ValueError on anything else."""
        celsius = data["temperature_c"]
        return cls(float(data["utc_s"]), None if celsius is None else float(celsius))
