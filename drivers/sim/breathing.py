"""What temperature and time do to the rig: the cameras turn against each other, images shift.

All of it counts from the settings' `start_utc`, before which everything rests.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np

from core.arrays import FloatArray
from core.geometry.pose import Pose
from core.site import CameraGeometry
from drivers.sim.climate import DAY_S, TrueClimate
from drivers.sim.geometry import TrueBoard, TrueLens
from drivers.sim.settings import SimSettings

AIR_INDEX_PER_K = -1e-6
"""dn/dT of air at about 15 degrees C and visible light; Ciddor, Appl. Opt. 35 (1996)."""


@dataclass(frozen=True, slots=True)
class Breath:
    """How far everything has changed since the start."""

    T_CM_CM0: Pose
    """Turn of the main camera about its optical centre, against the sub-camera."""
    main_shift_px: FloatArray
    """(2,) of the main camera's principal point."""
    main_scale: float
    """Of the main camera's focal length, 1 at the start."""
    sub_shift_px: FloatArray
    """(2,) of the sub-camera's principal point."""
    T_WS0_WS: Pose
    """Where the board sits, as against where it was bonded."""
    board_scale: float
    gradient_k_per_m: float
    """Of the air: warmer above."""

    def main_lens(self, lens: TrueLens) -> TrueLens:
        """Give the main camera's lens as it is now; the same object where nothing has changed."""
        return _changed(lens, self.main_shift_px, self.main_scale)

    def sub_lens(self, lens: TrueLens) -> TrueLens:
        """Give the sub-camera's lens likewise."""
        return _changed(lens, self.sub_shift_px, 1.0)

    def board(self, board: TrueBoard) -> TrueBoard:
        """Give the board as large as it is now, grown about its middle."""
        if self.board_scale == 1.0:
            return board
        x, y = board.x_lines_mm, board.y_lines_mm
        return replace(
            board,
            x_lines_mm=_grown(x, 0.5 * (x[0] + x[-1]), self.board_scale),
            y_lines_mm=_grown(y, 0.5 * (y[0] + y[-1]), self.board_scale),
        )

    def bending_mm(self, distance_mm: float) -> FloatArray:
        """(3,) in WM, how far the air makes a plate at this distance seem to be displaced.

        A ray bends towards the denser, colder air: y = -1/2 dn/dT G d^2, up where it is warmer
        above.
        """
        distance_m = distance_mm / 1000.0
        up_m = -0.5 * AIR_INDEX_PER_K * self.gradient_k_per_m * distance_m**2
        return np.array([0.0, 1000.0 * up_m, 0.0])


class TrueBreathing:
    """The breath at any time after the start, from the climate and random walks of the seed."""

    def __init__(self, settings: SimSettings, climate: TrueClimate, board: TrueBoard) -> None:
        self._breathing = settings.breathing
        self._seed = settings.seed
        self._climate = climate
        self._start_utc = settings.start_utc
        x, y = board.x_lines_mm, board.y_lines_mm
        self._middle_mm = np.array([0.5 * (x[0] + x[-1]), 0.5 * (y[0] + y[-1]), 0.0])
        fixed = settings.breathing.board_fixed_mm
        self._fixed_mm = self._middle_mm if fixed is None else np.append(fixed, 0.0)

    def at(self, t_utc: datetime) -> Breath:
        """Give the breath at a time not before the start."""
        breathing, climate, start_utc = self._breathing, self._climate, self._start_utc
        days = (t_utc - start_utc).total_seconds() / DAY_S
        main_k = climate.camera_c("main", t_utc) - climate.camera_c("main", start_utc)
        sub_k = climate.camera_c("sub", t_utc) - climate.camera_c("sub", start_utc)
        air_k = climate.air_c(t_utc) - climate.air_c(start_utc)
        creep = random_walk([self._seed, 11], days, 6)
        cameras_urad = np.multiply(breathing.cameras_urad_per_k, main_k)
        cameras_urad += np.multiply(breathing.cameras_urad_per_sqrt_day, creep[:3])
        board_urad = np.multiply(breathing.board_urad_per_k, air_k)
        board_urad += np.multiply(breathing.board_urad_per_sqrt_day, creep[3:])
        growth = 1e-6 * breathing.board_ppm_per_k * air_k
        day = climate.day_wave(t_utc) - climate.day_wave(start_utc)
        return Breath(
            T_CM_CM0=Pose.from_vectors(1e-6 * cameras_urad, np.zeros(3)),
            main_shift_px=np.multiply(breathing.main_px_per_k, main_k),
            main_scale=1.0 + 1e-6 * breathing.main_scale_ppm_per_k * main_k,
            sub_shift_px=np.multiply(breathing.sub_px_per_k, sub_k),
            T_WS0_WS=self._board_moved(1e-6 * board_urad, growth),
            board_scale=1.0 + growth,
            gradient_k_per_m=-breathing.air_gradient_k_per_m * day,
        )

    def _board_moved(self, turn_rad: FloatArray, growth: float) -> Pose:
        """Turn and growth about the point that stays; the growth moves the middle away from it."""
        turn = Pose.from_vectors(turn_rad, np.zeros(3))
        pushed_mm = growth * (self._middle_mm - self._fixed_mm)
        return Pose(turn.R, self._fixed_mm + turn.R @ (pushed_mm - self._fixed_mm))


def pose_by_shift(
    lens: TrueLens, camera: CameraGeometry, T_CS_WS: Pose, board: TrueBoard, shift_px: FloatArray
) -> FloatArray:
    """(6,) change of the board's pose, as `Pose.perturbed` has it, that a shifted image looks like.

    Without distortion of the lens that is a translation only. With distortion, which shifts along
    with the principal point, part of the shift looks like a turn: for k1 = -0.09, 4 urad in 0.02 px
    of a 6 mm lens. To first order, least squares over the corners in view.
    """
    corners_mm = board.corners_mm().reshape(-1, 3)
    seen_px = lens.project(T_CS_WS.apply(corners_mm))
    in_view = np.all((seen_px > 0.0) & (seen_px < 2.0 * camera.centre_px), axis=1)
    steps = np.diag([1e-5, 1e-5, 1e-5, 1e-3, 1e-3, 1e-3])
    columns = [
        lens.project(T_CS_WS.perturbed(step).apply(corners_mm[in_view]))
        - lens.project(T_CS_WS.perturbed(-step).apply(corners_mm[in_view]))
        for step in steps
    ]
    J = np.stack([column.ravel() for column in columns], axis=1) / (2.0 * steps.sum(axis=0))
    return np.asarray(np.linalg.lstsq(J, np.tile(shift_px, int(in_view.sum())), rcond=None)[0])


def random_walk(seed: Sequence[int], days: float, components: int) -> FloatArray:
    """Walks (components,) of 1 sigma in a day after so many days; straight within a day."""
    whole = math.floor(days)
    steps = np.random.default_rng(seed).standard_normal((whole + 1, components))
    steps[whole] *= days - whole
    return np.asarray(steps.sum(axis=0))


def _changed(lens: TrueLens, shift_px: FloatArray, scale: float) -> TrueLens:
    if scale == 1.0 and not shift_px.any():
        return lens
    return replace(
        lens,
        fx_px=lens.fx_px * scale,
        fy_px=lens.fy_px * scale,
        cx_px=lens.cx_px + float(shift_px[0]),
        cy_px=lens.cy_px + float(shift_px[1]),
    )


def _grown(lines_mm: FloatArray, middle_mm: float, scale: float) -> FloatArray:
    return np.asarray(middle_mm + scale * (lines_mm - middle_mm))
