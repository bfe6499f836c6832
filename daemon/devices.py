"""The one place where the config's words become concrete clocks, cameras and heads."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Literal, cast

from daemon.config_model import Config
from daemon.errors import ConfigError
from drivers.clock import SteppedClock, SystemClock
from drivers.pair import SynchronizedPair
from drivers.protocols import Camera, CameraSettings, Clock, FramePairSource, PanTiltHead, Role

if TYPE_CHECKING:
    from drivers.sim.world import World

Built = Literal["aravis", "simulated", "replay"]
"""The backends that this version has."""

_BUILT = ("aravis", "simulated", "replay")
_ROLES: tuple[Role, Role] = ("main", "sub")


@dataclass(frozen=True, slots=True)
class SimulatedRig:
    """The simulated devices, and the one world behind them that knows the truth."""

    world: World
    source: FramePairSource
    head: PanTiltHead


def require_backend(config: Config) -> Built:
    """Give the backend of both cameras. Raises ConfigError: which key to set to what."""
    for role in _ROLES:
        backend = config.camera.of(role).backend
        if backend is None:
            raise _wrong(config, f"camera.{role}.backend", f"not set; use {' or '.join(_BUILT)}")
        if backend not in _BUILT:
            raise _wrong(
                config, f"camera.{role}.backend", f"{backend} is not in this version; use aravis"
            )
    main, sub = config.camera.main.backend, config.camera.sub.backend
    if main != sub:
        raise _wrong(config, "camera.sub.backend", f"{sub}, but the main camera's is {main}")
    if main == "aravis":
        _require_serials(config)
    if main == "replay" and config.replay.directory is None:
        raise _wrong(config, "replay.directory", "not set; name the frame set to play")
    return cast("Built", main)


def _require_serials(config: Config) -> None:
    for role in _ROLES:
        if config.camera.of(role).serial is None:
            raise _wrong(
                config, f"camera.{role}.serial", "not set; aravis finds a camera by its serial"
            )
    serial = config.camera.sub.serial
    if serial == config.camera.main.serial:
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
    from drivers.aravis import AravisCamera
    from drivers.aravis_device import load_aravis

    load_aravis()  # a library that is not installed is told at once, not at every slot
    main, sub = (
        AravisCamera(str(config.camera.of(role).serial), camera_settings(config, role), role)
        for role in _ROLES
    )
    return _pair(main, sub, config, clock)


def open_simulated_rig(config: Config, clock: Clock) -> SimulatedRig:
    """Give cameras and head of one simulated world."""
    from drivers.sim.cameras import SimulatedCamera
    from drivers.sim.head import SimulatedHead
    from drivers.sim.world import World

    world = World(config.site(), config.simulation.settings())
    main, sub = (
        SimulatedCamera(world, role, clock, config.camera.of(role).serial or "") for role in _ROLES
    )
    return SimulatedRig(world, _pair(main, sub, config, clock), SimulatedHead(world))


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
    )


def _pair(main: Camera, sub: Camera, config: Config, clock: Clock) -> SynchronizedPair:
    return SynchronizedPair(main, sub, clock, timeout_s=config.trigger.timeout_s)
