"""Links to the record's zero, for programs and for people."""

from __future__ import annotations

import math

from core.results import Displacement
from daemon.store.records import DatumRecord


def sigmas_mm(offset: Displacement) -> tuple[float, float]:
    """1 sigma in x and in y."""
    covariance = offset.covariance_mm2
    return math.sqrt(covariance[0, 0]), math.sqrt(covariance[1, 1])


def offset_text(offset: Displacement) -> str:
    """An offset as people read it."""
    (x_mm, y_mm), (sigma_x_mm, sigma_y_mm) = offset.mm, sigmas_mm(offset)
    return f"x {x_mm:+.3f} ± {sigma_x_mm:.2g}, y {y_mm:+.3f} ± {sigma_y_mm:.2g} mm"


def datum_fields(link: DatumRecord) -> dict[str, object]:
    """A link for `--json`."""
    return {
        "calibration": link.calibration_id,
        "link": link.id,
        "method": link.method,
        **offset_fields(link.offset),
        "reference_utc": link.reference_utc,
        "created_utc": link.created_utc,
        "detail": link.detail,
        "targets": {name: offset_fields(offset) for name, offset in link.targets.items()},
    }


def offset_fields(offset: Displacement) -> dict[str, float]:
    """An offset under the names of a row's columns."""
    sigma_x_mm, sigma_y_mm = sigmas_mm(offset)
    return {
        "x_mm": float(offset.mm[0]),
        "y_mm": float(offset.mm[1]),
        "sigma_x_mm": sigma_x_mm,
        "sigma_y_mm": sigma_y_mm,
        "cov_xy_mm2": float(offset.covariance_mm2[0, 1]),
    }
