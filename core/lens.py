"""The sub-camera's lens: pinhole with skew (Eq. 10) and Brown-Conrady distortion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.site import FloatArray

LENS_PARAMETERS = ("alpha", "beta", "gamma", "mu", "nu", "k1", "k2", "p1", "p2", "k3")


@dataclass(frozen=True, slots=True)
class Lens:
    """Intrinsics of one camera, in the paper's symbols (Eq. 10), with distortion.

    u = alpha x'' + gamma y'' + mu, v = beta y'' + nu, where (x'', y'') is the distorted
    normalised image point (Brown 1971, as in OpenCV's five-parameter model).
    """

    parameters: FloatArray
    """(10,) in the order of LENS_PARAMETERS; px for the first five."""

    @classmethod
    def pinhole(cls, focal_px: float, centre_px: tuple[float, float]) -> Lens:
        """Build an undistorted lens."""
        mu, nu = centre_px
        return cls(np.array([focal_px, focal_px, 0.0, mu, nu, 0.0, 0.0, 0.0, 0.0, 0.0]))

    @property
    def matrix(self) -> FloatArray:
        """(3, 3) intrinsic matrix A of Eq. 10."""
        alpha, beta, gamma, mu, nu = self.parameters[:5]
        return np.array([[alpha, gamma, mu], [0.0, beta, nu], [0.0, 0.0, 1.0]])

    def distort(self, xy: FloatArray) -> FloatArray:
        """Distort normalised points (n, 2)."""
        k1, k2, p1, p2, k3 = self.parameters[5:]
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return np.stack(
            [
                x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
            ],
            axis=1,
        )

    def distort_jacobian(self, xy: FloatArray) -> FloatArray:
        """d(distorted)/d(normalised), (n, 2, 2)."""
        k1, k2, p1, p2, k3 = self.parameters[5:]
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
        jacobian = np.empty((len(xy), 2, 2))
        jacobian[:, 0, 0] = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
        jacobian[:, 0, 1] = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
        jacobian[:, 1, 0] = jacobian[:, 0, 1]
        jacobian[:, 1, 1] = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
        return jacobian

    def project(self, points_mm: FloatArray) -> FloatArray:
        """Project points in the camera frame (n, 3) to pixels (n, 2)."""
        return self.to_pixels(self.distort(points_mm[:, :2] / points_mm[:, 2:]))

    def to_pixels(self, distorted: FloatArray) -> FloatArray:
        """Apply the intrinsic matrix to distorted normalised points (n, 2)."""
        alpha, beta, gamma, mu, nu = self.parameters[:5]
        u = alpha * distorted[:, 0] + gamma * distorted[:, 1] + mu
        return np.stack([u, beta * distorted[:, 1] + nu], axis=1)

    def project_jacobians(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Project points (n, 3), with d(px)/d(point) (n, 2, 3) and d(px)/d(lens) (n, 2, 10)."""
        alpha, beta, gamma = self.parameters[:3]
        z = points_mm[:, 2]
        xy = points_mm[:, :2] / z[:, None]
        distorted = self.distort(xy)
        to_px = np.array([[alpha, gamma], [0.0, beta]])
        by_xy = to_px @ self.distort_jacobian(xy)
        by_point = np.empty((len(z), 2, 3))
        by_point[:, :, :2] = by_xy / z[:, None, None]
        by_point[:, :, 2] = -(by_xy @ xy[:, :, None])[:, :, 0] / z[:, None]
        by_lens = np.zeros((len(z), 2, 10))
        by_lens[:, 0, 0] = distorted[:, 0]
        by_lens[:, 1, 1] = distorted[:, 1]
        by_lens[:, 0, 2] = distorted[:, 1]
        by_lens[:, 0, 3] = 1.0
        by_lens[:, 1, 4] = 1.0
        by_lens[:, :, 5:] = to_px @ _distortion_terms(xy)
        return self.to_pixels(distorted), by_point, by_lens

    def normalise(self, pixels: FloatArray, iterations: int = 30) -> FloatArray:
        """Undo lens and intrinsics: pixels (n, 2) to normalised image points (n, 2), by Newton."""
        alpha, beta, gamma, mu, nu = self.parameters[:5]
        y = (pixels[:, 1] - nu) / beta
        target = np.stack([(pixels[:, 0] - mu - gamma * y) / alpha, y], axis=1)
        xy = target.copy()
        for _ in range(iterations):
            miss = self.distort(xy) - target
            step = np.linalg.solve(self.distort_jacobian(xy), miss[:, :, None])[:, :, 0]
            np.clip(step, -0.3, 0.3, out=step)
            xy -= step
            if len(step) == 0 or float(np.abs(step).max()) < 1e-13:
                break
        return xy


def _distortion_terms(xy: FloatArray) -> FloatArray:
    """d(distorted)/d(k1, k2, p1, p2, k3), (n, 2, 5)."""
    x, y = xy[:, 0], xy[:, 1]
    r2 = x * x + y * y
    terms = np.empty((len(xy), 2, 5))
    terms[:, 0] = np.stack([x * r2, x * r2**2, 2 * x * y, r2 + 2 * x * x, x * r2**3], 1)
    terms[:, 1] = np.stack([y * r2, y * r2**2, r2 + 2 * y * y, 2 * x * y, y * r2**3], 1)
    return terms
