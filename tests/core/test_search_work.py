"""What a search costs on images that show no target, but much that looks a little like one.

Counted, not timed: pixels looked through, peaks outlined, steps along borders. The time of each is
bounded too, and measured by `python -m benchmarks.finders`.
"""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.hard_images import HARD_IMAGES
from core.checkerboard.saddle_points import find_saddle_points
from core.discs.blobs import Blobs, find_blobs, pyramid
from core.discs.layout import Expectation, Layout
from core.discs.search import MOST_SPOTS, search_plate
from core.images import GreyImage
from tests.core.scenes import CENTRES_MM

LAYOUT = Layout(CENTRES_MM * [1.0, -1.0], np.full(len(CENTRES_MM), 4.0))
SHAPE = (600, 800)
SIZES = 6
"""That many sizes of such an image are looked through."""


@pytest.mark.parametrize("px_per_mm", [None, 1.5, 6.0], ids=["no scale", "small", "large"])
@pytest.mark.parametrize("name", HARD_IMAGES)
def test_a_search_for_discs_costs_so_much_for_each_pixel_whatever_is_seen(name, px_per_mm) -> None:
    """Every size once, a peak for 1200 pixels, a border step for four; or so many at each size."""
    image = GreyImage(HARD_IMAGES[name](SHAPE))
    seen = search_plate(image, LAYOUT, Expectation(px_per_mm, min_discs=4))
    pixels = image.pixels.size
    assert seen.work.pixels <= 1.34 * pixels
    assert seen.work.peaks <= pixels / 1200 + 600 * SIZES
    assert seen.work.border_steps <= 0.25 * pixels + 42_000 * SIZES
    assert seen.most_spots <= MOST_SPOTS


@pytest.mark.parametrize("name", ["noise", "foliage", "snow"])
def test_four_times_the_pixels_cost_at_most_four_times_the_steps(name) -> None:
    """Nothing grows with the square of what is seen."""
    small, large = (
        find_blobs(HARD_IMAGES[name](shape), pyramid(shape, 0.0, np.inf))[1].border_steps
        for shape in ((500, 500), (1000, 1000))
    )
    assert large <= 4.4 * small


@pytest.mark.parametrize("name", ["fine grid", "black"])
def test_where_nothing_is_round_no_border_is_followed_far(name) -> None:
    """A grid of lines and an even image cost little but looking through them."""
    image = HARD_IMAGES[name](SHAPE)
    _, work = find_blobs(image, pyramid(SHAPE, 0.0, np.inf))
    assert work.border_steps < image.size


def test_a_search_for_a_board_looks_at_one_saddle_for_300_pixels_at_most() -> None:
    """Squares of 9 px all over the image have four times as many."""
    shape = (1000, 1500)
    squares = (np.indices(shape) // 9).sum(axis=0) % 2
    saddles = find_saddle_points(200.0 * squares)
    assert len(saddles.points_px) <= shape[0] * shape[1] // 300


def test_the_clearest_spots_are_chosen_among_those_of_each_size() -> None:
    """A thousand clear snowflakes do not displace five discs of twice their size and more."""
    radius = np.concatenate([np.full(1000, 3.0), np.full(5, 9.0)])
    outline = radius[:, None, None] * np.eye(2)
    evenness = np.where(radius < 5.0, 20.0, 4.0)
    blobs = Blobs(np.zeros((1005, 2)), outline, np.full(1005, 90.0), evenness)
    chosen = blobs.clearest(20)
    assert len(chosen.radius_px) == 20
    assert (chosen.radius_px > 5.0).sum() == 5
