"""A target in the main image as the reference of a calibration shows it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from core.arrays import FloatArray
from core.site import TargetRole


@dataclass(frozen=True, slots=True)
class CalibratedTarget:
    """The main target, or a further one."""

    name: str
    role: TargetRole | None
    """None: the main target."""
    reference_px: FloatArray
    """(discs, 2) in the reference image, NaN for a disc not seen there."""
    reference_px2: FloatArray
    """(discs,) variance of a coordinate of each; 0 for the main target, whose posterior has it."""
    B: FloatArray
    """(2, 2) B~ of Eq. 8, px/mm."""
    distance_mm: float
    """As surveyed."""
    distance_sigma_mm: float

    @property
    def is_fixed(self) -> bool:
        """Whether it shows the rig's own error."""
        return self.role is TargetRole.FIXED

    @property
    def middle_px(self) -> FloatArray:
        """(2,) of the discs that the reference shows."""
        return np.asarray(np.nanmean(self.reference_px, axis=0))

    def to_dict(self) -> dict[str, Any]:
        """Give plain JSON types; NaN becomes null."""
        return {
            "name": self.name,
            "role": self.role,
            "reference_px": points_to_json(self.reference_px),
            "reference_px2": self.reference_px2.tolist(),
            "B": self.B.tolist(),
            "distance_mm": self.distance_mm,
            "distance_sigma_mm": self.distance_sigma_mm,
        }

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> CalibratedTarget:
        """Read what `to_dict` gave. Raises KeyError or ValueError on anything else."""
        return cls(
            str(data["name"]),
            TargetRole(data["role"]),
            points_from_json(data["reference_px"]),
            np.array(data["reference_px2"], dtype=float),
            np.array(data["B"]),
            float(data["distance_mm"]),
            float(data["distance_sigma_mm"]),
        )


def points_to_json(points_px: FloatArray) -> list[list[float] | None]:
    """Points (n, 2) as lists; NaN becomes null."""
    return [None if np.isnan(point).any() else point.tolist() for point in points_px]


def points_from_json(points: list[list[float] | None]) -> FloatArray:
    """Points (n, 2) as `points_to_json` gave them."""
    return np.array([[np.nan, np.nan] if p is None else p for p in points], dtype=float)
