"""Real, public images, of which the truth is not known but something that must hold is.

`apt-get install visp-images-data opencv-doc`, then `python -m benchmarks.real_images`. A plate of
five white discs is moved by hand before a cluttered background, 501 images (ViSP, `mire-2`): its
discs are to be found, and to keep their names. Two cameras that are fixed to one another look at a
board of 9x6 corners, 13 pairs (OpenCV, `left01.jpg`): their pose to one another is always the same.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from core.arrays import FloatArray
from core.checkerboard.board import Board
from core.checkerboard.board_pose import board_pose
from core.discs.target import find_target
from core.errors import TargetNotFoundError
from core.geometry.pose import Pose
from core.images import GreyImage
from core.lens.intrinsics import calibrate_lens
from core.site import CheckerboardTarget

PLATE = Path("/usr/share/visp-images-data/ViSP-images/mire-2")
PAIRS = Path("/usr/share/doc/opencv-doc/examples/data")
PACKAGES = {PLATE: "visp-images-data", PAIRS: "opencv-doc"}

CENTRES_MM = np.array([[-66.0, 55.0], [66.0, 55.0], [0.0, 0.0], [-66.0, -55.0], [66.0, -55.0]])
DIAMETERS_MM = np.array([15.8, 15.8, 60.0, 15.8, 15.8])
"""Up to scale, as the images themselves show them: no drawing of the plate is published."""
BOARD = CheckerboardTarget(squares_x=10, squares_y=7, square_mm=30.0, distance_mm=0.0)
INNER = BOARD.squares_x - 1, BOARD.squares_y - 1


@dataclass(frozen=True, slots=True)
class Steadiness:
    """How far the pose of one camera to the other differs from its mean, rms over the pairs."""

    pairs: int
    turn_mrad: float
    at_board_mm: float
    """Of the board's middle, as the other camera sees it."""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.real_images", description=__doc__)
    parser.parse_args()
    missing = [package for path, package in PACKAGES.items() if not path.is_dir()]
    if missing:
        sys.exit(f"real images are not here: apt-get install {' '.join(missing)}")
    images, found, renamed = plate()
    print(f"plate of five discs: found in {found} of {images} images, {renamed} with other names")
    for name, steady in (("dcam", by_dcam()), ("OpenCV", by_opencv())):
        print(
            f"two rigid cameras, {steady.pairs} pairs, {name}: {steady.turn_mrad:.2f} mrad, "
            f"{steady.at_board_mm:.3f} mm at the board"
        )


def plate() -> tuple[int, int, int]:
    """Images, those in which the plate is found, and those where its discs changed places."""
    paths = sorted(PLATE.glob("*.pgm"))
    found = renamed = 0
    for path in paths:
        try:
            seen = find_target(_grey(path), CENTRES_MM, DIAMETERS_MM)
        except TargetNotFoundError:
            continue
        found += 1
        renamed += abs(seen.roll_deg) > 20.0  # throughout, the plate is upright to 12 degrees
    return len(paths), found, renamed


def by_dcam() -> Steadiness:
    """Both lenses from all their views, then the board's pose in each."""
    board = Board.nominal(BOARD)

    def poses(side: str) -> list[Pose]:
        images = [GreyImage(_grey(path)) for path in _views(side)]
        found = calibrate_lens(images, board)
        corners_mm = found.adjustment.corners_mm
        return [board_pose(image, found.lens, board, corners_mm).fit.pose for image in images]

    return _steadiness(poses("left"), poses("right"), board.corners_mm.mean(axis=0))


def by_opencv() -> Steadiness:
    """The same with OpenCV's finder, refinement, lens and poses, as its tutorials have it."""
    grid = np.mgrid[: INNER[0], : INNER[1]].T.reshape(-1, 2) * BOARD.square_mm
    board = np.column_stack([grid, np.zeros(len(grid))]).astype(np.float32)
    until = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)

    def poses(side: str) -> list[Pose]:
        images = [_grey(path) for path in _views(side)]
        rough = [cv2.findChessboardCorners(image, INNER)[1] for image in images]
        corners = [
            cv2.cornerSubPix(image, points, (5, 5), (-1, -1), until)
            for image, points in zip(images, rough, strict=True)
        ]
        boards, size = [board] * len(images), images[0].shape[::-1]
        _, _, _, turns, shifts = cv2.calibrateCamera(boards, corners, size, None, None)
        return [
            Pose.from_vectors(np.ravel(turn).astype(float), np.ravel(shift).astype(float))
            for turn, shift in zip(turns, shifts, strict=True)
        ]

    return _steadiness(poses("left"), poses("right"), board.mean(axis=0).astype(float))


def _steadiness(left: list[Pose], right: list[Pose], middle_mm: FloatArray) -> Steadiness:
    between = [b.compose(a.inverse()) for a, b in zip(left, right, strict=True)]
    vectors = np.array([pose.vector for pose in between])
    mean = Pose.from_vectors(vectors[:, :3].mean(axis=0), vectors[:, 3:].mean(axis=0))
    turns = np.array([mean.inverse().compose(pose).rotation_rad for pose in between])
    seen = [pose.apply(middle_mm[None]) for pose in left]
    strayed = [
        (pose.apply(point) - mean.apply(point))[0]
        for pose, point in zip(between, seen, strict=True)
    ]
    away = np.array(strayed) - np.mean(strayed, axis=0)
    return Steadiness(len(between), 1e3 * _rms(turns), _rms(away))


def _rms(vectors: FloatArray) -> float:
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))


def _views(side: str) -> list[Path]:
    return sorted(PAIRS.glob(f"{side}[0-9][0-9].jpg"))


def _grey(path: Path) -> NDArray[np.uint8]:
    return np.asarray(Image.open(path).convert("L"))


if __name__ == "__main__":
    main()
