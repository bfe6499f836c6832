"""Discs identified by their layout among all round bright spots of an image.

A disc's outline shows how the plate is squeezed there, up to a turn; two of them and the line
between them give the turn and the shift. Every pair of spots is tried as every pair of discs,
what these affine maps predict is compared with the other spots, and the best are refined as
homographies and judged by places, outlines and contrasts together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.arrays import BoolArray, FloatArray, IntArray
from core.discs.blobs import Blobs
from core.discs.layout_kernels import nearest_spots
from core.geometry.homography import fit_homography, perspective, project, slopes

MIN_DISCS = 3
"""The affine map of a plane has six unknowns, and each disc gives two coordinates."""
SCALE_TOLERANCE = 2.0
"""Factor, either way, between the scale seen and the scale expected. Chosen: focal length and
distance are known far better, and a target 2.5 times off must be refused (a test)."""
_LENGTH_TOLERANCE, _SLOPE_TOLERANCE = 0.25, 0.35
"""Of a pair of spots: natural logarithm of its length, by its outlines, over the length drawn; and
the largest difference between its two outlines, relative to their mean. Chosen: 0.25 is a factor
of 1.28, and diameters stated 22 % wrong must do (a test); 0.35 leaves room for perspective."""
_BLOB_SIGMA_PX = 0.35
"""Of a spot's place, and of its radius, px. Chosen: a little more than the sqrt(1 / 12) = 0.29 px
of rounding to whole pixels."""
_PLACE_SHARE, _SPACING_SHARE = 0.2, 0.4
"""How far a spot may be from where two others predict it: share of the target's size, and of the
smallest spacing. Below half of the spacing a spot belongs to one disc only; 0.2 is chosen: an
affine map from two discs does not know the perspective."""
_SLACK, _CONTRAST_RANGE = 1.6, 1.6
"""Of the quick choice of pairs: factor on distances and radii, and natural logarithm of the ratio
of contrasts, a factor of five. Chosen: the two tolerances above allow factors of 1.28 and about
1.2 on a distance, together less than 1.6."""
_MOST_PAIRS, _MOST_REFINED = 3000, 60
"""Bounds on the work: pairs tried, the best by length, and namings refined, the most complete.
Chosen: any of the plate's own pairs, ten of five discs, can lead to the right naming."""
_PLACE_SIGMA = 0.01
"""Of a disc's place, as a share of the target's size: how well the plate is drawn and the lens free
of distortion. Chosen; 3 px for a target of 300 px."""
_OUTLINE_SIGMA = 0.07
"""Of the natural logarithm of an outline's half axes over those expected. Chosen: 7 %,
to which _BLOB_SIGMA_PX over the radius is added."""
_CONTRAST_SIGMA = 0.6
"""Of the natural logarithm of a disc's contrast over the target's median. Chosen: a factor of 1.8,
as uneven light is usual and contrast shall decide only where places and outlines do not."""
_PERSPECTIVE_SIGMA = 0.2
"""Of the change of depth over the target, relative to its mean. Chosen: a target tilted by 60
degrees reaches that from a distance of four times its size, and a bridge's is far beyond."""
_SCALE_SIGMA = 0.15
"""Of the natural logarithm of the scale over the one expected. Chosen: a plate half as large costs
(log(2) / 0.15)^2 = 21 more, twice _ALIKE, so that it is no rival even where it is a perfect copy
and the wanted one's outlines are off by a sigma."""
_WORST = 25.0
"""Cost from which a spot is not this disc: five sigma in one of place and outline."""
_MISSING = 15.0
"""Cost of a disc without a spot. Chosen between the 5 that a spot with errors of one sigma costs on
average (place and outline 2 each, contrast 1) and _WORST."""
_ALIKE = 10.0
"""Difference in cost below which two namings are taken to be as good. Costs are sums of squares of
errors over sigma, so that at 10 the better naming is exp(10 / 2) = 150 times as likely."""
_SAME_SHARE = 0.1
"""Share of the target's size within which two places are the same when a layout is turned onto
itself. Chosen: ten times _PLACE_SIGMA."""
_TURN_MARGIN_DEG = 5.0
"""How far the turn of one pair may exceed the limit, which the refined naming has to keep; and by
how much more than the best the next naming has to be turned. Chosen: outlines that are 7 % off in
one axis turn a pair by up to 2 degrees."""


@dataclass(frozen=True, slots=True)
class Layout:
    """Discs on a plate, in the image's sense of rotation: x right, y down."""

    places_mm: FloatArray
    """(n, 2)."""
    radii_mm: FloatArray
    """(n,)."""

    @property
    def size_mm(self) -> float:
        """The larger side of the box about all centres."""
        return float(np.ptp(self.places_mm, axis=0).max())

    @property
    def farthest_mm(self) -> float:
        """Between the two centres that are farthest apart."""
        return float(np.hypot(*(self.places_mm[:, None] - self.places_mm[None]).T).max())

    @property
    def spacing_mm(self) -> float:
        """Between the centres of the two discs that are nearest to one another."""
        away = np.hypot(*(self.places_mm[:, None] - self.places_mm[None]).T)
        return float(away[~np.eye(len(away), dtype=bool)].min())


@dataclass(frozen=True, slots=True)
class Expectation:
    """What is known before looking."""

    px_per_mm: float | None = None
    """Scale, right to a factor of two."""
    near_px: FloatArray | None = None
    """(n, 2) about where the discs are, NaN where unknown."""
    upright_deg: float = 45.0
    """How far the camera may be rolled where a turned layout looks the same."""
    max_roll_deg: float = 180.0
    """How far it may be rolled at all."""
    min_discs: int = MIN_DISCS


@dataclass(frozen=True, slots=True)
class DiscAssignment:
    """Which spot is which disc."""

    discs: IntArray
    """(k,) indices of the layout's discs."""
    spots: IntArray
    """(k,) indices of the spots."""
    H: FloatArray
    """(3, 3) homography from the plate, mm, y down, to px."""
    cost: float
    roll_deg: float
    unambiguous: bool = True
    """False if another naming explains the image as well, so that this one is a guess."""


def identify_discs(blobs: Blobs, layout: Layout, expected: Expectation) -> DiscAssignment | None:
    """Give the naming that explains the image best; None if none does.

    >>> layout = Layout(np.array([[0.0, 0.0], [30.0, 0.0], [0.0, 20.0]]), np.full(3, 4.0))
    >>> seen_px = 50.0 + 6.0 * layout.places_mm[[2, 0, 1]]  # 6 px/mm, in another order
    >>> blobs = Blobs(seen_px, np.tile(24.0 * np.eye(2), (3, 1, 1)), np.full(3, 90.0), np.ones(3))
    >>> named = identify_discs(blobs, layout, Expectation(px_per_mm=6.0))
    >>> named.discs.tolist(), named.spots.tolist(), named.unambiguous
    ([0, 1, 2], [1, 2, 0], True)
    """
    rivals: list[DiscAssignment] = []
    for spots, slope in _guesses(blobs, layout, expected):
        if rivals and (spots >= 0).sum() < len(rivals[0].discs) - 1:
            break
        assignment = _refine(blobs, layout, spots, slope, expected)
        if assignment is not None:
            rivals.append(assignment)
    return _choose(rivals, layout, expected) if rivals else None


def _guesses(
    blobs: Blobs, layout: Layout, expected: Expectation
) -> list[tuple[IntArray, FloatArray]]:
    """Spots (n,) of all discs, -1 for none, with a slope (2, 2) px/mm; the most complete first."""
    anchor, place, slope = _pairs(blobs, layout, expected)
    shape = len(slope), len(layout.radii_mm)
    nearest, away = np.empty(shape, dtype=np.int64), np.empty(shape)
    size = 0.5 * np.log(np.abs(np.linalg.det(blobs.outline_px)))
    nearest_spots(
        blobs.points_px, size, anchor, place, slope, layout.places_mm, np.log(layout.radii_mm),
        2.0 * _SLOPE_TOLERANCE, nearest, away,
    )  # fmt: skip
    hit = away < min(_PLACE_SHARE * layout.size_mm, _SPACING_SHARE * layout.spacing_mm)
    quality = hit.sum(axis=1) - np.where(hit, away, 0.0).sum(axis=1) / (10.0 * layout.size_mm)
    order = np.argsort(-quality, kind="stable")
    assigned = np.where(hit, nearest, -1)[order]
    _, first = np.unique(assigned, axis=0, return_index=True)
    chosen = np.sort(first)[:_MOST_REFINED]
    few = (assigned >= 0).sum(axis=1) < expected.min_discs
    return [(assigned[k], slope[order[k]]) for k in chosen if not few[k]]


def _pairs(
    blobs: Blobs, layout: Layout, expected: Expectation
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points (h, 2), places (h, 2), slopes (h, 2, 2) of maps by two spots taken for two discs."""
    a, b = np.nonzero(_may_be_neighbours(blobs, layout))
    i, j = np.triu_indices(len(layout.radii_mm), 1)
    line = blobs.points_px[b] - blobs.points_px[a]
    blunt = 2.0 * _BLOB_SIGMA_PX / np.minimum(blobs.radius_px[a], blobs.radius_px[b])[:, None]
    radii = layout.radii_mm
    here = _elements(blobs.outline_px[a])[:, :, None] / radii[i]
    there = _elements(blobs.outline_px[b])[:, :, None] / radii[j]
    xx, xy, yy = squeeze = 0.5 * (here + there)
    det = xx * yy - xy * xy
    u, v = line[:, 0, None], line[:, 1, None]
    flat = (yy * u - xy * v + 1j * (xx * v - xy * u)) / det
    apart = layout.places_mm[j] - layout.places_mm[i]
    turn = flat / (apart[:, 0] + 1j * apart[:, 1])
    off, angle = np.abs(np.log(np.abs(turn))), np.angle(turn)
    difference = np.abs(there - here).max(axis=0) / np.abs(squeeze).max(axis=0)
    fits = (off < _LENGTH_TOLERANCE + blunt) & (difference < _SLOPE_TOLERANCE + blunt)
    fits &= np.abs(angle) < np.radians(expected.max_roll_deg + _TURN_MARGIN_DEG)
    if expected.px_per_mm is not None:
        scale = 0.5 * np.log(det / expected.px_per_mm**2)
        fits &= np.abs(scale) < np.log(SCALE_TOLERANCE)
    pair, discs = np.nonzero(fits)
    best = np.argsort(off[pair, discs], kind="stable")[:_MOST_PAIRS]
    pair, discs = pair[best], discs[best]
    c, s = np.cos(angle[pair, discs]), np.sin(angle[pair, discs])
    xx, xy, yy = squeeze[:, pair, discs]
    slope = np.stack([xx * c + xy * s, xy * c - xx * s, xy * c + yy * s, yy * c - xy * s], axis=1)
    middle = blobs.points_px[a[pair]] + 0.5 * line[pair]
    place = layout.places_mm[i[discs]] + 0.5 * apart[discs]
    return middle, place, slope.reshape(-1, 2, 2)


def _elements(outline: FloatArray) -> FloatArray:
    """The three different elements (3, m) of symmetric matrices (m, 2, 2)."""
    return np.asarray(np.stack([outline[:, 0, 0], outline[:, 0, 1], outline[:, 1, 1]]))


def _may_be_neighbours(blobs: Blobs, layout: Layout) -> BoolArray:
    """Whether two spots (m, m) are about as far apart, as large and as bright as two discs."""
    radius = blobs.radius_px
    line = blobs.points_px[:, None] - blobs.points_px[None]
    # How far the other is in units of the one's outline, which squeeze and scale leave as it is.
    flat = np.einsum("iab,ijb->ija", np.linalg.inv(blobs.outline_px), line)
    away = np.hypot(flat[..., 0], flat[..., 1])
    near = away < _SLACK * layout.farthest_mm / layout.radii_mm.min()
    near &= away > layout.spacing_mm / layout.radii_mm.max() / _SLACK
    spread = layout.radii_mm.max() / layout.radii_mm.min() * _SLACK
    alike = np.abs(np.log(radius[:, None] / radius)) < np.log(spread)
    bright = np.abs(np.log(blobs.contrast_dn[:, None] / blobs.contrast_dn)) < _CONTRAST_RANGE
    return np.asarray(near & alike & bright & ~np.eye(len(radius), dtype=bool))


def _refine(
    blobs: Blobs, layout: Layout, spots: IntArray, slope: FloatArray, expected: Expectation
) -> DiscAssignment | None:
    """Fit a homography to a guess, look again for all discs, and judge the outcome."""
    for _ in range(2):
        discs = np.flatnonzero(spots >= 0)
        if len(discs) < expected.min_discs:
            return None
        places, points = layout.places_mm[discs], blobs.points_px[spots[discs]]
        sigma = _place_sigma_px(layout, slope)
        H = fit_homography(places, points, sigma, slope)
        if perspective(H, layout.places_mm) > 1.0:
            return None
        spots, costs = _look_again(blobs, layout, H)
    discs = np.flatnonzero(spots >= 0)
    if len(discs) < expected.min_discs:
        return None
    chosen = spots[discs]
    contrast = np.log(blobs.contrast_dn[chosen])
    contrast = (contrast - np.median(contrast)) / _CONTRAST_SIGMA
    cost = float(costs[discs].sum() + contrast @ contrast)
    cost += (perspective(H, layout.places_mm) / _PERSPECTIVE_SIGMA) ** 2
    cost += _MISSING * (len(spots) - len(discs))
    at_middle = slopes(H, layout.places_mm.mean(axis=0, keepdims=True))[0]
    if expected.px_per_mm is not None:
        scale = 0.5 * np.log(max(float(np.linalg.det(at_middle)), 1e-12) / expected.px_per_mm**2)
        cost += float(scale / _SCALE_SIGMA) ** 2
    roll = np.arctan2(at_middle[1, 0] - at_middle[0, 1], at_middle[0, 0] + at_middle[1, 1])
    if abs(np.degrees(roll)) > expected.max_roll_deg:
        return None
    return DiscAssignment(discs, chosen, H, cost, float(np.degrees(roll)))


def _place_sigma_px(layout: Layout, slope: FloatArray) -> float:
    extent = layout.size_mm * np.sqrt(abs(float(np.linalg.det(slope))))
    return float(np.hypot(_PLACE_SIGMA * extent, _BLOB_SIGMA_PX))


def _look_again(blobs: Blobs, layout: Layout, H: FloatArray) -> tuple[IntArray, FloatArray]:
    """Spots (n,) at the places that a homography predicts, -1 for none, and their costs."""
    places = project(H, layout.places_mm)
    slope = slopes(H, layout.places_mm)
    sigma = _place_sigma_px(layout, slopes(H, layout.places_mm.mean(axis=0, keepdims=True))[0])
    miss = np.hypot(*np.moveaxis(places[:, None] - blobs.points_px[None], -1, 0))
    cost = (miss / sigma) ** 2
    expected = slope * layout.radii_mm[:, None, None]
    ratio = np.linalg.inv(blobs.outline_px)[None] @ expected[:, None]
    # The singular values s of the ratio are 1 if the outline is as expected.
    square = (ratio**2).sum(axis=(2, 3))
    det = np.maximum(np.linalg.det(ratio), 1e-9)
    root = np.sqrt(np.maximum(square**2 - 4.0 * det**2, 0.0))
    larger = np.sqrt(0.5 * (square + root))
    blunt = np.hypot(_OUTLINE_SIGMA, _BLOB_SIGMA_PX / blobs.radius_px)
    cost += (np.log(larger) ** 2 + np.log(det / larger) ** 2) / blunt**2
    spots = np.argmin(cost, axis=1)
    costs = cost[np.arange(len(spots)), spots]
    return np.where(costs < _WORST, spots, -1), costs


def _choose(rivals: list[DiscAssignment], layout: Layout, expected: Expectation) -> DiscAssignment:
    """The cheapest; where others are as good, by what is expected; else it is a guess."""
    best = min(rivals, key=lambda assignment: assignment.cost)
    alike = [best]
    for assignment in sorted(rivals, key=lambda assignment: assignment.cost):
        if assignment.cost < best.cost + _ALIKE and all(
            _contradict(assignment, one) for one in alike
        ):
            alike.append(assignment)
    if len(alike) == 1:
        return best
    if expected.near_px is not None:
        away = [_distance(assignment, layout, expected.near_px) for assignment in alike]
        order = np.argsort(away)
        chosen, next_away = alike[order[0]], away[order[1]]
        return _with_certainty(chosen, unambiguous=away[order[0]] < 0.6 * next_away)
    alike.sort(key=lambda assignment: abs(assignment.roll_deg))
    first, second = abs(alike[0].roll_deg), abs(alike[1].roll_deg)
    upright = first <= expected.upright_deg < second and second - first > _TURN_MARGIN_DEG
    turned = all(_looks_the_same(alike[0], other, layout) for other in alike[1:])
    return _with_certainty(alike[0], unambiguous=upright and turned)


def _looks_the_same(one: DiscAssignment, other: DiscAssignment, layout: Layout) -> bool:
    """Whether the whole layout, named the one way and the other, is at the same places."""
    moved = project(np.linalg.inv(other.H) @ one.H, layout.places_mm)
    away = np.hypot(*np.moveaxis(moved[:, None] - layout.places_mm[None], -1, 0))
    radii = layout.radii_mm[np.argmin(away, axis=1)] / layout.radii_mm
    same = away.min(axis=1) < _SAME_SHARE * layout.size_mm
    return bool(same.all() and (np.abs(np.log(radii)) < _OUTLINE_SIGMA).all())


def _with_certainty(assignment: DiscAssignment, *, unambiguous: bool) -> DiscAssignment:
    return DiscAssignment(
        assignment.discs,
        assignment.spots,
        assignment.H,
        assignment.cost,
        assignment.roll_deg,
        unambiguous,
    )


def _contradict(one: DiscAssignment, other: DiscAssignment) -> bool:
    """Whether a spot has different names, or none is shared."""
    names = dict(zip(one.spots.tolist(), one.discs.tolist(), strict=True))
    shared = [
        (names[spot], disc)
        for spot, disc in zip(other.spots.tolist(), other.discs.tolist(), strict=True)
        if spot in names
    ]
    return not shared or any(a != b for a, b in shared)


def _distance(assignment: DiscAssignment, layout: Layout, near_px: FloatArray) -> float:
    """How far, px, the discs are on average from where they were expected."""
    away = np.hypot(*(project(assignment.H, layout.places_mm) - near_px).T)
    return float(np.nanmean(away))
