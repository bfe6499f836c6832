"""How far the main target has moved from one calibration's reference to another's.

With the board bonded again, a lens changed or a camera replaced, the sub-camera no longer knows how
the pair moved between the two references. A fixed target that both show does: what has moved
beside it in the main image is the bridge.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from core.arrays import FloatArray
from core.results import Displacement
from core.rig.calibrated_site import CalibratedSite
from core.rig.calibrated_target import CalibratedTarget
from core.rig.reference_errors import Gains
from core.rig.stability import main_scale
from core.rig.travel import Travel
from core.site import Site

_UNKNOWN_PX, _UNKNOWN_TURN = 1e5, 1.0
"""1 sigma of the shift (px), and of the turn (rad) and change of scale, of the main image between
two references: nothing is known of them."""
_ROUNDS = 4
"""Of Gauss and Newton: a replaced camera may be rolled by degrees."""
_LEAST_DISCS = 2
"""Of a fixed target, to tell shift, turn and scale."""


@dataclass(frozen=True, slots=True)
class _Pair:
    """One target's discs in both references."""

    old_px: FloatArray
    new_px: FloatArray
    px2: FloatArray
    """(n,) variance of a coordinate, of both together."""
    distance_mm: float
    stable_mm: float
    """0 of a target that moves."""
    B: FloatArray
    """(2, 2) in the old reference."""
    name: str


@dataclass(frozen=True, slots=True)
class Moved:
    """How far a target has moved between two references."""

    displacement: Displacement
    gains: Gains
    """What is taken off it for each target's shift (mm), turn and scale at the new reference, but
    for its own shift; at the old one the same, with the opposite sign."""


def through_fixed_targets(
    old: CalibratedSite, new: CalibratedSite, site: Site, travel: Travel | None = None
) -> dict[str, Moved] | None:
    """Displacements of the moving targets at the new reference, from where they were at the old.

    The main image may have shifted, turned and changed its scale by any amount. The pair may have
    moved, which by parallax shifts targets at other distances otherwise: as travel says, or else
    by the expected drift. None where no fixed target is in both references. Keys are the targets'
    names.
    """
    travel = travel or Travel(np.zeros(2), site.quality.expected_drift_mm)
    stable_mm = {extra.name: extra.stable_mm for extra in site.extra_targets}
    earlier = {target.name: target for target in (old.main_target, *old.further)}
    pairs = [
        _pair(earlier[target.name], target, stable_mm.get(target.name, 0.0), old, new)
        for target in (new.main_target, *new.further)
        if target.name in earlier
    ]
    fixed_names = {target.name for target in new.further if target.is_fixed}
    fixed = [p for p in pairs if p.name in fixed_names and len(p.old_px) >= _LEAST_DISCS]
    moving = [p for p in pairs if p.name not in fixed_names and len(p.old_px)]
    if not fixed or not moving:
        return None
    focal_px = main_scale(old.B) * site.main_target.distance_mm
    return _solve(fixed, moving, site, focal_px, travel)


def _pair(
    old: CalibratedTarget,
    new: CalibratedTarget,
    stable_mm: float,
    before: CalibratedSite,
    after: CalibratedSite,
) -> _Pair:
    both = np.isfinite(old.reference_px).all(axis=1) & np.isfinite(new.reference_px).all(axis=1)
    px2 = _disc_px2(old, before) + _disc_px2(new, after)
    return _Pair(
        old.reference_px[both],
        new.reference_px[both],
        px2[both],
        new.distance_mm,
        stable_mm,
        old.B,
        new.name,
    )


def _disc_px2(target: CalibratedTarget, site: CalibratedSite) -> FloatArray:
    """(n,) variance of a coordinate of each disc in a reference."""
    if target.role is not None:
        return target.reference_px2
    return np.asarray((site.posterior.discs**2).sum(axis=(1, 2)) / 2.0)


def _solve(
    fixed: Sequence[_Pair],
    moving: Sequence[_Pair],
    site: Site,
    focal_px: float,
    travel: Travel,
) -> dict[str, Moved]:
    """Least squares: shift, turn, scale, parallax, own shifts of the fixed, and of the moving."""
    everyone = [*fixed, *moving]
    n = 6 + 2 * len(everyone)
    prior = np.array(
        [_UNKNOWN_PX] * 2
        + [_UNKNOWN_TURN] * 2
        + [travel.sigma_mm] * 2
        + [value for p in fixed for value in [_own_px(p)] * 2]
        + [_UNKNOWN_PX] * 2 * len(moving)
    )
    centre_px, near_mm = site.main.centre_px, site.main_target.distance_mm
    start = np.concatenate([np.zeros(4), travel.mm, np.zeros(n - 6)])
    state = start
    for _ in range(_ROUNDS):
        normal, right = np.diag(prior**-2.0), (start - state) / prior**2
        for k, pair in enumerate(everyone):
            model, jacobian = _model(state, k, pair, centre_px, focal_px, near_mm)
            weight = np.repeat(1.0 / pair.px2, 2)
            normal += (jacobian.T * weight) @ jacobian
            right += (jacobian.T * weight) @ (pair.new_px - model).ravel()
        state = state + np.linalg.solve(normal, right)
    covariance = np.linalg.inv(normal)
    scaled = (1.0 + state[3]) * _rotation(state[2])
    found = {}
    for k, pair in enumerate(moving, start=len(fixed)):
        own = slice(6 + 2 * k, 8 + 2 * k)
        to_mm = np.linalg.inv(scaled @ pair.B)
        displacement = Displacement(to_mm @ state[own], to_mm @ covariance[own, own] @ to_mm.T)
        by_state = to_mm @ covariance[own]
        gains = {
            one.name: _gain(by_state, _model(state, at, one, centre_px, focal_px, near_mm)[1], one)
            for at, one in enumerate(everyone)
        }
        gains[pair.name] += np.eye(2, 4)  # its own shift is what has moved
        found[pair.name] = Moved(displacement, gains)
    return found


def _gain(by_state: FloatArray, jacobian: FloatArray, pair: _Pair) -> FloatArray:
    """(2, 4) of `Gains`: how the estimate follows a target's discs, moved together.

    by_state (2, states) is to mm times the rows of the states' covariance.
    """
    by_discs = by_state @ jacobian.T / np.repeat(pair.px2, 2)
    x, y = (pair.new_px - pair.new_px.mean(axis=0)).T
    ones, nothing = np.ones(len(x)), np.zeros(len(x))
    shifts = np.stack([np.stack([ones, nothing], axis=1), np.stack([nothing, ones], axis=1)])
    turn_and_scale = np.stack([np.stack([-y, x], axis=1), np.stack([x, y], axis=1)])
    together = np.concatenate([np.einsum("km,knc->mnc", pair.B, shifts), turn_and_scale])
    return np.asarray(-by_discs @ together.reshape(4, -1).T)


def _own_px(pair: _Pair) -> float:
    """1 sigma of a fixed target's own movement, px; not quite 0, which has no inverse."""
    return max(pair.stable_mm, 1e-6) * main_scale(pair.B)


def _rotation(turn_rad: float) -> FloatArray:
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    return np.array([[c, -s], [s, c]])


def _model(
    state: FloatArray,
    k: int,
    pair: _Pair,
    centre_px: FloatArray,
    focal_px: float,
    near_mm: float,
) -> tuple[FloatArray, FloatArray]:
    """Places (n, 2) of a target's discs in the new reference, and d(places) (2 n, m)."""
    turned = (pair.old_px - centre_px) @ _rotation(state[2]).T
    # A shift of the pair moves all images alike but for this: the rest is in the common shift.
    parallax = focal_px * (1.0 / pair.distance_mm - 1.0 / near_mm)
    own = state[6 + 2 * k : 8 + 2 * k]
    model = centre_px + state[:2] + (1.0 + state[3]) * turned + parallax * state[4:6] + own
    jacobian = np.zeros((len(turned), 2, len(state)))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1.0
    jacobian[:, :, 2] = (1.0 + state[3]) * np.stack([-turned[:, 1], turned[:, 0]], axis=1)
    jacobian[:, :, 3] = turned
    jacobian[:, 0, 4] = jacobian[:, 1, 5] = parallax
    jacobian[:, 0, 6 + 2 * k] = jacobian[:, 1, 7 + 2 * k] = 1.0
    return model, jacobian.reshape(-1, len(state))
