"""The page's worker: finds targets in stored frames, and makes pictures of them for a browser.

A process of its own, as the numerics and OpenCV take more memory than the page may. It reads one
JSON object a line and answers each with one: `python -m daemon.web.finder CONFIG`.
"""

from __future__ import annotations

import base64
import sys
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from core.arrays import FloatArray
from core.images import GreyImage
from core.site import CirclesTarget, Site
from daemon.calibration.view_check import ViewCheck, see_pair
from daemon.config.reading import load_config
from daemon.plain import plain
from daemon.preview.snapshot import take_snapshot
from daemon.web.lines import answer_lines
from drivers.frameset import read_image
from drivers.protocols import CapturedFrame, CapturedPair


def answer(site: Site, asked: Mapping[str, Any]) -> dict[str, Any]:
    """Do what is asked. Raises DriverError, CoreError."""
    if asked["what"] == "picture":
        image = read_image(Path(asked["path"]))
        return {"picture": _text(_picture(image, asked["width_px"]))}
    pair = CapturedPair(_frame(Path(asked["main"])), _frame(Path(asked["sub"])), None)
    if asked["what"] == "look":
        look = take_snapshot(pair, site, datetime.fromisoformat(asked["time"]))
        pictures = {name: _text(data) for name, data in look.pictures.items()}
        return {"look": plain(look.fields()), "pictures": pictures}
    return {"targets": targets(see_pair(pair, site), site)}


def targets(seen: ViewCheck, site: Site) -> dict[str, Any]:
    """What was found in a pair, in pixels."""
    main: list[dict[str, Any]] = []
    named = [("main", site.main_target, seen.discs)]
    named += [
        (extra.name, extra.target, discs)
        for extra, discs in zip(site.extra_targets, seen.further, strict=False)
    ]
    for name, target, discs in named:
        if discs is not None:
            main += _discs(name, target, discs.points_px, discs.found)
    board = None if seen.board is None else seen.board.view.points_px
    return {
        "size": {
            "main": list(seen.pair.main.pixels.shape[::-1]),
            "sub": list(seen.pair.sub.pixels.shape[::-1]),
        },
        "main": main,
        "sub": [] if board is None else [{"u": u, "v": v} for u, v in board.round(2).tolist()],
        "error": "; ".join(seen.problems) or None,
    }


def _discs(
    name: str, target: CirclesTarget, points_px: FloatArray, found: np.ndarray
) -> list[dict[str, Any]]:
    """Discs as circles: their radii by the map from the drawing to the image."""
    if found.sum() < 3:
        return []
    places = np.column_stack([target.centres_mm[found], np.ones(int(found.sum()))])
    affine = np.linalg.lstsq(places, points_px[found], rcond=None)[0][:2]
    px_per_mm = float(np.sqrt(abs(np.linalg.det(affine))))
    radii_px = np.broadcast_to(target.diameters_mm, found.shape)[found] * px_per_mm / 2.0
    return [
        {"u": round(u, 2), "v": round(v, 2), "r": round(r, 2), "name": name}
        for (u, v), r in zip(points_px[found].tolist(), radii_px.tolist(), strict=True)
    ]


def _frame(path: Path) -> CapturedFrame:
    image = read_image(path)
    return CapturedFrame(image.pixels, image.bits, 0, 0, 0.0)


def _picture(image: GreyImage, width_px: int) -> bytes:
    """A frame with 8 bits a pixel: whole as PNG, made smaller as JPEG."""
    grey = (image.pixels >> max(image.bits - 8, 0)).astype(np.uint8)
    if not width_px or width_px >= grey.shape[1]:
        return cv2.imencode(".png", grey)[1].tobytes()
    scale = width_px / grey.shape[1]
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode()


def main() -> None:
    """Answer until nobody asks any more."""
    site = load_config(Path(sys.argv[1])).site()
    answer_lines(lambda asked: answer(site, asked))


if __name__ == "__main__":
    main()
