"""What the columns of `measurement` hold: for the page on them, and for files that say so."""

from __future__ import annotations

from typing import NamedTuple

from daemon.store.queries.sensors import CAUSES
from daemon.store.rows.targets import target_of_column


class Meaning(NamedTuple):
    """One column for its readers."""

    unit: str
    """As in docs/conventions.md; empty for text, times, numbers of things, yes and no."""
    text: str


MEANINGS: dict[str, Meaning] = {
    "id": Meaning("", "number of the row, in the order of writing; late rows come late"),
    "slot_utc": Meaning("", "slot of the schedule, UTC: the name of the row"),
    "flag": Meaning("", "1 good, 3 suspect, 4 bad (value withheld), 9 missing"),
    "reasons": Meaning("", "why the flag is not 1, joined by +; of a slot in a gap its cause"),
    "x_mm": Meaning("mm", "corrected displacement, to the right as the main camera sees it"),
    "y_mm": Meaning("mm", "corrected displacement, upwards as the main camera sees it"),
    "sigma_x_mm": Meaning("mm", "1 sigma of x_mm"),
    "sigma_y_mm": Meaning("mm", "1 sigma of y_mm"),
    "cov_xy_mm2": Meaning("mm2", "covariance of x_mm and y_mm"),
    "raw_x_mm": Meaning("mm", "displacement to the right as the main camera alone sees it"),
    "raw_y_mm": Meaning("mm", "displacement upwards as the main camera alone sees it"),
    "raw_sigma_x_mm": Meaning("mm", "1 sigma of raw_x_mm"),
    "raw_sigma_y_mm": Meaning("mm", "1 sigma of raw_y_mm"),
    "raw_cov_xy_mm2": Meaning("mm2", "covariance of raw_x_mm and raw_y_mm"),
    "rx_rad": Meaning("rad", "rig rotation since the reference, x of the rotation vector"),
    "ry_rad": Meaning("rad", "rig rotation since the reference, y of the rotation vector"),
    "rz_rad": Meaning("rad", "rig rotation since the reference, z of the rotation vector"),
    "tx_mm": Meaning("mm", "rig translation since the reference, x"),
    "ty_mm": Meaning("mm", "rig translation since the reference, y"),
    "tz_mm": Meaning("mm", "rig translation since the reference, z"),
    "motion_covariance": Meaning(
        "",
        "covariance of rx_rad to tz_mm: JSON of the 21 numbers of the upper triangle, row by row",
    ),
    "discs_found": Meaning("", "discs of the main target that were found"),
    "corners_used": Meaning("", "corners of the sub target that the pose rests on"),
    "main_residual_px": Meaning("px", "rms distance of the discs from where the pose puts them"),
    "sub_residual_px": Meaning("px", "rms distance of the corners from where the pose puts them"),
    "main_contrast_dn": Meaning("dn", "light less dark of the main target, grey values"),
    "sub_contrast_dn": Meaning("dn", "light less dark of the sub target, grey values"),
    "main_blur_px": Meaning("px", "blur of the main image, 1 sigma"),
    "sub_blur_px": Meaning("px", "blur of the sub image, 1 sigma"),
    "spread_x_mm": Meaning("mm", "1 sigma of one pair of a burst about their mean, x"),
    "spread_y_mm": Meaning("mm", "1 sigma of one pair of a burst about their mean, y"),
    "frames_used": Meaning("", "pairs that the value rests on"),
    "skew_s": Meaning("s", "trigger of the sub-camera less trigger of the main camera"),
    "main_exposure_us": Meaning("us", "exposure of the main camera"),
    "main_gain_db": Meaning("dB", "gain of the main camera"),
    "main_temperature_c": Meaning("degC", "temperature of the main camera, as it says itself"),
    "sub_exposure_us": Meaning("us", "exposure of the sub-camera"),
    "sub_gain_db": Meaning("dB", "gain of the sub-camera"),
    "sub_temperature_c": Meaning("degC", "temperature of the sub-camera, as it says itself"),
    "main_frame": Meaning("", "main image, a path in the state directory"),
    "sub_frame": Meaning("", "sub image, a path in the state directory"),
    "captured_utc": Meaning("", "trigger of the pair, UTC, to the microsecond"),
    "boot_id": Meaning("", "the kernel's name for the run of the computer"),
    "uptime_s": Meaning("s", "time of the capture since that run began"),
    "clock_synchronised": Meaning("", "whether something (NTP, PTP) kept the computer's clock"),
    "redated_from_utc": Meaning("", "the slot that a wrong clock had given the row at first"),
    "recorded_late": Meaning(
        "",
        "whether the row was made from its frames later: after a restart, or as of its true time",
    ),
    "calibration_id": Meaning("", "number of the calibration that it was measured with"),
    "config_hash": Meaning("", "short hash of the config that it was measured with"),
    "version": Meaning(
        "", "version of dcam that measured; after + a digest of code, libraries and processor"
    ),
    "sigma_image_x_mm": Meaning(
        "mm", "part of sigma_x_mm that pixels and calibration give; empty in old rows: all of it"
    ),
    "sigma_image_y_mm": Meaning(
        "mm", "part of sigma_y_mm that pixels and calibration give; empty in old rows: all of it"
    ),
    "cov_image_xy_mm2": Meaning("mm2", "part of cov_xy_mm2 that pixels and calibration give"),
    "closure_x_mm": Meaning("mm", "what the fixed targets together say of the rig's error, x"),
    "closure_y_mm": Meaning("mm", "what the fixed targets together say of the rig's error, y"),
    "closure_sigma_x_mm": Meaning("mm", "1 sigma of closure_x_mm"),
    "closure_sigma_y_mm": Meaning("mm", "1 sigma of closure_y_mm"),
    "closure_cov_xy_mm2": Meaning("mm2", "covariance of closure_x_mm and closure_y_mm"),
    "targets": Meaning("", "JSON of the further targets; exported as columns of each"),
    "readings": Meaning(
        "",
        "sensors' readings: JSON, name to [value, unit], or to [null, unit, cause]; exported as "
        "columns of their own",
    ),
    "digest": Meaning("", "checksum of the row; not exported"),
}
"""By the column's name, in the order of the table."""

OF_EXPORTS = {
    CAUSES: Meaning("", "why readings have no value: name and cause, joined by ;"),
    "excluded": Meaning(
        "", "points whose value the quality ledger leaves out, joined by +, or all; only in exports"
    ),
    "detail": Meaning("", "of a slot in a gap, what is known beyond its cause; only in exports"),
}
"""Columns that the database does not have."""

ROLE = Meaning("", "fixed (does not move with the bridge) or measured (a further point of it)")
"""Of a further target; only in exports."""


def of(column: str) -> Meaning:
    """What a column of the database, or of an export, holds."""
    if column in OF_EXPORTS:
        return OF_EXPORTS[column]
    target = None if column in MEANINGS else target_of_column(column)
    if target is None:
        return MEANINGS[column]
    name, key = target
    meaning = ROLE if key == "role" else MEANINGS[key]
    return Meaning(meaning.unit, f"target {name}: {meaning.text}")
