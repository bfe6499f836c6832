"""A site with its world, its calibration views, and what became of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np

from core.arrays import FloatArray
from core.calibration.calibrate import (
    Calibration,
    CalibrationReport,
    CalibrationView,
    Method,
    calibrate,
)
from core.images import GreyImage
from core.measurement import measure_pair
from core.results import Measurement
from core.site import Site
from drivers.sim.settings import Scenario, SimSettings
from drivers.sim.truth import Truth
from drivers.sim.world import World
from tests.core.scenes import (
    MINUTE,
    grey,
    head_positions,
    lens_views,
    reference_utc,
    rest_views,
    small_site,
)


@dataclass(frozen=True, slots=True)
class Row:
    """One measured pair and the truth."""

    measurement: Measurement
    truth: Truth

    @property
    def error_mm(self) -> FloatArray:
        """(2,) of the corrected displacement."""
        assert self.measurement.corrected is not None
        return self.measurement.corrected.mm - self.truth.displacement_mm

    @property
    def raw_error_mm(self) -> FloatArray:
        """(2,) of the main camera alone."""
        assert self.measurement.raw is not None
        return self.measurement.raw.mm - self.truth.displacement_mm

    @property
    def sigma_mm(self) -> FloatArray:
        """(2,) 1 sigma of the corrected displacement."""
        assert self.measurement.corrected is not None
        return np.sqrt(np.diag(self.measurement.corrected.covariance_mm2))


@dataclass(frozen=True, slots=True)
class Session:
    """A calibrated site."""

    site: Site
    world: World
    views: tuple[CalibrationView, ...]
    calibration: Calibration
    report: CalibrationReport

    def calibrated_again(self, method: Method) -> Session:
        """The same views by another method."""
        calibration, report = calibrate(self.views, self.site, method)
        return replace(self, calibration=calibration, report=report)

    def with_world(self, *scenarios: Scenario, **changes: object) -> Session:
        """The same rig and calibration in other weather, or with other cameras or motion."""
        settings = self.world.settings
        changed = replace(settings, scenarios=(*settings.scenarios, *scenarios), **changes)
        return replace(self, world=World(self.site, changed))

    def pair(self, t_utc: datetime) -> tuple[GreyImage, GreyImage]:
        """Main and sub image of an instant."""
        return grey(self.world, "main", t_utc), grey(self.world, "sub", t_utc)

    def row(self, t_utc: datetime) -> Row:
        """Measure an instant."""
        measurement = measure_pair(*self.pair(t_utc), self.site, self.calibration)
        return Row(measurement, self.world.truth(t_utc, reference_utc(self.world.settings)))

    def rows(self, count: int, every_min: float = 60.0) -> list[Row]:
        """Measure the drift at regular times."""
        start = self.world.settings.start_utc
        return [self.row(start + k * every_min * MINUTE) for k in range(1, count + 1)]


def all_views(
    world: World, lens: int, positions_deg: Sequence[Sequence[float]] | FloatArray
) -> tuple[CalibrationView, ...]:
    """Lens views, the reference and the rig at these pan and tilt angles."""
    return (*lens_views(world, lens), *rest_views(world, np.asarray(positions_deg)))


def session(distance_mm: float, settings: SimSettings, *, lens: int, rig: int) -> Session:
    """Make a site, take views of it, calibrate it by the rigid method."""
    site = small_site(distance_mm)
    world = World(site, settings)
    views = all_views(world, lens, head_positions(site, rig))
    calibration, report = calibrate(views, site)
    return Session(site, world, views, calibration, report)
