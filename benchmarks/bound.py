"""Cramer-Rao bounds: how well the pixels of an image could tell a pose or a disc's centre.

Fisher information J^T V^-1 J of all pixels: J by central differences of clean rendered images, V
the variance of each pixel (shot and read noise, rounding as 1/12 DN^2; what the variance itself
tells is left out). No unbiased estimate does better, whatever its model.
"""

from __future__ import annotations

import numpy as np

from benchmarks.scene import CLEAN, Scene, mean_dn
from core.arrays import FloatArray
from core.geometry.pose import Pose

_STEP = np.array([1e-4] * 3 + [5e-3] * 3)
"""rad and mm: a tenth of a pixel or so."""
_BLUR_STEP_PX, _SHIFT_STEP_MM = 0.02, 0.5
_DISC_WINDOW = 1.5
"""Pixels nearer to a disc's centre than so many radii belong to it."""


def pose_bound_mm(scene: Scene, T_CS_WS: Pose) -> float:
    """Bound (rms of the 2-vector, mm at the main target) of one frame's false displacement.

    Unknown are the six of the pose and, as nuisance, one gain, one offset and one blur for the
    image; the lens, the board and the shading are known.
    """
    renderer = scene.sub_renderer(CLEAN)
    here = mean_dn(scene.sub(renderer, T_CS_WS))
    rows = []
    for axis, step in enumerate(_STEP):
        delta = np.zeros(6)
        delta[axis] = step
        ahead, behind = (
            mean_dn(scene.sub(renderer, T_CS_WS.perturbed(d))) for d in (delta, -delta)
        )
        rows.append((ahead - behind) / (2.0 * step))
    wider, finer = (
        mean_dn(scene.sub(scene.sub_renderer(CLEAN, by), T_CS_WS))
        for by in (_BLUR_STEP_PX, -_BLUR_STEP_PX)
    )
    rows += [np.ones_like(here), here, (wider - finer) / (2.0 * _BLUR_STEP_PX)]
    covariance = _inverse_information(np.array(rows), scene.variance_dn2(here))[:6, :6]
    to_mm = scene.false_by_pose(T_CS_WS)
    return float(np.sqrt(np.trace(to_mm @ covariance @ to_mm.T)))


def disc_bound_mm(scene: Scene) -> float:
    """Bound (rms of the 2-vector, mm) of the mean of the discs' centres in one frame.

    Unknown are the two of each centre. Size, light and blur change a disc evenly all around and
    say nothing of its centre, so that not knowing them costs nothing.
    """
    renderer, target = scene.main_renderer(CLEAN), scene.site.main_target
    here = mean_dn(scene.main(renderer, np.zeros(2)))
    rows = []
    for axis in range(2):
        step = np.zeros(2)
        step[axis] = _SHIFT_STEP_MM
        ahead, behind = (mean_dn(scene.main(renderer, moved)) for moved in (step, -step))
        rows.append((ahead - behind) / (2.0 * _SHIFT_STEP_MM))
    slopes, variance = np.array(rows), scene.variance_dn2(here)
    v, u = np.divmod(np.arange(len(here)), scene.site.main.width_px)
    covariance = np.zeros((2, 2))
    centres = np.column_stack([target.centres_mm, np.zeros(len(target.centres_mm))])
    points = scene.geometry.main.project(scene.geometry.T_CM_WM.apply(centres))
    reach_px = _DISC_WINDOW * target.diameters_mm / 2.0 * scene.rig.scale_px_per_mm
    for (x, y), reach in zip(points, reach_px, strict=True):
        mine = (u - x) ** 2 + (v - y) ** 2 < reach**2
        covariance += _inverse_information(slopes[:, mine], variance[mine])
    return float(np.sqrt(np.trace(covariance)) / len(points))


def _inverse_information(rows: FloatArray, variance: FloatArray) -> FloatArray:
    """Inverse of J^T V^-1 J; rows (parameters, pixels), scaled for the sake of its condition."""
    unit = 1.0 / np.linalg.norm(rows, axis=1)
    scaled = rows * unit[:, None]
    inverse = np.linalg.inv((scaled / variance) @ scaled.T)
    return np.asarray(inverse * unit[:, None] * unit)
