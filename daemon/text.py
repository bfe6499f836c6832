"""Times, spans, sizes, values and coverage as people read them."""

from __future__ import annotations

from datetime import UTC, datetime

from core.results import Flag, Measurement


def utc_text(when: datetime) -> str:
    """Write a time as `2026-03-01T00:00:00Z`; fractions of a second only if there are any."""
    return when.astimezone(UTC).isoformat().replace("+00:00", "Z")


def span_text(seconds: float) -> str:
    """Write a duration with its two leading units: `42 s`, `3 min 5 s`, `2 d 4 h`."""
    left = round(abs(seconds))
    parts = []
    for unit, size in (("d", 86400), ("h", 3600), ("min", 60), ("s", 1)):
        count, left = divmod(left, size)
        if count:
            parts.append(f"{count} {unit}")
        elif parts:
            break
    return " ".join(parts[:2]) or "0 s"


def value_text(measurement: Measurement) -> str:
    """Write a displacement, or why there is none, in a few words."""
    why = "+".join(measurement.reasons)
    if measurement.corrected is None:
        return f"no value ({measurement.flag.name.lower()}: {why})"
    (x_mm, y_mm), covariance = measurement.corrected.mm, measurement.corrected.covariance_mm2
    text = (
        f"x {x_mm:+.3f} ± {covariance[0, 0] ** 0.5:.3f} mm, "
        f"y {y_mm:+.3f} ± {covariance[1, 1] ** 0.5:.3f} mm"
    )
    return text if measurement.flag is Flag.GOOD else f"{text} (suspect: {why})"


def bytes_text(count: float) -> str:
    """Write a number of bytes in decimal units, as disks are sold."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} TB"
