"""What `dcam.toml` may hold: every table and key, and their conversion to the layers' own types.

Every key carries its unit in its name. What a key is for stands in `config.example.toml`.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    AwareDatetime,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PrivateAttr,
    Strict,
    ValidationInfo,
)

from core.site import (
    CameraGeometry,
    CheckerboardTarget,
    CirclesTarget,
    QualityLimits,
    RigPrior,
    Site,
)
from daemon.schedule import Schedule
from drivers.protocols import PixelFormat, Role
from drivers.sim.settings import (
    AsBuilt,
    Motion,
    Optics,
    Scenario,
    ScenarioKind,
    Sensor,
    SimSettings,
)

DEFAULT_STATE_DIRECTORY = Path("/var/lib/dcam")


def _number_to_list(value: object) -> object:
    return [value] if isinstance(value, int | float) else value


def _beside_the_config(value: Path, info: ValidationInfo) -> Path:
    """Take a relative path as relative to the config file, not to where the daemon was started."""
    base: Path = (info.context or {}).get("directory", Path())
    return base / value.expanduser()


PositiveFloat = Annotated[float, Field(gt=0)]
Pair = Annotated[tuple[float, float], Strict(strict=False)]
Triple = Annotated[tuple[float, float, float], Strict(strict=False)]
Directory = Annotated[Path, Strict(strict=False), AfterValidator(_beside_the_config)]
Instant = Annotated[AwareDatetime, Strict(strict=False)]
Backend = Literal["aravis", "harvesters", "simulated", "replay"]


class Section(BaseModel):
    """A table of the config: no unknown keys, no silent conversions, no NaN."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class SiteSection(Section):
    """`[site]`."""

    name: str = Field(min_length=1)


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


class CamerasSection(Section):
    """`[camera]`."""

    main: CameraSection
    sub: CameraSection

    def of(self, role: Role) -> CameraSection:
        """Give one camera's table."""
        return self.main if role == "main" else self.sub


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
    distance_sigma_mm: float = Field(default=20.0, gt=0)

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


class CheckerboardSection(Section):
    """`[target.sub]`: a checkerboard; the square at the WS origin is black."""

    kind: Literal["checkerboard"] = "checkerboard"
    squares_x: int = Field(ge=4, le=1000)
    squares_y: int = Field(ge=4, le=1000)
    square_mm: float = Field(gt=0)
    distance_mm: float = Field(gt=0, le=1e5)

    def target(self) -> CheckerboardTarget:
        """Convert to the core's type."""
        return CheckerboardTarget(
            squares_x=self.squares_x,
            squares_y=self.squares_y,
            square_mm=self.square_mm,
            distance_mm=self.distance_mm,
        )


class TargetsSection(Section):
    """`[target]`."""

    main: CirclesSection
    sub: CheckerboardSection


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
    rotation_sigma_deg: float = Field(default=1.0, gt=0, le=45.0)
    offset_main_sub_mm: Triple
    offset_sigma_mm: float = Field(default=3.0, gt=0, le=1000.0)

    def prior(self) -> RigPrior:
        """Convert to the core's type."""
        return RigPrior(
            rotation_main_sub_deg=np.array(self.rotation_main_sub_deg, dtype=np.float64),
            rotation_sigma_deg=self.rotation_sigma_deg,
            offset_main_sub_mm=np.array(self.offset_main_sub_mm, dtype=np.float64),
            offset_sigma_mm=self.offset_sigma_mm,
        )


class ScheduleSection(Section):
    """`[schedule]`: slots at offset_s + k * period_s of the wall clock, UTC."""

    period_s: int = Field(default=60, ge=1, le=86_400)
    offset_s: int = Field(default=0, ge=0)
    max_late_s: float = Field(default=2.0, gt=0)

    def schedule(self) -> Schedule:
        """Convert to the daemon's type; later than half a period is nearer to the next slot."""
        return Schedule(self.period_s, self.offset_s, min(self.max_late_s, self.period_s / 2))


class ExposureSection(Section):
    """`[exposure]`: fixed exposure and gain of each camera; no gain means the camera's lowest."""

    main_us: float = Field(default=5000.0, ge=1.0, le=1e7)
    sub_us: float = Field(default=5000.0, ge=1.0, le=1e7)
    main_gain_db: float | None = Field(default=None, ge=0.0, le=60.0)
    sub_gain_db: float | None = Field(default=None, ge=0.0, le=60.0)


class TriggerSection(Section):
    """`[trigger]`: the software trigger of both cameras."""

    timeout_s: float = Field(default=2.0, gt=0, le=60.0)


class QualitySection(Section):
    """`[quality]`: what a row must hold to be called good."""

    expected_drift_mrad: float = Field(default=1.0, gt=0, le=100.0)
    expected_drift_mm: float = Field(default=1.5, gt=0, le=1000.0)
    max_sigma_mm: float = Field(default=0.5, gt=0)
    max_skew_ms: float = Field(default=20.0, gt=0)

    def limits(self) -> QualityLimits:
        """Convert to the core's type."""
        return QualityLimits(**self.model_dump())


class StorageSection(Section):
    """`[storage]`: where the database and the frames live."""

    directory: Directory = DEFAULT_STATE_DIRECTORY


class LogSection(Section):
    """`[log]`."""

    format: Literal["keyvalue", "json"] = "keyvalue"
    level: Literal["debug", "info", "warning", "error"] = "info"


class ReplaySection(Section):
    """`[replay]`: the frame set that the `replay` backend plays."""

    directory: Directory | None = None


class ScenarioSection(Section):
    """`[[simulation.scenarios]]`: something that happens to the simulated rig for a while."""

    kind: ScenarioKind
    start_min: float = Field(default=0.0, ge=0)
    end_min: float | None = Field(default=None, gt=0)
    role: Role | None = None
    repeat_min: float | None = Field(default=None, gt=0)


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
    ramp_min: float = Field(default=10.0, ge=0)
    night_light: float = Field(default=0.005, ge=0, le=1.0)
    as_built_scale: float = Field(default=1.0, ge=0, le=10.0)
    noise: bool = True

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
                ramp_min=self.ramp_min,
            ),
            as_built=AsBuilt(scale=self.as_built_scale),
            optics=Optics(night_light=self.night_light),
            sensor=Sensor(noise=self.noise),
        )


class Config(Section):
    """The whole file."""

    site_section: SiteSection = Field(alias="site")
    camera: CamerasSection
    target: TargetsSection
    rig: RigSection
    schedule: ScheduleSection = ScheduleSection()
    exposure: ExposureSection = ExposureSection()
    trigger: TriggerSection = TriggerSection()
    quality: QualitySection = QualitySection()
    storage: StorageSection = StorageSection()
    log: LogSection = LogSection()
    replay: ReplaySection = ReplaySection()
    simulation: SimulationSection = SimulationSection()

    _path: Path = PrivateAttr(default=Path("dcam.toml"))

    @property
    def path(self) -> Path:
        """The file that this was read from, for messages."""
        return self._path

    @property
    def name(self) -> str:
        """What the site is called."""
        return self.site_section.name

    def site(self) -> Site:
        """Convert cameras, targets, rig and limits to the core's type."""
        return Site(
            main=self.camera.main.geometry(),
            sub=self.camera.sub.geometry(),
            main_target=self.target.main.target(),
            sub_target=self.target.sub.target(),
            rig=self.rig.prior(),
            quality=self.quality.limits(),
        )

    def config_hash(self) -> str:
        """Give the SHA-256 of what turns a frame pair into numbers, as 64 hex digits.

        Two rows with equal hash, calibration and version were measured alike: the hash covers
        `[camera]` geometry, `[target]`, `[rig]` and `[quality]`, and neither the order nor the
        spelling of the file (8 or 8.0), nor where things are stored or logged.
        """
        return hashlib.sha256(_canonical_json(self.site()).encode()).hexdigest()


def _canonical_json(site: Site) -> str:
    return json.dumps(
        asdict(site),
        sort_keys=True,
        separators=(",", ":"),
        allow_nan=False,
        default=lambda array: array.tolist(),
    )
