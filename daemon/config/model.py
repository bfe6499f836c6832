"""What `dcam.toml` may hold: every table and key, and their conversion to the layers' own types.

Every key carries its unit in its name. What a key is for stands in `config.example.toml`.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field, PrivateAttr, Strict

from core.site import Site, StabilityBudget
from daemon.config.alarm import AlarmSection
from daemon.config.log import LogSection
from daemon.config.outputs import FleetSection, InfluxSection, MqttSection
from daemon.config.readings import MOST_READINGS, ReadingSection
from daemon.config.report import ReportSection
from daemon.config.section import Directory, Section
from daemon.config.simulation import SimulationSection
from daemon.config.site import (
    CamerasSection,
    QualitySection,
    RigSection,
    SiteSection,
    StabilitySection,
    TargetsSection,
)
from daemon.config.web import WebSection
from daemon.retention.rules import Rules
from drivers.protocols import HeadSettings, LineOut, Role, TriggerIn

if TYPE_CHECKING:  # scheduler and cameras are loaded by who runs slots, not by who reads a config
    from daemon.burst import BurstPlan
    from daemon.schedule import Schedule

HeadBackend = Literal["ptu", "pelco-d", "simulated"]
Angle = Annotated[float, Field(ge=-179.99, le=179.99)]
AnglePair = Annotated[tuple[Angle, Angle], Strict(strict=False)]

Time = Annotated[float, Field(ge=1.0, le=1e7)]
TimePair = Annotated[tuple[Time, Time], Strict(strict=False)]
Gain = Annotated[float, Field(ge=0.0, le=60.0)]
GainPair = Annotated[tuple[Gain, Gain], Strict(strict=False)]

DEFAULT_STATE_DIRECTORY = Path("/var/lib/dcam")

BURST_SHARE = 0.5
"""Of the period, for the pairs of a slot to be taken in; the rest is for measuring them."""


class ScheduleSection(Section):
    """`[schedule]`: slots at offset_s + k * period_s of the wall clock, UTC."""

    period_s: int = Field(default=60, ge=1, le=86_400)
    offset_s: int = Field(default=0, ge=0)
    max_late_s: float = Field(default=2.0, gt=0)
    burst: int = Field(default=1, ge=1, le=32)
    burst_spacing_s: float = Field(default=0.5, gt=0, le=60.0)

    def schedule(self) -> Schedule:
        """Convert to the daemon's type; later than half a period is nearer to the next slot."""
        from daemon.schedule import Schedule

        return Schedule(self.period_s, self.offset_s, min(self.max_late_s, self.period_s / 2))


class ExposureSection(Section):
    """`[exposure]`: fixed, or the start of a loop that follows the light within limits.

    No gain means the camera's lowest.
    """

    mode: Literal["fixed", "auto"] = "fixed"
    main_us: float = Field(default=5000.0, ge=1.0, le=1e7)
    sub_us: float = Field(default=5000.0, ge=1.0, le=1e7)
    main_gain_db: float | None = Field(default=None, ge=0.0, le=60.0)
    sub_gain_db: float | None = Field(default=None, ge=0.0, le=60.0)
    white_level: float = Field(default=0.65, ge=0.3, le=0.75)
    main_limits_us: TimePair = (50.0, 100_000.0)
    sub_limits_us: TimePair = (50.0, 100_000.0)
    main_gain_limits_db: GainPair = (0.0, 12.0)
    sub_gain_limits_db: GainPair = (0.0, 12.0)

    @property
    def longest_us(self) -> float:
        """The longest exposure that there may be."""
        if self.mode == "fixed":
            return max(self.main_us, self.sub_us)
        return max(self.main_limits_us[1], self.sub_limits_us[1])


class TriggerSection(Section):
    """`[trigger]`: both cameras by software, or the sub-camera by a line of the main camera's."""

    mode: Literal["software", "hardware"] = "software"
    timeout_s: float = Field(default=2.0, gt=0, le=60.0)
    main_output_line: str = Field(default="Line2", min_length=1)
    main_output_source: str = Field(default="ExposureActive", min_length=1)
    sub_input_line: str = Field(default="Line3", min_length=1)
    sub_edge: Literal["rising", "falling"] = "rising"

    def line_out(self, role: Role) -> LineOut | None:
        """What a camera shows on its line; None leaves its lines alone."""
        if self.mode == "software" or role == "sub":
            return None
        return LineOut(self.main_output_line, self.main_output_source)

    def line_in(self, role: Role) -> TriggerIn | None:
        """The line that triggers a camera; None for the software trigger."""
        if self.mode == "software" or role == "main":
            return None
        rising = self.sub_edge == "rising"
        return TriggerIn(self.sub_input_line, "RisingEdge" if rising else "FallingEdge")


class GenicamSection(Section):
    """`[genicam]`: the vendor's library behind `backend = "harvesters"`."""

    producer: Directory | None = None


class PanTiltSection(Section):
    """`[pan_tilt]`: the head that turns the rig for a calibration."""

    backend: HeadBackend | None = None
    port: str | None = Field(default=None, min_length=1)
    baud: int | None = Field(default=None, ge=300, le=921_600)
    address: int = Field(default=1, ge=1, le=255)
    reports_position: bool = True
    pan_limits_deg: AnglePair = (-5.0, 5.0)
    tilt_limits_deg: AnglePair = (-5.0, 5.0)
    home_deg: AnglePair = (0.0, 0.0)
    speed_deg_s: float | None = Field(default=None, gt=0, le=200.0)
    speed_level: int = Field(default=1, ge=1, le=63)
    tolerance_deg: float = Field(default=0.05, gt=0, le=5.0)
    answer_timeout_s: float = Field(default=1.0, gt=0, le=60.0)
    move_timeout_s: float = Field(default=60.0, gt=0, le=600.0)

    @property
    def is_serial(self) -> bool:
        """Whether there is a head at a port."""
        return self.backend in {"ptu", "pelco-d"}

    def settings(self) -> HeadSettings:
        """Convert to the drivers' type."""
        return HeadSettings(
            pan_limits_deg=self.pan_limits_deg,
            tilt_limits_deg=self.tilt_limits_deg,
            speed_deg_s=self.speed_deg_s,
            tolerance_deg=self.tolerance_deg,
            answer_timeout_s=self.answer_timeout_s,
            move_timeout_s=self.move_timeout_s,
        )

    def room_deg(self) -> tuple[float, float]:
        """How far pan and tilt may go from home, either way."""
        axes = zip(self.home_deg, (self.pan_limits_deg, self.tilt_limits_deg), strict=True)
        pan_deg, tilt_deg = (min(home - low, high - home) for home, (low, high) in axes)
        return pan_deg, tilt_deg


class StorageSection(Section):
    """`[storage]`: where the database and the frames live."""

    directory: Directory = DEFAULT_STATE_DIRECTORY


class RetentionSection(Section):
    """`[retention]`: how long frames are kept, and what room is left on the disk."""

    every_slot_days: int = Field(default=30, ge=1, le=36_500)
    hourly_days: int = Field(default=365, ge=1, le=36_500)
    frames_days: int | None = Field(default=None, ge=1, le=36_500)
    frames_max_gb: float | None = Field(default=None, gt=0)
    min_free_gb: float = Field(default=5.0, ge=0)
    reserve_mb: int = Field(default=64, ge=0, le=10_000)

    def rules(self) -> Rules:
        """Convert to the daemon's type."""
        return Rules(**self.model_dump())


class ReplaySection(Section):
    """`[replay]`: the frame set that the `replay` backend plays."""

    directory: Directory | None = None


class Config(Section):
    """The whole file."""

    site_section: SiteSection = Field(alias="site")
    camera: CamerasSection
    target: TargetsSection
    rig: RigSection
    schedule: ScheduleSection = ScheduleSection()
    exposure: ExposureSection = ExposureSection()
    trigger: TriggerSection = TriggerSection()
    genicam: GenicamSection = GenicamSection()
    pan_tilt: PanTiltSection = PanTiltSection()
    quality: QualitySection = QualitySection()
    stability: StabilitySection = StabilitySection()
    reading: Annotated[
        tuple[ReadingSection, ...], Strict(strict=False), Field(max_length=MOST_READINGS)
    ] = ()
    storage: StorageSection = StorageSection()
    retention: RetentionSection = RetentionSection()
    alarm: AlarmSection = AlarmSection()
    report: ReportSection = ReportSection()
    mqtt: MqttSection = MqttSection()
    influx: InfluxSection = InfluxSection()
    fleet: FleetSection = FleetSection()
    web: WebSection = WebSection()
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

    @property
    def has_stepped_clock(self) -> bool:
        """Whether the site's time is simulated and not the machine's."""
        return self.camera.main.backend == "simulated" and self.simulation.clock == "stepped"

    def site(self) -> Site:
        """Convert cameras, targets, rig and limits to the core's type."""
        return Site(
            main=self.camera.main.geometry(),
            sub=self.camera.sub.geometry(),
            main_target=self.target.main.target(),
            sub_target=self.target.sub.target(),
            rig=self.rig.prior(),
            quality=self.quality.limits(),
            lens_model=self.camera.sub.model(),
            extra_targets=tuple(extra.extra_target() for extra in self.target.extra),
            stability=self.stability.budget(),
            temperature_reading=self.stability.temperature_reading,
        )

    def burst_plan(self) -> BurstPlan:
        """Convert to the daemon's type; pairs end in time for the last one to be measured."""
        from daemon.burst import BurstPlan

        return BurstPlan(
            self.schedule.burst, self.schedule.burst_spacing_s, self.schedule.period_s * BURST_SHARE
        )

    def config_hash(self) -> str:
        """Give the SHA-256 of what turns a frame pair into numbers, as 64 hex digits.

        Two rows with equal hash, calibration and version were measured alike: the hash covers
        `[camera]` geometry, `[target]`, `[rig]`, `[quality]` and `[stability]`, and neither the
        order nor the spelling of the file (8 or 8.0), nor where things are stored or logged.
        """
        return hashlib.sha256(_canonical_json(self.site()).encode()).hexdigest()


def _canonical_json(site: Site) -> str:
    unset = None, (), asdict(StabilityBudget())

    def present(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        """Leave out what is not set: a new optional key must not change old hashes."""
        return {
            name: value
            for name, value in pairs
            if isinstance(value, np.ndarray) or value not in unset
        }

    return json.dumps(
        asdict(site, dict_factory=present),
        sort_keys=True,
        separators=(",", ":"),
        allow_nan=False,
        default=lambda array: array.tolist(),
    )
