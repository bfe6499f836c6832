"""What a calibration was made with: the cameras by their serial numbers, the sensors' readings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from daemon.store.records import Reading
from drivers.protocols import Role

KEY = "circumstances"
"""In a stored calibration's content, beside what measures; older calibrations do not have it."""


@dataclass(frozen=True, slots=True)
class Circumstances:
    """Of the reference."""

    serials: Mapping[Role, str] = field(default_factory=dict)
    """The cameras' serial numbers, as far as they are known."""
    readings: tuple[Reading, ...] = ()
    """What the sensors said; those without a value are left out."""

    def to_dict(self) -> dict[str, Any]:
        """Give plain JSON types."""
        readings = {one.name: {"value": one.value, "unit": one.unit} for one in self.readings}
        return {"serials": dict(self.serials), "readings": readings}

    @property
    def lines(self) -> tuple[str, ...]:
        """For the report."""
        said = [f"{one.name} {one.value:g} {one.unit}" for one in self.readings]
        return (f"readings at the reference: {', '.join(said)}",) if said else ()


def circumstances_of(content: Mapping[str, Any]) -> Circumstances:
    """Read a stored calibration's; empty of one that has none."""
    stored = content.get(KEY, {})
    readings = [
        Reading(name, str(one["unit"]), float(one["value"]))
        for name, one in stored.get("readings", {}).items()
    ]
    return Circumstances(stored.get("serials", {}), tuple(readings))
