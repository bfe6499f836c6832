"""What a row and the datum of its calibration have in common: predicted, and drawn at random.

    python -m benchmarks.datum_covariance --trials 2000

No images are rendered: corners and discs are drawn about their true places, references are
measured from them, each later one by the calibration before, and a row by the last. The bridge is
at rest, so that a row in the record's zero is nothing but error.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime

import numpy as np

from core.arrays import FloatArray
from core.checkerboard.board import Board
from core.checkerboard.resection import BoardPose, BoardView, resect
from core.discs.disc_finder import Discs
from core.geometry.lens import Lens
from core.geometry.pose import Pose
from core.lens_model import LensModel
from core.results import Flag, Measurement, TargetMeasurement
from core.rig.calibrated_site import Baseline, CalibratedSite
from core.rig.calibrated_target import CalibratedTarget
from core.rig.closure import close, gains_of, joint_shifts
from core.rig.compensation import SeenTarget, remaining_shifts
from core.rig.datum import through_fixed_targets
from core.rig.posterior import Posterior
from core.rig.reference_errors import ReferenceErrors
from core.rig.reference_places import errors_at_reference
from core.rig.rigid import Rig
from core.rig.stability import Term
from core.rig.travel import Travel
from core.site import (
    MAIN,
    CameraGeometry,
    CheckerboardTarget,
    CirclesTarget,
    ExtraTarget,
    QualityLimits,
    RigPrior,
    Site,
    TargetRole,
)
from daemon.datum.candidates import gains_of as gains_of_row
from daemon.datum.chain import offset_by, origin
from daemon.store.records import DatumMethod, DatumRecord, DatumStep
from daemon.store.rows.datum import in_record_zero

_CORNER_PX, _DISC_PX = 0.02, 0.004
_MAIN_MM, _PLATE_MM = 22000.0, 21500.0
_CENTRES_MM = np.array([[-30.0, 22.0], [30.0, 22.0], [0.0, 0.0], [-30.0, -22.0], [30.0, -22.0]])
_PLATE = "abutment"
_STATE = np.array([0.05, 0.05, 5e-6, 1e-5, 0.003, 0.003])
"""1 sigma of what changes between two references: shift (px), roll, scale, air (px)."""
_TRAVEL_MM = 0.1
_NOW = datetime(2026, 6, 1, tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class Way:
    """How references are linked, and rows measured."""

    name: str
    has_plate: bool
    by_plate: bool = False
    """Whether the board is bonded again each time, and the fixed plate links the references."""


WAYS = (
    Way("no fixed plate, by the calibration before", has_plate=False),
    Way("a fixed plate, by the calibration before", has_plate=True),
    Way("through the fixed plate", has_plate=True, by_plate=True),
)


@dataclass(frozen=True, slots=True)
class Drawn:
    """One trial: a row in the record's zero, in which nothing has moved."""

    row_mm: FloatArray
    """(2,) by its own calibration."""
    datum_mm: FloatArray
    """(2,)."""
    row_mm2: FloatArray
    """(2, 2) predicted, likewise the next ones."""
    datum_mm2: FloatArray
    sum_mm2: FloatArray


@dataclass(frozen=True, slots=True)
class _Pair:
    """What the cameras have seen of one instant."""

    view: BoardView
    discs: tuple[FloatArray, ...]
    """(5, 2) px of each target."""


def make_site(*, has_plate: bool) -> Site:
    """A site at 22 m, with a fixed plate 108 mm beside the main target or without."""
    near = CirclesTarget(_CENTRES_MM, np.full(5, 16.0), _MAIN_MM, 20.0)
    beside = CirclesTarget(0.5 * _CENTRES_MM, np.full(5, 8.0), _PLATE_MM, 20.0)
    extra = ExtraTarget(_PLATE, TargetRole.FIXED, beside)
    return Site(
        CameraGeometry(960, 600, 11.72, 800.0),
        CameraGeometry(640, 400, 11.72, 6.0),
        near,
        CheckerboardTarget(12, 9, 5.0, 50.0),
        RigPrior(np.array([0.0, 180.0, 0.0]), 1.0, np.array([0.0, 0.0, -80.0]), 3.0),
        QualityLimits(),
        extra_targets=(extra,) if has_plate else (),
    )


class _World:
    """The true rig, and images of it with their noise."""

    def __init__(self, site: Site, rng: np.random.Generator) -> None:
        self.site, self.rng = site, rng
        self.board = Board.nominal(site.sub_target)
        self.lens = Lens.ideal(LensModel.BROWN, site.sub.focal_px, site.sub.centre_px)
        middle_mm = self.board.corners_mm.mean(axis=0)
        self.rest = Pose(np.eye(3), np.array([0.0, 0.0, 50.0]) - middle_mm)
        scale = site.nominal_px_per_mm
        back_to_back = Pose(np.diag([-1.0, 1.0, -1.0]), np.array([0.0, 0.0, -80.0]))
        self.rig = Rig(back_to_back, _MAIN_MM, scale, site.main.centre_px)
        flip = np.diag([1.0, -1.0])
        plates = ((None, _CENTRES_MM, _MAIN_MM, np.zeros(2)),) + (
            ((TargetRole.FIXED, 0.5 * _CENTRES_MM, _PLATE_MM, np.array([108.0, 30.0])),)
            if site.extra_targets
            else ()
        )
        self.targets = [
            CalibratedTarget(
                _PLATE if role else MAIN,
                role,
                site.main.centre_px + (places + beside) @ (scale * _MAIN_MM / depth * flip),
                np.full(5, _DISC_PX**2 if role else 0.0),
                scale * _MAIN_MM / depth * flip,
                depth,
                0.0,
            )
            for role, places, depth, beside in plates
        ]
        self.state = np.zeros(6)

    def moved(self) -> Pose:
        """Let the rig bend, and move; where it is then."""
        self.state = self.state + _STATE * self.rng.standard_normal(6)
        turn, shift = 3e-4 * self.rng.standard_normal(3), 0.3 * self.rng.standard_normal(3)
        return Pose.from_vectors(turn, shift)

    def pair(self, motion: Pose) -> _Pair:
        """Images after a motion from the place where the targets' places are known."""
        corners_px = self.lens.project(motion.compose(self.rest).apply(self.board.corners_mm))
        noise = _CORNER_PX * self.rng.standard_normal(corners_px.shape)
        covariance = np.tile(_CORNER_PX**2 * np.eye(2), (len(corners_px), 1, 1))
        view = BoardView(np.arange(len(corners_px)), corners_px + noise, covariance)
        return _Pair(view, tuple(self._discs(target, motion) for target in self.targets))

    def _discs(self, target: CalibratedTarget, motion: Pose) -> FloatArray:
        scale = self.rig.focal_px / target.distance_mm
        there = replace(self.rig, depth_mm=target.distance_mm, scale_px_per_mm=scale)
        at_rest = there.move(target.reference_px, motion)
        roll, centre = self.state[2], self.rig.centre_px
        turn = (1.0 + self.state[3]) * np.array([[1.0, -roll], [roll, 1.0]])
        air = self.state[4:] * target.distance_mm / _MAIN_MM
        places = centre + (at_rest - centre) @ turn.T + self.state[:2] + air
        return np.asarray(places + _DISC_PX * self.rng.standard_normal(places.shape))

    def calibrated(self, pair: _Pair) -> CalibratedSite:
        """A calibration that errs by the noise of its reference alone."""
        board = resect(self.lens, self.board.corners_mm, pair.view, self.rest)
        n, r = len(self.board.corners_mm), 16
        factor = np.linalg.cholesky(board.covariance)
        discs = np.concatenate([np.zeros((10, 6)), _DISC_PX * np.eye(10)], axis=1)
        posterior = Posterior(
            np.zeros((len(self.lens.parameters), r)),
            np.zeros((8, r)),
            np.concatenate([factor, np.zeros((6, 10))], axis=1),
            discs.reshape(5, 2, r),
            np.zeros((n, 3, r)),
            np.zeros((n, 2, 2)),
        )
        further = tuple(
            replace(target, reference_px=seen)
            for target, seen in zip(self.targets[1:], pair.discs[1:], strict=True)
        )
        return CalibratedSite(
            self.board,
            self.board.corners_mm,
            self.lens,
            board.pose,
            pair.discs[0],
            self.targets[0].B,
            self.rig,
            posterior,
            Baseline(_CORNER_PX, 100.0, 1.0, 100.0, 1.0, 1e-3, 1.0),
            further,
        )

    def measured(self, pair: _Pair, by: CalibratedSite) -> Measurement:
        """The pair, measured as the program does once discs and corners are located."""
        board: BoardPose = resect(self.lens, by.corners_mm, pair.view, by.reference_pose)
        noise = np.tile(_DISC_PX**2 * np.eye(2), (5, 1, 1))
        seen = [
            SeenTarget(target, Discs(np.ones(5, bool), points, noise, np.ones(5), 100.0, 1.0))
            for target, points in zip([by.main_target, *by.further], pair.discs, strict=True)
        ]
        shifts = remaining_shifts(by, seen, board, pair.view)
        terms = [Term("bending", np.diag(_STATE**2), "")]
        joint = joint_shifts(shifts, self.site, self.site.main.centre_px, terms)
        fixed = [one.name for one in by.further]
        closed, gains = close(joint, fixed), gains_of(joint, fixed, MAIN)
        targets = tuple(
            TargetMeasurement(
                *(name, TargetRole.FIXED, Flag.GOOD, ()), closed[name], None, {MAIN: gains[name]}
            )
            for name in fixed
        )
        return Measurement(Flag.GOOD, (), closed[MAIN], None, None, targets=targets)


def draw(way: Way, calibrations: int, rng: np.random.Generator) -> Drawn:
    """One record: calibrations one after the other, then a row, in the record's zero."""
    site = make_site(has_plate=way.has_plate)
    world = _World(site, rng)
    where = Pose.identity()
    calibrated = world.calibrated(world.pair(where))
    link = origin(_NOW, None, errors_at_reference(calibrated, site.sub))
    for number in range(2, calibrations + 1):
        now = world.moved()
        pair = world.pair(now)
        later = world.calibrated(pair)
        if way.by_plate:
            step = _through_plate(world, calibrated, later, (where, now), number - 1)
        else:
            found = world.measured(pair, calibrated)
            assert found.corrected is not None
            gains = gains_of_row(found)
            method = DatumMethod.OLD_CALIBRATION
            step = DatumStep(method, number - 1, found.corrected, {}, gains, gains)
        link = _linked(link, step, errors_at_reference(later, site.sub))
        calibrated, where = later, now
    row = world.measured(world.pair(world.moved()), calibrated)
    whole = in_record_zero(row, link).corrected
    assert row.corrected is not None
    assert whole is not None
    return Drawn(
        row.corrected.mm,
        link.offset.mm,
        row.corrected.covariance_mm2,
        link.offset.covariance_mm2,
        whole.covariance_mm2,
    )


def _through_plate(
    world: _World,
    old: CalibratedSite,
    new: CalibratedSite,
    places: tuple[Pose, Pose],
    earlier_id: int,
) -> DatumStep:
    T_CM_CS = world.rig.T_CM_CS
    moved = places[1].compose(places[0].inverse())
    travel = T_CM_CS.compose(moved).compose(T_CM_CS.inverse()).t_mm[:2]
    known = Travel(travel + _TRAVEL_MM * world.rng.standard_normal(2), _TRAVEL_MM)
    found = through_fixed_targets(old, new, world.site, known)
    assert found is not None
    gains = {name: one.gains for name, one in found.items()}
    offset = found[MAIN].displacement
    return DatumStep(DatumMethod.FIXED_TARGETS, earlier_id, offset, {}, gains, gains)


def _linked(before: DatumRecord, step: DatumStep, errors: ReferenceErrors) -> DatumRecord:
    solved = offset_by(step, before, errors)
    shared = {} if solved.shared is None else {MAIN: solved.shared}
    return DatumRecord(
        step.method,
        solved.offset,
        (step,),
        _NOW,
        errors=errors,
        shared=shared,
    )


def squares(drawn: Sequence[Drawn]) -> dict[str, float]:
    """Mean squares of errors over their predicted variance: 1 where the prediction is true."""
    row, datum = (
        np.array([getattr(one, name) for one in drawn]) for name in ("row_mm", "datum_mm")
    )
    whole = row + datum

    def mean(error_mm: FloatArray, mm2: Sequence[FloatArray]) -> float:
        z2 = [
            e @ np.linalg.solve(c + 1e-18 * np.eye(2), e)
            for e, c in zip(error_mm, mm2, strict=True)
        ]
        return float(np.mean(z2) / 2.0)

    return {
        "row": mean(row, [one.row_mm2 for one in drawn]),
        "datum": mean(datum, [one.datum_mm2 for one in drawn]),
        "sum": mean(whole, [one.sum_mm2 for one in drawn]),
        "as if independent": mean(whole, [one.row_mm2 + one.datum_mm2 for one in drawn]),
    }


def common_mm2(drawn: Sequence[Drawn]) -> tuple[FloatArray, FloatArray]:
    """(2,) covariance of row and datum in x and in y: predicted, and as drawn."""
    predicted = [np.diag(one.sum_mm2 - one.row_mm2 - one.datum_mm2) / 2.0 for one in drawn]
    seen = [one.row_mm * one.datum_mm for one in drawn]
    return np.mean(predicted, axis=0), np.mean(seen, axis=0)


def main() -> None:
    """Print a line for each way and length of the chain."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    for way in WAYS:
        for calibrations in (2, 4):
            rng = np.random.default_rng(asked.seed)
            drawn = [draw(way, calibrations, rng) for _ in range(asked.trials)]
            said = ", ".join(f"{name} {value:.3f}" for name, value in squares(drawn).items())
            predicted, seen = common_mm2(drawn)
            spread = np.std([one.row_mm * one.datum_mm for one in drawn], axis=0)
            error = spread / np.sqrt(len(drawn))
            print(
                f"{way.name}, {calibrations - 1} after the first: mean squares over predicted "
                f"variance ± {1 / np.sqrt(len(drawn)):.3f}: {said}; common x, y, um^2: predicted "
                f"{1e6 * predicted.round(9)}, drawn {1e6 * seen.round(9)} ± {1e6 * error.round(9)}",
                flush=True,
            )


if __name__ == "__main__":
    main()
