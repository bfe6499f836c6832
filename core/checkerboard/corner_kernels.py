"""Compiled loops: corners fitted to the grey values about them."""

from __future__ import annotations

import math

import numpy as np

from core.arrays import FloatArray, IntArray
from core.checkerboard.corner_equations import (
    BLUR,
    CORNER_PARAMETERS,
    EVEN_PARAMETERS,
    GAIN,
    SCALARS,
    SHIFT,
    accumulate,
    accumulate_even,
    flat_noise,
)
from core.checkerboard.light_kernels import BOX, fit_light_planes
from core.compiled import compiled, inner_loop
from core.grey_fit import MIN_PIXELS, solve_keeping
from core.images import PixelArray

_LANES = 16
"""Samples are filled up to a multiple of this: as many single-precision numbers as a wide vector
unit holds."""
_SETTLED_PX = 0.01
"""A step of the shift that is the last: the next would be a hundred times smaller."""
_NEARLY_PX = 0.05
"""Likewise where gain, offset and blur start nearly right."""
NO_SIDES = np.zeros((0, 2, 3))
"""For `fit_corners` where the noise is not asked for."""
_NEARLY_SATURATED = 0.99
"""Of full scale: the mean of a box that holds a saturated pixel."""
_LEAST_BLUR_PX, _MOST_BLUR_PX = 0.35, 6.0
"""1-sigma width of the edges. A pixel's own square makes 0.29; corners with more than 5.9 are not
used."""
_MOST_SHIFT = 0.5
"""Of half the window: a fit that goes further has left its corner."""
_LEAST_GAIN_SHARE = 0.3
"""Of the guessed gain that the first step must leave, for the shift to be scaled by their ratio."""
_LEAST_A_SIDE = 8.0
"""Pixels, bright and dark, from which offset and gain start."""
_LEAST_SLOPE, _MOST_REACH_PX = 1e-6, 1e6
"""Of an edge across a row; one that runs along it is taken as crossing so far away."""
_ZERO = np.float32(0.0)
"""In single precision, as the samples."""


@inner_loop
def _edges_in_px(m: FloatArray, c: FloatArray) -> None:
    """Put the map m (2, 5), in squares, into c[:10] in px, and its slopes in px into c[21:25]."""
    for axis in range(2):
        px = 1.0 / math.sqrt(m[axis, 0] * m[axis, 0] + m[axis, 1] * m[axis, 1])
        for term in range(5):
            c[5 * axis + term] = m[axis, term] * px
        c[21 + 2 * axis], c[22 + 2 * axis] = m[axis, 0] * px, m[axis, 1] * px


@inner_loop
def _pack(
    p: FloatArray, blur: FloatArray, noise: FloatArray, saturation: float, slack: float,
    c: FloatArray,
) -> None:  # fmt: skip
    """Put parameters, saturation and what makes the pixel weights into c[10:21] and c[25:32].

    p (9,): see `corner_equations.GAIN`; blur (3,): where it began, and its slopes by u and v, which
    are not fitted; slack: what the model may miss, squared; 0 lets no pixel fade. c: see SCALARS.
    """
    for k in range(CORNER_PARAMETERS):
        c[10 + k] = p[k]
    c[16] = 1.0 / p[BLUR]
    c[19] = 1.0 / 9.0 if slack > 0.0 else 0.0
    c[20] = saturation
    for k in range(4):
        c[25 + k] = noise[k]
    c[29] = slack
    for k in range(2):
        c[30 + k] = -blur[1 + k] / (p[BLUR] * p[BLUR])


@inner_loop
def _per(slope: float) -> float:
    return 1.0 / slope if abs(slope) > _LEAST_SLOPE else _MOST_REACH_PX


@inner_loop
def _gather_edges(
    image: PixelArray, at: FloatArray, half: float, c: FloatArray, limits: FloatArray,
    samples: FloatArray,
) -> int:  # fmt: skip
    """Collect the pixels near a corner's edges and not nearer to the next corner's.

    Their u, v and grey; gives how many there are. Either edge crosses a row in one stretch; where
    the two touch they are one.
    """
    count, (height, width) = 0, image.shape
    us, vs, greys = samples[0], samples[1], samples[2]
    reach_x, reach_y, band = limits[0] / limits[4], limits[0] / limits[5], limits[1]
    per_x, per_y = _per(c[0]), _per(c[5])
    a_slope, b_slope = -c[1] * per_x, -c[6] * per_y
    a_band, b_band = band * abs(per_x), band * abs(per_y)
    a_reach, b_reach = reach_x * abs(per_x), reach_y * abs(per_y)
    top, bottom = max(0, math.ceil(at[1] - half)), min(height - 1, math.floor(at[1] + half))
    for row in range(top, bottom + 1):
        v = row - at[1]
        a, b = a_slope * v, b_slope * v
        low, high = max(a - a_reach, b - b_reach, -half), min(a + a_reach, b + b_reach, half)
        first = max(math.ceil(at[0] + max(low, a - a_band)), 0)
        last = min(math.floor(at[0] + min(high, a + a_band)), width - 1)
        again = max(math.ceil(at[0] + max(low, b - b_band)), 0)
        end = min(math.floor(at[0] + min(high, b + b_band)), width - 1)
        if first <= last and again <= end and again <= last + 1 and first <= end + 1:
            first, last, end = min(first, again), max(last, end), again - 1
        for part in range(2):
            start, stop = (first, last) if part == 0 else (again, end)
            for column in range(start, stop + 1):
                us[count], vs[count] = np.float32(column - at[0]), np.float32(v)
                greys[count] = np.float32(image[row, column])
                count += 1
    return count


@inner_loop
def _gather_flats(
    boxes: FloatArray, at: FloatArray, half: float, c: FloatArray, limits: FloatArray,
    samples: FloatArray, count: int,
) -> int:  # fmt: skip
    """Append the means of boxes that lie in the squares, off the edges, and are not saturated."""
    reach_x, reach_y = limits[0] / limits[4], limits[0] / limits[5]
    gap, full = limits[2], _NEARLY_SATURATED * limits[3]
    middle = 0.5 * (BOX - 1)
    first_u = max(0, math.ceil((at[0] - half - middle) / BOX))
    last_u = min(boxes.shape[1] - 1, math.floor((at[0] + half - middle) / BOX))
    first_v = max(0, math.ceil((at[1] - half - middle) / BOX))
    last_v = min(boxes.shape[0] - 1, math.floor((at[1] + half - middle) / BOX))
    for row in range(first_v, last_v + 1):
        v = BOX * row + middle - at[1]
        for column in range(first_u, last_u + 1):
            u = BOX * column + middle - at[0]
            x, y = abs(c[0] * u + c[1] * v), abs(c[5] * u + c[6] * v)
            if x < gap or y < gap or x > reach_x or y > reach_y or boxes[row, column] > full:
                continue
            samples[0, count], samples[1, count] = u, v
            samples[2, count], samples[3, count] = boxes[row, column], BOX * BOX
            count += 1
    return count


@inner_loop
def _start(samples: FloatArray, count: int, c: FloatArray, p: FloatArray) -> bool:
    """Start offset and gain from the mean of the bright and of the dark squares."""
    same = other = n_same = n_other = _ZERO
    for i in range(count):
        u, v, n = samples[0, i], samples[1, i], samples[3, i]
        alike = (c[0] * u + c[1] * v) * (c[5] * u + c[6] * v) > _ZERO
        here = n if alike else _ZERO
        there = n - here
        same, other = same + here * samples[2, i], other + there * samples[2, i]
        n_same, n_other = n_same + here, n_other + there
    if n_same < _LEAST_A_SIDE or n_other < _LEAST_A_SIDE:
        return False
    same, other = same / n_same, other / n_other
    p[:] = 0.0
    p[0], p[GAIN] = 0.5 * (same + other), 0.5 * (same - other)
    return True


@inner_loop
def _information(factor: FloatArray, n: int, information: FloatArray) -> None:
    """What the last two rows of a Cholesky factor (n, n) say: the others' Schur complement."""
    a, b, d = factor[n - 2, n - 2], factor[n - 1, n - 2], factor[n - 1, n - 1]
    information[0, 0], information[1, 1] = a * a, b * b + d * d
    information[0, 1] = information[1, 0] = a * b


@compiled
def fit_corners(
    image: PixelArray, boxes: FloatArray, points: FloatArray, maps: FloatArray,
    half: FloatArray, which: IntArray, noise: FloatArray, limits: FloatArray, blurs: FloatArray,
    iterations: int, state: FloatArray, information: FloatArray, figures: FloatArray,
    sides: FloatArray,
) -> None:  # fmt: skip
    """Fit the corner model at the predicted points `which` by Gauss-Newton.

    In at most `iterations` steps. image (h, w) DN; boxes (h // BOX, w // BOX) means of its boxes,
    or (0, 0) to do without; points (n, 2) px; maps (n, 2, 5) squares per px, px^2; half (n,) px;
    noise (6,): a pixel's variance at grey 0, by grey, the least and the most it may be, what the
    model may miss (squared; 0: no pixel fades), and what even light may; limits: reach in
    squares, band about the edges px, gap between edges and boxes px, saturation DN; blurs (n, 3)
    px to start from, and its slopes by u and v.
    Out: state (n, 9); information (n, 2, 2), the inverse covariance of the shift, nuisance
    parameters eliminated; figures (n, 3): weighted sum of squares, degrees of freedom, 1 if the
    fit is usable; sides (n, 2, 3), or of no rows, see `flat_noise`.
    """
    n = CORNER_PARAMETERS
    normal, factor, right, step = np.zeros((n, n)), np.zeros((n, n)), np.zeros(n), np.zeros(n)
    room = int(2 * half.max() + 4) ** 2 + _LANES if len(half) else _LANES
    samples, c = np.zeros((4, room), np.float32), np.zeros(SCALARS, np.float32)
    settled_px = _SETTLED_PX if noise[4] > 0.0 else _NEARLY_PX
    bounds = np.zeros(6)
    for i in range(4):
        bounds[i] = limits[i]
    for k in which:
        m, p = maps[k], state[k]
        figures[k, :] = 0.0
        _edges_in_px(m, c)
        bounds[4] = math.sqrt(m[0, 0] * m[0, 0] + m[0, 1] * m[0, 1])
        bounds[5] = math.sqrt(m[1, 0] * m[1, 0] + m[1, 1] * m[1, 1])
        count = _gather_edges(image, points[k], half[k], c, bounds, samples)
        if count < MIN_PIXELS:
            continue
        samples[3, :count] = 1.0
        count = _gather_flats(boxes, points[k], half[k], c, bounds, samples, count)
        if not _start(samples, count, c, p):
            continue
        p[BLUR] = blurs[k, 0]
        padded = (count + _LANES - 1) // _LANES * _LANES
        samples[:, count:padded] = 0.0
        usable, squares, effective_count = True, 0.0, 0.0
        for turn in range(iterations):
            _pack(p, blurs[k], noise, limits[3], noise[4] if turn > 0 else 0.0, c)
            squares, effective_count = accumulate(samples, padded, c, normal, right)
            usable = solve_keeping(normal, right, factor, step, n)
            if not usable:
                break
            gain = p[GAIN]
            for a in range(n):
                p[a] += step[a]
                squares -= step[a] * right[a]  # the sum after the step, which is not evaluated
            if turn == 0 and abs(p[GAIN]) > _LEAST_GAIN_SHARE * abs(gain):
                # The first step was found with a gain that was only guessed.
                p[SHIFT] *= gain / p[GAIN]
                p[SHIFT + 1] *= gain / p[GAIN]
            moved_px = abs(step[SHIFT]) + abs(step[SHIFT + 1])
            if turn > 0 and moved_px < settled_px:
                break
            p[BLUR] = min(max(p[BLUR], _LEAST_BLUR_PX), _MOST_BLUR_PX)
            if abs(p[SHIFT]) + abs(p[SHIFT + 1]) > _MOST_SHIFT * half[k]:
                usable = False
                break
        figures[k, 0], figures[k, 1] = squares, effective_count - n
        if usable:
            _information(factor, n, information[k])
            figures[k, 2] = 1.0
            if len(sides):
                _pack(p, blurs[k], noise, limits[3], 0.0, c)
                flat_noise(samples, count, c, sides[k])


@compiled
def fit_even_corners(
    image: PixelArray, boxes: FloatArray, points: FloatArray, maps: FloatArray,
    half: FloatArray, noise: FloatArray, limits: FloatArray, blurs: FloatArray, iterations: int,
    state: FloatArray, information: FloatArray, figures: FloatArray,
) -> None:  # fmt: skip
    """As `fit_corners`, for corners with nothing odd about them: quicker, and nearer to the bound.

    The slopes of the light are those of the squares around, and no pixel fades. Where that does
    not do, figures[k, 2] is 0.
    """
    n = EVEN_PARAMETERS
    normal, factor, right, step = np.zeros((n, n)), np.zeros((n, n)), np.zeros(n), np.zeros(n)
    room = int(2 * half.max() + 4) ** 2 + _LANES if len(half) else _LANES
    samples, c = np.zeros((4, room), np.float32), np.zeros(SCALARS, np.float32)
    samples[3, :] = 1.0
    bounds, planes, parts = np.zeros(6), np.zeros((2, 3)), np.zeros((8, 4))
    for i in range(4):
        bounds[i] = limits[i]
    for k in range(len(points)):
        m, p = maps[k], state[k]
        figures[k, :] = 0.0
        if not fit_light_planes(
            boxes, points[k], m, limits[2], _NEARLY_SATURATED * limits[3], noise, parts, planes
        ):
            continue
        _edges_in_px(m, c)
        bounds[4] = math.sqrt(m[0, 0] * m[0, 0] + m[0, 1] * m[0, 1])
        bounds[5] = math.sqrt(m[1, 0] * m[1, 0] + m[1, 1] * m[1, 1])
        count = _gather_edges(image, points[k], half[k], c, bounds, samples)
        if count < MIN_PIXELS:
            continue
        for i in range(3):
            p[i] = 0.5 * (planes[0, i] + planes[1, i])
            p[GAIN + i] = 0.5 * (planes[0, i] - planes[1, i])
        p[BLUR], p[SHIFT], p[SHIFT + 1] = blurs[k, 0], 0.0, 0.0
        padded = (count + _LANES - 1) // _LANES * _LANES
        samples[:, count:padded] = 0.0
        usable, squares = True, 0.0
        for _ in range(iterations):
            _pack(p, blurs[k], noise, limits[3], 0.0, c)
            squares = accumulate_even(samples, padded, c, normal, right)
            usable = solve_keeping(normal, right, factor, step, n)
            if not usable:
                break
            for a in range(n):
                squares -= step[a] * right[a]
            p[0] += step[0]
            p[GAIN] += step[1]
            p[BLUR] = min(max(p[BLUR] + step[2], _LEAST_BLUR_PX), _MOST_BLUR_PX)
            p[SHIFT] += step[3]
            p[SHIFT + 1] += step[4]
            moved_px = abs(step[3]) + abs(step[4])
            if abs(p[SHIFT]) + abs(p[SHIFT + 1]) > _MOST_SHIFT * half[k]:
                usable = False
            if moved_px < _NEARLY_PX or not usable:
                break
        samples[3, count:padded] = 1.0
        if usable:
            figures[k, 0], figures[k, 1] = squares, count - n
            _information(factor, n, information[k])
            figures[k, 2] = 1.0
