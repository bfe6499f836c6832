"""The tables of `dcam.toml` that describe a site: cameras, targets, rig, limits of quality.

They become `core.site.Site`; whether its values fit together is judged in `plausibility`.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import BeforeValidator, Field, Strict

from core.lens_model import LensModel
from core.site import (
    CameraGeometry,
    CheckerboardTarget,
    CirclesTarget,
    ExtraTarget,
    QualityLimits,
    RigPrior,
    StabilityBudget,
    TargetRole,
)
from daemon.config.section import Pair, Section, Triple
from drivers.protocols import PixelFormat, Role


def _number_to_list(value: object) -> object:
    return [value] if isinstance(value, int | float) else value


_STABLE = StabilityBudget()
MOST_EXTRA_TARGETS = 16
"""Chosen: each costs a search, and no image has room for more."""

PositiveFloat = Annotated[float, Field(gt=0)]
Backend = Literal["aravis", "harvesters", "simulated", "replay"]


class SiteSection(Section):
    """`[site]`."""

    name: str = Field(min_length=1)
    timezone: str | None = Field(default=None, min_length=1)
    latitude_deg: float | None = Field(default=None, ge=-90.0, le=90.0)
    longitude_deg: float | None = Field(default=None, ge=-180.0, le=180.0)

    @property
    def position_deg(self) -> tuple[float, float] | None:
        """Latitude and longitude; None where they are not given."""
        if self.latitude_deg is None or self.longitude_deg is None:
            return None
        return self.latitude_deg, self.longitude_deg


class CameraSection(Section):
    """`[camera.main]`, `[camera.sub]`."""

    backend: Backend | None = None
    serial: str | None = Field(default=None, min_length=1)
    width_px: int = Field(ge=64, le=65536)
    height_px: int = Field(ge=64, le=65536)
    pixel_pitch_um: float = Field(ge=0.5, le=100.0)
    focal_length_mm: float = Field(ge=1.0, le=20_000.0)
    pixel_format: PixelFormat = "Mono8"
    packet_size_bytes: int | None = Field(default=None, ge=576, le=16_384)

    def geometry(self) -> CameraGeometry:
        """Convert to the core's type."""
        return CameraGeometry(
            width_px=self.width_px,
            height_px=self.height_px,
            pixel_pitch_um=self.pixel_pitch_um,
            focal_length_mm=self.focal_length_mm,
        )


class SubCameraSection(CameraSection):
    """`[camera.sub]`, whose lens is calibrated."""

    lens_model: Literal["auto", "radial", "brown", "rational", "fisheye"] = "auto"

    def model(self) -> LensModel | None:
        """Convert to the core's type."""
        return None if self.lens_model == "auto" else LensModel(self.lens_model)


class CamerasSection(Section):
    """`[camera]`."""

    main: CameraSection
    sub: SubCameraSection

    def of(self, role: Role) -> CameraSection:
        """Give one camera's table."""
        return self.main if role == "main" else self.sub

    @property
    def serials(self) -> dict[Role, str]:
        """Serial numbers of the cameras that have one here."""
        known: dict[Role, str | None] = {"main": self.main.serial, "sub": self.sub.serial}
        return {role: serial for role, serial in known.items() if serial}


class CirclesSection(Section):
    """`[target.main]`: white discs on black, centres in WM (x right, y up)."""

    kind: Literal["circles"] = "circles"
    centres_mm: Annotated[tuple[Pair, ...], Strict(strict=False), Field(min_length=3)]
    diameter_mm: Annotated[
        tuple[PositiveFloat, ...],
        Strict(strict=False),
        Field(min_length=1),
        BeforeValidator(_number_to_list),
    ]
    distance_mm: float = Field(gt=0, le=1e6)
    distance_sigma_mm: float = Field(default=20.0, ge=0.01)

    def target(self) -> CirclesTarget:
        """Convert to the core's type; one diameter stands for all discs."""
        count = len(self.centres_mm)
        diameters = self.diameter_mm * count if len(self.diameter_mm) == 1 else self.diameter_mm
        return CirclesTarget(
            centres_mm=np.array(self.centres_mm, dtype=np.float64),
            diameters_mm=np.array(diameters, dtype=np.float64),
            distance_mm=self.distance_mm,
            distance_sigma_mm=self.distance_sigma_mm,
        )


class ExtraTargetSection(CirclesSection):
    """`[[target.extra]]`: a further plate of discs in the main camera's image."""

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9-]{0,31}$")
    role: Literal["fixed", "measured"]
    position_px: Pair | None = None
    stable_mm: float = Field(default=0.0, ge=0, le=100.0)

    def extra_target(self) -> ExtraTarget:
        """Convert to the core's type."""
        position_px = None if self.position_px is None else np.array(self.position_px, dtype=float)
        return ExtraTarget(
            self.name, TargetRole(self.role), self.target(), position_px, self.stable_mm
        )


class CheckerboardSection(Section):
    """`[target.sub]`: a checkerboard; the square at the WS origin is black."""

    kind: Literal["checkerboard"] = "checkerboard"
    squares_x: int = Field(ge=4, le=1000)
    squares_y: int = Field(ge=4, le=1000)
    square_mm: float = Field(gt=0)
    square_sigma_mm: float | None = Field(default=None, gt=0)
    distance_mm: float = Field(gt=0, le=1e5)
    distance_sigma_mm: float | None = Field(default=None, gt=0)

    def target(self) -> CheckerboardTarget:
        """Convert to the core's type; a sigma that is not given is the core's default."""
        sigmas: dict[str, float] = {}
        if self.square_sigma_mm is not None:
            sigmas["scale_sigma"] = self.square_sigma_mm / self.square_mm
        if self.distance_sigma_mm is not None:
            sigmas["distance_sigma"] = self.distance_sigma_mm / self.distance_mm
        return CheckerboardTarget(
            squares_x=self.squares_x,
            squares_y=self.squares_y,
            square_mm=self.square_mm,
            distance_mm=self.distance_mm,
            **sigmas,
        )


class TargetsSection(Section):
    """`[target]`."""

    main: CirclesSection
    sub: CheckerboardSection
    extra: Annotated[
        tuple[ExtraTargetSection, ...], Strict(strict=False), Field(max_length=MOST_EXTRA_TARGETS)
    ] = ()


class RigSection(Section):
    """`[rig]`: `T_CM_CS` as drawn, X_CM = R X_CS + t."""

    rotation_main_sub_deg: Annotated[
        tuple[
            Annotated[float, Field(ge=-360, le=360)],
            Annotated[float, Field(ge=-360, le=360)],
            Annotated[float, Field(ge=-360, le=360)],
        ],
        Strict(strict=False),
    ]
    rotation_sigma_deg: float = Field(default=1.0, ge=1e-3, le=30.0)
    offset_main_sub_mm: Triple
    offset_sigma_mm: float = Field(default=3.0, ge=0.01, le=1000.0)

    def prior(self) -> RigPrior:
        """Convert to the core's type."""
        return RigPrior(
            rotation_main_sub_deg=np.array(self.rotation_main_sub_deg, dtype=np.float64),
            rotation_sigma_deg=self.rotation_sigma_deg,
            offset_main_sub_mm=np.array(self.offset_main_sub_mm, dtype=np.float64),
            offset_sigma_mm=self.offset_sigma_mm,
        )


class QualitySection(Section):
    """`[quality]`: what a row must hold to be called good."""

    expected_drift_mrad: float = Field(default=1.0, gt=0, le=100.0)
    expected_drift_mm: float = Field(default=1.5, gt=0, le=1000.0)
    max_sigma_mm: float = Field(default=0.5, gt=0)
    max_skew_ms: float = Field(default=20.0, gt=0)
    max_step_mm: float | None = Field(default=None, gt=0)

    def limits(self) -> QualityLimits:
        """Convert to the core's type."""
        return QualityLimits(**self.model_dump())


class StabilitySection(Section):
    """`[stability]`: what may have changed since the calibration; 1 sigma of each."""

    cameras_urad_per_k: float = Field(default=_STABLE.cameras_urad_per_k, ge=0, le=1000.0)
    cameras_urad_per_sqrt_day: float = Field(
        default=_STABLE.cameras_urad_per_sqrt_day, ge=0, le=1000.0
    )
    board_urad_per_k: float = Field(default=_STABLE.board_urad_per_k, ge=0, le=1000.0)
    board_urad_per_sqrt_day: float = Field(default=_STABLE.board_urad_per_sqrt_day, ge=0, le=1000.0)
    board_expansion_per_k: float = Field(default=_STABLE.board_expansion_per_k, ge=0, le=1e-3)
    main_px_per_k: float = Field(default=_STABLE.main_px_per_k, ge=0, le=10.0)
    main_scale_per_k: float = Field(default=_STABLE.main_scale_per_k, ge=0, le=1e-2)
    sub_px_per_k: float = Field(default=_STABLE.sub_px_per_k, ge=0, le=10.0)
    air_gradient_k_per_m: float = Field(default=_STABLE.air_gradient_k_per_m, ge=0, le=100.0)
    temperature_range_k: float = Field(default=_STABLE.temperature_range_k, ge=0, le=100.0)
    temperature_reading: str | None = None

    def budget(self) -> StabilityBudget:
        """Convert to the core's type."""
        return StabilityBudget(**self.model_dump(exclude={"temperature_reading"}))
