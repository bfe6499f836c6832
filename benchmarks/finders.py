"""What it costs to look for targets in images that show none, beside decoding these images.

By itself: `python -m benchmarks.finders`. An image that compresses well is decoded in almost no
time; so the time is held against decoding the image itself or noise of its size, whichever takes
longer.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from benchmarks.hard_images import HARD_IMAGES, Image, noise
from core.checkerboard.board import Board
from core.checkerboard.corners import detect_board
from core.discs.disc_finder import find_discs
from core.discs.disc_mismatch import explain_discs
from core.discs.target import find_target
from core.errors import TargetNotFoundError
from core.images import GreyImage
from core.site import CirclesTarget
from drivers.png import encode_png

SIZES = {"2.3 MP": (1200, 1920), "12 MP": (3000, 4096)}
REPEATS = 3
CENTRES_MM = np.array([[-15.0, 11.0], [15.0, 11.0], [0.0, 0.0], [-15.0, -11.0], [15.0, -11.0]])
TARGET = CirclesTarget(CENTRES_MM, np.full(5, 8.0), 11000.0, 20.0)
PX_PER_MM = 6.0
BOARD = Board.of_squares(32, 31, 3.0)

FINDERS: dict[str, Callable[[GreyImage], object]] = {
    "find_target": lambda image: find_target(image, CENTRES_MM, 8.0),
    "find_discs": lambda image: find_discs(image, TARGET, PX_PER_MM),
    "explain_discs": lambda image: explain_discs(image, TARGET),
    "detect_board": lambda image: detect_board(image, BOARD),
}


@dataclass(frozen=True, slots=True)
class FinderCost:
    """CPU seconds of one core for one image, the least of some runs."""

    finder: str
    image: str
    size: str
    find_s: float
    decode_s: float


def measure_finders() -> list[FinderCost]:
    """Each finder on each image."""
    costs = []
    for find in FINDERS.values():
        _look(find, GreyImage(noise((300, 400))))  # loads the compiled loops
    for size, shape in SIZES.items():
        noise_s = _decoding_s(noise(shape))
        for name, draw in HARD_IMAGES.items():
            pixels = draw(shape)
            decode_s = max(noise_s, _decoding_s(pixels))
            image = GreyImage(pixels)
            for finder, find in FINDERS.items():
                find_s = _least_s(partial(_look, find, image))
                costs.append(FinderCost(finder, name, size, find_s, decode_s))
    return costs


def worst(costs: list[FinderCost]) -> list[FinderCost]:
    """Of each finder and size the image that costs most for its decoding."""
    chosen: dict[tuple[str, str], FinderCost] = {}
    for cost in sorted(costs, key=lambda cost: cost.find_s / cost.decode_s):
        chosen[cost.finder, cost.size] = cost
    return sorted(
        chosen.values(), key=lambda cost: (list(FINDERS).index(cost.finder), cost.decode_s)
    )


def _look(find: Callable[[GreyImage], object], image: GreyImage) -> None:
    try:
        find(image)
    except TargetNotFoundError:
        return


def _decoding_s(pixels: Image) -> float:
    data = np.frombuffer(encode_png(pixels), np.uint8)
    return _least_s(lambda: cv2.imdecode(data, cv2.IMREAD_UNCHANGED))


def _least_s(run: Callable[[], object]) -> float:
    seconds = []
    for _ in range(REPEATS):
        started_s = time.process_time()
        run()
        seconds.append(time.process_time() - started_s)
    return min(seconds)


def main() -> None:
    """Measure and print all."""
    cv2.setNumThreads(1)
    for cost in measure_finders():
        print(
            f"{cost.find_s / cost.decode_s:5.1f} {cost.finder:14} {cost.size:7} {cost.image:10}"
            f" {1e3 * cost.find_s:7.1f} ms, decoding {1e3 * cost.decode_s:6.1f} ms"
        )


if __name__ == "__main__":
    main()
