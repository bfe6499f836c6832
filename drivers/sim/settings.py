"""What a simulated rig is made of and what happens to it: plain values, with a sober default."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Literal, get_args

from drivers.protocols import Role

Disturbance = Literal[
    "night",
    "insect_main",
    "insect_sub",
    "snow",
    "rain",
    "glare",
    "cobweb",
    "cover",
    "haze",
    "vibration",
    "camera_loss",
]
"""What makes images worse or takes them away."""
Triple = tuple[float, float, float]
ScenarioKind = Literal["drift", "bridge", Disturbance]
DISTURBANCES: tuple[Disturbance, ...] = get_args(Disturbance)


@dataclass(frozen=True, slots=True)
class Scenario:
    """Something that happens for a while; minutes count from `SimSettings.start_utc`."""

    kind: ScenarioKind
    start_min: float = 0.0
    end_min: float | None = None
    """None: without end."""
    role: Role | None = None
    """Which camera it strikes, if not an insect, haze or vibration; None is both."""
    repeat_min: float | None = None
    """Come again after so many minutes, e.g. 1440 for every night."""

    def minutes_inside(self, minute: float) -> tuple[float, float] | None:
        """Minutes since the window opened and until it closes; None outside the window."""
        since = minute - self.start_min
        if since < 0.0:
            return None
        if self.repeat_min is not None:
            since %= self.repeat_min
        left = float("inf") if self.end_min is None else self.end_min - self.start_min - since
        return (since, left) if left > 0.0 else None

    def strikes(self, role: Role | None) -> bool:
        """Whether it is for this camera; None asks for any."""
        return role is None or self.role is None or self.role == role


@dataclass(frozen=True, slots=True)
class Motion:
    """How far and how fast rig and bridge move while a `drift` or `bridge` scenario is on."""

    drift_mrad: float = 1.0
    """Largest rig rotation about each axis."""
    drift_mm: float = 1.5
    """Largest rig translation along each axis."""
    drift_period_min: float = 720.0
    """Middle of the periods that the drift is made of."""
    bridge_daily_mm: float = 5.0
    """Vertical amplitude of the slow motion of the bridge; a tenth of it sideways."""
    bridge_period_min: float = 1440.0
    bridge_small_mm: float = 0.3
    """Amplitude of the faster motion, periods of minutes."""
    bridge_course: tuple[tuple[float, float], ...] = ()
    """Minutes after the start and mm up, in time order: what happens to the bridge besides, as when
    a slab is cast or concrete creeps. Straight between them, level before and after; no scenario
    switches it."""
    vibration_mrad: float = 0.05
    """1 sigma of the rig's turn about each axis, another one at each instant of a `vibration`."""
    vibration_apart: float = 0.1
    """Share of it by which the main camera shakes apart from the sub-camera."""
    ramp_min: float = 10.0
    """How long motion takes to set in and to end at the edges of its windows."""


@dataclass(frozen=True, slots=True)
class Print:
    """How far a printed board is from the nominal one."""

    line_error_um: float = 4.0
    """rms of the position of each printed line."""
    scale_error: float = 0.0005
    """1 sigma of the print scale along x and y, held below 0.001."""
    bow_um: float = 25.0
    """Height of the board's middle over its corners, away from the camera."""


@dataclass(frozen=True, slots=True)
class AsBuilt:
    """1-sigma departures of the true rig from the drawing, beyond the site's own sigmas."""

    scale: float = 1.0
    """Multiplies every departure, the site's sigmas and the print too; 0 is just as drawn."""
    main_focal: float = 0.005
    """Relative departure of the main lens from its nominal focal length."""
    sub_focal: float = 0.01
    centre_px_per_1000: float = 6.0
    """Principal point from the image centre, per 1000 px of image width."""
    sub_distortion: tuple[float, float, float, float, float] = (-0.09, 0.02, 3e-4, -2e-4, -0.002)
    """k1, k2, p1, p2, k3 (OpenCV's order); each varies by a tenth."""
    target_tilt_deg: float = 1.5
    """Each target's rotation about each axis, against its camera."""
    board_offset_mm: float = 1.0
    """The board's middle, off the sub-camera's axis and distance."""
    aim_mm: float = 2.0
    """The main target's centre, off the main camera's axis."""


@dataclass(frozen=True, slots=True)
class Optics:
    """Blur and light; grey values are fractions of saturation."""

    main_blur_px: float = 0.75
    """Gaussian sigma at the image centre, without pixel integration; at least 0.5."""
    sub_blur_px: float = 0.65
    corner_blur: float = 1.5
    """Sigma in the corner over sigma in the centre."""
    pedestal: float = 0.01
    main_white: float = 0.73
    main_grey: float = 0.28
    main_black: float = 0.03
    sub_white: float = 0.75
    sub_black: float = 0.05
    main_shading: float = 0.04
    """Loss of light from the brightest to the darkest corner, main camera."""
    sub_shading: float = 0.45
    light_change: float = 0.06
    """Amplitude of the slow change of the light."""
    night_light: float = 0.005
    """What is left of the light at night."""
    dusk_min: float = 0.0
    """How long the light takes to fall at the beginning of a night, and to come at its end."""
    haze_mm: float = 0.3
    """1 sigma of how far `haze` moves the main target's image along each axis, at the target;
    single discs move by a third of it against each other."""


@dataclass(frozen=True, slots=True)
class Sensor:
    """Sensor of both cameras; the defaults are those of a Sony IMX174."""

    bits: int = 8
    full_well_e: float = 32000.0
    read_noise_e: float = 7.0
    noise: bool = True
    """False: no noise at all, for tests of geometry."""


@dataclass(frozen=True, slots=True)
class HeadModel:
    """A pan-tilt head whose axes do not meet and are not quite square to the rig."""

    limit_pan_deg: float = 5.0
    limit_tilt_deg: float = 5.0
    arcsec_per_count: float = 23.142857
    """As read from a real unit; positions are truncated to counts."""
    pan_axis_mm: tuple[float, float, float] = (6.0, 0.0, -44.0)
    """A point of the pan axis (about -y) in CS at rest."""
    tilt_axis_mm: tuple[float, float, float] = (0.0, 118.0, -25.0)
    """A point of the tilt axis (about x) in CS at rest."""
    misalignment_deg: float = 1.0
    """1 sigma of each axis's direction."""


@dataclass(frozen=True, slots=True)
class Climate:
    """The air's temperature by hour, season and weather; the cameras follow it."""

    air_mean_c: float = 15.0
    air_daily_k: float = 8.0
    """Amplitude of the daily wave: half of what lies between night and afternoon."""
    air_seasonal_k: float = 0.0
    """Amplitude of the yearly wave, coldest on 20 January."""
    air_weather_k: float = 0.0
    """1 sigma of what the weather adds."""
    weather_days: float = 5.0
    """Middle of the periods that the weather is made of."""
    warmest_hour_utc: float = 15.0
    camera_lag_h: float = 0.0
    """Time constant with which the cameras follow the air."""
    main_above_air_k: float = 20.0
    """How much the main camera's own heat makes it warmer than the air."""
    sub_above_air_k: float = 20.0
    sensor_noise_k: float = 0.0
    """1 sigma of a camera's report of its temperature, frame by frame."""


@dataclass(frozen=True, slots=True)
class Breathing:
    """How rig, lenses, board and air change with temperature and time, as counted from the start.

    Creep is a random walk: so much, 1 sigma, in a day, and twice that in four.
    """

    cameras_urad_per_k: Triple = (0.0, 0.0, 0.0)
    """Turn of the main camera against the sub-camera, about the main camera's x, y and z axis."""
    cameras_urad_per_sqrt_day: Triple = (0.0, 0.0, 0.0)
    """Creep of the same turn."""
    main_px_per_k: tuple[float, float] = (0.0, 0.0)
    """Shift of the main camera's principal point, u and v."""
    main_scale_ppm_per_k: float = 0.0
    """Growth of the main camera's focal length."""
    sub_px_per_k: tuple[float, float] = (0.0, 0.0)
    """Shift of the sub-camera's principal point, u and v."""
    board_ppm_per_k: float = 0.0
    """Growth of the board, with the air's temperature."""
    board_urad_per_k: Triple = (0.0, 0.0, 0.0)
    """Turn of the board on the pier about its x axis, y axis and normal, with the air's."""
    board_urad_per_sqrt_day: Triple = (0.0, 0.0, 0.0)
    """Creep of the same turn."""
    board_fixed_mm: tuple[float, float] | None = None
    """The point of the board, in WS, that stays where it is; None: the board's middle."""
    air_gradient_k_per_m: float = 0.0
    """How much warmer the air is a metre higher, at the coldest hour; by day as much colder."""


@dataclass(frozen=True, slots=True)
class SimPlate:
    """One of the site's further plates: where it truly stands and how it moves."""

    name: str
    """Of the site's extra target."""
    offset_mm: tuple[float, float] | None = None
    """Its middle from the main target's, along x and y of WM, at its own distance; None: where
    the site expects it in the image, or else where there is most room."""
    bridge_factor: float | None = None
    """Its share of the bridge's movement; None: 1 for a measured plate, 0 for a fixed one."""
    knock_min: float = 0.0
    """Minutes after the start at which it is knocked aside, for good."""
    knock_mm: tuple[float, float] = (0.0, 0.0)
    """How far, x and y."""
    creep_mm_per_sqrt_day: float = 0.0
    """1 sigma along x and along y of its own slow movement, a random walk."""
    hidden_min: tuple[tuple[float, float], ...] = ()
    """Spans, from and to so many minutes after the start, in which it is not to be seen."""


@dataclass(frozen=True, slots=True)
class SimSettings:
    """One simulated rig. All that is random in it follows from the seed."""

    seed: int = 1
    start_utc: datetime = datetime(2026, 3, 1, tzinfo=UTC)
    """Minute 0 of the scenarios. Before it everything is at rest, and calibration is due."""
    scenarios: tuple[Scenario, ...] = (Scenario("drift"), Scenario("bridge"))
    motion: Motion = field(default_factory=Motion)
    print: Print = field(default_factory=Print)
    as_built: AsBuilt = field(default_factory=AsBuilt)
    optics: Optics = field(default_factory=Optics)
    sensor: Sensor = field(default_factory=Sensor)
    head: HeadModel = field(default_factory=HeadModel)
    climate: Climate = field(default_factory=Climate)
    breathing: Breathing = field(default_factory=Breathing)
    plates: tuple[SimPlate, ...] = ()

    @property
    def breathes(self) -> bool:
        """Whether temperature matters: something follows it, or the climate is not the usual."""
        return self.breathing != Breathing() or self.climate != Climate()

    def __post_init__(self) -> None:
        if min(self.optics.main_blur_px, self.optics.sub_blur_px) < 0.5:
            msg = "simulation: blur below 0.5 px cannot be rendered truly; set at least 0.5"
            raise ValueError(msg)
        if not 8 <= self.sensor.bits <= 16:
            msg = f"simulation: {self.sensor.bits} bits a pixel; set 8 to 16"
            raise ValueError(msg)
        if self.start_utc.utcoffset() is None:
            msg = "simulation: start_utc has no time zone; write UTC with Z"
            raise ValueError(msg)
