"""From calibration views to a calibrated site, and how far to trust it."""
