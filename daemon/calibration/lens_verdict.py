"""What lens a set of views gives, and whether the views are enough for it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from core.arrays import FloatArray
from core.checkerboard.board import Board
from core.checkerboard.board_mismatch import turns_if_mirrored
from core.errors import ImageError
from core.geometry.lens import Lens
from core.images import GreyImage, require_size
from core.lens.intrinsics import LensCalibration, calibrate_lens
from core.lens.lens_coverage import lens_coverage
from core.site import CameraGeometry, Site
from drivers.errors import FrameSetError
from drivers.frameset import FrameSet, FrameSetRow, format_slot

MAX_FOCAL_SIGMA = 0.002
"""Relative; the rig views sharpen it further, but cannot do so alone."""


@dataclass(frozen=True, slots=True)
class LensVerdict:
    """A lens in sentences and figures."""

    enough: bool
    lines: tuple[str, ...]
    fields: dict[str, Any]


def judge_lens(
    frames: FrameSet, site: Site, on_step: Callable[[str], None], begin: Callable[[str], None]
) -> LensVerdict:
    """Calibrate the sub-camera's lens on the lens views of a frame set.

    on_step hears of each view that was read, begin of the fit. Raises CalibrationError when too
    few of them fit together.
    """
    images: list[GreyImage] = []
    rows: list[FrameSetRow] = []
    left_out: list[str] = []
    for row in frames.rows_of("intrinsics"):
        try:
            image = frames.read(str(row.sub))
            require_size(image, site.sub, str(frames.directory / str(row.sub)))
        except (FrameSetError, ImageError) as error:
            left_out.append(str(error))
        else:
            images.append(image)
            rows.append(row)
        on_step(f"read {format_slot(row.slot_utc)}")
    begin("fitting the lens")
    calibration = calibrate_lens(
        images, Board.nominal(site.sub_target), site.sub, model=site.lens_model
    )
    left_out += [f"{rows[k].sub}: {reason}" for k, reason in calibration.rejected]
    return _verdict(calibration, site, left_out)


def _verdict(calibration: LensCalibration, site: Site, left_out: list[str]) -> LensVerdict:
    adjusted, lens = calibration.adjustment, calibration.lens
    sigmas = adjusted.posterior.lens_sigma
    focal_px, focal_sigma = float(lens.parameters[0]), float(sigmas[0] / lens.parameters[0])
    covered = lens_coverage(
        [_in_image(lens, pose.apply(adjusted.corners_mm), site.sub) for pose in adjusted.poses],
        adjusted.poses,
        site.sub,
    )
    rms_px = float(np.median(adjusted.view_rms_px))
    problems = list(covered.suggestions)
    if focal_sigma > MAX_FOCAL_SIGMA:
        problems.append(f"the focal length is known to {focal_sigma:.2%} only; tilt the board more")
    warnings = list(_warnings(calibration, Board.nominal(site.sub_target)))
    verdict = "lens views are enough" if not problems else "lens views are NOT enough"
    alpha, _, _, mu, nu = lens.parameters[:5]
    views = f"{covered.views} views used, {len(left_out)} left out"
    focal = f"{focal_px:.2f} px ({alpha * site.sub.pixel_pitch_um / 1e3:.4f} mm)"
    lines = (
        verdict + "".join(f"; {problem}" for problem in problems),
        f"{views}, {covered.covered:.0%} of the image covered",
        *(f"left out {reason}" for reason in left_out),
        f"focal length {focal}, 1 sigma {focal_sigma:.3%}; principal point ({mu:.1f}, {nu:.1f}) px",
        f"{calibration.choice.sentence}; corners fit to {rms_px:.4f} px rms",
        *(f"warning: {warning}" for warning in warnings),
    )
    fields = {
        "enough": not problems,
        "problems": problems,
        "warnings": warnings,
        "views": covered.views,
        "left_out": left_out,
        "covered": covered.covered,
        "lens_model": lens.model.value,
        "lens_held_out_px": {m.value: px for m, px in calibration.choice.held_out_px.items()},
        "lens": dict(zip(lens.model.parameters, lens.parameters.tolist(), strict=True)),
        "lens_sigma": sigmas.tolist(),
        "sub_rms_px": rms_px,
    }
    return LensVerdict(not problems, lines, fields)


def _warnings(calibration: LensCalibration, board: Board) -> Iterator[str]:
    mirrored = turns_if_mirrored(board)
    if mirrored and set(calibration.quarter_turns) == {mirrored}:
        yield (
            f"all views show the board turned by {90 * mirrored} degrees; if it was held upright, "
            "the images are mirrored or turned: switch ReverseX and ReverseY of the sub-camera "
            "off, and take them again"
        )


def _in_image(lens: Lens, points_mm: FloatArray, camera: CameraGeometry) -> FloatArray:
    points_px = lens.project(points_mm)
    inside = (points_px >= 0.0).all(axis=1)
    inside &= (points_px < [camera.width_px, camera.height_px]).all(axis=1)
    return points_px[inside]
