"""A camera's lens: intrinsics with skew (Eq. 10) and one of a closed family of distortions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.arrays import BoolArray, FloatArray
from core.geometry.lens_kernels import MOST_DISTORTION, fisheye, perspective
from core.lens_model import LensModel

INTRINSICS = 5
"""alpha, beta, gamma, mu, nu of Eq. 10: the first parameters of every model."""
_WIDEST_TANGENT = 6.0
"""Tangent of the angle from the axis up to which a perspective lens is used: 80 degrees."""
_WIDEST_ANGLE_RAD = 2.2
"""And a fisheye: 126 degrees from the axis, beyond the widest lenses sold (250 degrees in all)."""
_TABLE_NODES = 240
"""Of the table of the radial distortion. Chosen: every 1.4 degrees or less near the axis; Newton's
method does the rest."""
_NEWTON_STEPS = 30
"""From the table it takes 3 (measured); more only where the image turns back."""
_NEWTON_LIMIT_RAD = 0.2
"""A step is no larger, so that one from a poor start does not leave the lens."""
_NEWTON_SETTLED_RAD = 1e-13
"""Two orders above the rounding of a unit vector."""
_SINGULAR = 1e-9
"""Determinant of d(px)/d(angle) over alpha beta, below which the image stands still."""


@dataclass(frozen=True, slots=True)
class Lens:
    """Intrinsics of one camera, in the paper's symbols (Eq. 10), with distortion.

    u = alpha x'' + gamma y'' + mu, v = beta y'' + nu, where (x'', y'') is the distorted
    image point at unit focal length.

    >>> lens = Lens(np.array([1000.0, 1000.0, 0.0, 320.0, 240.0, -0.1, 0.0]), LensModel.RADIAL)
    >>> pixels = lens.project(np.array([[10.0, 0.0, 100.0]]))
    >>> pixels.tolist()
    [[419.9, 240.0]]
    >>> (lens.rays(pixels) * [100.0, 100.0, 100.0]).round(3).tolist()
    [[9.95, 0.0, 99.504]]
    """

    parameters: FloatArray
    """(5 + coefficients,) in the order of LensModel.parameters; px for the first five."""
    model: LensModel = LensModel.BROWN

    def __post_init__(self) -> None:
        """Refuse parameters of another model."""
        if self.parameters.shape != (len(self.model.parameters),):
            msg = (
                f"a {self.model} lens has {len(self.model.parameters)} parameters, "
                f"{self.parameters.shape} given"
            )
            raise ValueError(msg)

    @classmethod
    def ideal(
        cls, model: LensModel, focal_px: float, centre_px: tuple[float, float] | FloatArray
    ) -> Lens:
        """Build a lens without distortion: tan(theta), or theta itself for a fisheye."""
        mu, nu = centre_px
        coefficients = [0.0] * len(model.coefficients)
        return cls(np.array([focal_px, focal_px, 0.0, mu, nu, *coefficients], dtype=float), model)

    @property
    def size(self) -> int:
        """How many parameters there are."""
        return len(self.parameters)

    @property
    def matrix(self) -> FloatArray:
        """(3, 3) intrinsic matrix A of Eq. 10."""
        alpha, beta, gamma, mu, nu = self.parameters[:INTRINSICS]
        return np.array([[alpha, gamma, mu], [0.0, beta, nu], [0.0, 0.0, 1.0]])

    def moved(self, step: FloatArray) -> Lens:
        """Add a step to the parameters."""
        return Lens(self.parameters + step, self.model)

    def project(self, points_mm: FloatArray) -> FloatArray:
        """Project points in the camera frame (n, 3) to pixels (n, 2)."""
        nothing = np.empty((0, 2, 3))
        pixels = np.empty((len(points_mm), 2))
        self._run(points_mm, pixels, nothing, np.empty((0, 2, self.size)))
        return pixels

    def project_slopes(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Project points (n, 3), with d(px)/d(point) (n, 2, 3)."""
        pixels, by_point = np.empty((len(points_mm), 2)), np.empty((len(points_mm), 2, 3))
        self._run(points_mm, pixels, by_point, np.empty((0, 2, self.size)))
        return pixels, by_point

    def project_jacobians(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Project points (n, 3), with d(px)/d(point) (n, 2, 3) and d(px)/d(lens) (n, 2, size)."""
        n = len(points_mm)
        pixels, by_point, by_lens = (
            np.empty((n, 2)),
            np.empty((n, 2, 3)),
            np.empty((n, 2, self.size)),
        )
        self._run(points_mm, pixels, by_point, by_lens)
        return pixels, by_point, by_lens

    def _run(
        self, points_mm: FloatArray, px: FloatArray, by_point: FloatArray, by_lens: FloatArray
    ) -> None:
        points = np.ascontiguousarray(points_mm, dtype=float)
        if self.model is LensModel.FISHEYE:
            fisheye(points, np.ascontiguousarray(self.parameters), px, by_point, by_lens)
            return
        filled = np.zeros(INTRINSICS + MOST_DISTORTION)
        filled[: self.size] = self.parameters
        perspective(points, filled, px, by_point, by_lens)

    def sees(self, points_mm: FloatArray) -> BoolArray:
        """Which points (n, 3) lie where the image still grows with the angle from the axis.

        Beyond that a polynomial folds the scene back into the image, which no lens does.
        """
        off_axis = np.hypot(points_mm[:, 0], points_mm[:, 1])
        limit = self._limit()
        if self.model is LensModel.FISHEYE:
            return np.asarray(np.arctan2(off_axis, points_mm[:, 2]) < limit)
        return np.asarray((points_mm[:, 2] > 0.0) & (off_axis < limit * points_mm[:, 2]))

    def _limit(self) -> float:
        """Tangent (fisheye: angle, rad) at which the radial distortion turns back."""
        widest = _WIDEST_ANGLE_RAD if self.model is LensModel.FISHEYE else _WIDEST_TANGENT
        off_axis = np.linspace(0.0, widest, _TABLE_NODES)
        back = np.nonzero(np.diff(self._radial(off_axis)) <= 0.0)[0]
        return float(off_axis[back[0]]) if len(back) else widest

    def _radial(self, off_axis: FloatArray) -> FloatArray:
        """Distance of the distorted image point from the axis, without the decentring."""
        k = np.zeros(MOST_DISTORTION)
        k[: self.size - INTRINSICS] = self.parameters[INTRINSICS:]
        q = off_axis * off_axis
        if self.model is LensModel.FISHEYE:
            return np.asarray(off_axis * (1.0 + q * (k[0] + q * (k[1] + q * (k[2] + q * k[3])))))
        above = 1.0 + q * (k[0] + q * (k[1] + q * k[4]))
        below = 1.0 + q * (k[5] + q * (k[6] + q * k[7]))
        return np.asarray(off_axis * above / np.where(below > 0.0, below, np.inf))

    def rays(self, pixels: FloatArray) -> FloatArray:
        """Undo the lens: pixels (n, 2) to directions (n, 3) of unit length, by Newton's method.

        A pixel that no direction is imaged at gives the outermost direction of the lens.
        """
        angle, around = self._start_of_rays(pixels)
        flat = abs(self.parameters[0] * self.parameters[1])
        directions = _directions(angle, around)
        for _ in range(_NEWTON_STEPS):
            px, by_point = self.project_slopes(directions)
            across, over = _tangents(directions)
            by_turn = by_point @ np.stack([across, over], axis=2)
            sound = np.abs(np.linalg.det(by_turn)) > _SINGULAR * flat
            step = np.zeros((len(pixels), 2))
            miss = (pixels - px)[sound, :, None]
            step[sound] = np.linalg.solve(by_turn[sound], miss)[:, :, 0]
            np.clip(step, -_NEWTON_LIMIT_RAD, _NEWTON_LIMIT_RAD, out=step)
            directions = directions + step[:, :1] * across + step[:, 1:] * over
            directions /= np.linalg.norm(directions, axis=1, keepdims=True)
            if len(step) == 0 or float(np.abs(step).max()) < _NEWTON_SETTLED_RAD:
                break
        return directions

    def _start_of_rays(self, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Angles (n,) from the axis and around it, by the radial distortion's table."""
        alpha, beta, gamma, mu, nu = self.parameters[:INTRINSICS]
        y = (pixels[:, 1] - nu) / beta
        x = (pixels[:, 0] - mu - gamma * y) / alpha
        off_axis = np.linspace(0.0, self._limit(), _TABLE_NODES)
        found = np.interp(np.hypot(x, y), self._radial(off_axis), off_axis)
        angle = found if self.model is LensModel.FISHEYE else np.arctan(found)
        return np.asarray(angle), np.arctan2(y, x)


def _directions(angle: FloatArray, around: FloatArray) -> FloatArray:
    sine = np.sin(angle)
    return np.stack([sine * np.cos(around), sine * np.sin(around), np.cos(angle)], axis=1)


def _tangents(directions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors (n, 3) across each direction and across one another."""
    aside = np.where(np.abs(directions[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    across = np.cross(directions, aside)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return across, np.cross(directions, across)
