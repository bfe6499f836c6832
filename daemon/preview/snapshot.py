"""One look at a pair: pictures for a browser, and the figures that aiming and focusing need."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import datetime

import cv2
import numpy as np

from core.arrays import FloatArray
from core.images import GreyImage
from core.site import Site
from daemon.calibration.view_check import ViewCheck, see_pair
from drivers.protocols import CapturedFrame, CapturedPair, Role

SHOWN_WIDTH_PX = 960
DETAIL_PX = 480
"""Side of the part that is shown pixel for pixel, where focus can be judged by eye."""
BINS = 64
_GREEN = (80, 200, 60)


@dataclass(frozen=True, slots=True)
class CameraLook:
    """What one camera sees; for the page as JSON, but for the pictures."""

    width_px: int
    height_px: int
    found: str
    """How much of the target is found, or why it is not."""
    problems: tuple[str, ...]
    """What is to be mended before a calibration."""
    focus: float
    """Figure of merit, greatest in focus; only to be compared with itself, see `focus_figure`."""
    blur_px: float | None
    """Width of the target's edges, 1 sigma; None while it is not found."""
    off_centre_px: tuple[float, float] | None
    """From the middle of the image to that of the target, right and down."""
    brightest: float
    """Share of saturation of the brightest pixels (their 99.9th percentile)."""
    saturated: float
    """Share of the pixels that are saturated."""
    histogram: tuple[int, ...]
    exposure_us: float | None
    gain_db: float | None
    temperature_c: float | None


@dataclass(frozen=True, slots=True)
class Snapshot:
    """One pair."""

    time_utc: datetime
    cameras: dict[Role, CameraLook]
    pictures: dict[str, bytes]
    """JPEG by name: `main`, `sub`, and `main_detail`, `sub_detail` pixel for pixel."""

    def fields(self) -> dict[str, object]:
        """Everything but the pictures, for JSON."""
        return {
            "time_utc": self.time_utc.isoformat(),
            "cameras": {role: asdict(camera) for role, camera in self.cameras.items()},
        }


def take_snapshot(pair: CapturedPair, site: Site, time_utc: datetime) -> Snapshot:
    """Look for the targets in a pair and make everything that is shown of it."""
    check = see_pair(pair, site)
    seen: dict[Role, tuple[CapturedFrame, FloatArray | None]] = {
        "main": (pair.main, None if check.discs is None else _found_points(check)),
        "sub": (pair.sub, None if check.board is None else check.board.view.points_px),
    }
    pictures: dict[str, bytes] = {}
    for role, (frame, points_px) in seen.items():
        pictures[role], pictures[f"{role}_detail"] = _pictures(frame, points_px)
    cameras: dict[Role, CameraLook] = {
        role: _camera(role, frame, points_px, check) for role, (frame, points_px) in seen.items()
    }
    return Snapshot(time_utc, cameras, pictures)


def focus_figure(image: GreyImage) -> float:
    """How sharp an image is, with or without a target in it: greatest in focus.

    Variance of the Laplacian (J. L. Pech-Pacheco et al., ICPR 2000) of the image smoothed by a
    pixel, over the image's own variance; noise only adds a constant. It depends on what is in view:
    compare it while nothing but the focus ring moves.
    """
    smooth = cv2.GaussianBlur(image.pixels.astype(np.float32), (0, 0), 1.0)
    return float(cv2.Laplacian(smooth, cv2.CV_32F).var()) / max(float(smooth.var()), 1.0)


def _found_points(check: ViewCheck) -> FloatArray:
    if check.discs is None:
        return np.empty((0, 2))
    return check.discs.points_px[check.discs.found]


def _camera(
    role: Role, frame: CapturedFrame, points_px: FloatArray | None, check: ViewCheck
) -> CameraLook:
    image = GreyImage(frame.pixels, frame.bits)
    height_px, width_px = frame.pixels.shape
    counts, _ = np.histogram(frame.pixels, BINS, (0, image.saturation_dn + 1))
    off = None
    if points_px is not None and len(points_px):
        middle = (points_px.min(axis=0) + points_px.max(axis=0)) / 2.0
        off = (float(middle[0] - width_px / 2.0), float(middle[1] - height_px / 2.0))
    target = check.discs if role == "main" else check.board
    return CameraLook(
        width_px=width_px,
        height_px=height_px,
        found=_found_text(role, check),
        problems=tuple(line for line in check.problems if _is_of(role, line)),
        focus=focus_figure(image),
        blur_px=None if target is None else float(target.blur_px),
        off_centre_px=off,
        brightest=float(np.percentile(frame.pixels, 99.9)) / image.saturation_dn,
        saturated=float((frame.pixels >= image.saturation_dn).mean()),
        histogram=tuple(counts.tolist()),
        exposure_us=frame.exposure_us,
        gain_db=frame.gain_db,
        temperature_c=frame.temperature_c,
    )


def _found_text(role: Role, check: ViewCheck) -> str:
    if role == "main":
        if check.discs is None:
            return "target not found"
        return f"{int(check.discs.found.sum())} of {len(check.discs.found)} discs found"
    if check.board is None:
        return "board not found"
    return f"{len(check.board.view.index)} of {check.board.visible} corners in view found"


def _is_of(role: Role, problem: str) -> bool:
    return f"{role} target" in problem or f"{role} camera" in problem or f"{role}-camera" in problem


def _pictures(frame: CapturedFrame, points_px: FloatArray | None) -> tuple[bytes, bytes]:
    """The whole image, made smaller, with what was found marked, and a part of it as it is."""
    grey = (frame.pixels >> max(frame.bits - 8, 0)).astype(np.uint8)
    height_px, width_px = grey.shape
    scale = min(SHOWN_WIDTH_PX / width_px, 1.0)
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    shown = cv2.cvtColor(small, cv2.COLOR_GRAY2BGR)
    centre = np.array([width_px / 2.0, height_px / 2.0])
    if points_px is not None and len(points_px):
        for x, y in np.rint((points_px + 0.5) * scale).astype(int).tolist():
            cv2.circle(shown, (x, y), 3, _GREEN, 1, cv2.LINE_AA)
        centre = points_px[np.argmin(np.hypot(*(points_px - centre).T))]
    return _jpeg(shown), _jpeg(_cut_out(grey, centre))


def _cut_out(grey: np.ndarray, centre: Sequence[float] | FloatArray) -> np.ndarray:
    half = DETAIL_PX // 2
    x = int(np.clip(centre[0], min(half, grey.shape[1] // 2), max(grey.shape[1] - half, half)))
    y = int(np.clip(centre[1], min(half, grey.shape[0] // 2), max(grey.shape[0] - half, half)))
    return grey[max(y - half, 0) : y + half, max(x - half, 0) : x + half]


def _jpeg(picture: np.ndarray) -> bytes:
    _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 85])
    return data.tobytes()
