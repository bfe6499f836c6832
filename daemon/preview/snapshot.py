"""One look at a pair: pictures for a browser, and the figures that aiming and focusing need."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from datetime import datetime

import cv2
import numpy as np

from core.arrays import FloatArray
from core.discs.disc_finder import Discs
from core.images import GreyImage
from core.site import CirclesTarget, Site, TargetRole
from daemon.calibration.view_check import ViewCheck, see_pair
from drivers.protocols import CapturedFrame, CapturedPair, Role

SHOWN_WIDTH_PX = 960
DETAIL_PX = 480
"""Side of the part whose pixels are shown as they are, where focus can be judged by eye."""
BINS = 64
CENTRED_SHARE = 0.1
"""Of the image's width or height: a target nearer to the middle is well aimed at."""
_GREEN = (80, 200, 60)


@dataclass(frozen=True, slots=True)
class FurtherLook:
    """A further target."""

    name: str
    role: TargetRole
    is_found: bool
    """All of it."""
    text: str
    """How much of it is found, and where its middle is in the image."""


@dataclass(frozen=True, slots=True)
class CameraLook:
    """What one camera sees; for the page as JSON, but for the pictures."""

    width_px: int
    height_px: int
    found: str
    """How much of the target is found, or why it is not."""
    problems: tuple[str, ...]
    """What is to be mended before a calibration."""
    further: tuple[FurtherLook, ...]
    """Of the main camera: the further targets, in the order of the config."""
    focus: float
    """Figure of merit, greatest in focus; only to be compared with itself, see `focus_figure`."""
    blur_px: float | None
    """Width of the target's edges, 1 sigma; None while it is not found."""
    off_centre_px: tuple[float, float] | None
    """From the middle of the image to that of the target, right and down."""
    room_px: dict[str, float] | None
    """From the outermost points found to the image's edges: left, right, top, bottom."""
    hints: tuple[str, ...]
    """How to turn this camera so that the target comes to the middle."""
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
    """By file name: `main.jpg`, `sub.jpg` small; `main_detail.png`, `sub_detail.png` pixel for
    pixel around the middle of the target, or of the image while it is not found."""

    def fields(self) -> dict[str, object]:
        """Everything but the pictures, for JSON."""
        return {
            "time_utc": self.time_utc.isoformat(),
            "cameras": {role: asdict(camera) for role, camera in self.cameras.items()},
        }


def take_snapshot(pair: CapturedPair, site: Site, time_utc: datetime) -> Snapshot:
    """Look for the targets in a pair and make everything that is shown of it."""
    check = see_pair(pair, site)
    seen: dict[Role, _Seen] = {
        "main": _seen_targets(pair.main, check, site),
        "sub": _seen_board(pair.sub, None if check.board is None else check.board.view.points_px),
    }
    pictures: dict[str, bytes] = {}
    for role, of_camera in seen.items():
        pictures[f"{role}.jpg"] = _overview(of_camera)
        pictures[f"{role}_detail.png"] = _detail(of_camera)
    cameras: dict[Role, CameraLook] = {
        role: _camera(role, of_camera, check, site) for role, of_camera in seen.items()
    }
    return Snapshot(time_utc, cameras, pictures)


@dataclass(frozen=True, slots=True)
class _Seen:
    """A frame and where its target is."""

    frame: CapturedFrame
    points_px: FloatArray
    """(n, 2) what was found of it."""
    middle_px: FloatArray | None
    """(2,) of the target; None while it is not found."""


def _seen_targets(frame: CapturedFrame, check: ViewCheck, site: Site) -> _Seen:
    """What is found of all targets, and the middle of the main one."""
    found = [discs.points_px[discs.found] for discs in (check.discs, *check.further) if discs]
    points_px = np.concatenate([np.empty((0, 2)), *found])
    middle_px = None if check.discs is None else _middle_px(check.discs, site.main_target)
    return _Seen(frame, points_px, middle_px)


def _middle_px(discs: Discs, target: CirclesTarget) -> FloatArray:
    """(2,) of all discs of a target, also where some are hidden: by an affine map."""
    points_px, centres_mm = discs.points_px[discs.found], target.centres_mm
    middle_mm = (centres_mm.min(axis=0) + centres_mm.max(axis=0)) / 2.0
    places = np.column_stack([centres_mm[discs.found] - middle_mm, np.ones(len(points_px))])
    middle: FloatArray = np.linalg.lstsq(places, points_px, rcond=None)[0][2]
    return middle


def _further_looks(check: ViewCheck, site: Site) -> tuple[FurtherLook, ...]:
    looks = []
    for extra, discs in zip(site.extra_targets, check.further, strict=True):
        text, is_found = "not found", False
        if discs is not None:
            x_px, y_px = _middle_px(discs, extra.target)
            count, is_found = int(discs.found.sum()), bool(discs.found.all())
            text = f"{count} of {len(discs.found)} discs found, position_px {x_px:.0f}, {y_px:.0f}"
        looks.append(FurtherLook(extra.name, extra.role, is_found, text))
    return tuple(looks)


def _seen_board(frame: CapturedFrame, points_px: FloatArray | None) -> _Seen:
    if points_px is None or not len(points_px):
        return _Seen(frame, np.empty((0, 2)), None)
    return _Seen(frame, points_px, (points_px.min(axis=0) + points_px.max(axis=0)) / 2.0)


def _image_middle(frame: CapturedFrame) -> FloatArray:
    """(2,) px; the origin is the centre of the top-left pixel."""
    return (np.array(frame.pixels.shape[::-1], dtype=np.float64) - 1.0) / 2.0


def focus_figure(image: GreyImage) -> float:
    """How sharp an image is, with or without a target in it: greatest in focus.

    Variance of the Laplacian (J. L. Pech-Pacheco et al., ICPR 2000) of the image smoothed by a
    pixel, over the image's own variance; noise only adds a constant. It depends on what is in view:
    compare it while nothing but the focus ring moves.
    """
    smooth = cv2.GaussianBlur(image.pixels.astype(np.float32), (0, 0), 1.0)
    return float(cv2.Laplacian(smooth, cv2.CV_32F).var()) / max(float(smooth.var()), 1.0)


def _camera(role: Role, seen: _Seen, check: ViewCheck, site: Site) -> CameraLook:
    frame = seen.frame
    image = GreyImage(frame.pixels, frame.bits)
    height_px, width_px = frame.pixels.shape
    counts, _ = np.histogram(frame.pixels, BINS, (0, image.saturation_dn + 1))
    off = None
    if seen.middle_px is not None:
        x_px, y_px = (seen.middle_px - _image_middle(frame)).tolist()
        off = (x_px, y_px)
    target = check.discs if role == "main" else check.board
    return CameraLook(
        width_px=width_px,
        height_px=height_px,
        found=_found_text(role, check),
        problems=tuple(line for line in check.problems if _is_of(role, line)),
        further=_further_looks(check, site) if role == "main" else (),
        focus=focus_figure(image),
        blur_px=None if target is None else float(target.blur_px),
        off_centre_px=off,
        room_px=_room_px(seen),
        hints=() if off is None else turning_hints(off, (width_px, height_px)),
        brightest=float(np.percentile(frame.pixels, 99.9)) / image.saturation_dn,
        saturated=float((frame.pixels >= image.saturation_dn).mean()),
        histogram=tuple(counts.tolist()),
        exposure_us=frame.exposure_us,
        gain_db=frame.gain_db,
        temperature_c=frame.temperature_c,
    )


def _room_px(seen: _Seen) -> dict[str, float] | None:
    if not len(seen.points_px):
        return None
    height_px, width_px = seen.frame.pixels.shape
    (left, top), (right, bottom) = seen.points_px.min(axis=0), seen.points_px.max(axis=0)
    room = {
        "left": left,
        "right": width_px - 1 - right,
        "top": top,
        "bottom": height_px - 1 - bottom,
    }
    return {side: float(px) for side, px in room.items()}


def turning_hints(off_centre_px: tuple[float, float], size_px: tuple[int, int]) -> tuple[str, ...]:
    """How to turn a camera whose target is too far from the middle of its image."""
    words = (("left", "right"), ("up", "down"))
    hints = []
    for off_px, length_px, (back, forth) in zip(off_centre_px, size_px, words, strict=True):
        if abs(off_px) > CENTRED_SHARE * length_px:
            word = forth if off_px > 0 else back
            hints.append(f"turn this camera {word}: the target is {abs(off_px):.0f} px {word}")
    return tuple(hints)


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


def _grey(frame: CapturedFrame) -> np.ndarray:
    """The frame as 8 bits a pixel."""
    return (frame.pixels >> max(frame.bits - 8, 0)).astype(np.uint8)


def _overview(seen: _Seen) -> bytes:
    """The whole image as JPEG, made smaller, with what was found marked."""
    grey = _grey(seen.frame)
    scale = min(SHOWN_WIDTH_PX / grey.shape[1], 1.0)
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    shown = cv2.cvtColor(small, cv2.COLOR_GRAY2BGR)
    for x, y in np.rint((seen.points_px + 0.5) * scale).astype(int).tolist():
        cv2.circle(shown, (x, y), 3, _GREEN, 1, cv2.LINE_AA)
    _, data = cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, 85])
    return data.tobytes()


def _detail(seen: _Seen) -> bytes:
    """The frame's own pixels around the target's middle as PNG, which loses nothing."""
    grey = _grey(seen.frame)
    middle_px = _image_middle(seen.frame) if seen.middle_px is None else seen.middle_px
    x, y = (
        slice(first := _first_px(float(middle), size), first + DETAIL_PX)
        for middle, size in zip(middle_px, grey.shape[::-1], strict=True)
    )
    _, data = cv2.imencode(".png", grey[y, x])
    return data.tobytes()


def _first_px(middle_px: float, size_px: int) -> int:
    """Where the cut-out begins: it stays in the image, and is all of a smaller one."""
    first = round(middle_px - (DETAIL_PX - 1) / 2.0)
    return max(min(first, size_px - DETAIL_PX), 0)
