"""Several targets found in one image, told apart by layout, size and place."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from core.arrays import BoolArray, FloatArray
from core.discs.blobs import NO_BLOBS, Blobs, find_blobs, join_blobs
from core.discs.disc_finder import Discs, expectation, layout_of, locate_assigned
from core.discs.layout import DiscAssignment, Expectation, identify_discs
from core.discs.search import MOST_SPOTS, is_plausible, looks
from core.errors import TargetNotFoundError
from core.geometry.homography import project, slopes
from core.images import GreyImage
from core.site import CirclesTarget

_SCALE_SIGMA = 0.15
"""Of the natural logarithm of a target's scale over that expected. Chosen: focal length and
distance are known to some per cent, and sizes that differ by a half are told apart."""
_PLACE_SHARE = 0.02
"""1 sigma of a target's place, once the shift that all have in common is off, as a share of the
image's longer side. Chosen: a roll of one degree moves a target at the border by 1 %."""
_POSITION_SHARE = 0.1
"""Likewise of a place that a person gave roughly."""
_HIDDEN_DISC = 10.0
"""Cost of a disc that is not seen. As in the layout: one without a spot costs 15, one with a spot 5
on average."""
_MISSING = 40.0
"""Cost of a target that is not seen. Chosen: more than that of two hidden discs of five, or of a
place or scale that is 6 sigma off."""
_CERTAIN = 10.0
"""By how much another way to name the targets has to cost more: exp(10 / 2) = 150 times less
likely. As in the layout."""
_MOST_PLACES = 4
"""Places more than there are targets at which one target's layout is sought. Chosen as a bound on
the work: lamps and drops seldom stand like a plate's discs."""


_NEVER = 1e6
"""Stands for an infinite cost."""


@dataclass(frozen=True, slots=True)
class WantedPlate:
    """A target to be found, and what is known of it before."""

    name: str
    """For messages."""
    target: CirclesTarget
    px_per_mm: float
    """Its scale, right to some per cent."""
    near_px: FloatArray | None = None
    """(n, 2) its discs' places in an earlier image, NaN where unknown; a rough one: its middle, n
    times."""
    rough: bool = False
    """Whether near_px is a person's word."""


@dataclass(frozen=True, slots=True)
class _Place:
    """Spots that are laid out as a target's discs."""

    assignment: DiscAssignment
    spots: frozenset[int]
    middle_px: FloatArray
    """(2,) of all the target's discs."""
    cost: float
    """By its scale and the discs that are not seen."""


def find_plates(image: GreyImage, wanted: Sequence[WantedPlate]) -> list[Discs | None]:
    """Find several targets; None stands for one that is not seen.

    Alike ones are told apart by size, and by their places beside one another: those of an earlier
    image, all shifted by the same amount, or those that a person gave. Raises TargetNotFoundError
    where that does not decide.
    """

    def choose(blobs: Blobs) -> list[_Place | None]:
        places = [_places(blobs, plate, len(wanted)) for plate in wanted]
        return _assign(places, wanted, max(image.pixels.shape))

    return _look_and_locate(image, wanted, choose)


def find_plates_near(
    image: GreyImage, wanted: Sequence[WantedPlate], within_px: Sequence[float]
) -> list[Discs | None]:
    """Find several targets whose discs are near known places (`near_px`), in this order.

    within_px says how far the middle of each may be from there. None stands for one not seen.
    """

    def choose(blobs: Blobs) -> list[_Place | None]:
        free = np.ones(len(blobs.points_px), dtype=bool)
        chosen = []
        for plate, within in zip(wanted, within_px, strict=True):
            place = _place_near(blobs, free, plate, within)
            chosen.append(place)
            if place is not None:
                free &= ~_at(blobs, place)
        return chosen

    return _look_and_locate(image, wanted, choose)


def _look_and_locate(
    image: GreyImage,
    wanted: Sequence[WantedPlate],
    choose: Callable[[Blobs], list[_Place | None]],
) -> list[Discs | None]:
    """Look ever more thoroughly until all is found; locate what was found best."""
    whole = sum(len(plate.target.centres_mm) for plate in wanted)
    best: tuple[Blobs, list[_Place | None]] = NO_BLOBS, [None] * len(wanted)
    seen = NO_BLOBS
    for shrinks in _looks(image, wanted):
        seen = join_blobs([seen, find_blobs(image.pixels, shrinks)[0]])
        blobs = seen.select(_of_any(seen, wanted)).clearest(MOST_SPOTS)
        chosen = choose(blobs)
        if _spots_named(chosen) > _spots_named(best[1]):
            best = blobs, chosen
        if _spots_named(chosen) == whole:
            break
    blobs, chosen = best
    return [
        None if place is None else _located(image, plate, blobs, place.assignment)
        for plate, place in zip(wanted, chosen, strict=True)
    ]


def _looks(image: GreyImage, wanted: Sequence[WantedPlate]) -> Iterator[list[int]]:
    """By how much to shrink the image: first the most for each target, then all else in turns."""
    turns = [list(looks(image, _radii_px(plate))) for plate in wanted]
    most = [[[max(steps[0])] if steps else [], *steps] for steps in turns]
    done: set[int] = set()
    for steps in itertools.zip_longest(*most):
        fresh = {shrink for shrinks in steps if shrinks for shrink in shrinks} - done
        done |= fresh
        if fresh:
            yield sorted(fresh, reverse=True)


def _radii_px(plate: WantedPlate) -> FloatArray:
    return plate.target.diameters_mm / 2.0 * plate.px_per_mm


def _of_any(blobs: Blobs, wanted: Sequence[WantedPlate]) -> BoolArray:
    """Which spots (n,) may be a disc of some target."""
    return np.asarray(np.any([is_plausible(blobs, _radii_px(one)) for one in wanted], axis=0))


def _spots_named(chosen: Sequence[_Place | None]) -> int:
    return sum(len(place.spots) for place in chosen if place is not None)


def _located(
    image: GreyImage, plate: WantedPlate, blobs: Blobs, assignment: DiscAssignment
) -> Discs | None:
    try:
        return locate_assigned(image, plate.target, blobs, assignment)
    except TargetNotFoundError:
        return None


def _place_near(
    blobs: Blobs, free: BoolArray, plate: WantedPlate, within_px: float
) -> _Place | None:
    """The naming of free spots nearest to where a target is expected, if near enough."""
    near_px = plate.near_px
    if near_px is None:
        msg = f"{plate.name}: where it is expected must be known"
        raise ValueError(msg)
    middle = np.nanmean(near_px, axis=0)
    reach = within_px + 1.5 * float(np.nanmax(np.hypot(*(near_px - middle).T)))
    close = free & (np.hypot(*(blobs.points_px - middle).T) < reach)
    place = _name(blobs, close, plate, expectation(plate.px_per_mm, near_px))
    if place is None or not place.assignment.unambiguous:
        return None
    away = np.nanmean(
        project(place.assignment.H, layout_of(plate.target).places_mm) - near_px, axis=0
    )
    return place if float(np.hypot(*away)) <= within_px else None


def _name(
    blobs: Blobs, free: BoolArray, plate: WantedPlate, expected: Expectation
) -> _Place | None:
    """Name free spots as a target's discs."""
    index = np.flatnonzero(free)
    some = blobs.select(index)
    fits = is_plausible(some, _radii_px(plate))
    index, some = index[fits], some.select(fits)
    if len(index) < expected.min_discs:
        return None
    layout = layout_of(plate.target)
    found = identify_discs(some, layout, expected)
    if found is None:
        return None
    at = index[found.spots]
    points = project(found.H, layout.places_mm)
    slope = slopes(found.H, layout.places_mm.mean(axis=0, keepdims=True))[0]
    scale = np.sqrt(abs(float(np.linalg.det(slope))))
    cost = (np.log(scale / plate.px_per_mm) / _SCALE_SIGMA) ** 2
    cost += _HIDDEN_DISC * (len(layout.radii_mm) - len(index[found.spots]))
    return _Place(
        replace(found, spots=at), frozenset(at.tolist()), points.mean(axis=0), float(cost)
    )


def _at(blobs: Blobs, place: _Place) -> BoolArray:
    """Which spots (n,) are a place's: also those of its discs at another size of the image."""
    own = sorted(place.spots)
    away = np.hypot(*np.moveaxis(blobs.points_px[:, None] - blobs.points_px[own], -1, 0))
    return np.asarray((away < blobs.radius_px[own]).any(axis=1))


def _places(blobs: Blobs, plate: WantedPlate, plates: int) -> list[_Place]:
    """Everywhere that spots are laid out as a target's discs, each spot used once."""
    expected = expectation(plate.px_per_mm)
    free = np.ones(len(blobs.points_px), dtype=bool)
    rough = []
    for _ in range(plates + _MOST_PLACES):
        place = _name(blobs, free, plate, expected)
        if place is None:
            break
        rough.append(place)
        free &= ~_at(blobs, place)
    # Named once more without the spots of the other places, which may have been rivals.
    sure = []
    for place in rough:
        others = [_at(blobs, other) for other in rough if other is not place]
        alone = ~np.any(others, axis=0) if others else np.ones(len(free), dtype=bool)
        again = _name(blobs, alone, plate, expected) if len(rough) > 1 else place
        if again is not None and again.assignment.unambiguous:
            sure.append(again)
    return sure


def _assign(
    places: Sequence[Sequence[_Place]], wanted: Sequence[WantedPlate], size_px: int
) -> list[_Place | None]:
    """Which place is which target, at the least cost over all shifts that they may have in common.

    Raises TargetNotFoundError where another way is as good.
    """
    spots = _different([place.spots for some in places for place in some])
    ways = []
    for shift in _shifts(places, wanted):
        costs = _costs(places, wanted, spots, size_px, shift)
        best, chosen = _cheapest(costs)
        ways.append((best, chosen))
        for k, place in enumerate(chosen):
            if place is not None:
                ways.append(_cheapest(_forbidden(costs, k, place)))
    ways.sort(key=lambda way: way[0])
    best, chosen = ways[0]
    for cost, other in ways[1:]:
        alike = [
            plate.name for plate, one, two in zip(wanted, chosen, other, strict=True) if one != two
        ]
        if alike and cost < best + _CERTAIN:
            msg = (
                f"main image: {' and '.join(alike)} look alike, and it is not certain which is "
                "which; write position_px into [[target.extra]], about where it is in the image"
            )
            raise TargetNotFoundError(msg)
    by_spots = [{spots.index(_group(place, spots)): place for place in some} for some in places]
    return [
        None if group is None else some[group] for some, group in zip(by_spots, chosen, strict=True)
    ]


def _different(spots: Sequence[frozenset[int]]) -> list[frozenset[int]]:
    """Sets of spots of which no two share one: those that do are joined."""
    groups: list[frozenset[int]] = []
    for one in spots:
        joined = one.union(*(group for group in groups if group & one))
        groups = [group for group in groups if not group & one] + [joined]
    return groups


def _group(place: _Place, spots: Sequence[frozenset[int]]) -> frozenset[int]:
    return next(group for group in spots if place.spots <= group)


def _shifts(
    places: Sequence[Sequence[_Place]], wanted: Sequence[WantedPlate]
) -> Iterator[FloatArray]:
    """Shifts (2,) that bring a target from where it was to a place where its layout is seen."""
    known = False
    for some, plate in zip(places, wanted, strict=True):
        if plate.near_px is not None and not plate.rough:
            for place in some:
                known = True
                yield place.middle_px - np.nanmean(plate.near_px, axis=0)
    if not known:
        yield np.zeros(2)


def _costs(
    places: Sequence[Sequence[_Place]],
    wanted: Sequence[WantedPlate],
    spots: Sequence[frozenset[int]],
    size_px: int,
    shift: FloatArray,
) -> FloatArray:
    """(targets, groups of spots) cost of each target's being there; infinite where it is not."""
    costs = np.full((len(wanted), len(spots)), np.inf)
    for k, (some, plate) in enumerate(zip(places, wanted, strict=True)):
        for place in some:
            cost = place.cost
            if plate.near_px is not None:
                moved = place.middle_px - np.nanmean(plate.near_px, axis=0)
                away = moved if plate.rough else moved - shift
                share = _POSITION_SHARE if plate.rough else _PLACE_SHARE
                cost += float((away @ away) / (share * size_px) ** 2)
            costs[k, spots.index(_group(place, spots))] = cost
    return costs


def _forbidden(costs: FloatArray, target: int, group: int) -> FloatArray:
    others = costs.copy()
    others[target, group] = np.inf
    return others


def _cheapest(costs: FloatArray) -> tuple[float, list[int | None]]:
    """The least cost, and the group of spots of each target; a target may be missing."""
    n, groups = costs.shape
    with_missing = np.concatenate([costs, np.full((n, n), _MISSING)], axis=1)
    with_missing = np.minimum(with_missing, _NEVER)
    rows, columns = linear_sum_assignment(with_missing)
    chosen: list[int | None] = [int(c) if c < groups else None for c in columns]
    return float(with_missing[rows, columns].sum()), chosen
