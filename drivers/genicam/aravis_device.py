"""One device through Aravis; implements `drivers.genicam.device.Device` and `Features`."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from drivers.deadline import DeadlineExceededError, DeadlineThread
from drivers.errors import DeviceHangsError, DeviceLostError, MissingLibraryError
from drivers.genicam.device import (
    CODE_OF_FORMAT,
    CONTROL_WAIT_S,
    FOREIGN_ADVICE,
    N_BUFFERS,
    POLL_S,
    Grabbed,
    NoAnswerError,
    NodeRefusedError,
    Value,
)
from drivers.genicam.serial_number import as_on_label, as_on_usb, places_of
from drivers.genicam.usb_bus import why_not_on_usb
from drivers.protocols import CameraSettings

MIN_SOCKET_BUFFER = 1 << 20
USB_UNDER_WAY = 8 << 20
"""So many bytes Aravis asks a USB3 camera for in advance, and no more (arvuvstream.c)."""
MOST_BUFFERS = 64

# Discovery fills one table for the whole process; reading it must not meet another's update.
_discovery = threading.Lock()


ARAVIS_VERSIONS = ("0.8", "0.10")
"""Of its interface, the one that was tested with cameras first; Debian carries one of them."""


def aravis_version(installed: Iterable[str]) -> str:
    """Give the version to ask for; the first of ours where none is there, for the error's sake."""
    there = set(installed)
    return next((ours for ours in ARAVIS_VERSIONS if ours in there), ARAVIS_VERSIONS[0])


def load_aravis() -> tuple[Any, Any]:
    """Give the Aravis namespace and GLib's error class.

    Raises MissingLibraryError that says what to install.
    """
    try:
        import gi

        installed = gi.Repository.get_default().enumerate_versions("Aravis")
        gi.require_version("Aravis", aravis_version(installed))
        from gi.repository import Aravis, GLib
    except (ImportError, ValueError) as error:
        msg = (
            f"Aravis cannot be loaded ({error}); install it with: apt-get install"
            " --no-install-recommends gir1.2-aravis-0.8 python3-gi aravis-tools-cli, and make the"
            " virtual environment with --system-site-packages"
        )
        raise MissingLibraryError(msg) from error
    return Aravis, GLib.Error


def is_refusal(error: Any) -> bool:
    """Whether the camera answered and declined; otherwise it did not answer.

    What the camera's description forbids has error domains of its own. In the domain of devices
    (ArvDeviceError in arvdevice.h) these are WRONG_FEATURE, FEATURE_NOT_FOUND, PROTOCOL_ERROR,
    INVALID_PARAMETER, and from 12 what the protocol answers, as "write protected"; 18 is "busy".
    """
    refusals = {0, 1, 3, 7, *range(12, 18)}
    return error.domain != "arv-device-error-quark" or error.code in refusals


def find_device(aravis: Any, serial: str) -> tuple[str, str]:
    """Look for a camera on USB and on every network interface; give Aravis' name and number of it.

    Raises DeviceLostError, with what was found instead.
    """
    aravis.update_device_list()
    found = [
        (aravis.get_device_serial_nbr(i), aravis.get_device_id(i), aravis.get_device_address(i))
        for i in range(aravis.get_n_devices())
    ]
    matches = [found[i] for i in places_of(serial, [number for number, _, _ in found])]
    if len(matches) == 1:
        number, device_id, _ = matches[0]
        return str(device_id), str(number)
    if matches:
        names = ", ".join(f"{number} at {address}" for number, _, address in matches)
        msg = f"camera {serial}: {len(matches)} cameras have this serial number: {names}"
        raise DeviceLostError(msg)
    msg = f"camera {as_on_usb(serial)}: {_why_not_found(serial, found)}"
    raise DeviceLostError(msg)


def _why_not_found(serial: str, found: Sequence[tuple[str, str, str]]) -> str:
    if why := why_not_on_usb(serial):
        return why
    others = ", ".join(
        sorted(f"{as_on_label(number)} at {address}" for number, _, address in found)
    )
    return (
        f"not found; there is {others or 'no camera at all'}."
        " Check power, cable and the serial number in the config"
    )


def buffers_for(frame_bytes: int, *, on_usb: bool) -> int:
    """Give the number of buffers of a stream, one of which is always with us.

    On USB the others exceed what Aravis asks for in advance: with fewer, Aravis 0.8.26 looks for
    another one without a pause, and a processor is busy all day (aravis#652). Not for images below
    130 kB: the end of a stream hangs in Aravis once in some ten thousand buffers (its wait for a
    cancelled transfer begins after the look whether it has ended).
    """
    if not on_usb:
        return N_BUFFERS + 1
    return min(max(N_BUFFERS, USB_UNDER_WAY // frame_bytes + 2), MOST_BUFFERS)


def network_addresses(timeout_s: float) -> dict[str, str]:
    """Give the IP address of each GigE Vision camera that answers, by serial number.

    Raises MissingLibraryError, DeviceHangsError.
    """
    aravis, _ = load_aravis()

    def look() -> dict[str, str]:
        with _discovery:
            aravis.update_device_list()
            return {
                str(aravis.get_device_serial_nbr(i)): str(aravis.get_device_address(i))
                for i in range(aravis.get_n_devices())
                if aravis.get_device_protocol(i) == "GigEVision"
            }

    thread = DeadlineThread("discovery", at_end=lambda: None)
    try:
        return thread.call(look, timeout_s)
    except DeadlineExceededError:
        msg = f"discovery of cameras hangs in Aravis for more than {timeout_s:g} s"
        raise DeviceHangsError(msg) from None
    finally:
        thread.end()


class AravisDevice:
    """One device, its features and its stream."""

    def __init__(self, serial: str, open_timeout_s: float) -> None:
        self._serial = serial
        self._open_timeout_s = open_timeout_s
        self._lost = threading.Event()
        self._aravis: Any = None
        self._glib_error: Any = None
        self._camera: Any = None
        self._device: Any = None
        self._stream: Any = None
        self._held: Any = None
        """The buffer of the last frame; see `pop`."""
        self._on_usb = self._stopped = False
        self._payload_code = 0
        self.listed_serial = ""

    @property
    def features(self) -> AravisFeatures:
        """Its features, once it is open."""
        return AravisFeatures(self._device, self._glib_error)

    @property
    def is_lost(self) -> bool:
        """Whether Aravis has said that control over the device is lost."""
        return self._lost.is_set()

    @property
    def missing_data_advice(self) -> str:
        """What to look at when data of a frame are missing."""
        if self._on_usb:
            return "check the USB cable, hub and port, and that usbfs_memory_mb is 1000"
        return "check cable, switch, packet size, and that net.core.rmem_max exceeds four frames"

    def open(self) -> None:
        """Find the device and become the one program that controls it."""
        self._aravis, self._glib_error = load_aravis()
        with _answers(self._glib_error):
            if not _discovery.acquire(timeout=self._open_timeout_s):
                msg = f"camera {self._serial}: discovery hangs in Aravis"
                raise DeviceLostError(msg)
            try:
                device_id, self.listed_serial = find_device(self._aravis, self._serial)
                self._camera = self._opened(device_id)
            finally:
                _discovery.release()
            self._on_usb = self._camera.is_uv_device()
            self._device = self._camera.get_device()
            # Fires in a thread of Aravis' own: it sets the flag and does nothing else. It must not
            # hold this object, or the device would never be released.
            self._device.connect("control-lost", lambda _device, lost: lost.set(), self._lost)
            # Without it Aravis sends any number to the camera.
            self._device.set_range_check_policy(self._aravis.RangeCheckPolicy.ENABLE)
            self._take_control()
            self._stop_what_runs()

    def open_stream(self, settings: CameraSettings) -> None:
        """Make the stream and its buffers."""
        self._payload_code = CODE_OF_FORMAT[settings.pixel_format]
        with _answers(self._glib_error):
            if self._on_usb:
                # The other mode loses frames and hangs before Aravis 0.8.28.
                self._camera.uv_set_usb_mode(self._aravis.UvUsbMode.ASYNC)
            elif settings.packet_size_bytes is None:
                self._camera.gv_auto_packet_size()
            self._make_stream()

    def _make_stream(self) -> None:
        payload = self._camera.get_payload()
        self._stream = self._held = None
        self._stream = self._camera.create_stream(None, None)
        if not self._on_usb:
            # Aravis 0.8 keeps the kernel's default otherwise, a tenth of a frame, and asks for
            # nothing twice. The kernel grants no more than net.core.rmem_max.
            gv = self._aravis
            self._stream.set_property("socket-buffer", gv.GvStreamSocketBuffer.FIXED)
            self._stream.set_property("socket-buffer-size", max(4 * payload, MIN_SOCKET_BUFFER))
            self._stream.set_property("packet-resend", gv.GvStreamPacketResend.ALWAYS)
        for _ in range(buffers_for(payload, on_usb=self._on_usb)):
            self._stream.push_buffer(self._aravis.Buffer.new_allocate(payload))

    def start(self) -> None:
        """Start acquisition.

        On USB data that were lost put the stream out of step for good: leader, image and trailer
        then come where Aravis waits for another of them. After a stop it is a new one.
        """
        with _answers(self._glib_error):
            if self._on_usb and self._stopped:
                self._make_stream()
            self._camera.start_acquisition()

    def stop(self) -> None:
        """Stop acquisition."""
        self._stopped = True
        with _answers(self._glib_error):
            self._camera.stop_acquisition()

    def pop(self, timeout_s: float) -> Grabbed | None:
        """Give the next frame as a copy; its buffer goes back when another frame has come.

        On USB, Aravis up to 0.9.3 at least hands a buffer over and only then, in the same thread,
        lets go of it: given back before that, it is filled again and lost with its frame. Another
        frame from that thread shows that it has let go of the last one.
        """
        buffer = self._stream.timeout_pop_buffer(int(1e6 * timeout_s))
        if buffer is None:
            return None
        held, self._held = self._held, buffer
        if held is not None:
            self._stream.push_buffer(held)
        return self._grabbed(buffer)

    def release(self) -> None:
        """Stop what runs and let go of everything."""
        try:
            if self._stream is not None and not self._lost.is_set():
                self.stop()
        finally:
            self._stream = self._held = self._device = self._camera = None

    def _opened(self, device_id: str) -> Any:
        """Open it; wait a little for a program that is about to end and has it on USB."""
        deadline_s = time.monotonic() + CONTROL_WAIT_S
        while True:
            try:
                return self._aravis.Camera.new(device_id)
            except self._glib_error as error:
                if "LIBUSB_ERROR_BUSY" not in error.message:
                    raise NoAnswerError(_why_not_opened(error.message)) from None
                if time.monotonic() > deadline_s:
                    raise DeviceLostError(self._in_use()) from None
            self._lost.wait(POLL_S)

    def _in_use(self) -> str:
        return f"camera {self._serial}: in use by another program, which must be stopped"

    def _take_control(self) -> None:
        """Become the one program that may set a GigE camera."""
        if not self._camera.is_gv_device():
            return
        deadline_s = time.monotonic() + CONTROL_WAIT_S
        while not self._device.is_controller():
            if time.monotonic() > deadline_s:
                raise DeviceLostError(self._in_use())
            self._lost.wait(POLL_S)
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

    def _grabbed(self, buffer: Any) -> Grabbed:
        frame_id, time_ns = buffer.get_frame_id(), buffer.get_timestamp()
        status = buffer.get_status()
        if status != self._aravis.BufferStatus.SUCCESS:
            return Grabbed(frame_id, time_ns, None, status.value_nick)
        code = buffer.get_image_pixel_format()
        data = buffer.get_data()  # a copy
        shape = (buffer.get_image_height(), buffer.get_image_width())
        sample = np.dtype("u1" if code == CODE_OF_FORMAT["Mono8"] else "<u2")
        if code != self._payload_code or len(data) != shape[0] * shape[1] * sample.itemsize:
            problem = f"{shape[1]}x{shape[0]} px, pixel format {code:#010x}, {len(data)} bytes"
            return Grabbed(frame_id, time_ns, None, problem, FOREIGN_ADVICE)
        return Grabbed(frame_id, time_ns, np.frombuffer(data, sample).reshape(shape).copy())


def _why_not_opened(message: str) -> str:
    """What Aravis says, without the names of a USB camera that it had no chance to read."""
    text = message.replace("(null)-", "")
    cure = "it does not answer; unplug it and plug it in, or cut its power for a moment"
    return f"{text}: {cure}" if "bootstrap USB" in text else text


class AravisFeatures:
    """The features of one open device."""

    def __init__(self, device: Any, glib_error: Any) -> None:
        self._device = device
        self._glib_error = glib_error

    def has(self, name: str) -> bool:
        """Whether the feature is there and can be used now."""
        with _answers(self._glib_error):
            return bool(self._device.is_feature_available(name))

    def read(self, name: str) -> Value:
        """Give the value in the type of its node."""
        with _answers(self._glib_error, declines=True):
            value: Value = getattr(self._device, f"get_{self._kind(name)}_feature_value")(name)
            return value

    def write(self, name: str, value: Value) -> None:
        """Set the value; the access mode is not looked at (aravis#684)."""
        with _answers(self._glib_error, declines=True):
            getattr(self._device, f"set_{self._kind(name)}_feature_value")(name, value)

    def limits(self, name: str) -> tuple[float, float]:
        """Give the least and the greatest value."""
        with _answers(self._glib_error, declines=True):
            low, high = getattr(self._device, f"get_{self._kind(name)}_feature_bounds")(name)
            return low, high

    def step(self, name: str) -> int:
        """Give the step of an integer."""
        with _answers(self._glib_error, declines=True):
            return int(self._device.get_integer_feature_increment(name))

    def choices(self, name: str) -> list[str]:
        """Give the entries of an enumeration that can be chosen now."""
        with _answers(self._glib_error, declines=True):
            strings = self._device.dup_available_enumeration_feature_values_as_strings(name)
            return list(strings)

    def execute(self, name: str) -> None:
        """Carry out a command; GigE Vision acknowledges it, or Aravis gives up in 2.5 s."""
        with _answers(self._glib_error, declines=True):
            self._device.execute_command(name)

    def _kind(self, name: str) -> str:
        """Aravis has a call for each type; what type a number has differs between cameras."""
        node = type(self._device.get_feature(name)).__name__
        if "Enumeration" in node or "String" in node:
            return "string"
        if "Boolean" in node:
            return "boolean"
        is_float = "Float" in node or node in {"GcSwissKnifeNode", "GcConverterNode"}
        return "float" if is_float else "integer"


@contextmanager
def _answers(glib_error: Any, *, declines: bool = False) -> Iterator[None]:
    """Turn GLib's errors into ours: declined, or no answer."""
    try:
        yield
    except glib_error as error:
        if declines and is_refusal(error):
            raise NodeRefusedError(error.message) from None
        raise NoAnswerError(error.message) from None
