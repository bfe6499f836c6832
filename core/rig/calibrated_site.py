"""The calibrated state of a site: what every measurement is computed with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from core.arrays import FloatArray
from core.checkerboard.board import Board
from core.checkerboard.board_shape import shape_terms
from core.geometry.lens import Lens
from core.geometry.pose import Pose
from core.lens_model import LensModel
from core.rig.calibrated_target import CalibratedTarget, points_from_json, points_to_json
from core.rig.paper import PaperModel
from core.rig.posterior import Posterior
from core.rig.rigid import Rig
from core.site import MAIN


@dataclass(frozen=True, slots=True)
class Baseline:
    """How the images looked and fitted at calibration: what later frames are held against."""

    sub_rms_px: float
    sub_contrast_dn: float
    sub_blur_px: float
    main_contrast_dn: float
    main_blur_px: float
    max_rotation_rad: float
    """Largest rotation among the calibration's motions."""
    max_translation_mm: float


@dataclass(frozen=True, slots=True)
class CalibratedSite:
    """Lens, board, reference and rig as calibrated."""

    board: Board
    """As drawn."""
    corners_mm: FloatArray
    """(corners, 3) as estimated."""
    lens: Lens
    reference_pose: Pose
    """`T_CS1_WS`."""
    reference_discs_px: FloatArray
    """(discs, 2) in the reference image, NaN for a disc not seen there."""
    B: FloatArray
    """(2, 2) B~ of Eq. 8, px/mm."""
    model: Rig | PaperModel
    posterior: Posterior
    """How far all of this can be trusted."""
    baseline: Baseline
    further: tuple[CalibratedTarget, ...] = ()
    """The further targets that the reference shows."""

    @property
    def main_target(self) -> CalibratedTarget:
        """The main target as the further ones are."""
        nothing = np.zeros(len(self.reference_discs_px))
        depth_mm = self.model.depth_mm if isinstance(self.model, Rig) else 0.0
        return CalibratedTarget(MAIN, None, self.reference_discs_px, nothing, self.B, depth_mm, 0.0)

    @property
    def shape_terms(self) -> FloatArray:
        """d(corner)/d(shape), (corners, 3, 13)."""
        return shape_terms(self.board)

    def to_dict(self) -> dict[str, Any]:
        """Give plain JSON types; NaN becomes null."""
        further = [target.to_dict() for target in self.further]
        return {
            "board": [
                self.board.columns + 1,
                self.board.rows + 1,
                self.board.square_mm,
            ],
            "corners_mm": self.corners_mm.tolist(),
            "lens": {"model": self.lens.model, "parameters": self.lens.parameters.tolist()},
            "reference_pose": _pose_to_dict(self.reference_pose),
            "reference_discs_px": points_to_json(self.reference_discs_px),
            "B": self.B.tolist(),
            "model": _model_to_dict(self.model),
            "posterior": self.posterior.to_dict(),
            "levels": {name: getattr(self.baseline, name) for name in Baseline.__slots__},
            **({"further": further} if further else {}),
        }

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> CalibratedSite:
        """Read what `to_dict` gave. Raises KeyError or ValueError on anything else."""
        squares_x, squares_y, square_mm = data["board"]
        return cls(
            Board.of_squares(int(squares_x), int(squares_y), square_mm),
            np.array(data["corners_mm"]),
            _lens_from_dict(data["lens"]),
            _pose_from_dict(data["reference_pose"]),
            points_from_json(data["reference_discs_px"]),
            np.array(data["B"]),
            _model_from_dict(data["model"]),
            Posterior.from_dict(data["posterior"]),
            Baseline(**data["levels"]),
            tuple(CalibratedTarget.from_dict(target) for target in data.get("further", ())),
        )


def _lens_from_dict(data: dict[str, Any]) -> Lens:
    return Lens(np.array(data["parameters"]), LensModel(data["model"]))


def _pose_to_dict(pose: Pose) -> dict[str, Any]:
    return {"R": pose.R.tolist(), "t_mm": pose.t_mm.tolist()}


def _pose_from_dict(data: dict[str, Any]) -> Pose:
    return Pose(np.array(data["R"]), np.array(data["t_mm"]))


def _model_to_dict(model: Rig | PaperModel) -> dict[str, Any]:
    if isinstance(model, Rig):
        return {
            "kind": "rigid",
            "T_CM_CS": _pose_to_dict(model.T_CM_CS),
            "depth_mm": model.depth_mm,
            "scale_px_per_mm": model.scale_px_per_mm,
            "centre_px": model.centre_px.tolist(),
        }
    return {
        "kind": "paper",
        "B": model.B.tolist(),
        "p_mm": model.p_mm.tolist(),
        "covariance": model.covariance.tolist(),
        "singular_values": model.singular_values.tolist(),
    }


def _model_from_dict(data: dict[str, Any]) -> Rig | PaperModel:
    if data["kind"] == "rigid":
        return Rig(
            _pose_from_dict(data["T_CM_CS"]),
            data["depth_mm"],
            data["scale_px_per_mm"],
            np.array(data["centre_px"]),
        )
    if data["kind"] != "paper":
        msg = f"unknown kind of model {data['kind']!r}"
        raise ValueError(msg)
    return PaperModel(
        np.array(data["B"]),
        np.array(data["p_mm"]),
        np.array(data["covariance"]),
        np.array(data["singular_values"]),
    )
