"""The joint covariance of all calibrated quantities that a measurement rests on.

The unknowns are the lens, the model (rig or the paper's nine parameters), the reference (its pose
and its discs) and every corner of the board, some thousand. All are correlated: an error of the
lens or the board acts alike on the reference and on a row, and cancels. So their covariance is kept
whole, as a factor F with covariance F F^T, beside what is left of each corner's own error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from core.arrays import FloatArray, IntArray

_NEGLIGIBLE_PX = 2e-4
"""Effects on a row's false shift below this are dropped."""
_MOST_COLUMNS = 96
"""Of a compressed factor: three times what rows were seen to feel (10 to 30 directions)."""
_RANK_TOLERANCE = 1e-9
"""Singular value over the largest: rows of the factor that depend on one another are found by
it."""
_KNOWN_MM = 1e-6
"""1 sigma of a corner taken as known: small beside any print error, and still invertible."""


@dataclass(frozen=True, slots=True)
class Posterior:
    """Covariance of lens, model, reference and corners: F F^T and the corners' own."""

    lens: FloatArray
    """(lens parameters, r) rows of F."""
    model: FloatArray
    """(8 or 9, r)."""
    reference: FloatArray
    """(6, r) of the reference pose, see Pose.perturbed."""
    discs: FloatArray
    """(discs, 2, r) of the discs' places in the reference image."""
    corners: FloatArray
    """(corners, 3, r)."""
    own_mm2: FloatArray
    """(corners, 2, 2) in the board's plane, independent from corner to corner."""

    @property
    def model_sigma(self) -> FloatArray:
        """(8 or 9,) 1 sigma; of a compressed posterior only what rows see of it."""
        return np.asarray(np.sqrt((self.model**2).sum(axis=1)))

    @property
    def lens_sigma(self) -> FloatArray:
        """(lens parameters,) 1 sigma; of a compressed posterior only what rows see of it."""
        return np.asarray(np.sqrt((self.lens**2).sum(axis=1)))

    def with_model(self, covariance: FloatArray) -> Posterior:
        """Another model, fitted by itself: its errors independent of all others."""
        values, vectors = np.linalg.eigh(covariance)
        own = vectors * np.sqrt(np.maximum(values, 0.0))
        n, r = len(own), self.lens.shape[1]
        corners = np.concatenate([self.corners, np.zeros((len(self.corners), 3, n))], axis=2)
        return Posterior(
            np.concatenate([self.lens, np.zeros((len(self.lens), n))], axis=1),
            np.concatenate([np.zeros((n, r)), own], axis=1),
            np.concatenate([self.reference, np.zeros((6, n))], axis=1),
            np.concatenate([self.discs, np.zeros((len(self.discs), 2, n))], axis=2),
            corners,
            self.own_mm2,
        )

    def transformed(self, matrix: FloatArray) -> Posterior:
        """Each row of F by a matrix (r, s)."""
        flat = self.corners.reshape(-1, len(matrix))  # one product, not one for each corner
        return Posterior(
            self.lens @ matrix,
            self.model @ matrix,
            self.reference @ matrix,
            self.discs @ matrix,
            (flat @ matrix).reshape(*self.corners.shape[:2], matrix.shape[1]),
            self.own_mm2,
        )

    def conditioned_on(self, rows: FloatArray) -> Posterior:
        """The conditional covariance, were the quantities of these rows (k, r) of F known exactly.

        For a posterior that was not compressed.
        """
        scaled = rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-30)
        known = np.linalg.pinv(scaled, rcond=_RANK_TOLERANCE) @ scaled
        return self.transformed(np.eye(len(known)) - known)

    def conditioned_on_board(self) -> Posterior:
        """Likewise if every corner's place on the board were known."""
        flat = self.corners[:, :2].reshape(-1, self.lens.shape[1])
        root = np.linalg.inv(np.linalg.cholesky(self.own_mm2 + _KNOWN_MM**2 * np.eye(2)))
        white = (root @ self.corners[:, :2]).reshape(flat.shape)
        depth = self.corners[:, 2] / _KNOWN_MM
        information = np.eye(flat.shape[1]) + white.T @ white + depth.T @ depth
        left = self.transformed(np.linalg.inv(np.linalg.cholesky(information)).T)
        return replace(left, own_mm2=np.zeros_like(self.own_mm2))

    def compressed(self, sensitivities_px: FloatArray) -> Posterior:
        """Keep what matters, in the precision it is stored with.

        sensitivities_px (m, r) are F's columns seen in rows of many motions.
        """
        _, size, directions = np.linalg.svd(sensitivities_px, full_matrices=False)
        kept = int((size > _NEGLIGIBLE_PX).sum())
        short = self.transformed(directions[: min(max(kept, 1), _MOST_COLUMNS)].T)
        return Posterior(*(_rounded(getattr(short, name)) for name in Posterior.__slots__))

    def to_dict(self) -> dict[str, Any]:
        """Give plain JSON types: single-precision numbers, in hexadecimal."""
        return {name: _pack(getattr(self, name)) for name in Posterior.__slots__}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Posterior:
        """Read what `to_dict` gave. Raises KeyError or ValueError on anything else."""
        return cls(*(_unpack(data[name]) for name in Posterior.__slots__))


@dataclass(frozen=True, slots=True)
class Sensitivities:
    """How a value (k,) changes with everything calibrated."""

    by_lens: FloatArray
    """(k, lens parameters)."""
    by_model: FloatArray
    """(k, 8 or 9)."""
    by_reference: FloatArray
    """(k, 6)."""
    by_discs: FloatArray
    """(k, discs, 2)."""
    index: IntArray
    """(n,) the corners seen."""
    by_corners: FloatArray
    """(k, n, 3)."""
    floor: FloatArray
    """(k, k) covariance of what the model leaves out."""

    def propagate(self, posterior: Posterior) -> FloatArray:
        """(k, r) the value's factor: its covariance is this by its transpose, and `own`."""
        k = len(self.by_lens)
        everywhere = np.zeros((k, *posterior.corners.shape[:2]))
        everywhere[:, self.index] = self.by_corners
        return np.asarray(
            self.by_lens @ posterior.lens
            + self.by_model @ posterior.model
            + self.by_reference @ posterior.reference
            + self.by_discs.reshape(k, -1) @ posterior.discs.reshape(-1, posterior.discs.shape[2])
            + everywhere.reshape(k, -1) @ posterior.corners.reshape(-1, posterior.corners.shape[2])
        )

    def covariance(self, posterior: Posterior) -> FloatArray:
        """(k, k) of the value, from the calibration."""
        factor = self.propagate(posterior)
        return np.asarray(factor @ factor.T + self.own(posterior))

    def own(self, posterior: Posterior) -> FloatArray:
        """(k, k) covariance from the corners' own errors, and the floor."""
        flat = self.by_corners[:, :, :2]
        spread = np.einsum("kna,nab->knb", flat, posterior.own_mm2[self.index])
        return np.asarray(np.einsum("knb,lnb->kl", spread, flat) + self.floor)


def _rounded(array: FloatArray) -> FloatArray:
    return np.asarray(array.astype("<f4"), dtype=float)


def _pack(array: FloatArray) -> dict[str, Any]:
    raw = np.ascontiguousarray(array, dtype="<f4").tobytes()
    return {"shape": list(array.shape), "float32": raw.hex()}


def _unpack(data: dict[str, Any]) -> FloatArray:
    raw = bytes.fromhex(data["float32"])
    return np.frombuffer(raw, dtype="<f4").reshape(data["shape"]).astype(float)
