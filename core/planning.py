"""What a site will measure, before it is built: the same calibration and correction, no images.

Views are projected from the drawing instead of located in images, with the covariance that located
corners and discs would have. The project's own fit then gives its own covariance, and its own
correction the sigma of a row: what is planned here is what a calibration will report.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from core.compensation import corrected_displacement
from core.drawing import Campaign, Drawing
from core.dual import Method, Recipe, fit_views, setup_of
from core.observability import drift_errors
from core.pose import Pose
from core.propagation import reference_noise
from core.resection import resect
from core.setup import Setup
from core.site import FloatArray, QualityLimits, Site


@dataclass(frozen=True, slots=True)
class MotionSigma:
    """What is foreseen for one motion of the rig."""

    motion: str
    calibration_mm: float
    """1 sigma of its correction from the calibration alone, the worse direction: as reported."""
    row_mm: float
    """1 sigma of a corrected displacement then, the worse direction: as in a row."""


@dataclass(frozen=True, slots=True)
class Foreseen:
    """1-sigma errors, mm at the main target."""

    still_mm: FloatArray
    """(2,) x, y of a corrected displacement with the rig where it was at the reference."""
    drifted_mm: FloatArray
    """(2,) x, y with the rig anywhere within the expected drift (each axis evenly spread)."""
    motions: tuple[MotionSigma, ...]
    """The largest expected drift along or about each axis."""

    @property
    def worst_mm(self) -> float:
        """Of the rows foreseen."""
        return max(m.row_mm for m in self.motions)

    @property
    def typical_mm(self) -> float:
        """The worse coordinate within the drift."""
        return float(self.drifted_mm.max())


def calibrate_drawing(drawing: Drawing, campaign: Campaign) -> Setup:
    """Fit the calibration's model to views as drawn.

    Raises NotObservableError if the positions do not determine it, TargetNotFoundError if the
    board is hardly in view.
    """
    recipe = Recipe(drawing.site, drawing.board, Method.RIGID, skew=False)
    fit = fit_views(drawing.views(campaign), drawing.lens, recipe)
    return replace(setup_of(fit, recipe), posterior=fit.posterior)


@dataclass(frozen=True, slots=True)
class FrameNoise:
    """How noisy one frame is, as multiples of what its images tell (variance)."""

    corners: float = 1.0
    discs: float = 1.0


def foresee(drawing: Drawing, setup: Setup, noise: FrameNoise | None = None) -> Foreseen:
    """Foresee the sigma of corrected displacements, as `corrected_displacement` gives it."""
    noise = noise or FrameNoise()
    limits = drawing.site.quality
    still = row_covariance(drawing, setup, Pose.identity(), noise)
    drifts = drift_motions(limits)
    rows = [row_covariance(drawing, setup, motion, noise) for motion in drifts]
    reported = drift_errors(setup, drawing.site)
    # The error of a small motion's correction is linear in the motion; evenly spread within
    # its limits a motion has a third of the variance that its limit has.
    drifted = still + sum((row - still for row in rows), np.zeros((2, 2))) / 3.0
    return Foreseen(
        np.sqrt(np.diag(still)),
        np.sqrt(np.diag(drifted)),
        tuple(
            MotionSigma(
                error.motion, error.calibration_mm, math.sqrt(np.linalg.eigvalsh(row).max())
            )
            for error, row in zip(reported, rows, strict=True)
        ),
    )


def drift_motions(limits: QualityLimits) -> list[Pose]:
    """`T_CSj_CS1` of the largest expected drift about and along each axis, as `drift_errors`."""
    amounts = [limits.expected_drift_mrad * 1e-3] * 3 + [limits.expected_drift_mm] * 3
    steps = np.diag(amounts)
    return [Pose.from_vectors(step[:3], step[3:]) for step in steps]


def row_covariance(drawing: Drawing, setup: Setup, motion: Pose, noise: FrameNoise) -> FloatArray:
    """Covariance (2, 2) mm^2 of a corrected displacement with the rig moved by `T_CSj_CS1`."""
    pair = drawing.see_pair("row", motion)
    board = resect(setup.lens, setup.corners_mm, pair.board.view)
    board = replace(board, covariance=noise.corners * board.covariance)
    discs = replace(pair.discs, covariance_px2=noise.discs * pair.discs.covariance_px2)
    return corrected_displacement(setup, discs, board, pair.board.view)[0].covariance_mm2


@dataclass(frozen=True, slots=True)
class Limit:
    """One cause of error, and what would be left without it."""

    cause: str
    without_mm: float
    """`typical_mm` if this were perfect."""


def limits_of(drawing: Drawing, setup: Setup) -> tuple[Limit, ...]:
    """What limits the accuracy: the sigma within the drift if one thing after another were perfect.

    The most costly first. What a part known perfectly leaves is the conditional covariance.
    """
    whole = setup.posterior
    parts = {
        "lens of the sub-camera": whole.knowing(whole.lens),
        "print and flatness of the board": whole.knowing_board(),
        "rotation between the cameras": whole.knowing(whole.model[:3]),
        "offset between the cameras": whole.knowing(whole.model[3:6]),
        "distance and scale of the main target": whole.knowing(whole.model[6:8]),
        "noise of the reference's pose": whole.knowing(reference_noise(setup, drawing.site.sub)),
    }
    limits = [
        Limit(cause, foresee(drawing, replace(setup, posterior=left)).typical_mm)
        for cause, left in parts.items()
    ]
    quiet = {
        "noise of a frame's pose (sub-camera)": FrameNoise(corners=0.0),
        "noise of the discs (main camera)": FrameNoise(discs=0.0),
    }
    limits += [
        Limit(cause, foresee(drawing, setup, noise).typical_mm) for cause, noise in quiet.items()
    ]
    return tuple(sorted(limits, key=lambda limit: limit.without_mm))


@dataclass(frozen=True, slots=True)
class Change:
    """Something that could be done otherwise."""

    what: str
    drawing: Drawing
    campaign: Campaign
    noise: FrameNoise = field(default_factory=FrameNoise)


@dataclass(frozen=True, slots=True)
class Improvement:
    """A change, and what it would bring."""

    what: str
    typical_mm: float


WORTHWHILE = 0.9
"""Changes that leave more of the sigma than this are not told."""


def possible_changes(drawing: Drawing, campaign: Campaign) -> tuple[Change, ...]:
    """What an engineer could do otherwise, one thing at a time."""
    site = drawing.site
    target, rig, main = site.sub_target, site.rig, site.main_target
    focal_mm = 1.5 * site.sub.focal_length_mm
    longer = replace(site, sub=replace(site.sub, focal_length_mm=focal_mm))
    squares = math.ceil(1.4 * target.squares_x), math.ceil(1.4 * target.squares_y)
    larger = replace(target, squares_x=squares[0], squares_y=squares[1])
    surveyed = replace(
        site,
        rig=replace(
            rig,
            rotation_sigma_deg=rig.rotation_sigma_deg / 4.0,
            offset_sigma_mm=rig.offset_sigma_mm / 4.0,
        ),
        main_target=replace(main, distance_sigma_mm=main.distance_sigma_mm / 4.0),
    )
    more = 2 * campaign.lens_views

    def other(changed: Site) -> Drawing:
        return replace(drawing, site=changed)

    return (
        Change(
            f"{more} lens views instead of {campaign.lens_views}",
            drawing,
            replace(campaign, lens_views=more),
        ),
        Change(
            f"a sub-camera lens of {focal_mm:g} mm instead of {site.sub.focal_length_mm:g} mm",
            other(longer),
            campaign,
        ),
        Change(
            f"a larger board, {squares[0]} x {squares[1]} squares of {target.square_mm:g} mm",
            other(replace(site, sub_target=larger)),
            campaign,
        ),
        Change(
            f"a survey four times as good: {rig.rotation_sigma_deg / 4:.2g} deg between the "
            f"cameras, {rig.offset_sigma_mm / 4:.2g} mm of offset, "
            f"{main.distance_sigma_mm / 4:.2g} mm of distance",
            other(surveyed),
            campaign,
        ),
        Change("four pairs a slot", drawing, campaign, FrameNoise(0.25, 0.25)),
    )


def improvements(now: Foreseen, setup: Setup, changes: Sequence[Change]) -> tuple[Improvement, ...]:
    """Plan again with each change; those worth it, the best first."""
    found = []
    for change in changes:
        calibrates_anew = change.noise == FrameNoise()
        again = calibrate_drawing(change.drawing, change.campaign) if calibrates_anew else setup
        typical_mm = foresee(change.drawing, again, change.noise).typical_mm
        if typical_mm < WORTHWHILE * now.typical_mm:
            found.append(Improvement(change.what, typical_mm))
    return tuple(sorted(found, key=lambda improvement: improvement.typical_mm))
