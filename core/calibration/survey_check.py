"""Whether config, drawing and survey agree with what the images say, and which number is wrong.

Five quantities can be seen without knowing what they are compared with:

- the main camera's focal length in px, by how far its image moves when the rig turns: f / pitch;
- the main target's distance, by that focal length and the px between its discs. Discs drawn
  further apart than they are make it further away, so this is distance x drawn / true spacing;
- the discs' diameter, by the px between them;
- the sub-camera's focal length in px, by the lens views, whatever the size of a square: f / pitch;
- the board's distance in the reference, counted in squares.

A quantity that is far off names the numbers that it depends on; where several quantities depend on
one number, the fewest numbers that explain them all are named.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from core.arrays import FloatArray
from core.calibration.joint_fit import (
    MIN_LENS_VIEWS,
    Fit,
    FitOptions,
    fit_views,
    nominal_rig,
    rig_prior,
)
from core.calibration.plate_check import plate_problem
from core.discs.disc_finder import Discs
from core.discs.disc_mismatch import diameter_ratio
from core.errors import digits
from core.geometry.lens import Lens
from core.images import GreyImage
from core.rig.rigid import Rig
from core.site import CameraGeometry, CheckerboardTarget, CirclesTarget, Site

FAR_SIGMAS = 3.5
"""Five quantities: by chance one of them is that far off at one site in 400, were errors normal."""
_DOUBTFUL_SIGMAS = 2.5
"""Worth a look: by chance at one site in 16."""
_LENS_SIGMA = 0.025
"""Relative; makers engrave focal lengths to some per cent."""
_PRINT_TOLERANCE = 0.01
"""Relative, of the size of a print."""
_LINEAR = 0.05
"""Relative: a distance drawn so much further away or nearer is too far off to be extrapolated to
from the fit with the one drawn; the fit is repeated nearer to it."""
_DISC_SIGMA, _EDGE_SIGMA_PX = 0.015, 0.5
"""Of a diameter: paint and overexposure widen a disc."""
_LENS_MM, _PITCH_UM = "focal_length_mm", "pixel_pitch_um"
_DISTANCE, _CENTRES, _DIAMETER = (
    "target.main.distance_mm",
    "target.main.centres_mm",
    "target.main.diameter_mm",
)
_SQUARE, _BOARD_DISTANCE = "target.sub.square_mm", "target.sub.distance_mm"


def _shown(value: float) -> str:
    """Five digits at least, written out."""
    return f"{value:.5g}" if abs(value) < 99_999.5 else f"{value:.0f}"


@dataclass(frozen=True, slots=True)
class Quantity:
    """One quantity as the config has it and as the images show it."""

    name: str
    unit: str
    expected: tuple[float, float]
    """Range by the config: a focused lens is up to D / (D - f) longer than engraved."""
    seen: float
    sigma: float
    """Relative, 1 sigma of their difference: of survey, drawing, maker and images together."""
    follows: dict[str, int]
    """Config keys, and by which power of true / config the quantity changes."""

    @property
    def difference(self) -> float:
        """Natural logarithm of seen / expected; 0 within the range."""
        low, high = self.expected
        return math.log(self.seen / min(max(self.seen, low), high))

    @property
    def sigmas(self) -> float:
        """How far the images are from the config, in sigmas."""
        return self.difference / self.sigma

    @property
    def sentence(self) -> str:
        """Both values and their distance."""
        low, high = self.expected
        config = _shown(low) if low == high else f"{_shown(low)} to {_shown(high)}"
        return (
            f"{self.name}: by the config {config} {self.unit}, by the images {_shown(self.seen)} "
            f"{self.unit}, {abs(self.sigmas):.1f} sigma of {self.sigma:.2%} off"
        )

    def to_dict(self) -> dict[str, Any]:
        """Give plain JSON types."""
        return {
            "name": self.name,
            "unit": self.unit,
            "config": list(self.expected),
            "images": self.seen,
            "sigma": self.sigma,
            "off_sigmas": self.sigmas,
        }


@dataclass(frozen=True, slots=True)
class Group:
    """Quantities that depend on the same numbers of the config."""

    quantities: tuple[Quantity, ...]
    values: dict[str, float]
    """Config keys with their values; a factor of 1 stands for lists."""
    by_hand: str
    """What to measure to settle it."""

    @property
    def problem(self) -> str | None:
        """Which numbers are likely wrong and what they should be, or None."""
        if all(abs(q.sigmas) < FAR_SIGMAS for q in self.quantities):
            return None
        seen = "; ".join(q.sentence for q in self.quantities if abs(q.sigmas) >= FAR_SIGMAS)
        return f"{self._likely()}: {seen}; {self.by_hand}"

    @property
    def unlikely_print(self) -> str | None:
        """A board that is a misprint if it is as far away as drawn; None else, or if far off."""
        first, square_mm = self.quantities[0], self.values.get(_SQUARE)
        if square_mm is None or abs(first.sigmas) >= _DOUBTFUL_SIGMAS:
            return None
        if abs(first.difference) < _PRINT_TOLERANCE:
            return None
        wanted_mm = square_mm * math.exp(-first.difference)
        return (
            f"warning: {_BOARD_DISTANCE} or {_SQUARE} is {abs(first.difference):.1%} off, and "
            f"printers err by {_PRINT_TOLERANCE:.0%} at most; {self.by_hand}; if they are not, "
            f"{_SQUARE} is likely {wanted_mm:.4g}; if they are, {_BOARD_DISTANCE} is likely "
            f"{digits(first.seen)}, and {_SQUARE} is right"
        )

    def _likely(self) -> str:
        """The fewest numbers that explain all quantities, the best explanation first."""
        for count in range(1, len(self.values)):
            fits = [self._explained(keys) for keys in combinations(self.values, count)]
            good = sorted((f for f in fits if f[0] < FAR_SIGMAS**2), key=_left_and_change)
            if good:
                return ", or ".join(
                    " and ".join(self._suggestion(key, change) for key, change in changes.items())
                    for _, changes in good
                )
        return "several are wrong: " + ", ".join(self.values)

    def _explained(self, keys: Sequence[str]) -> tuple[float, dict[str, float]]:
        """What is left (chi square), and ln(true / config) of these numbers, if they are free."""
        sigmas = np.array([q.sigma for q in self.quantities])
        off = np.array([q.difference for q in self.quantities]) / sigmas
        design = np.array([[q.follows.get(k, 0) for k in keys] for q in self.quantities])
        weighted = design / sigmas[:, None]
        changes = np.linalg.lstsq(weighted, off, rcond=None)[0]
        left = float(((off - weighted @ changes) ** 2).sum())
        return left, dict(zip(keys, changes.tolist(), strict=True))

    def _suggestion(self, key: str, change: float) -> str:
        value, factor = self.values[key], math.exp(change)
        if key == _CENTRES:
            return f"{key} should likely all be {digits(factor)} times as large"
        first = self.quantities[0]
        if first.expected[0] < first.expected[1]:
            low, high = sorted(
                value * (first.seen / end) ** first.follows[key] for end in first.expected
            )
            low, high = low * math.exp(-first.sigma), high * math.exp(first.sigma)
            return f"{key} is likely {digits(low)} to {digits(high)}, not {value:.10g}"
        return f"{key} is likely about {digits(value * factor)}, not {value:.10g}"


def _left_and_change(fit: tuple[float, dict[str, float]]) -> tuple[int, float]:
    """The best explanation leaves least; of equals it changes least."""
    left, changes = fit
    return round(left), sum(change**2 for change in changes.values())


@dataclass(frozen=True, slots=True)
class SurveyCheck:
    """What the images say of the config."""

    groups: tuple[Group, ...]
    by_hand: str
    """What images cannot tell."""
    plate: str | None = None
    """What of the main target's drawing contradicts its image; what depends on it is left out."""

    @property
    def problems(self) -> list[str]:
        """Which numbers of the config contradict the images; empty if none does."""
        problems = [self.plate, *(group.problem for group in self.groups)]
        return [problem for problem in problems if problem is not None]

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """All of them."""
        return tuple(quantity for group in self.groups for quantity in group.quantities)

    @property
    def lines(self) -> list[str]:
        """What was compared, as sentences, and what is left to do by hand."""
        doubtful = [
            f"warning: {quantity.name}: {abs(quantity.sigmas):.1f} sigma off; {group.by_hand}"
            for group in self.groups
            for quantity in group.quantities
            if _DOUBTFUL_SIGMAS <= abs(quantity.sigmas) < FAR_SIGMAS
        ]
        doubtful += [group.unlikely_print for group in self.groups if group.unlikely_print]
        return [*(quantity.sentence for quantity in self.quantities), *doubtful, self.by_hand]


def check_survey(
    fit: Fit, start: Lens, options: FitOptions, factor: float, reference_main: GreyImage
) -> SurveyCheck:
    """Hold the config against a fit; reference_main is the main camera's reference image.

    factor is what `compare_with_drawing` gave, start the lens that it was compared with.
    """
    site, discs = options.site, fit.views.reference.discs
    groups = []
    plate = plate_problem(reference_main, discs, site.main_target)
    if isinstance(fit.model, Rig) and plate is None:
        near = site
        if abs(math.log(factor)) > _LINEAR:
            near = _at(factor, site)
            fit = fit_views(fit.views, start, replace(options, site=near))
        main_focal_px, distance = _main_distance(fit, near, site)
        groups.append(_lens("main", site.main, main_focal_px, site.main_target.distance_mm))
        diameter = _disc_diameter(reference_main, discs, site.main_target, fit.B)
        groups.append(_main_target((distance, diameter), site.main_target))
    if len(fit.views.lens) >= MIN_LENS_VIEWS:
        focal_px = float(np.sqrt(np.prod(fit.adjustment.lens.parameters[:2])))
        groups.append(_lens("sub", site.sub, focal_px, site.sub_target.distance_mm))
        groups.append(_board(fit, site.sub_target))
    return SurveyCheck(tuple(groups), _by_hand(site), plate)


def _at(factor: float, site: Site) -> Site:
    """The site with its main target so many times as far away, as well surveyed."""
    target = site.main_target
    there = replace(
        target,
        distance_mm=factor * target.distance_mm,
        distance_sigma_mm=factor * target.distance_sigma_mm,
    )
    return replace(site, main_target=there)


def _main_distance(fit: Fit, near: Site, site: Site) -> tuple[float, Quantity]:
    """Focal length of the main camera by the views alone, px, and the distance that follows.

    near is the site that was fitted, with a distance near the one seen.

    The fit holds the product of depth and scale between views and prior; r, its departure from the
    prior of variance v, is a share g = 1 - posterior variance / v of what the views alone say,
    which is r / g, with variance v / g for their difference.
    """
    drawn, sigmas = nominal_rig(near, fit.B), rig_prior(near)
    assert isinstance(fit.model, Rig)  # noqa: S101 - the paper's model has no distance
    departure = -float(fit.model.deviation_from(drawn)[6:8].sum())
    factor = fit.posterior.model
    prior = float((sigmas[6:8] ** 2).sum())
    share = float(np.clip(1.0 - ((factor[6] + factor[7]) ** 2).sum() / prior, 1e-3, 1.0))
    seen_mm = drawn.depth_mm * math.exp(departure / share)
    quantity = Quantity(
        "distance of the main target",
        "mm",
        (site.main_target.distance_mm, site.main_target.distance_mm),
        seen_mm,
        math.sqrt(prior / share),
        {_DISTANCE: 1, _CENTRES: -1},
    )
    return drawn.scale_px_per_mm * seen_mm, quantity


def _main_target(quantities: tuple[Quantity, ...], target: CirclesTarget) -> Group:
    diameter_mm = float(target.diameters_mm[0])
    return Group(
        quantities,
        {_DISTANCE: target.distance_mm, _CENTRES: 1.0, _DIAMETER: diameter_mm},
        f"measure the plate: {_plate(target)}; check [rig] offset_main_sub_mm and its signs, too",
    )


def _disc_diameter(main: GreyImage, discs: Discs, target: CirclesTarget, B: FloatArray) -> Quantity:
    """Diameter of the first disc by the outlines of all that were found."""
    px_per_mm = math.sqrt(abs(float(np.linalg.det(B))))
    ratio = diameter_ratio(main, discs, target, px_per_mm)
    narrowest_px = px_per_mm * float(target.diameters_mm[discs.found].min())
    diameter_mm = float(target.diameters_mm[0])
    return Quantity(
        "diameter of a disc",
        "mm",
        (diameter_mm, diameter_mm),
        diameter_mm * ratio,
        math.hypot(_DISC_SIGMA, _EDGE_SIGMA_PX / narrowest_px),
        {_DIAMETER: 1, _CENTRES: -1},
    )


def _lens(which: str, camera: CameraGeometry, focal_px: float, distance_mm: float) -> Group:
    focused = distance_mm / (distance_mm - camera.focal_length_mm)
    length, pitch = f"camera.{which}.{_LENS_MM}", f"camera.{which}.{_PITCH_UM}"
    quantity = Quantity(
        f"focal length of the {which} camera",
        "px",
        (camera.focal_px, camera.focal_px * focused),
        focal_px,
        _LENS_SIGMA,
        {length: 1, pitch: -1},
    )
    return Group(
        (quantity,),
        {length: camera.focal_length_mm, pitch: camera.pixel_pitch_um},
        "read the one off the lens and the other in the camera's data sheet (binning doubles it)",
    )


def _board(fit: Fit, target: CheckerboardTarget) -> Group:
    pose = fit.reference_pose
    normal = pose.R[:, 2]
    quantity = Quantity(
        "distance of the board",
        "mm",
        (target.distance_mm, target.distance_mm),
        float(normal @ pose.t_mm / normal[2]),
        target.distance_sigma,
        {_BOARD_DISTANCE: 1, _SQUARE: -1},
    )
    return Group(
        (quantity,),
        {_SQUARE: target.square_mm, _BOARD_DISTANCE: target.distance_mm},
        f"measure the print: {_print(target)}",
    )


def _print(target: CheckerboardTarget) -> str:
    across, down = target.squares_x * target.square_mm, target.squares_y * target.square_mm
    return (
        f"by the config the board's {target.squares_x} x {target.squares_y} squares are "
        f"{across:.1f} x {down:.1f} mm"
    )


def _plate(target: CirclesTarget) -> str:
    apart_mm = np.hypot(*(target.centres_mm[:, None] - target.centres_mm[None]).T)
    first, second = sorted(np.unravel_index(int(np.argmax(apart_mm)), apart_mm.shape))
    return (
        f"by the config the middles of discs {first + 1} and {second + 1} are "
        f"{apart_mm.max():.1f} mm apart and disc 1 is {target.diameters_mm[0]:.1f} mm wide"
    )


def _by_hand(site: Site) -> str:
    drift_mm = site.quality.expected_drift_mm
    return (
        f"measure by hand, as no image tells sizes to a per cent: {_print(site.sub_target)} (1 % "
        f"off costs {0.01 * drift_mm:.3f} mm after {drift_mm:g} mm of drift); "
        f"{_plate(site.main_target)} (1 % off costs 1 % of every displacement)"
    )
