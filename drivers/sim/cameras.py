"""The two simulated cameras: the same face as the real ones, on the world and a clock."""

from __future__ import annotations

from datetime import datetime

from drivers.errors import DeviceLostError, FrameTimeoutError
from drivers.protocols import CapturedFrame, Clock, Role
from drivers.sim.render import Exposed
from drivers.sim.world import World

ORDINARY_US = 5000.0
"""The exposure for which the world's grey values are given, at a gain of 0 dB."""
EXPOSURE_LIMITS_US = (4.83, 4.0e6)
GAIN_LIMITS_DB = (0.0, 24.0)


class SimulatedCamera:
    """A camera of the simulated rig; implements `drivers.protocols.Camera`.

    The image is that of the instant of the trigger. Under a stepped clock that is the slot itself,
    so a run is reproducible to the last grey value. While a `camera_loss` scenario is on, the
    camera is gone: every call raises DeviceLostError until it is over and `open` is called.
    """

    def __init__(
        self,
        world: World,
        role: Role,
        clock: Clock,
        serial: str = "",
        exposure_us: float | None = None,
        gain_db: float | None = None,
    ) -> None:
        """None: 5 ms and the least gain, as `CameraSettings` has it."""
        self._configured = exposure_us or ORDINARY_US, gain_db or 0.0
        self._exposure_us, self._gain_db = self._configured
        self._world = world
        self._role: Role = role
        self._clock = clock
        self._serial = serial or f"simulated-{role}"
        self._open = False
        self._frame_id = 0
        self._triggered: tuple[datetime, float, tuple[float, float]] | None = None

    @property
    def is_lost(self) -> bool:
        """It is missed only when it is asked for a frame."""
        return False

    @property
    def serial(self) -> str:
        """The serial number from the config."""
        return self._serial

    def open(self) -> None:
        """Connect, exposure and gain as configured; fails while a camera loss is on."""
        self._open = True
        self._require_present()
        self._exposure_us, self._gain_db = self._configured

    def set_exposure(self, exposure_us: float, gain_db: float | None) -> None:
        """Expose the next frames so, within the limits of a GS3."""
        self._require_present()
        self._exposure_us = _within(exposure_us, EXPOSURE_LIMITS_US)
        if gain_db is not None:
            self._gain_db = _within(gain_db, GAIN_LIMITS_DB)

    def arm(self) -> None:
        """Forget a frame that was triggered and never fetched."""
        self._require_present()
        self._triggered = None

    def trigger(self) -> None:
        """Expose now."""
        self._require_present()
        when_utc, monotonic_s = self._clock.now_utc(), self._clock.monotonic_s()
        self._triggered = (when_utc, monotonic_s, self._world.head_deg())
        self._frame_id += 1

    def fetch(self, timeout_s: float) -> CapturedFrame:
        """Render what was there at the trigger; takes no simulated time."""
        self._require_present()
        if self._triggered is None:
            msg = (
                f"{self._role} camera {self._serial}: no frame in {timeout_s:g} s; trigger it first"
            )
            raise FrameTimeoutError(msg, self._role)
        (when_utc, monotonic_s, head_deg), self._triggered = self._triggered, None
        return CapturedFrame(
            pixels=self._world.render(self._role, when_utc, head_deg, self._exposed()),
            bits=self._world.settings.sensor.bits,
            frame_id=self._frame_id,
            camera_time_ns=round(monotonic_s * 1e9),
            trigger_monotonic_s=monotonic_s,
            exposure_us=self._exposure_us,
            gain_db=self._gain_db,
            temperature_c=self._world.reported_c(self._role, when_utc),
        )

    def close(self) -> None:
        """Disconnect."""
        self._open = False
        self._triggered = None

    def _exposed(self) -> Exposed:
        return Exposed(self._exposure_us / ORDINARY_US, 10.0 ** (self._gain_db / 20.0))

    def _require_present(self) -> None:
        if self._open and not self._world.active("camera_loss", self._clock.now_utc(), self._role):
            return
        self.close()
        msg = f"{self._role} camera {self._serial}: not there; check its cable and power"
        raise DeviceLostError(msg, self._role)


def _within(value: float, limits: tuple[float, float]) -> float:
    return min(max(value, limits[0]), limits[1])
