"""Displacements to the columns of a table and back."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from core.arrays import FloatArray
from core.results import Displacement


def displacement_columns(displacement: Displacement | None, prefix: str = "") -> dict[str, float]:
    """A displacement's columns, their names behind `prefix`; none without a displacement.

    Raises ValueError for a value or covariance that is not finite.
    """
    if displacement is None:
        return {}
    columns = {
        f"{prefix}x_mm": float(displacement.mm[0]),
        f"{prefix}y_mm": float(displacement.mm[1]),
        **_covariance_columns(displacement.covariance_mm2, prefix),
    }
    return finite(columns)


def corrected_columns(displacement: Displacement | None) -> dict[str, float]:
    """The columns of a corrected displacement, that of its image's share of sigma among them.

    Raises ValueError for a value or covariance that is not finite.
    """
    columns = displacement_columns(displacement)
    if displacement is None or displacement.image_mm2 is None:
        return columns
    return columns | finite(_covariance_columns(displacement.image_mm2, "", "image_"))


def displacement_of(values: Mapping[str, Any], prefix: str = "") -> Displacement | None:
    """The displacement of columns; None where it is withheld."""
    x, y = (values.get(f"{prefix}{axis}_mm") for axis in "xy")
    covariance = _covariance(values, prefix)
    if x is None or y is None or covariance is None:
        return None
    image = _covariance(values, prefix, "image_")
    return Displacement(np.array([x, y]), covariance, image_mm2=image)


def finite(columns: dict[str, float]) -> dict[str, float]:
    """Pass numbers on. SQLite would make NULL of a NaN, and a value would look withheld.

    Raises ValueError.
    """
    for name, value in columns.items():
        if not math.isfinite(value):
            msg = f"{name} is {value}"
            raise ValueError(msg)
    return columns


def _covariance_columns(
    covariance_mm2: FloatArray, prefix: str, part: str = ""
) -> dict[str, float]:
    return {
        f"{prefix}sigma_{part}x_mm": math.sqrt(covariance_mm2[0, 0]),
        f"{prefix}sigma_{part}y_mm": math.sqrt(covariance_mm2[1, 1]),
        f"{prefix}cov_{part}xy_mm2": float(covariance_mm2[0, 1]),
    }


def _covariance(values: Mapping[str, Any], prefix: str, part: str = "") -> FloatArray | None:
    names = (f"sigma_{part}x_mm", f"sigma_{part}y_mm", f"cov_{part}xy_mm2")
    sigma_x, sigma_y, cov_xy = (values.get(prefix + name) for name in names)
    if sigma_x is None or sigma_y is None:
        return None
    return np.array([[sigma_x**2, cov_xy], [cov_xy, sigma_y**2]])
