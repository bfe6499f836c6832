"""What may have changed since the calibration and no image noise shows: the stability budget.

Whatever the two cameras do not share is taken for displacement. To first order all of it is a
common shift of the main image, a roll and a change of scale, and, for the air, a shift in
proportion to the distance. Its 1-sigma follows from the time and the temperature since the
reference; docs/method.md has the figures and their sources.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from core.arrays import FloatArray
from core.geometry.lens import Lens
from core.lens_model import LensModel
from core.moment import Moment
from core.rig.calibrated_target import CalibratedTarget
from core.site import Site

STATE = 6
"""Shift of the main image (2, px), its roll (rad), relative change of scale, and the air's shift
at the main target (2, px)."""
_DAY_S, _MONTH_S = 86_400.0, 30 * 86_400.0
"""A day, and 30 of them, s."""
_SETTLED_S = 6 * 3600.0
"""Time in which temperatures that no camera tells, and the air's gradient, may have left what they
were at the calibration. Chosen: a quarter of the daily wave; steel lags the air by hours."""
DN_DT_PER_K = 9.3e-7
"""Of air at visible light, 15 degrees C and 1013 hPa, with its sign changed (Edlen's equation:
n - 1 = 2.77e-4, falling with 1/T)."""
_HORIZONTAL_SHARE = 0.3
"""Of the air's gradient sideways. Chosen: air lies in layers; beside a warm wall it may be more."""
_USUAL_K1, _USUAL_K2 = -0.09, 0.02
"""Radial distortion of a sub-camera that is not calibrated yet: as a 6 mm lens may have."""
_GRID = 9
"""Points along each side of the image, where its shift is looked at; more change nothing."""
_IN_FRONT = 0.1
"""Cosine from which a ray meets a board that faces the camera."""


@dataclass(frozen=True, slots=True)
class Term:
    """One cause of change."""

    name: str
    """In words, as the end of "... come from"."""
    covariance: FloatArray
    """(6, 6) of the state."""
    advice: str
    """What makes it smaller."""

    def sigma_mm(self, scale_px_per_mm: float) -> float:
        """1 sigma of the main target's displacement, of the larger axis."""
        variance = np.diag(self.covariance)
        return float(np.sqrt((variance[:2] + variance[4:]).max())) / scale_px_per_mm


_STIFFER = "bolt a stiffer plate, or hang a fixed target"
_BOARD = "glue the board to a plate of glass or steel, or hang a fixed target"
_LENS = "shade the main camera, or hang a fixed target"
_SUB_LENS = "shade the sub-camera, take a lens that distorts less, or hang a fixed target"
_AIR = "measure at night, or hang a fixed target"


def budget_sentence(terms: Sequence[Term], scale_px_per_mm: float, image_mm: float) -> str | None:
    """Name the largest cause of a row's sigma; None where the pixels are.

    image_mm is 1 sigma by pixels and calibration. Said of rows that no fixed target corrects.
    """
    shares = [(term.sigma_mm(scale_px_per_mm), term) for term in terms]
    whole_mm = float(np.hypot(image_mm, np.sqrt(sum(sigma**2 for sigma, _ in shares))))
    if not shares or max(shares, key=lambda share: share[0])[0] <= image_mm:
        return None
    largest_mm, term = max(shares, key=lambda share: share[0])
    return (
        f"{largest_mm:.2g} mm of {whole_mm:.2g} mm (1 sigma) come from {term.name}: {term.advice}"
    )


@dataclass(frozen=True, slots=True)
class Prior:
    """What is known of the state before a pair is looked at."""

    mean: FloatArray
    """(6,)."""
    covariance: FloatArray
    """(6, 6)."""


def total_covariance(terms: Sequence[Term]) -> FloatArray:
    """(6, 6) of the state, by all causes."""
    return sum((term.covariance for term in terms), np.zeros((STATE, STATE)))


def main_scale(B: FloatArray) -> float:
    """px/mm of a target by its B~: the largest singular value, along which it is not tilted."""
    return float(np.linalg.svd(B, compute_uv=False)[0])


def turn_by_sub_shift(site: Site, lens: Lens | None = None) -> float:
    """Turn (rad) that the board seems to make when the sub-camera's image shifts by 1 px.

    Of a board that fills the image. Without distortion that looks like a shift, and 0 is left.
    With it the shift is not the same everywhere on the board, and the pose that fits best is
    turned: with k1 alone by some 2.7 k1 of the shift's angle. Without a lens a usual one is taken.
    """
    camera = site.sub
    if lens is None:
        ideal = Lens.ideal(LensModel.RADIAL, camera.focal_px, camera.centre_px)
        lens = ideal.moved(np.array([0.0, 0.0, 0.0, 0.0, 0.0, _USUAL_K1, _USUAL_K2]))
    size_px = camera.width_px, camera.height_px
    return _turn_by_shift(size_px, lens.model, tuple(lens.parameters.tolist()))


@lru_cache(maxsize=8)
def _turn_by_shift(
    size_px: tuple[int, int], model: LensModel, parameters: tuple[float, ...]
) -> float:
    """Of one camera and its lens; rows ask for the same again and again."""
    lens = Lens(np.array(parameters), model)
    across, down = (np.linspace(0.0, n - 1.0, _GRID) for n in size_px)
    rays = lens.rays(np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2))
    rays = rays[rays[:, 2] > _IN_FRONT]
    points = rays / rays[:, 2:]
    _, by_point = lens.project_slopes(points)
    by_turn = np.cross(np.eye(3)[None], points[:, None]).transpose(0, 2, 1)
    by_pose = np.concatenate([by_point @ by_turn, by_point], axis=2).reshape(-1, 6)
    shifts = np.tile(np.eye(2), (len(points), 1))
    turns = np.linalg.lstsq(by_pose, shifts, rcond=None)[0][:2]
    return float(np.sqrt((turns**2).sum() / 2.0))


def stability_terms(
    site: Site,
    scale_px_per_mm: float,
    reference: Moment,
    now: Moment,
    sub_lens: Lens | None = None,
) -> tuple[Term, ...]:
    """What may have changed from one moment to another, cause by cause.

    scale_px_per_mm is the main camera's at the main target; sub_lens as calibrated, where it is.
    """
    budget, focal_px = site.stability, scale_px_per_mm * site.main_target.distance_mm
    age_s = abs(now.utc_s - reference.utc_s)
    days = age_s / _DAY_S
    settled = 1.0 - float(np.exp(-((age_s / _SETTLED_S) ** 2)))
    lens_k, steel_k = _warming(site, reference, now, budget.temperature_range_k * settled)
    elapsed = "a day" if days < 1.5 else f"{days:.0f} days"
    warmed, lens_warmed = f"{abs(steel_k):.1f} K", f"{abs(lens_k):.1f} K"

    def turns(urad_per_k: float, urad_per_sqrt_day: float) -> tuple[float, float]:
        return (1e-6 * urad_per_k * steel_k) ** 2, 1e-12 * urad_per_sqrt_day**2 * days

    def of_turn(rad2: float) -> FloatArray:
        return np.diag([focal_px**2 * rad2, focal_px**2 * rad2, rad2, 0.0, 0.0, 0.0])

    cameras_k, cameras_d = turns(budget.cameras_urad_per_k, budget.cameras_urad_per_sqrt_day)
    board_k, board_d = turns(budget.board_urad_per_k, budget.board_urad_per_sqrt_day)
    half_board_mm = 0.5 * site.sub_target.square_mm * site.sub_target.squares_x
    slide_px = budget.board_expansion_per_k * steel_k * half_board_mm * scale_px_per_mm
    lens_px, lens_scale = budget.main_px_per_k * lens_k, budget.main_scale_per_k * lens_k
    apparent_px = focal_px * turn_by_sub_shift(site, sub_lens) * budget.sub_px_per_k * lens_k
    metres = 1e-3 * site.main_target.distance_mm
    air_mm = 1e3 * 0.5 * DN_DT_PER_K * budget.air_gradient_k_per_m * metres**2 * settled
    air_px2 = (air_mm * scale_px_per_mm) ** 2
    zero = np.zeros(STATE)
    return (
        Term(f"the cameras turning against each other over {warmed}", of_turn(cameras_k), _STIFFER),
        Term(f"the cameras turning against each other in {elapsed}", of_turn(cameras_d), _STIFFER),
        Term(f"the board turning on the pier over {warmed}", of_turn(board_k), _BOARD),
        Term(f"the board turning on the pier in {elapsed}", of_turn(board_d), _BOARD),
        Term(
            f"the board expanding over {warmed}",
            np.diag([slide_px**2, slide_px**2, *zero[2:]]),
            _BOARD,
        ),
        Term(
            f"the main lens warming by {lens_warmed}",
            np.diag([lens_px**2, lens_px**2, 0.0, lens_scale**2, 0.0, 0.0]),
            _LENS,
        ),
        Term(
            f"the sub lens warming by {lens_warmed}",
            np.diag([apparent_px**2, apparent_px**2, *zero[2:]]),
            _SUB_LENS,
        ),
        Term(
            "the air's temperature gradient",
            np.diag([*zero[:4], _HORIZONTAL_SHARE**2 * air_px2, air_px2]),
            _AIR,
        ),
    )


def _warming(site: Site, reference: Moment, now: Moment, unknown_k: float) -> tuple[float, float]:
    """By how much lenses, and steel and board, are warmer than at the reference, K.

    Lenses follow the camera, steel and board the sensor that the site names; the one stands for
    the other where that is not known.
    """

    def change(before: float | None, after: float | None) -> float | None:
        return None if before is None or after is None else after - before

    name = site.temperature_reading or ""
    camera_k = change(reference.temperature_c, now.temperature_c)
    sensor_k = change(reference.readings.get(name), now.readings.get(name))
    known = [kelvin for kelvin in (camera_k, sensor_k) if kelvin is not None]
    return (known[0], known[-1]) if known else (unknown_k, unknown_k)


def season_sentence(
    site: Site, scale_px_per_mm: float, image_mm: float, sub_lens: Lens | None = None
) -> str:
    """Say what a row's sigma becomes a month and a change of temperature after the calibration."""
    later = Moment(_MONTH_S, site.stability.temperature_range_k)
    terms = stability_terms(site, scale_px_per_mm, Moment(0.0, 0.0), later, sub_lens)
    when = f"30 days and {site.stability.temperature_range_k:g} K after the calibration"
    cause = budget_sentence(terms, scale_px_per_mm, image_mm)
    if site.has_fixed_target:
        return f"{when} the fixed targets keep a row's sigma; while they are hidden {cause}"
    return f"{when} {cause}" if cause else f"{when} a row is as good as its pixels"


def state_effects(
    target: CalibratedTarget, place_px: FloatArray, centre_px: FloatArray, main_distance_mm: float
) -> FloatArray:
    """(4, 6): how a target's mean shift (px), turn (rad) and change of scale follow the state.

    place_px (2,) is where it is now: a change of scale changes a displacement, too.
    """
    x, y = place_px - centre_px
    effects = np.zeros((4, STATE))
    effects[:2, :2] = np.eye(2)
    effects[:2, 2] = -y, x
    effects[:2, 3] = x, y
    effects[:2, 4:] = np.eye(2) * target.distance_mm / main_distance_mm
    effects[2, 2] = effects[3, 3] = 1.0
    return effects
