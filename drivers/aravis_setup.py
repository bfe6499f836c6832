"""Find a GenICam camera by its serial number, and bring it into the state the config asks for.

The order is that of the GS3-U3-23S6: what locks or limits a setting comes before it. Which features
a camera has, and how they are called, differs (SFNC names, and the older `Abs` and `Raw` ones); a
feature that is not there is passed over, unless the config asks for it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import structlog

from drivers.errors import DeviceLostError, MissingLibraryError, SettingRefusedError
from drivers.protocols import CameraSettings

_log = structlog.get_logger("dcam.drivers")

DEFAULT_EXPOSURE_US = 5000.0
READBACK_TOLERANCE = 0.01
"""A camera rounds exposure and gain to its own steps; more than this share is worth a line."""

BITS_OF_FORMAT = {"Mono8": 8, "Mono10": 10, "Mono12": 12, "Mono16": 16}
CODE_OF_FORMAT = {
    "Mono8": 0x01080001,
    "Mono10": 0x01100003,
    "Mono12": 0x01100005,
    "Mono16": 0x01100007,
}
"""GigE Vision and USB3 Vision pixel format codes (Pixel Format Naming Convention 2.1)."""

Value = str | bool | float

# What would change grey values or geometry behind our back, in the order it must be switched off.
_NEUTRAL: tuple[tuple[str, Value], ...] = (
    ("ExposureAuto", "Off"),
    ("GainAuto", "Off"),
    ("BlackLevelAuto", "Off"),
    ("AcquisitionFrameRateAuto", "Off"),
    ("AcquisitionFrameRateEnabled", False),  # FLIR GS3; while on, it limits the exposure
    ("AcquisitionFrameRateEnable", False),  # SFNC
    ("GammaEnabled", False),
    ("GammaEnable", False),
    ("SharpnessEnabled", False),
    ("SharpeningEnable", False),
    ("LUTEnable", False),
    ("BinningHorizontal", 1),
    ("BinningVertical", 1),
    ("DecimationHorizontal", 1),
    ("DecimationVertical", 1),
    ("ReverseX", False),
    ("ReverseY", False),
    ("TestPattern", "Off"),
)


@dataclass(frozen=True, slots=True)
class Applied:
    """What the camera says its settings are, after set-up."""

    exposure_us: float | None
    gain_db: float | None


def load_aravis() -> tuple[Any, Any]:
    """Give the Aravis namespace and GLib's error class.

    Raises MissingLibraryError that says what to install.
    """
    try:
        import gi

        gi.require_version("Aravis", "0.8")
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


def find_device(aravis: Any, serial: str) -> str:
    """Look for a camera on USB and on every network interface; give Aravis' name for it.

    Raises DeviceLostError, with what was found instead.
    """
    aravis.update_device_list()
    found = [
        (aravis.get_device_serial_nbr(i), aravis.get_device_id(i), aravis.get_device_address(i))
        for i in range(aravis.get_n_devices())
    ]
    matches = [device_id for number, device_id, _ in found if number == serial]
    if len(matches) == 1:
        return str(matches[0])
    if matches:
        msg = f"camera {serial}: {len(matches)} cameras have this serial number"
        raise DeviceLostError(msg)
    others = ", ".join(sorted(f"{number} at {address}" for number, _, address in found))
    msg = (
        f"camera {serial}: not found; there is {others or 'no camera at all'}. Check power, cable"
        " and the serial number in the config"
    )
    raise DeviceLostError(msg)


def apply_settings(device: Any, glib_error: Any, serial: str, settings: CameraSettings) -> Applied:
    """Set everything in order and read it back; log what differs from the config.

    Raises SettingRefusedError that names feature, value and limits. An error of the connection
    itself passes through as GLib's.
    """
    features = _Features(device, glib_error, serial)
    for name, value in _NEUTRAL:
        features.set_if_there(name, value)
    if features.has("Gamma") and not (features.has("GammaEnabled") or features.has("GammaEnable")):
        features.set_if_there("Gamma", 1.0)
    features.set_required("PixelFormat", settings.pixel_format)
    _set_region(features, settings)
    features.set_if_there("ExposureMode", "Timed")
    exposure_us = _set_exposure(features, settings.exposure_us)
    gain_db = _set_gain(features, settings.gain_db)
    _set_trigger(features)
    if settings.packet_size_bytes is not None:
        features.set_integer("GevSCPSPacketSize", settings.packet_size_bytes)
    return Applied(exposure_us, gain_db)


def read_temperature_c(device: Any, glib_error: Any) -> float | None:
    """The camera's own temperature, if it tells one.

    An error of the connection itself passes through as GLib's.
    """
    try:
        if not device.is_feature_available("DeviceTemperature"):
            return None
        return float(device.get_float_feature_value("DeviceTemperature"))
    except glib_error as error:
        if is_refusal(error):
            return None
        raise


def _set_region(features: _Features, settings: CameraSettings) -> None:
    """Take the middle of the sensor: the optical axis stays in the middle of the image."""
    for size_name, offset_name, size_px in (
        ("Width", "OffsetX", settings.width_px),
        ("Height", "OffsetY", settings.height_px),
    ):
        features.set_if_there(offset_name, 0)  # what is left of an offset limits the size
        whole_px = features.set_integer(size_name, size_px)
        if features.has(offset_name):
            step = max(1, features.device.get_integer_feature_increment(offset_name))
            features.set_integer(offset_name, (whole_px - size_px) // 2 // step * step)


def _set_exposure(features: _Features, exposure_us: float | None) -> float | None:
    name = features.first("ExposureTime", "ExposureTimeAbs")
    if name is None:
        if exposure_us is None:
            return None
        why = "the camera has no such feature"
        raise features.refused(name="ExposureTime", value=exposure_us, why=why)
    return features.set_float(name, exposure_us, "us", fallback=DEFAULT_EXPOSURE_US)


def _set_gain(features: _Features, gain_db: float | None) -> float | None:
    features.set_if_there("GainSelector", "All")
    name = features.first("Gain", "GainAbs")
    if name is not None:
        return features.set_float(name, gain_db, "dB", fallback=float("-inf"))
    if gain_db is not None:
        why = "the camera counts gain in units of its own; leave it out of the config"
        raise features.refused(name="Gain", value=gain_db, why=why)
    if features.has("GainRaw"):
        features.set_integer("GainRaw", features.device.get_integer_feature_bounds("GainRaw")[0])
    return None


def _set_trigger(features: _Features) -> None:
    """Leave the frame's software trigger as the only one."""
    features.set_if_there("AcquisitionMode", "Continuous")
    if features.has("TriggerSelector"):
        selectors = features.device.dup_available_enumeration_feature_values_as_strings(
            "TriggerSelector"
        )
        for selector in selectors:
            features.set_if_there("TriggerSelector", selector)
            features.set_if_there("TriggerMode", "Off")
        features.set_required("TriggerSelector", "FrameStart")
    # Some cameras let the source be changed only while the trigger is off. And no look at the
    # access mode: Aravis takes the GS3's TriggerSource for read-only, which it is not (aravis#684).
    features.set_required("TriggerSource", "Software")
    features.set_required("TriggerMode", "On")


class _Features:
    """The features of one camera by name, each written and then read back."""

    def __init__(self, device: Any, glib_error: Any, serial: str) -> None:
        self.device = device
        self._glib_error = glib_error
        self._serial = serial

    def has(self, name: str) -> bool:
        return bool(self.device.is_feature_available(name))

    def first(self, *names: str) -> str | None:
        return next((name for name in names if self.has(name)), None)

    def refused(self, name: str, value: object, why: str) -> SettingRefusedError:
        return SettingRefusedError(f"camera {self._serial}: {name} = {value} refused: {why}")

    def set_if_there(self, name: str, value: Value) -> None:
        """Set what the camera may do without; a refusal is worth a warning only."""
        if not self.has(name):
            return
        try:
            actual = self._write(name, value)
        except SettingRefusedError as error:
            _log.warning("camera_setting_not_applied", serial=self._serial, reason=str(error))
            return
        if actual != value:
            self._log_difference(name, value, actual)

    def set_required(self, name: str, value: str) -> None:
        if not self.has(name):
            raise self.refused(name, value, "the camera has no such feature")
        actual = self._write(name, value)
        if actual != value:
            raise self.refused(name, value, f"reads back as {actual}")

    def set_integer(self, name: str, value: int) -> int:
        """Set a number that must be met exactly, and give the largest there is."""
        if not self.has(name):
            raise self.refused(name, value, "the camera has no such feature")
        low, high = self.device.get_integer_feature_bounds(name)
        step = max(1, self.device.get_integer_feature_increment(name))
        if not low <= value <= high or (value - low) % step:
            raise self.refused(name, value, f"the camera takes {low} to {high} in steps of {step}")
        actual = self._write(name, value)
        if actual != value:
            raise self.refused(name, value, f"reads back as {actual}")
        return int(high)

    def set_float(self, name: str, value: float | None, unit: str, fallback: float) -> float:
        """Set a number within the camera's limits; without one, the fallback brought into them."""
        low, high = self.device.get_float_feature_bounds(name)
        if value is None:
            value = min(max(fallback, low), high)
        elif not low <= value <= high:
            limits = f"the camera takes {low:g} to {high:g} {unit}"
            raise self.refused(name, f"{value:g} {unit}", limits)
        actual = float(self._write(name, value))
        if abs(actual - value) > READBACK_TOLERANCE * max(abs(value), 1.0):
            self._log_difference(name, value, actual)
        return actual

    def _write(self, name: str, value: Value) -> Any:
        """Write and read back. An error of the camera's description is a refusal."""
        kind = {str: "string", bool: "boolean", int: "integer", float: "float"}[type(value)]
        try:
            getattr(self.device, f"set_{kind}_feature_value")(name, value)
            return getattr(self.device, f"get_{kind}_feature_value")(name)
        except self._glib_error as error:
            if is_refusal(error):
                raise self.refused(name, value, error.message) from None
            raise

    def _log_difference(self, name: str, wanted: object, actual: object) -> None:
        _log.warning(
            "camera_setting_differs",
            serial=self._serial,
            feature=name,
            wanted=wanted,
            actual=actual,
        )
