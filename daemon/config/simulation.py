"""`[simulation]`: the rig behind `backend = "simulated"`, and how it becomes the driver's type."""

from __future__ import annotations

import itertools
from datetime import UTC, datetime
from typing import Annotated, Literal

from pydantic import Field, Strict

from daemon.config.section import Directory, Instant, Pair, Section, Triple
from drivers.protocols import Role
from drivers.sim.settings import (
    AsBuilt,
    Breathing,
    Climate,
    Motion,
    Optics,
    Scenario,
    ScenarioKind,
    Sensor,
    SimPlate,
    SimSettings,
)

STILL = (0.0, 0.0, 0.0)


class ScenarioSection(Section):
    """`[[simulation.scenarios]]`: something that happens to the simulated rig for a while."""

    kind: ScenarioKind
    start_min: float = Field(default=0.0, ge=0)
    end_min: float | None = Field(default=None, gt=0)
    role: Role | None = None
    repeat_min: float | None = Field(default=None, gt=0)


class ClimateSection(Section):
    """`[simulation.climate]`: how warm air and cameras are."""

    air_mean_c: float = Field(default=15.0, ge=-60.0, le=60.0)
    air_daily_k: float = Field(default=8.0, ge=0, le=50.0)
    air_seasonal_k: float = Field(default=0.0, ge=0, le=50.0)
    air_weather_k: float = Field(default=0.0, ge=0, le=50.0)
    weather_days: float = Field(default=5.0, gt=0, le=365.0)
    warmest_hour_utc: float = Field(default=15.0, ge=0, lt=24.0)
    camera_lag_h: float = Field(default=0.0, ge=0, le=1000.0)
    main_above_air_k: float = Field(default=20.0, ge=0, le=100.0)
    sub_above_air_k: float = Field(default=20.0, ge=0, le=100.0)
    sensor_noise_k: float = Field(default=0.0, ge=0, le=10.0)


class BreathingSection(Section):
    """`[simulation.breathing]`: what changes with temperature and time."""

    cameras_urad_per_k: Triple = STILL
    cameras_urad_per_sqrt_day: Triple = STILL
    main_px_per_k: Pair = (0.0, 0.0)
    main_scale_ppm_per_k: float = Field(default=0.0, ge=-1000.0, le=1000.0)
    sub_px_per_k: Pair = (0.0, 0.0)
    board_ppm_per_k: float = Field(default=0.0, ge=-1000.0, le=1000.0)
    board_urad_per_k: Triple = STILL
    board_urad_per_sqrt_day: Triple = STILL
    board_fixed_mm: Pair | None = None
    air_gradient_k_per_m: float = Field(default=0.0, ge=-100.0, le=100.0)


class PlateSection(Section):
    """`[[simulation.plates]]`: where a plate of `[[target.extra]]` stands and how it moves."""

    name: str = Field(min_length=1)
    offset_mm: Pair | None = None
    bridge_factor: float | None = Field(default=None, ge=-10.0, le=10.0)
    knock_min: float = Field(default=0.0, ge=0)
    knock_mm: Pair = (0.0, 0.0)
    creep_mm_per_sqrt_day: float = Field(default=0.0, ge=0, le=100.0)
    hidden_min: Annotated[tuple[Pair, ...], Strict(strict=False)] = ()


class SimulationSection(Section):
    """`[simulation]`: the rig behind `backend = "simulated"`."""

    seed: int = Field(default=1, ge=0)
    clock: Literal["stepped", "system"] = "stepped"
    start_utc: Instant = datetime(2026, 3, 1, tzinfo=UTC)
    clock_start_utc: Instant | None = None
    scenarios: Annotated[tuple[ScenarioSection, ...], Strict(strict=False)] = (
        ScenarioSection(kind="drift"),
        ScenarioSection(kind="bridge"),
    )
    drift_mrad: float = Field(default=1.0, ge=0, le=100.0)
    drift_mm: float = Field(default=1.5, ge=0, le=100.0)
    drift_period_min: float = Field(default=720.0, gt=0)
    bridge_daily_mm: float = Field(default=5.0, ge=0, le=1000.0)
    bridge_period_min: float = Field(default=1440.0, gt=0)
    bridge_small_mm: float = Field(default=0.3, ge=0, le=1000.0)
    bridge_course: Annotated[tuple[Pair, ...], Strict(strict=False)] = ()
    vibration_mrad: float = Field(default=0.05, ge=0, le=10.0)
    ramp_min: float = Field(default=10.0, ge=0)
    night_light: float = Field(default=0.005, ge=0, le=1.0)
    dusk_min: float = Field(default=0.0, ge=0)
    haze_mm: float = Field(default=0.3, ge=0, le=100.0)
    as_built_scale: float = Field(default=1.0, ge=0, le=10.0)
    noise: bool = True
    head_angles: Directory | None = None
    climate: ClimateSection = ClimateSection()
    breathing: BreathingSection = BreathingSection()
    plates: Annotated[tuple[PlateSection, ...], Strict(strict=False)] = ()

    def settings(self) -> SimSettings:
        """Convert to the simulated rig's type."""
        return SimSettings(
            seed=self.seed,
            start_utc=self.start_utc,
            scenarios=tuple(Scenario(**scenario.model_dump()) for scenario in self.scenarios),
            motion=Motion(
                drift_mrad=self.drift_mrad,
                drift_mm=self.drift_mm,
                drift_period_min=self.drift_period_min,
                bridge_daily_mm=self.bridge_daily_mm,
                bridge_period_min=self.bridge_period_min,
                bridge_small_mm=self.bridge_small_mm,
                bridge_course=self.bridge_course,
                vibration_mrad=self.vibration_mrad,
                ramp_min=self.ramp_min,
            ),
            as_built=AsBuilt(scale=self.as_built_scale),
            optics=Optics(
                night_light=self.night_light, dusk_min=self.dusk_min, haze_mm=self.haze_mm
            ),
            sensor=Sensor(noise=self.noise),
            climate=Climate(**self.climate.model_dump()),
            breathing=Breathing(**self.breathing.model_dump()),
            plates=tuple(SimPlate(**plate.model_dump()) for plate in self.plates),
        )

    def problems(self, plates: list[str]) -> list[str]:
        """Name values that do not go together; plates are the names of the site's further ones."""
        found = []
        minutes = [minute for minute, _ in self.bridge_course]
        if any(later <= earlier for earlier, later in itertools.pairwise(minutes)):
            found.append("simulation.bridge_course: each point must be later than the one before")
        for number, scenario in enumerate(self.scenarios):
            if scenario.end_min is not None and scenario.end_min <= scenario.start_min:
                found.append(
                    f"simulation.scenarios[{number}].end_min: must be greater than start_min = "
                    f"{scenario.start_min:g}, is {scenario.end_min:g}"
                )
        for number, plate in enumerate(self.plates):
            key = f"simulation.plates[{number}]"
            if plate.name not in plates:
                known = ", ".join(f'"{name}"' for name in plates) or "none"
                found.append(
                    f'{key}.name: "{plate.name}" is no plate of [[target.extra]]; there: {known}'
                )
            if plate.name in [other.name for other in self.plates[:number]]:
                found.append(f'{key}.name: "{plate.name}" has a table already; put them together')
            found += [
                f"{key}.hidden_min: each span from its first minute to a later one, is "
                f"[{first:g}, {end:g}]"
                for first, end in plate.hidden_min
                if not 0.0 <= first < end
            ]
        return found
