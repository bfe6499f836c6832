"""One GenICam camera from opening to release, all of it in the thread that talks to Aravis."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import structlog

from drivers.aravis_setup import (
    BITS_OF_FORMAT,
    CODE_OF_FORMAT,
    Applied,
    apply_settings,
    find_device,
    is_refusal,
    load_aravis,
    read_temperature_c,
)
from drivers.errors import (
    DeviceLostError,
    FrameTimeoutError,
    IncompleteFrameError,
    SettingRefusedError,
)
from drivers.protocols import CameraSettings, CapturedFrame, Image

_log = structlog.get_logger("dcam.drivers")

N_BUFFERS = 4
MIN_SOCKET_BUFFER = 1 << 20
CONTROL_WAIT_S = 5.0
"""A GigE camera forgets a program that died after its heartbeat time-out, 3 s by default."""
POLL_S = 0.25
"""How often a waiting call looks again."""
SETTLE_S = 0.3
"""A stream with no frame for this long is dry; Aravis keeps a torn frame for 0.2 s."""
DRAIN_S = 2.0
"""A stream that does not run dry within this is not waiting for triggers."""

# Discovery fills one table for the whole process; reading it must not meet another's update.
_discovery = threading.Lock()


class Session:
    """One opened device, from `start` to `release`; used by its own thread only, but `lost`."""

    def __init__(self, serial: str, settings: CameraSettings) -> None:
        self.lost = threading.Event()
        self._serial = serial
        self._settings = settings
        self._aravis: Any = None
        self._glib_error: Any = None
        self._camera: Any = None
        self._device: Any = None
        self._stream: Any = None
        self._applied = Applied(None, None)
        self._temperature_c: float | None = None
        self._triggered_s = 0.0
        self._unanswered = False
        self._last_id: int | None = None
        self._last_time_ns = 0

    def start(self) -> None:
        """Find the device, become its controller, set it up and start acquisition."""
        self._aravis, self._glib_error = load_aravis()
        with self._connection("open"):
            if not _discovery.acquire(timeout=self._settings.open_timeout_s):
                msg = f"camera {self._serial}: discovery hangs in Aravis"
                raise DeviceLostError(msg)
            try:
                device_id = find_device(self._aravis, self._serial)
                self._camera = self._aravis.Camera.new(device_id)
            finally:
                _discovery.release()
            self._device = self._camera.get_device()
            # Fires in a thread of Aravis' own: it sets the flag and does nothing else. It must not
            # hold this object, or the device would never be released.
            self._device.connect("control-lost", lambda _device, lost: lost.set(), self.lost)
            # Without it Aravis sends any number to the camera.
            self._device.set_range_check_policy(self._aravis.RangeCheckPolicy.ENABLE)
            self._take_control()
            self._stop_what_runs()
            self._applied = apply_settings(
                self._device, self._glib_error, self._serial, self._settings
            )
            self._open_stream()
            self._start_acquisition()

    def arm(self) -> None:
        """Drop what nobody waits for any more, and read the temperature."""
        with self._connection("arm"):
            if self._unanswered:
                self._resynchronise()
            else:
                self._drain(0.0)
            self._temperature_c = read_temperature_c(self._device, self._glib_error)

    def trigger(self) -> None:
        """Send the software trigger; GigE Vision acknowledges it, or Aravis gives up in 2.5 s."""
        with self._connection("trigger"):
            self._unanswered = True
            self._triggered_s = time.monotonic()
            self._camera.software_trigger()

    def fetch(self, timeout_s: float) -> CapturedFrame:
        """Wait for the next complete frame that is newer than the last one seen."""
        deadline_s = time.monotonic() + timeout_s
        while (remaining_s := deadline_s - time.monotonic()) > 0.0:
            if self.lost.is_set():
                msg = f"camera {self._serial}: control lost while waiting for a frame"
                raise DeviceLostError(msg)
            buffer = self._stream.timeout_pop_buffer(int(1e6 * min(remaining_s, POLL_S)))
            if buffer is None:
                continue
            try:
                if self._is_new(buffer):
                    self._unanswered = False
                    return self._frame(buffer)
            finally:
                self._stream.push_buffer(buffer)
        msg = (
            f"camera {self._serial}: no frame within {timeout_s:g} s; check the link, and that the"
            " exposure is shorter"
        )
        raise FrameTimeoutError(msg)

    def release(self) -> None:
        """Give the device back; a dead one costs its time-outs here, where nobody waits."""
        try:
            if self._stream is not None and not self.lost.is_set():
                self._camera.stop_acquisition()
        except self._glib_error as error:
            _log.info("camera_released", serial=self._serial, reason=error.message)
        finally:
            self._stream = self._device = self._camera = None

    def _take_control(self) -> None:
        """Become the one program that may set a GigE camera."""
        if not self._camera.is_gv_device():
            return
        deadline_s = time.monotonic() + CONTROL_WAIT_S
        while not self._device.is_controller():
            if time.monotonic() > deadline_s:
                msg = f"camera {self._serial}: in use by another program, which must be stopped"
                raise DeviceLostError(msg)
            self.lost.wait(POLL_S)
            try:
                self._device.take_control()
            except self._glib_error:
                continue

    def _stop_what_runs(self) -> None:
        """A program that was killed may have left the camera running, its settings locked."""
        try:
            self._camera.stop_acquisition()
        except self._glib_error as error:
            if not is_refusal(error):  # a camera at rest may decline
                raise

    def _open_stream(self) -> None:
        camera, aravis = self._camera, self._aravis
        if camera.is_uv_device():
            # The other mode loses frames and hangs before Aravis 0.8.28.
            camera.uv_set_usb_mode(aravis.UvUsbMode.ASYNC)
        if camera.is_gv_device() and self._settings.packet_size_bytes is None:
            camera.gv_auto_packet_size()
        payload = camera.get_payload()
        self._stream = camera.create_stream(None, None)
        if camera.is_gv_device():
            # Aravis 0.8 keeps the kernel's default otherwise, a tenth of a frame, and asks for
            # nothing twice. The kernel grants no more than net.core.rmem_max.
            self._stream.set_property("socket-buffer", aravis.GvStreamSocketBuffer.FIXED)
            self._stream.set_property("socket-buffer-size", max(4 * payload, MIN_SOCKET_BUFFER))
            self._stream.set_property("packet-resend", aravis.GvStreamPacketResend.ALWAYS)
        for _ in range(N_BUFFERS):
            self._stream.push_buffer(aravis.Buffer.new_allocate(payload))

    def _resynchronise(self) -> None:
        """A trigger was not answered: its frame must not be taken for the next trigger's.

        A camera that was restarted takes commands as if nothing had happened, but has forgotten
        its settings: that is a lost one.
        """
        if self._device.get_string_feature_value("TriggerMode") != "On":
            msg = f"camera {self._serial}: was restarted; it will be opened anew"
            raise DeviceLostError(msg)
        self._camera.stop_acquisition()
        self._start_acquisition()

    def _start_acquisition(self) -> None:
        """Start, and throw away what comes of triggers sent before, ours or another program's."""
        self._camera.start_acquisition()
        self._last_id = None  # a camera may count from the start of the acquisition
        self._drain(SETTLE_S)
        self._unanswered = False

    def _drain(self, quiet_s: float) -> None:
        """Push back every frame nobody waits for, until none comes for `quiet_s`."""
        stale = 0
        deadline_s = time.monotonic() + DRAIN_S
        while (buffer := self._stream.timeout_pop_buffer(int(1e6 * quiet_s))) is not None:
            self._is_new(buffer)
            self._stream.push_buffer(buffer)
            stale += 1
            if time.monotonic() > deadline_s:
                msg = (
                    f"camera {self._serial}: TriggerMode = On refused: frames come without trigger"
                )
                raise SettingRefusedError(msg)
        if stale:
            _log.info("stale_frames_dropped", serial=self._serial, frames=stale)

    def _is_new(self, buffer: Any) -> bool:
        """Whether frame counter and camera time went on since the last frame seen."""
        frame_id, time_ns = buffer.get_frame_id(), buffer.get_timestamp()
        repeated = frame_id == self._last_id
        self._last_id = frame_id
        if self._is_complete(buffer):  # a torn frame may carry the time of its buffer's last one
            repeated |= 0 < time_ns <= self._last_time_ns
            self._last_time_ns = time_ns
        if repeated:
            _log.warning("stale_frame_refused", serial=self._serial, frame_id=frame_id)
        return not repeated

    def _is_complete(self, buffer: Any) -> bool:
        return bool(buffer.get_status() == self._aravis.BufferStatus.SUCCESS)

    def _frame(self, buffer: Any) -> CapturedFrame:
        if not self._is_complete(buffer):
            msg = (
                f"camera {self._serial}: frame {buffer.get_frame_id()} is incomplete"
                f" ({buffer.get_status().value_nick}); check cable, switch, packet size, and that"
                " net.core.rmem_max exceeds four frames"
            )
            raise IncompleteFrameError(msg)
        return CapturedFrame(
            pixels=self._pixels(buffer),
            bits=BITS_OF_FORMAT[self._settings.pixel_format],
            frame_id=buffer.get_frame_id(),
            camera_time_ns=buffer.get_timestamp(),
            trigger_monotonic_s=self._triggered_s,
            exposure_us=self._applied.exposure_us,
            gain_db=self._applied.gain_db,
            temperature_c=self._temperature_c,
        )

    def _pixels(self, buffer: Any) -> Image:
        settings = self._settings
        data = buffer.get_data()  # a copy
        sample = "u1" if BITS_OF_FORMAT[settings.pixel_format] == 8 else "<u2"
        shape = (buffer.get_image_height(), buffer.get_image_width())
        if (
            shape != (settings.height_px, settings.width_px)
            or buffer.get_image_pixel_format() != CODE_OF_FORMAT[settings.pixel_format]
            or len(data) != shape[0] * shape[1] * np.dtype(sample).itemsize
        ):
            msg = (
                f"camera {self._serial}: frame of {shape[1]}x{shape[0]} px, pixel format"
                f" {buffer.get_image_pixel_format():#010x} and {len(data)} bytes is not"
                f" the configured {settings.width_px}x{settings.height_px} {settings.pixel_format}"
            )
            raise IncompleteFrameError(msg)
        pixels: Image = np.frombuffer(data, sample).reshape(shape).copy()
        return pixels

    @contextmanager
    def _connection(self, what: str) -> Iterator[None]:
        """Turn the library's errors, which here mean that the camera does not answer."""
        if self.lost.is_set():
            msg = f"camera {self._serial}: control lost before {what}; it will be opened anew"
            raise DeviceLostError(msg)
        try:
            yield
        except self._glib_error as error:
            msg = f"camera {self._serial}: {what} failed: {error.message}"
            raise DeviceLostError(msg) from None
