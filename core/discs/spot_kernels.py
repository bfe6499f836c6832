"""Compiled loops that outline bright spots of an image: bounded work for each spot looked at."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from core.arrays import FloatArray, IntArray
from core.compiled import compiled, inner_loop

Grey = NDArray[np.float32]
"""(h, w) grey values, DN."""
_BLOCK_PX = 3
"""Side of the blocks whose brightest pixels are compared. Chosen: two spots of the least radius,
2.5 px, lie at least two blocks apart."""
_WAYS, _REACH_PX = 16, 12
"""Directions from a peak in which the dark is sought, and how far: the largest half axis."""
# Distances, px, of the pixels looked at on a way: closer together where small spots end.
_WAY_PX = np.array([2.5, 4.0, 6.0, 9.0, _REACH_PX]) * np.exp(
    2j * np.pi * np.arange(_WAYS)[:, None] / _WAYS
)
_WAY_U = np.rint(_WAY_PX.real).astype(np.int64)
_WAY_V = np.rint(_WAY_PX.imag).astype(np.int64)
_QUARTER, _HALF, _THREE_QUARTERS = 3, 7, 12
"""Ranks among the darkest values of the ways."""
_STILL_FALLING = 0.5
"""A way ends where it falls no further, by this share of what it has fallen: beyond the dark about
a disc another thing may be darker."""
LEAST_HALF_AXIS_PX, MOST_HALF_AXIS_PX = 2.5, 12.0
"""Of the shorter half axis, px of the image searched. Chosen: a smaller spot is too coarse to have
an outline, a larger one is found in an image of half the size."""
_MOST_RATIO = 3.0
"""Of the half axes: a disc seen at 70 degrees."""
MOST_STEPS = 180
"""Of a contour, px: the largest ellipse has 165."""
_LEAST_STEPS = 9
"""Of a contour: a disc of the least radius has 11 or more."""
_HOLES = 2
"""Holes passed on the way out of a spot."""
_LEAST_FILL = 0.85
"""Area over that of the ellipse with the same second moments: 1 for an ellipse, 0.95 for a
square, less for what is concave."""
_ON_OUTLINE, _OFF_PX, _OFF_SHARE = 0.8, 1.2, 0.05
"""So much of a contour lies nearer than this to the ellipse."""
_SHARES = np.array([0.9, 0.8, 0.65, 0.5, 0.35, 0.2])
"""Thresholds between a spot's surroundings and its peak, from the peak down."""
_DU = np.array([1, 1, 0, -1, -1, -1, 0, 1])
"""Steps in px to the right, to the eight neighbours: clockwise as seen in the image, from the right
one."""
_DV = np.array([0, 1, 1, 1, 0, -1, -1, -1])
"""The same down."""
REGION = 7
"""Of a region: x, y, longer and shorter half axis, angle (rad), sharpness, steps of its border."""


@compiled
def _block_peaks(grey: Grey, at: IntArray, most: Grey) -> None:
    """Row and column (bh, bw, 2) of the brightest pixel of each block, and its grey (bh, bw)."""
    for block_v in range(at.shape[0]):
        for block_u in range(at.shape[1]):
            first_v, first_u = block_v * _BLOCK_PX, block_u * _BLOCK_PX
            best, best_v, best_u = grey[first_v, first_u], first_v, first_u
            for v in range(first_v, first_v + _BLOCK_PX):
                for u in range(first_u, first_u + _BLOCK_PX):
                    if grey[v, u] > best:
                        best, best_v, best_u = grey[v, u], v, u
            at[block_v, block_u, 0], at[block_v, block_u, 1] = best_v, best_u
            most[block_v, block_u] = best


@inner_loop
def _is_first(most: Grey, v: int, u: int) -> bool:
    """Whether none of the four neighbours before a block is as bright."""
    here = most[v, u]
    return bool(
        most[v - 1, u - 1] < here
        and most[v - 1, u] < here
        and most[v - 1, u + 1] < here
        and most[v, u - 1] < here
    )


@inner_loop
def _sort(values: Grey) -> None:
    """Sort 2^k values in place: a bitonic network, which has no branches that noise decides."""
    size = 2
    while size <= len(values):
        apart = size >> 1
        while apart > 0:
            for i in range(len(values)):
                other = i ^ apart
                if other > i:
                    low, high = min(values[i], values[other]), max(values[i], values[other])
                    if i & size == 0:
                        values[i], values[other] = low, high
                    else:
                        values[i], values[other] = high, low
            apart >>= 1
        size <<= 1


@inner_loop
def _first_dark(grey: Grey, u: int, v: int, least_dn: float, dark: Grey) -> None:
    """Sort the grey values (16,) where the ways out from a pixel fall no further.

    The image goes on at its edge.
    """
    last_v, last_u = grey.shape[0] - 1, grey.shape[1] - 1
    here = grey[v, u]
    for way in range(_WAYS):
        first = here
        for step in range(_WAY_U.shape[1]):
            to_v = min(max(v + _WAY_V[way, step], 0), last_v)
            to_u = min(max(u + _WAY_U[way, step], 0), last_u)
            there = grey[to_v, to_u]
            fallen = here - first
            if fallen > least_dn and first - there <= _STILL_FALLING * fallen:
                break
            first = min(first, there)
        dark[way] = first
    _sort(dark)


@inner_loop
def _surroundings(grey: Grey, u: int, v: int, darkest: Grey) -> float:
    """Median of the darkest values on the ways out from a pixel; darkest (16,) is room for them."""
    last_v, last_u = grey.shape[0] - 1, grey.shape[1] - 1
    for way in range(_WAYS):
        least = grey[v, u]
        for step in range(_WAY_U.shape[1]):
            to_v = min(max(v + _WAY_V[way, step], 0), last_v)
            to_u = min(max(u + _WAY_U[way, step], 0), last_u)
            least = min(least, grey[to_v, to_u])
        darkest[way] = least
    _sort(darkest)
    return float(0.5 * (darkest[_HALF] + darkest[_HALF + 1]))


@compiled
def _peaks_among(
    grey: Grey, at: IntArray, most: Grey, about: Grey, least_dn: float, noise_dn: float
) -> FloatArray:
    count, peaks = 0, np.empty((most.size // 4 + 1, 3))
    dark = np.empty(_WAYS, np.float32)
    for block_v in range(1, most.shape[0] - 1):
        for block_u in range(1, most.shape[1] - 1):
            here = most[block_v, block_u]
            if here < about[block_v, block_u] or not _is_first(most, block_v, block_u):
                continue
            v, u = at[block_v, block_u, 0], at[block_v, block_u, 1]
            _first_dark(grey, u, v, least_dn, dark)
            if here - dark[_THREE_QUARTERS] < least_dn or count == len(peaks):
                continue
            step = here - 0.5 * (dark[_HALF] + dark[_HALF + 1])
            varies = dark[_THREE_QUARTERS] - dark[_QUARTER]
            peaks[count, 0], peaks[count, 1] = u, v
            peaks[count, 2] = step / (varies + noise_dn)
            count += 1
    return peaks[:count]


def find_peaks(grey: Grey, least_dn: float, noise_dn: float) -> FloatArray:
    """Give the peaks (n, 3) of an image: column, row, evenness.

    A peak is brighter by least_dn than what three quarters of the ways out of it fall to.
    """
    blocks = grey.shape[0] // _BLOCK_PX, grey.shape[1] // _BLOCK_PX
    at, most = np.empty((*blocks, 2), np.int64), np.empty(blocks, np.float32)
    _block_peaks(grey, at, most)
    about = np.asarray(cv2.dilate(most, np.ones((3, 3), np.uint8)), dtype=np.float32)
    return np.asarray(_peaks_among(grey, at, most, about, least_dn, noise_dn))


@inner_loop
def _follow(grey: Grey, level: float, u: int, v: int, us: IntArray, vs: IntArray) -> int:
    """Follow the border clockwise from a pixel above the level whose right neighbour is not.

    Gives the number of steps; 0 where it meets the image's edge or is too long.
    """
    height, width = grey.shape
    at_u, at_v, heading, first = u, v, 4, -1
    count = 0
    while True:
        if not (0 < at_u < width - 1 and 0 < at_v < height - 1):
            return 0
        turn = -1
        for k in range(8):
            way = (heading + 5 + k) % 8
            if grey[at_v + _DV[way], at_u + _DU[way]] > level:
                turn = way
                break
        if turn < 0 or (count > 0 and at_u == u and at_v == v and turn == first):
            return count
        if count == len(us):
            return 0
        if count == 0:
            first = turn
        us[count], vs[count] = at_u, at_v
        at_u, at_v, heading = at_u + _DU[turn], at_v + _DV[turn], turn
        count += 1


@inner_loop
def _outer_border(
    grey: Grey, level: float, u: int, v: int, us: IntArray, vs: IntArray
) -> tuple[int, int]:
    """Steps of the border about what a pixel lies in, and steps taken in all.

    0 where none is found: it is too long, or goes round too many holes.
    """
    taken, at = 0, u
    for _ in range(_HOLES + 1):
        while at < grey.shape[1] - 1 and grey[v, at + 1] > level:
            at += 1
            taken += 1
            if at - u > MOST_STEPS:
                return 0, taken
        count = _follow(grey, level, at, v, us, vs)
        taken += count or len(us)
        if count == 0:
            return 0, taken
        twice_area = 0
        for k in range(count):
            to = k + 1 if k + 1 < count else 0
            twice_area += us[k] * vs[to] - us[to] * vs[k]
        if twice_area > 0:
            return count, taken
        at += 1  # into the hole, and across it
        while at < grey.shape[1] - 1 and grey[v, at] <= level:
            at += 1
            if at - u > MOST_STEPS:
                return 0, taken
    return 0, taken


@inner_loop
def _ellipse(us: IntArray, vs: IntArray, count: int, region: FloatArray) -> bool:
    """Ellipse with the second moments of a border's inside; False where it is not like one."""
    area, sx, sy, sxx, sxy, syy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    u0, v0 = us[0], vs[0]
    for k in range(count):
        to = k + 1 if k + 1 < count else 0
        x0, y0 = float(us[k] - u0), float(vs[k] - v0)
        x1, y1 = float(us[to] - u0), float(vs[to] - v0)
        cross = x0 * y1 - x1 * y0
        area += cross / 2.0
        sx += (x0 + x1) * cross / 6.0
        sy += (y0 + y1) * cross / 6.0
        sxx += (x0 * x0 + x0 * x1 + x1 * x1) * cross / 12.0
        syy += (y0 * y0 + y0 * y1 + y1 * y1) * cross / 12.0
        sxy += (x0 * (2.0 * y0 + y1) + x1 * (y0 + 2.0 * y1)) * cross / 24.0
    mx, my = sx / area, sy / area
    xx, xy, yy = sxx / area - mx * mx, sxy / area - mx * my, syy / area - my * my
    half, difference = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
    if half - difference <= 0.0:
        return False
    longer, shorter = 2.0 * math.sqrt(half + difference), 2.0 * math.sqrt(half - difference)
    if area < _LEAST_FILL * math.pi * longer * shorter:
        return False
    # The border goes through the middles of its pixels: the inside is larger (Pick's theorem).
    whole = area + 0.5 * count + 1.0
    sum_axes = longer + shorter
    wider = 0.5 * (math.sqrt((longer - shorter) ** 2 + 4.0 * whole / math.pi) - sum_axes)
    if not LEAST_HALF_AXIS_PX <= shorter + wider <= MOST_HALF_AXIS_PX:
        return False
    if longer + wider > _MOST_RATIO * (shorter + wider):
        return False
    angle = 0.5 * math.atan2(2.0 * xy, xx - yy)
    c, s = math.cos(angle), math.sin(angle)
    within, near = _OFF_PX / shorter + _OFF_SHARE, 0
    for k in range(count):
        x, y = us[k] - u0 - mx, vs[k] - v0 - my
        rho = math.hypot((c * x + s * y) / longer, (c * y - s * x) / shorter)
        near += abs(rho - 1.0) < within
    region[0], region[1] = u0 + mx, v0 + my
    region[2], region[3], region[4] = longer + wider, shorter + wider, angle
    return near > _ON_OUTLINE * count


@inner_loop
def _sharpness(grey: Grey, us: IntArray, vs: IntArray, count: int) -> float:
    """Mean gradient along a border, DN/px."""
    total = 0.0
    for k in range(count):
        u, v = us[k], vs[k]
        across, down = grey[v, u + 1] - grey[v, u - 1], grey[v + 1, u] - grey[v - 1, u]
        total += math.sqrt(across * across + down * down)
    return 0.5 * total / count


@compiled
def outline_peaks(grey: Grey, peaks: FloatArray, most_steps: int) -> tuple[FloatArray, int]:
    """Regions (n, REGION) about peaks as from `find_peaks`, at the level of the sharpest edge.

    Also gives the steps taken along borders: when most_steps are used up, no more peaks are
    looked at.
    """
    regions, count, taken = np.empty((len(peaks), REGION)), 0, 0
    us, vs = np.empty(MOST_STEPS, np.int64), np.empty(MOST_STEPS, np.int64)
    region, darkest = np.zeros(REGION), np.empty(_WAYS, np.float32)
    for k in range(len(peaks)):
        if taken >= most_steps:
            break
        u, v, sharpest = int(peaks[k, 0]), int(peaks[k, 1]), 0.0
        dark = _surroundings(grey, u, v, darkest)
        for share in _SHARES:
            level = dark + share * (grey[v, u] - dark)
            steps, more = _outer_border(grey, level, u, v, us, vs)
            taken += more
            if steps == 0:
                break  # lower down it is only larger
            if steps < _LEAST_STEPS or not _ellipse(us, vs, steps, region):
                continue
            region[5], region[6] = _sharpness(grey, us, vs, steps), steps
            if region[5] > sharpest:
                sharpest = region[5]
                for i in range(REGION):
                    regions[count, i] = region[i]
        count += sharpest > 0.0
    return regions[:count], taken


@compiled
def sharpest_of_concentric(points: FloatArray, half_axis: FloatArray) -> IntArray:
    """Index of the regions, the sharpest first, that share no centre with one before.

    points (n, 2) and shorter half axes (n,), px, sorted by sharpness.
    """
    kept, count = np.empty(len(points), np.int64), 0
    for k in range(len(points)):
        alone = True
        for j in range(count):
            u, v = points[k, 0] - points[kept[j], 0], points[k, 1] - points[kept[j], 1]
            least = 0.5 * max(half_axis[kept[j]], 3.0)
            if u * u + v * v <= least * least:
                alone = False
                break
        if alone:
            kept[count] = k
            count += 1
    return kept[:count]
