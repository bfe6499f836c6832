"""The small faces behind which hardware, replayed files and the simulated rig are alike."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass
from datetime import datetime
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

Role = Literal["main", "sub"]
Image = NDArray[np.uint8] | NDArray[np.uint16]
PixelFormat = Literal["Mono8", "Mono10", "Mono12", "Mono16"]


@dataclass(frozen=True, slots=True)
class TriggerIn:
    """A frame is triggered by an edge on a line, not by software."""

    line: str
    """GenICam name, as `Line3`."""
    activation: Literal["RisingEdge", "FallingEdge"] = "RisingEdge"


@dataclass(frozen=True, slots=True)
class LineOut:
    """A line shows a signal of the camera to the outside."""

    line: str
    """GenICam name, as `Line2`."""
    source: str = "ExposureActive"
    """GenICam name of the signal: high while the sensor exposes."""


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """What the config asks of one camera; the camera's own memory never overrides it."""

    width_px: int
    height_px: int
    """Size of the image; smaller than the sensor means its middle part."""
    exposure_us: float | None = None
    """None: 5 ms, or the nearest the camera allows."""
    gain_db: float | None = None
    """None: the lowest the camera has, which is the least noise."""
    pixel_format: PixelFormat = "Mono8"
    """GenICam name; more than 8 bits come unpacked, 16 bits a pixel."""
    packet_size_bytes: int | None = None
    """GigE Vision stream packet; None: the largest the network is found to carry."""
    trigger: TriggerIn | None = None
    """None: the software trigger."""
    line_out: LineOut | None = None
    """None: lines are left as they are."""
    open_timeout_s: float = 15.0
    """Deadline of `Camera.open`."""
    command_timeout_s: float = 4.0
    """Deadline of `arm` and `trigger`, each."""
    close_timeout_s: float = 4.0
    """Of `close`, which then leaves behind what the library has not let go of."""


@dataclass(frozen=True, slots=True)
class CapturedFrame:
    """One complete frame as the camera gave it."""

    pixels: Image
    """(height, width) greyscale, uint8 or uint16."""
    bits: int
    """Significant bits of a pixel: 8 to 16; a saturated pixel is 2**bits - 1."""
    frame_id: int
    """The camera's own frame counter."""
    camera_time_ns: int
    """The camera's own clock; comparable within one camera only."""
    trigger_monotonic_s: float
    """Host monotonic time at which the trigger command went out; where a line triggers, at which
    the frame was expected."""
    exposure_us: float | None = None
    gain_db: float | None = None
    temperature_c: float | None = None


@dataclass(frozen=True, slots=True)
class CapturedPair:
    """Two frames of one slot."""

    main: CapturedFrame
    sub: CapturedFrame
    skew_s: float | None
    """Sub trigger minus main trigger, host clock, s; None when it was not measured, as where the
    main camera's line triggers the sub-camera: the host sees neither edge."""


class Camera(Protocol):
    """A camera that takes one frame at a trigger.

    Every call returns or raises a `drivers.errors.DeviceError` within its deadline.
    After a `DeviceLostError` the object is closed and `open` starts again.
    """

    @property
    def serial(self) -> str:
        """The serial number the camera is selected by."""
        ...

    @property
    def is_lost(self) -> bool:
        """Whether the camera, opened, is known to be gone; asks nothing, at any time."""
        ...

    def open(self) -> None:
        """Find the camera by serial, apply the settings, read them back, start acquisition."""
        ...

    def set_exposure(self, exposure_us: float, gain_db: float | None) -> None:
        """Expose the next frames so, until `close`; brought within what the camera can.

        gain_db None leaves the gain as it is. A camera that refuses keeps what it has; the frames
        say what that is.
        """
        ...

    def arm(self) -> None:
        """Throw away stale frames, so that the next frame is the one triggered next."""
        ...

    def trigger(self) -> None:
        """Send the software trigger; where a line triggers, expect its frame from now on."""
        ...

    def fetch(self, timeout_s: float) -> CapturedFrame:
        """Give the triggered frame; an incomplete frame is refused."""
        ...

    def close(self) -> None:
        """Release the device; safe to call at any time, more than once."""
        ...


class FramePairSource(Protocol):
    """Whatever can give one frame pair for a slot."""

    def prepare(self) -> None:
        """Open both cameras ahead of the first slot, so that it is taken in time.

        Raises `drivers.errors.DeviceError`; the slots are tried all the same.
        """
        ...

    def set_exposure(self, role: Role, exposure_us: float, gain_db: float | None) -> None:
        """Have a camera expose so from the next `capture` on, also after it was opened again.

        Only notes the wish, and never fails. Frames tell what came of it; a source whose frames
        are long taken ignores it.
        """
        ...

    def capture(self, slot_utc: datetime) -> CapturedPair:
        """Take both frames of a slot.

        Raises `drivers.errors.DeviceError` (its `role` tells which camera) when a frame cannot
        be had; the next call tries again, opening the lost device again.
        """
        ...

    def close(self) -> None:
        """Release both cameras."""
        ...


@dataclass(frozen=True, slots=True)
class HeadSettings:
    """What the config asks of a pan-tilt head."""

    pan_limits_deg: tuple[float, float] = (-5.0, 5.0)
    tilt_limits_deg: tuple[float, float] = (-5.0, 5.0)
    """Lowest and highest angle that may be asked for; checked before a byte is sent."""
    speed_deg_s: float | None = None
    """None: the head's own speed."""
    tolerance_deg: float = 0.05
    """How far from the angle asked for the head may come to rest."""
    answer_timeout_s: float = 1.0
    """Deadline of one answer; a question is asked three times."""
    move_timeout_s: float = 60.0
    """Deadline of one move."""


@dataclass(frozen=True, slots=True)
class HeadReport:
    """What a head says of itself."""

    name: str
    """Its firmware as it names it, or the protocol."""
    position_deg: tuple[float, float] | None
    """Pan and tilt; None for a head without feedback."""
    limits_deg: tuple[tuple[float, float], tuple[float, float]] | None
    """The head's own limits of pan and of tilt, where it tells them."""
    power: str | None
    """Supply voltage and temperatures in the head's words, where it tells them."""


class PanTiltHead(Protocol):
    """A two-axis head; angles in degrees from its own zero.

    Every call returns or raises a `drivers.errors.HeadError` within its deadline. The connection
    is made when it is first needed and made again when it was lost. A move that fails for whatever
    reason, Ctrl-C too, ends with the head halted, or with an error that says it could not be.
    """

    @property
    def reports_position(self) -> bool:
        """Whether the head tells its angles; else only images show where the rig is."""
        ...

    def move_to(self, pan_deg: float, tilt_deg: float) -> None:
        """Move and wait until there.

        Raises `drivers.errors.HeadLimitError` before any motion, and HeadError.
        """
        ...

    def position_deg(self) -> tuple[float, float] | None:
        """Pan and tilt as the head reports them; None for a head without feedback."""
        ...

    def describe(self) -> HeadReport:
        """Ask the head who and where it is, without moving it."""
        ...

    def halt(self) -> None:
        """Stop all motion at once; may be called from another thread than the one that moves."""
        ...

    def close(self) -> None:
        """Halt and release the port; safe to call more than once."""
        ...


class Sensor(Protocol):
    """Something that gives one number when asked."""

    @property
    def bus(self) -> str:
        """Sensors of one bus are read one after the other."""
        ...

    def read(self, timeout_s: float) -> float:
        """Give a finite number. Raises `drivers.errors.SensorError`, within the time if it can."""
        ...

    def stop(self) -> None:
        """Cut off a read that is under way in another thread, if that can be; none follows."""
        ...


class Clock(Protocol):
    """Where time comes from: UTC to identify, monotonic to wait."""

    def now_utc(self) -> datetime:
        """The present, timezone-aware UTC."""
        ...

    def monotonic_s(self) -> float:
        """Seconds that never step."""
        ...

    def pause(self, seconds: float) -> None:
        """Let monotonic time pass, whatever becomes of the wall clock."""
        ...

    def wait_until(
        self, when_utc: datetime, stop: threading.Event, longest_s: float = math.inf
    ) -> bool:
        """Wait for a wall-clock time; False if `stop` was set before.

        Ends about when it should by monotonic time, or after `longest_s` of it, at the latest: a
        clock that is stepped back meanwhile says less than that time afterwards.
        """
        ...
