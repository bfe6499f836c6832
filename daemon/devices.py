"""The one place where the config's words become concrete clocks, cameras and heads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Literal, cast

from daemon.config.model import Config
from daemon.errors import ConfigError, HardwareError
from drivers.clock import SteppedClock, SystemClock
from drivers.genicam.serial_number import is_same_serial, places_of
from drivers.pair import SynchronizedPair
from drivers.protocols import (
    Camera,
    CameraSettings,
    Clock,
    FramePairSource,
    PanTiltHead,
    Role,
    Sensor,
)

if TYPE_CHECKING:
    from drivers.sim.world import World

Built = Literal["aravis", "harvesters", "simulated", "replay"]
"""The backends that this version has."""

DISCOVERY_TIMEOUT_S = 15.0

_BUILT = ("aravis", "harvesters", "simulated", "replay")
_ROLES: tuple[Role, Role] = ("main", "sub")

OpenCamera = Callable[[str, CameraSettings, Role], Camera]
"""Makes a camera of its serial number, settings and role."""
_BAUD = {"ptu": 9600, "pelco-d": 2400, "simulated": 9600}
"""As most heads leave the factory."""


@dataclass(frozen=True, slots=True)
class SimulatedRig:
    """The simulated devices, and the one world behind them that knows the truth."""

    world: World
    source: FramePairSource
    head: PanTiltHead


@dataclass(frozen=True, slots=True)
class CalibrationRig:
    """What turns and sees during a calibration."""

    source: FramePairSource
    head: PanTiltHead
    hold_board: Callable[[int | None], None] | None
    """Brings the board into pose n before the sub-camera, and back with None; None where only
    a person can."""


def require_backend(config: Config) -> Built:
    """Give the backend of both cameras. Raises ConfigError: which key to set to what."""
    for role in _ROLES:
        backend = config.camera.of(role).backend
        if backend is None:
            raise _wrong(config, f"camera.{role}.backend", f"not set; use {' or '.join(_BUILT)}")
    main, sub = config.camera.main.backend, config.camera.sub.backend
    if main != sub:
        raise _wrong(config, "camera.sub.backend", f"{sub}, but the main camera's is {main}")
    if main in {"aravis", "harvesters"}:
        _require_serials(config, main)
    if main == "replay" and config.replay.directory is None:
        raise _wrong(config, "replay.directory", "not set; name the frame set to play")
    return cast("Built", main)


def _require_serials(config: Config, backend: str) -> None:
    for role in _ROLES:
        if config.camera.of(role).serial is None:
            problem = f"not set; {backend} finds a camera by its serial"
            raise _wrong(config, f"camera.{role}.serial", problem)
    serial = config.camera.sub.serial
    if is_same_serial(str(serial), str(config.camera.main.serial)):
        raise _wrong(config, "camera.sub.serial", f"{serial} is the main camera's as well")


def _wrong(config: Config, key: str, problem: str) -> ConfigError:
    return ConfigError(f"{config.path}: {key}: {problem}")


def open_clock(
    config: Config, last_utc: datetime | None = None, begin_utc: datetime | None = None
) -> Clock:
    """Give the clock of the site: the machine's, or a stepped one for the simulated rig.

    A stepped clock begins at `begin_utc` if given, or where the config says, else where the record
    ends (`last_utc`), so that simulated time goes on from one run to the next.
    """
    simulation = config.simulation
    if config.camera.main.backend != "simulated" or simulation.clock == "system":
        return SystemClock()
    if begin_utc is not None:
        return SteppedClock(begin_utc)
    begin = simulation.clock_start_utc or simulation.start_utc
    if simulation.clock_start_utc is None and last_utc is not None:
        begin = max(begin, last_utc)
    return SteppedClock(begin)


def open_pair_source(config: Config, clock: Clock) -> FramePairSource:
    """Give the source of frame pairs. A camera is opened when its first pair is wanted.

    Raises ConfigError, MissingLibraryError, FrameSetError.
    """
    backend = require_backend(config)
    if backend == "replay" and config.replay.directory is not None:
        from drivers.replay import ReplaySource

        return ReplaySource(config.replay.directory)
    if backend == "simulated":
        return open_simulated_rig(config, clock).source
    open_camera = _harvesters(config) if backend == "harvesters" else _aravis()
    main, sub = (
        open_camera(str(config.camera.of(role).serial), camera_settings(config, role), role)
        for role in _ROLES
    )
    return _pair(main, sub, config, clock)


def found_on_network(config: Config) -> dict[Role, str]:
    """Give the addresses of those of our cameras that answer on the network; nothing is opened.

    Only Aravis tells; the others say nothing of where a camera is. Raises MissingLibraryError,
    DeviceHangsError.
    """
    if config.camera.main.backend != "aravis":
        return {}
    from drivers.genicam.aravis_device import network_addresses

    addresses = network_addresses(DISCOVERY_TIMEOUT_S)
    serials, places = list(addresses), list(addresses.values())
    found = {role: places_of(str(config.camera.of(role).serial), serials) for role in _ROLES}
    return {role: places[indices[0]] for role, indices in found.items() if indices}


def open_simulated_rig(config: Config, clock: Clock) -> SimulatedRig:
    """Give cameras and head of one simulated world. Raises ConfigError for one that cannot be."""
    from drivers.sim.cameras import SimulatedCamera
    from drivers.sim.head import SimulatedHead
    from drivers.sim.world import World

    try:
        world = World(config.site(), config.simulation.settings())
    except ValueError as error:  # a plate that has no place in the image
        msg = f"{config.path}: {error}"
        raise ConfigError(msg) from None
    head: PanTiltHead = SimulatedHead(world)
    if config.pan_tilt.is_serial:
        from drivers.sim.head_angles import AnglesAsker

        if config.simulation.head_angles is None:
            problem = "not set; the simulated rig would not follow the head at pan_tilt.port"
            raise _wrong(config, "simulation.head_angles", problem)
        head = open_head(config)
        world.follow_head(_from_home(AnglesAsker(config.simulation.head_angles), config))
    serials = {role: config.camera.of(role).serial or "" for role in _ROLES}
    lights = {role: camera_settings(config, role) for role in _ROLES}
    main, sub = (
        SimulatedCamera(
            world, role, clock, serials[role], lights[role].exposure_us, lights[role].gain_db
        )
        for role in _ROLES
    )
    return SimulatedRig(world, _pair(main, sub, config, clock), head)


def _from_home(
    angles_deg: Callable[[], tuple[float, float]], config: Config
) -> Callable[[], tuple[float, float]]:
    """The simulated rig is aimed at its targets when its head is at home."""
    home = config.pan_tilt.home_deg

    def from_home() -> tuple[float, float]:
        pan_deg, tilt_deg = angles_deg()
        return pan_deg - home[0], tilt_deg - home[1]

    return from_home


def open_calibration_rig(config: Config, clock: Clock) -> CalibrationRig:
    """Give cameras and head for a calibration. Nothing is opened before it is needed.

    Raises ConfigError, MissingLibraryError, HardwareError for cameras that no head can turn.
    """
    backend = require_backend(config)
    if backend == "simulated":
        rig = open_simulated_rig(config, clock)
        return CalibrationRig(rig.source, rig.head, rig.world.hold_board)
    if backend == "replay":
        msg = "no pan-tilt head for backend replay, which plays what it has; use --from DIR"
        raise HardwareError(msg)
    if not config.pan_tilt.is_serial:
        raise _wrong(config, "pan_tilt.backend", "not set; use ptu or pelco-d, or --from DIR")
    return CalibrationRig(open_pair_source(config, clock), open_head(config), hold_board=None)


def open_bench(
    config: Config, clock: Clock
) -> tuple[FramePairSource, Callable[[int | None], None] | None]:
    """Give the cameras for lens views, and who holds the board: None is a person.

    Raises as `open_pair_source`.
    """
    if require_backend(config) == "simulated":
        rig = open_simulated_rig(config, clock)
        return rig.source, rig.world.hold_board
    return open_pair_source(config, clock), None


def open_head(config: Config) -> PanTiltHead:
    """Give the head at the configured port; it is opened when it is first needed.

    Raises ConfigError.
    """
    from drivers.heads.home import HomedHead
    from drivers.heads.pelco_d import PelcoHead, TimedPelcoHead
    from drivers.heads.ptu_ascii import PtuHead
    from drivers.heads.serial_line import SerialLine

    section, settings = config.pan_tilt, config.pan_tilt.settings()
    if section.port is None:
        raise _wrong(config, "pan_tilt.port", "not set; see ls /dev/serial/by-id")
    line = SerialLine(section.port, section.baud or _BAUD[section.backend or "ptu"])
    head: PanTiltHead
    if section.backend == "ptu":
        head = PtuHead(line, settings)
    elif section.reports_position:
        head = PelcoHead(line, settings, section.address)
    else:
        if section.speed_deg_s is None:
            problem = "not set; a head that reports no position is moved by time, at its true speed"
            raise _wrong(config, "pan_tilt.speed_deg_s", problem)
        if section.home_deg != (0.0, 0.0):
            problem = "must be [0, 0]: a head that reports no position counts from where it stands"
            raise _wrong(config, "pan_tilt.home_deg", problem)
        head = TimedPelcoHead(line, settings, section.address, section.speed_level)
    return head if section.home_deg == (0.0, 0.0) else HomedHead(head, section.home_deg)


def open_sensor(config: Config, number: int) -> Sensor:
    """Give the sensor of a reading, by its place in the config; nothing is opened or loaded yet."""
    from drivers.sensors.command import CommandSensor
    from drivers.sensors.file import FileSensor
    from drivers.sensors.modbus import ModbusSensor
    from drivers.sensors.modbus_url import ModbusAddress

    source = config.reading[number].source
    if isinstance(source, ModbusAddress):
        return ModbusSensor(source)
    return CommandSensor(source) if isinstance(source, tuple) else FileSensor(source)


def camera_settings(config: Config, role: Role) -> CameraSettings:
    """Give what the config asks of one camera."""
    camera, exposure = config.camera.of(role), config.exposure
    is_main = role == "main"
    return CameraSettings(
        width_px=camera.width_px,
        height_px=camera.height_px,
        exposure_us=exposure.main_us if is_main else exposure.sub_us,
        gain_db=exposure.main_gain_db if is_main else exposure.sub_gain_db,
        pixel_format=camera.pixel_format,
        packet_size_bytes=camera.packet_size_bytes,
        trigger=config.trigger.line_in(role),
        line_out=config.trigger.line_out(role),
    )


def _aravis() -> OpenCamera:
    from drivers.genicam.aravis import AravisCamera
    from drivers.genicam.aravis_device import load_aravis

    load_aravis()  # a library that is not installed is reported at once, not at every slot
    return AravisCamera


def _harvesters(config: Config) -> OpenCamera:
    from drivers.genicam.gentl import GentlCamera, find_producer

    producer = find_producer(config.genicam.producer)
    return lambda serial, settings, role: GentlCamera(serial, settings, producer, role)


def _pair(main: Camera, sub: Camera, config: Config, clock: Clock) -> SynchronizedPair:
    of_main, of_sub = config.camera.main, config.camera.sub
    return SynchronizedPair(
        main,
        sub,
        clock,
        timeout_s=config.trigger.timeout_s,
        main_triggers_sub=config.trigger.mode == "hardware",
        sizes_px=((of_main.width_px, of_main.height_px), (of_sub.width_px, of_sub.height_px)),
    )
