"""One frame pair to one measurement: the straight line of the whole system."""

from __future__ import annotations

from core.calibration import Calibration
from core.frames import GreyImage
from core.results import Measurement
from core.site import Site


def measure_pair(
    main: GreyImage | None,
    sub: GreyImage | None,
    site: Site,
    calibration: Calibration,
    skew_s: float | None = None,
) -> Measurement:
    """Measure one pair. Never raises for what an image shows; None means no usable image."""
    raise NotImplementedError
