"""Displacements as people read them."""

from __future__ import annotations

from core.results import Displacement, Flag, Measurement


def value_text(measurement: Measurement) -> str:
    """Write a displacement, or why there is none, in a few words."""
    why = "+".join(measurement.reasons)
    if measurement.corrected is None:
        return f"no value ({measurement.flag.name.lower()}: {why})"
    text = displacement_text(measurement.corrected)
    return text if measurement.flag is Flag.GOOD else f"{text} (suspect: {why})"


def displacement_text(displacement: Displacement) -> str:
    """Write a displacement with its sigma."""
    (x_mm, y_mm), covariance = displacement.mm, displacement.covariance_mm2
    return (
        f"x {x_mm:+.3f} ± {covariance[0, 0] ** 0.5:.3f} mm, "
        f"y {y_mm:+.3f} ± {covariance[1, 1] ** 0.5:.3f} mm"
    )
