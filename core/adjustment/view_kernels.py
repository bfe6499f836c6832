"""Compiled loops over the corners of a view: what each adds to the normal equations."""

from __future__ import annotations

import math

from core.arrays import FloatArray, IntArray
from core.compiled import compiled


@compiled
def add_corners(
    index: IntArray,
    whiten: FloatArray,
    white: FloatArray,
    weights: FloatArray,
    by_lens: FloatArray,
    by_point: FloatArray,
    rotated: FloatArray,
    R: FloatArray,
    terms: FloatArray,
    pose_column: int,
    local: FloatArray,
    rest: FloatArray,
    cross: FloatArray,
    corner: FloatArray,
    corner_right: FloatArray,
) -> None:
    """Fill the weighted equations of a view's corners, and add their blocks of corner offsets.

    index (n,) into the board's corners; whiten (n, 2, 2), white (n, 2) whitened residuals,
    weights (n,); by_lens (n, 2, lens) and by_point (n, 2, 3) d(px) by the lens and by the point in
    the camera's frame; rotated (n, 3) = R X with the pose's R; terms (corners, 3, shape)
    d(corner)/d(shape). local (2 n, lens + shape + 6) and rest (2 n,) are filled in this order;
    cross (corners, 2, size), corner (corners, 2, 2) and corner_right (corners, 2) are added to, the
    pose's columns from pose_column on. The derivatives by the pose are as in `pose_normal`.
    """
    lens, shape, pose = by_lens.shape[2], terms.shape[2], 6
    shared = lens + shape
    for n in range(len(index)):
        at = index[n]
        root = math.sqrt(weights[n])
        for k in range(2):
            line = 2 * n + k
            first, second = root * whiten[n, k, 0], root * whiten[n, k, 1]
            a = first * by_point[n, 0, 0] + second * by_point[n, 1, 0]
            b = first * by_point[n, 0, 1] + second * by_point[n, 1, 1]
            c = first * by_point[n, 0, 2] + second * by_point[n, 1, 2]
            x = a * R[0, 0] + b * R[1, 0] + c * R[2, 0]
            y = a * R[0, 1] + b * R[1, 1] + c * R[2, 1]
            z = a * R[0, 2] + b * R[1, 2] + c * R[2, 2]
            for i in range(lens):
                local[line, i] = first * by_lens[n, 0, i] + second * by_lens[n, 1, i]
            for i in range(shape):
                by_term = x * terms[at, 0, i] + y * terms[at, 1, i] + z * terms[at, 2, i]
                local[line, lens + i] = by_term
            local[line, shared] = rotated[n, 1] * c - rotated[n, 2] * b
            local[line, shared + 1] = rotated[n, 2] * a - rotated[n, 0] * c
            local[line, shared + 2] = rotated[n, 0] * b - rotated[n, 1] * a
            local[line, shared + 3], local[line, shared + 4], local[line, shared + 5] = a, b, c
            miss = root * white[n, k]
            rest[line] = miss
            for i in range(shared):
                cross[at, 0, i] += x * local[line, i]
                cross[at, 1, i] += y * local[line, i]
            for i in range(pose):
                cross[at, 0, pose_column + i] += x * local[line, shared + i]
                cross[at, 1, pose_column + i] += y * local[line, shared + i]
            corner[at, 0, 0] += x * x
            corner[at, 0, 1] += x * y
            corner[at, 1, 0] += x * y
            corner[at, 1, 1] += y * y
            corner_right[at, 0] += x * miss
            corner_right[at, 1] += y * miss
