"""The main target: discs found in an image, named by their layout, located to sub-pixels."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

import numpy as np

from core.blobs import Blobs, find_blobs
from core.disc_fit import locate_discs
from core.errors import TargetNotFoundError
from core.frames import GreyImage
from core.pixel_fit import as_float
from core.site import BoolArray, CirclesTarget, ComplexArray, FloatArray, IntArray

MIN_DISCS = 3
_MAX_ROLL_DEG = 50.0
_SCALE_TOLERANCE = 2.0
_RADIUS_TOLERANCE = 0.25
_PLACE_TOLERANCE = 0.12  # of the target's size
_PLANE_TOLERANCE = 0.02
_MIN_CLEAN = 0.5
_MOST_CANDIDATES = 60
_MOST_HYPOTHESES = 400


@dataclass(frozen=True, slots=True)
class Discs:
    """The target's discs in one image."""

    found: BoolArray
    """(n,), in the order of the target's centres."""
    points_px: FloatArray
    """(n, 2), NaN where not found."""
    covariance_px2: FloatArray
    """(n, 2, 2), NaN where not found."""
    clean: FloatArray
    """(n,) share of each outline's pixels that look like a disc's."""
    contrast_dn: float
    blur_px: float


def find_discs(
    image: GreyImage,
    target: CirclesTarget,
    expected_px_per_mm: float | None = None,
    expected_px: FloatArray | None = None,
) -> Discs:
    """Find the main target in an image.

    At least three discs are needed. expected_px_per_mm, where known, refuses other sizes (by a
    factor of two); expected_px (n, 2), NaN where unknown, are the discs' predicted places,
    which decide between layouts that look alike. The camera is upright to within 50 degrees.
    Raises TargetNotFoundError.
    """
    grey = as_float(image)
    blobs = _candidates(grey, target, expected_px_per_mm)
    names = _name(blobs, target, expected_px_per_mm, expected_px)
    if len(names) < MIN_DISCS:
        msg = (
            f"main target: {len(names)} of {len(target.centres_mm)} discs found "
            f"({len(blobs.points_px)} round bright spots in the image), {MIN_DISCS} are needed"
        )
        raise TargetNotFoundError(msg)
    which = np.array([disc for disc, _ in names])
    at = np.array([blob for _, blob in names])
    fits = locate_discs(grey, image.saturation_dn, blobs.points_px[at], blobs.outline_px[at])
    good = fits.usable & (fits.clean > _MIN_CLEAN)
    good &= fits.contrast_dn > 4.0 * fits.noise_dn / np.sqrt(10.0)
    n = len(target.centres_mm)
    found = np.zeros(n, dtype=bool)
    points, covariance, clean = np.full((n, 2), np.nan), np.full((n, 2, 2), np.nan), np.zeros(n)
    found[which[good]] = True
    points[which[good]] = fits.points_px[good]
    covariance[which[good]] = fits.covariance_px2[good]
    clean[which] = fits.clean
    if found.sum() < MIN_DISCS:
        msg = f"main target: only {int(found.sum())} of {n} discs are clear enough to measure"
        raise TargetNotFoundError(msg)
    return Discs(
        found,
        points,
        covariance,
        clean,
        float(np.median(fits.contrast_dn[good])),
        float(np.median(fits.blur_px[good])),
    )


def _candidates(grey: FloatArray, target: CirclesTarget, expected_px_per_mm: float | None) -> Blobs:
    """Round bright spots of a size that a disc may have; the clearest hundred."""
    if expected_px_per_mm is None:
        return find_blobs(grey).strongest(_MOST_CANDIDATES)
    radii = 0.5 * target.diameters_mm * expected_px_per_mm
    smallest, largest = radii.min() / _SCALE_TOLERANCE, radii.max() * _SCALE_TOLERANCE
    blobs = find_blobs(grey, smallest)
    fits = (blobs.radius_px > 0.8 * smallest) & (blobs.radius_px < 1.25 * largest)
    return blobs.select(fits).strongest(_MOST_CANDIDATES)


def _name(
    blobs: Blobs,
    target: CirclesTarget,
    expected_px_per_mm: float | None,
    expected_px: FloatArray | None,
) -> list[tuple[int, int]]:
    """Pairs (disc, blob) of the layout that explains most blobs best."""
    layout = target.centres_mm * np.array([1.0, -1.0])  # y up to y down
    radii = target.diameters_mm / 2.0
    factors, shifts = _hypotheses(blobs, layout, radii, expected_px_per_mm)
    counts = _hits(blobs, layout, factors, shifts)
    best: list[tuple[int, int]] = []
    best_cost = np.inf
    for h in np.argsort(-counts, kind="stable")[:_MOST_HYPOTHESES]:
        if counts[h] < max(MIN_DISCS, len(best)):
            break
        names, cost = _match(blobs, layout, radii, complex(factors[h]), complex(shifts[h]))
        if len(names) < max(MIN_DISCS, len(best)) or not _is_plane(blobs, layout, names):
            continue
        if expected_px is not None:
            away = [np.hypot(*(blobs.points_px[b] - expected_px[d])) for d, b in names]
            away = [distance for distance in away if np.isfinite(distance)]
            cost += float(np.mean(away)) / 1000.0 if away else 0.0
        if len(names) > len(best) or cost < best_cost:
            best, best_cost = names, cost
    return best


def _hits(
    blobs: Blobs, layout: FloatArray, factors: ComplexArray, shifts: ComplexArray
) -> IntArray:
    """How many discs of the layout find a spot near their place, for each similarity (h,)."""
    place = layout[:, 0] + 1j * layout[:, 1]
    spots = blobs.points_px[:, 0] + 1j * blobs.points_px[:, 1]
    reach = _PLACE_TOLERANCE * np.abs(factors) * float(np.ptp(layout, axis=0).max())
    counts = np.zeros(len(factors), dtype=np.int64)
    for disc in place:
        nearest = np.full(len(factors), np.inf)
        for spot in spots:
            np.minimum(nearest, np.abs(factors * disc + shifts - spot), out=nearest)
        counts += nearest <= reach
    return counts


def _is_plane(blobs: Blobs, layout: FloatArray, names: list[tuple[int, int]]) -> bool:
    """Whether four or more spots are an affine image of the layout (three always are)."""
    discs, spots = (np.array(side) for side in zip(*names, strict=True))
    design = np.concatenate([layout[discs], np.ones((len(discs), 1))], axis=1)
    points = blobs.points_px[spots]
    miss = design @ np.linalg.lstsq(design, points, rcond=None)[0] - points
    extent = float(np.ptp(points, axis=0).max())
    return bool(np.abs(miss).max() < _PLANE_TOLERANCE * extent)


def _hypotheses(
    blobs: Blobs, layout: FloatArray, radii: FloatArray, expected_px_per_mm: float | None
) -> tuple[ComplexArray, ComplexArray]:
    """Similarities z -> s z + t, all (s) and (t), taking two discs to two fitting blobs."""
    place = layout[:, 0] + 1j * layout[:, 1]
    spots = blobs.points_px[:, 0] + 1j * blobs.points_px[:, 1]
    blob_radii = blobs.radius_px
    pairs = list(permutations(range(len(spots)), 2))
    a, b = np.array(pairs, dtype=int).reshape(-1, 2).T
    factors, shifts = [np.zeros(0, dtype=complex)], [np.zeros(0, dtype=complex)]
    for i in range(len(place)):
        for j in range(i + 1, len(place)):
            factor = (spots[b] - spots[a]) / (place[j] - place[i])
            size = np.abs(factor)
            fits = np.abs(np.angle(factor)) < np.radians(_MAX_ROLL_DEG)
            for blob, disc in ((a, i), (b, j)):
                fits &= np.abs(np.log(blob_radii[blob] / (size * radii[disc]))) < _RADIUS_TOLERANCE
            if expected_px_per_mm is not None:
                fits &= np.abs(np.log(size / expected_px_per_mm)) < np.log(_SCALE_TOLERANCE)
            factors.append(factor[fits])
            shifts.append(spots[a][fits] - factor[fits] * place[i])
    return np.concatenate(factors), np.concatenate(shifts)


def _match(
    blobs: Blobs, layout: FloatArray, radii: FloatArray, factor: complex, shift: complex
) -> tuple[list[tuple[int, int]], float]:
    """Blobs nearest to the places of a layout, and their mean squared miss relative to its size."""
    place = factor * (layout[:, 0] + 1j * layout[:, 1]) + shift
    spots = blobs.points_px[:, 0] + 1j * blobs.points_px[:, 1]
    miss = np.abs(place[:, None] - spots[None, :])
    size = abs(factor)
    extent = size * float(np.ptp(layout, axis=0).max())
    wrong_size = np.abs(np.log(blobs.radius_px[None, :] / (size * radii[:, None])))
    relative = miss / (_PLACE_TOLERANCE * extent) + wrong_size
    relative[(miss > _PLACE_TOLERANCE * extent) | (wrong_size > _RADIUS_TOLERANCE)] = np.inf
    names, cost, taken = [], 0.0, set()
    for disc in range(len(place)):
        blob = int(np.argmin(relative[disc]))
        if np.isfinite(relative[disc, blob]) and blob not in taken:
            names.append((disc, blob))
            taken.add(blob)
            cost += float(relative[disc, blob]) ** 2
    return names, cost / max(len(names), 1)
