"""The budget's check: its inputs drawn and carried through the model itself (JCGM 101).

Each trial errs in every calibrated quantity at once, fits the pose of the board again, predicts the
false shift by its own rig, and takes off what its own fixed targets show. Nothing is linear here
but the gain of those, which the program takes from its covariances, too.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from core.analysis.budget import COVERAGE, Budget, BudgetModel, coverage_factor
from core.arrays import FloatArray
from core.checkerboard.resection import BoardView, resect
from core.geometry.lens import Lens
from core.rig.calibrated_site import CalibratedSite
from core.rig.calibrated_target import CalibratedTarget
from core.rig.propagation import geometry_errors, predict_shift_of, turned_B
from core.rig.rigid import Rig
from core.rig.stability import total_covariance
from core.site import MAIN

AGREEMENT = 0.05
"""Relative difference up to which budget and Monte Carlo agree."""
_BLOCK = 500
"""Trials after which it is asked whether that is decided, as JCGM 101, 7.9, adds block to block."""


@dataclass(frozen=True, slots=True)
class MonteCarlo:
    """What the trials gave, beside the budget; (2,) of x and y."""

    trials: int
    sigma_mm: FloatArray
    """Standard deviation of the trials."""
    half_width_mm: FloatArray
    """Half of the probabilistically symmetric interval that holds 95.45 % of them."""
    budget_sigma_mm: FloatArray

    @property
    def ratio(self) -> FloatArray:
        """Standard deviation of the trials over the budget's."""
        return np.asarray(self.sigma_mm / self.budget_sigma_mm)

    @property
    def interval_ratio(self) -> FloatArray:
        """Half width over the budget's, for the normal distribution that the inputs have."""
        return np.asarray(self.half_width_mm / (coverage_factor(math.inf) * self.budget_sigma_mm))

    @property
    def statistical(self) -> float:
        """Relative standard error of the trials' standard deviation."""
        return 1.0 / math.sqrt(2.0 * max(self.trials - 1, 1))

    @property
    def agrees(self) -> bool:
        """Whether both axes agree within 5 %."""
        return bool((np.abs(self.ratio - 1.0) <= AGREEMENT).all())


def monte_carlo(
    budget: Budget,
    trials: int,
    rng: np.random.Generator,
    tell: Callable[[int, int], None] = lambda _done, _total: None,
    *,
    all_trials: bool = False,
) -> MonteCarlo | None:
    """Draw the inputs of a budget and carry them through the model; None with the paper's method.

    It ends after `trials`, or before, once the agreement within 5 % is decided by twice the
    statistical error, unless `all_trials` are wanted. tell hears how many trials are done, and of
    how many.
    """
    model = budget.model
    if not isinstance(model.calibrated.model, Rig):
        return None
    truth = _Truth.of(model)
    datum_root = _root(model.datum_mm2)
    budget_sigma_mm = np.sqrt(np.diag(budget.covariance_mm2))
    errors: list[FloatArray] = []
    while len(errors) < trials:
        errors.append(_trial(model, truth, rng) + datum_root @ rng.standard_normal(2))
        tell(len(errors), trials)
        if all_trials or len(errors) % _BLOCK:
            continue
        if _is_decided(np.array(errors), budget_sigma_mm):
            break
    drawn, tail = np.array(errors), 0.5 * (1.0 - COVERAGE)
    low, high = np.quantile(drawn, [tail, 1.0 - tail], axis=0)
    return MonteCarlo(len(drawn), drawn.std(axis=0, ddof=1), 0.5 * (high - low), budget_sigma_mm)


def _is_decided(errors: FloatArray, budget_sigma_mm: FloatArray) -> bool:
    """Whether the ratios are clearly within 5 %, or one of them is clearly not."""
    away = np.abs(errors.std(axis=0, ddof=1) / budget_sigma_mm - 1.0)
    doubt = 2.0 / math.sqrt(2.0 * (len(errors) - 1))
    return bool((away + doubt <= AGREEMENT).all() or (away - doubt > AGREEMENT).any())


@dataclass(frozen=True, slots=True)
class _Truth:
    """What the images of a row show where nothing errs, and the roots of the covariances."""

    discs_px: tuple[FloatArray, ...]
    """(n, 2) of each target, at rest."""
    view: BoardView
    motion_root: FloatArray
    state_root: FloatArray
    corner_roots: FloatArray
    """(n, 2, 2) of the corners seen."""
    disc_roots: tuple[FloatArray, ...]

    @classmethod
    def of(cls, model: BudgetModel) -> _Truth:
        calibrated = model.calibrated
        discs = tuple(
            target.reference_px[c.which] + c.prediction.shift_px
            for target, c in zip(model.targets, model.combinations, strict=True)
        )
        own = calibrated.posterior.own_mm2[model.view.index]
        return cls(
            discs,
            model.view,
            _root(model.row.motion_covariance),
            _root(total_covariance(model.terms)),
            np.array([_root(each) for each in own]),
            tuple(_root(each) for each in model.disc_px2),
        )


def _root(covariance: FloatArray) -> FloatArray:
    """A matrix whose product with its transpose is a covariance, which may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _trial(model: BudgetModel, truth: _Truth, rng: np.random.Generator) -> FloatArray:
    """(2,) the error of one trial's displacement, mm."""
    z = rng.standard_normal((model.calibrated.posterior.lens.shape[1],))
    calibrated = _erring(model.calibrated, truth, z, rng)
    images = _changed_images(model, truth, rng)
    pose = resect(
        calibrated.lens,
        calibrated.corners_mm,
        truth.view,
        model.row.motion.compose(model.calibrated.reference_pose),
        settled=1e-8,
    ).pose
    motion = pose.compose(calibrated.reference_pose.inverse())
    motion = motion.perturbed(truth.motion_root @ rng.standard_normal(6))
    values, datum_mm = np.empty(len(model.own_mm)), model.datum_by_calibration_mm @ z
    plainness = rng.standard_normal(2)
    further = {target.name: target for target in calibrated.further}
    for number, (combination, rows) in enumerate(zip(model.combinations, model.rows, strict=True)):
        name, which = combination.target.name, combination.which
        target = calibrated.main_target if name == MAIN else _distance(further[name], rng)
        prediction = predict_shift_of(calibrated, target, which, motion)
        noise = rng.standard_normal((len(which), 2)) @ truth.disc_roots[number].T
        if name != MAIN:
            sigma_px = np.sqrt(target.reference_px2[which])[:, None]
            of_reference = sigma_px * rng.standard_normal((len(which), 2))
            datum_mm = datum_mm - model.datum_by_places_mm[:, rows] @ combination.of(of_reference)
            noise = noise + of_reference
        miss = images[number] + noise - target.reference_px[which] - prediction.shift_px
        values[rows] = combination.of(miss)
        values[rows] += geometry_errors([replace(combination, prediction=prediction)]) @ plainness
        shift = slice(rows.start, rows.start + 2)
        B = turned_B(calibrated, target, motion)
        values[shift] = np.linalg.solve(B, values[shift])
    values += model.own_mm * rng.standard_normal(len(values))
    return np.asarray(model.keep_mm @ np.linalg.inv(model.to_mm) @ values + datum_mm)


def _erring(
    calibrated: CalibratedSite, truth: _Truth, z: FloatArray, rng: np.random.Generator
) -> CalibratedSite:
    """A calibration that errs as its posterior says, by its columns' draws z (r,)."""
    posterior, index = calibrated.posterior, truth.view.index
    corners_mm = calibrated.corners_mm + posterior.corners @ z
    own = truth.corner_roots @ rng.standard_normal((len(index), 2, 1))
    corners_mm[index, :2] += own[:, :, 0]
    lens = Lens(calibrated.lens.parameters + posterior.lens @ z, calibrated.lens.model)
    assert isinstance(calibrated.model, Rig)  # noqa: S101 - else there are no trials
    return replace(
        calibrated,
        corners_mm=corners_mm,
        lens=lens,
        reference_pose=calibrated.reference_pose.perturbed(posterior.reference @ z),
        reference_discs_px=calibrated.reference_discs_px + posterior.discs @ z,
        model=calibrated.model.perturbed(posterior.model @ z),
    )


def _changed_images(
    model: BudgetModel, truth: _Truth, rng: np.random.Generator
) -> list[FloatArray]:
    """Where the discs are once the state has changed: turned, scaled and shifted."""
    state = truth.state_root @ rng.standard_normal(len(truth.state_root))
    centre, main_mm = model.site.main.centre_px, model.site.main_target.distance_mm
    roll, scale = float(state[2]), 1.0 + float(state[3])
    turn = scale * np.array([[math.cos(roll), -math.sin(roll)], [math.sin(roll), math.cos(roll)]])
    images = []
    for at_rest, place, target in zip(truth.discs_px, model.places_px, model.targets, strict=True):
        displaced = place - at_rest.mean(axis=0)
        points = centre + (at_rest + displaced - centre) @ turn.T - displaced
        bent = state[4:] * (target.distance_mm or main_mm) / main_mm
        images.append(points + state[:2] + bent)
    return images


def _distance(target: CalibratedTarget, rng: np.random.Generator) -> CalibratedTarget:
    """A further target whose surveyed distance errs."""
    share = target.distance_sigma_mm / target.distance_mm * rng.standard_normal()
    return replace(target, distance_mm=target.distance_mm * math.exp(share))
