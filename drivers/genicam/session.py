"""One GenICam camera from opening to release: what a frame at a trigger takes, in any library."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import structlog

from drivers.errors import (
    DeviceLostError,
    FrameTimeoutError,
    IncompleteFrameError,
    SettingRefusedError,
)
from drivers.genicam.byte_order import is_swapped
from drivers.genicam.device import (
    BITS_OF_FORMAT,
    POLL_S,
    Device,
    Grabbed,
    NoAnswerError,
    NodeRefusedError,
)
from drivers.genicam.identity import read_identity
from drivers.genicam.setup import Applied, apply_settings, change_exposure, read_temperature_c
from drivers.protocols import CameraSettings, CapturedFrame, Image

_log = structlog.get_logger("dcam.drivers")

SETTLE_S = 0.3
"""A stream with no frame for this long is dry; Aravis keeps a torn frame for 0.2 s."""
DRAIN_S = 2.0
"""A stream that does not run dry within this is not waiting for triggers."""


class Session:
    """One opened device, from `start` to `release`; used in one thread only, but `is_lost`."""

    def __init__(self, device: Device, serial: str, settings: CameraSettings) -> None:
        self._device = device
        self._serial = serial
        self._settings = settings
        self._applied = Applied(None, None)
        self._temperature_c: float | None = None
        self._triggered_s = 0.0
        self._unanswered = False
        self._last_id: int | None = None
        self._last_time_ns = 0
        self._swapped = False
        """Whether the bytes of its deep pixels were last seen in the wrong order."""

    @property
    def is_lost(self) -> bool:
        """Whether the library has noticed by itself that the device is gone."""
        return self._device.is_lost

    def start(self) -> None:
        """Find the device, become its controller, set it up and start acquisition."""
        with self._connection("open"):
            self._device.open()
            said = read_identity(self._device.features)
            listed = self._device.listed_serial
            _log.info("camera_identity", serial=self._serial, listed=listed, said=said)
            self._applied = apply_settings(self._device.features, self._serial, self._settings)
            self._device.open_stream(self._settings)
            self._start_acquisition()

    def set_exposure(self, exposure_us: float, gain_db: float | None) -> None:
        """Change exposure and gain, as far as the camera can; its frames tell what came of it."""
        with self._connection("set the exposure"):
            self._applied = change_exposure(
                self._device.features, self._serial, exposure_us, gain_db
            )

    def arm(self) -> None:
        """Drop what nobody waits for any more, and read the temperature."""
        with self._connection("arm"):
            if self._unanswered:
                self._resynchronise()
            else:
                self._drain(0.0)
            self._temperature_c = read_temperature_c(self._device.features)

    def trigger(self) -> None:
        """Send the software trigger; where a line triggers, only note that a frame is due."""
        with self._connection("trigger"):
            self._unanswered = True
            self._triggered_s = time.monotonic()
            if self._settings.trigger is None:
                self._device.features.execute("TriggerSoftware")

    def fetch(self, timeout_s: float) -> CapturedFrame:
        """Wait for the next complete frame that is newer than the last one seen."""
        deadline_s = time.monotonic() + timeout_s
        while (remaining_s := deadline_s - time.monotonic()) > 0.0:
            with self._connection("fetch"):
                grabbed = self._device.pop(min(remaining_s, POLL_S))
            if grabbed is not None and self._is_new(grabbed):
                self._unanswered = False
                return self._frame(grabbed)
        raise FrameTimeoutError(self._no_frame(timeout_s))

    def release(self) -> None:
        """Give the device back; a dead one costs its time-outs here, where nobody waits."""
        try:
            self._device.release()
        except NoAnswerError as error:
            _log.info("camera_released", serial=self._serial, reason=str(error))

    def _no_frame(self, timeout_s: float) -> str:
        what = f"camera {self._serial}: no frame within {timeout_s:g} s"
        if self._settings.trigger is None:
            return f"{what}; {self._device.missing_data_advice}; and that the exposure is shorter"
        return f"{what}; check the wire from the main camera to {self._settings.trigger.line}"

    def _resynchronise(self) -> None:
        """A trigger was not answered: its frame must not be taken for the next trigger's.

        A camera that was restarted takes commands as if nothing had happened, but has forgotten
        its settings: that is a lost one.
        """
        if self._device.features.read("TriggerMode") != "On":
            msg = f"camera {self._serial}: was restarted; it will be opened again"
            raise DeviceLostError(msg)
        self._device.stop()
        self._start_acquisition()

    def _start_acquisition(self) -> None:
        """Start, and throw away what comes of triggers sent before, ours or another program's."""
        self._device.start()
        self._last_id = None  # a camera may count from the start of the acquisition
        self._drain(SETTLE_S)
        self._unanswered = False

    def _drain(self, quiet_s: float) -> None:
        """Drop every frame nobody waits for, until none comes for `quiet_s`."""
        stale = 0
        deadline_s = time.monotonic() + DRAIN_S
        while (grabbed := self._device.pop(quiet_s)) is not None:
            self._is_new(grabbed)
            stale += 1
            if time.monotonic() > deadline_s:
                msg = (
                    f"camera {self._serial}: TriggerMode = On refused: frames come without trigger"
                )
                raise SettingRefusedError(msg)
        if stale:
            _log.info("stale_frames_dropped", serial=self._serial, frames=stale)

    def _is_new(self, grabbed: Grabbed) -> bool:
        """Whether the frame counter went on; the camera's time decides only where it did not.

        A camera's clock may be set, or start again after 128 s or 2**32 ticks.
        """
        number_went_on = grabbed.frame_id is None or grabbed.frame_id != self._last_id
        self._last_id = grabbed.frame_id
        last_ns, time_ns = self._last_time_ns, grabbed.time_ns
        if grabbed.pixels is None:  # it may carry the time of its buffer's last one
            return number_went_on
        self._last_time_ns = time_ns
        if not number_went_on and time_ns <= last_ns:
            _log.warning("stale_frame_refused", serial=self._serial, frame_id=grabbed.frame_id)
            return False
        if 0 < time_ns < last_ns:
            _log.warning(
                "camera_clock_went_back",
                serial=self._serial,
                before_s=1e-9 * last_ns,
                now_s=1e-9 * time_ns,
            )
        return True

    def _frame(self, grabbed: Grabbed) -> CapturedFrame:
        if grabbed.pixels is None or grabbed.frame_id is None:
            name = "a frame" if grabbed.frame_id is None else f"frame {grabbed.frame_id}"
            msg = (
                f"camera {self._serial}: {name} is incomplete ({grabbed.problem});"
                f" {grabbed.advice or self._device.missing_data_advice}"
            )
            raise IncompleteFrameError(msg)
        self._require_shape(grabbed.pixels)
        return CapturedFrame(
            pixels=self._in_order(grabbed.pixels),
            bits=BITS_OF_FORMAT[self._settings.pixel_format],
            frame_id=grabbed.frame_id,
            camera_time_ns=grabbed.time_ns,
            trigger_monotonic_s=self._triggered_s,
            exposure_us=self._applied.exposure_us,
            gain_db=self._applied.gain_db,
            temperature_c=self._temperature_c,
        )

    def _in_order(self, pixels: Image) -> Image:
        """Put the bytes of deep pixels right where the image shows that they are swapped."""
        if pixels.dtype != np.uint16:
            return pixels
        swapped = is_swapped(pixels, BITS_OF_FORMAT[self._settings.pixel_format])
        if swapped is not None and swapped != self._swapped:
            self._swapped = swapped
            _log.warning("camera_byte_order", serial=self._serial, high_byte_first=swapped)
        return pixels.byteswap() if self._swapped else pixels

    def _require_shape(self, pixels: Image) -> None:
        settings = self._settings
        wanted = (settings.height_px, settings.width_px)
        n_bytes = 1 if BITS_OF_FORMAT[settings.pixel_format] == 8 else 2
        if pixels.shape != wanted or pixels.dtype.itemsize != n_bytes:
            msg = (
                f"camera {self._serial}: a frame of shape {pixels.shape} and"
                f" {pixels.dtype.itemsize} bytes a pixel is not the configured"
                f" {settings.width_px}x{settings.height_px} {settings.pixel_format}"
            )
            raise IncompleteFrameError(msg)

    @contextmanager
    def _connection(self, what: str) -> Iterator[None]:
        """Turn the library's errors, which here mean that the camera does not answer."""
        if self.is_lost:
            msg = f"camera {self._serial}: control lost before {what}; it will be opened again"
            raise DeviceLostError(msg)
        try:
            yield
        except (NoAnswerError, NodeRefusedError) as error:
            msg = f"camera {self._serial}: {what} failed: {error}"
            raise DeviceLostError(msg) from None
