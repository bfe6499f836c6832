"""Bring a GenICam camera into the state the config asks for, whichever library reaches it.

The order is that of the GS3-U3-23S6: what locks or limits a setting comes before it. Which features
a camera has, and how they are called, differs (SFNC names, and the older `Abs` and `Raw` ones); a
feature that is not there is passed over, unless the config asks for it.
"""

from __future__ import annotations

from dataclasses import dataclass

import structlog

from drivers.errors import SettingRefusedError
from drivers.genicam.device import Features, NodeRefusedError, Value
from drivers.protocols import CameraSettings, LineOut, TriggerIn

_log = structlog.get_logger("dcam.drivers")

DEFAULT_EXPOSURE_US = 5000.0
READBACK_TOLERANCE = 0.01
"""A camera rounds exposure and gain to its own steps; more than this share is worth a line."""

_EXPOSURE_NAMES = ("ExposureTime", "ExposureTimeAbs")
_GAIN_NAMES = ("Gain", "GainAbs")

# What a camera comes up with or another program has left, and what would change grey values or
# geometry behind our back, or what is sent; in the order in which it must be switched off.
_NEUTRAL: tuple[tuple[str, Value], ...] = (
    ("SequencerConfigurationMode", "Off"),
    ("SequencerMode", "Off"),  # exposure and gain in turns
    ("pgrHDRModeEnabled", False),  # the same of FLIR's GS3
    ("ChunkModeActive", False),  # more bytes behind each image
    ("pgrExposureCompensationAuto", "Off"),
    ("ExposureAuto", "Off"),
    ("GainAuto", "Off"),
    ("BlackLevelAuto", "Off"),
    ("AcquisitionFrameRateAuto", "Off"),
    ("AcquisitionFrameRateEnabled", False),  # FLIR GS3; while on, it limits the exposure
    ("AcquisitionFrameRateEnable", False),  # SFNC
    ("GammaEnabled", False),
    ("GammaEnable", False),
    ("SharpnessAuto", "Off"),
    ("SharpnessEnabled", False),
    ("SharpeningEnable", False),
    ("LUTEnable", False),
    ("DigitalShift", 0),
    ("BinningSelector", "All"),
    ("BinningHorizontal", 1),
    ("BinningVertical", 1),
    ("DecimationHorizontal", 1),
    ("DecimationVertical", 1),
    ("ReverseX", False),
    ("ReverseY", False),
    ("TestPattern", "Off"),
    ("TestImageSelector", "Off"),
    ("AcquisitionBurstFrameCount", 1),
    ("TriggerOverlap", "Off"),
)


_ON_AT_POWER_UP = {
    *("ExposureAuto", "GainAuto", "BlackLevelAuto", "SharpnessAuto", "pgrExposureCompensationAuto"),
    *("AcquisitionFrameRateAuto", "AcquisitionFrameRateEnabled", "AcquisitionFrameRateEnable"),
    *("GammaEnabled", "GammaEnable", "SharpnessEnabled", "SharpeningEnable", "TriggerOverlap"),
    "BinningSelector",
}
"""Makers leave these on: to find one so says nothing of another program."""


@dataclass(frozen=True, slots=True)
class Applied:
    """What the camera says its settings are, after set-up."""

    exposure_us: float | None
    gain_db: float | None


def apply_settings(features: Features, serial: str, settings: CameraSettings) -> Applied:
    """Set everything in order and read it back; log what differs from the config.

    Raises SettingRefusedError that names feature, value and limits, NoAnswerError.
    """
    writer = _Writer(features, serial)
    _require_features(features, serial, settings)
    for name, value in _NEUTRAL:
        writer.set_if_there(name, value, foreign=name not in _ON_AT_POWER_UP)
    if features.has("Gamma") and not (features.has("GammaEnabled") or features.has("GammaEnable")):
        writer.set_if_there("Gamma", 1.0)
    writer.set_required("PixelFormat", settings.pixel_format)
    _set_region(writer, settings)
    writer.set_if_there("ExposureMode", "Timed")
    exposure_us = _set_exposure(writer, settings.exposure_us)
    gain_db = _set_gain(writer, settings.gain_db)
    _set_trigger(writer, settings.trigger)
    writer.say_foreign()
    if settings.line_out is not None:
        _set_line_out(writer, settings.line_out)
    if settings.packet_size_bytes is not None:
        writer.set_integer("GevSCPSPacketSize", settings.packet_size_bytes)
    return Applied(exposure_us, gain_db)


def change_exposure(
    features: Features, serial: str, exposure_us: float, gain_db: float | None
) -> Applied:
    """Set exposure and gain (None: leave it) within the camera's limits; give what it has then.

    A refusal is worth a warning, not a slot: the frame is taken with what the camera has. Raises
    NoAnswerError, NodeRefusedError when it does not even tell.
    """
    writer = _Writer(features, serial)
    return Applied(
        _changed(writer, writer.first(*_EXPOSURE_NAMES), exposure_us, "us"),
        _changed(writer, writer.first(*_GAIN_NAMES), gain_db, "dB"),
    )


def _changed(writer: _Writer, name: str | None, value: float | None, unit: str) -> float | None:
    """Set a number if there is one, brought within its limits; give what the camera has."""
    if name is None:
        return None
    if value is not None:
        low, high = writer.features.limits(name)
        within = min(max(value, low), high)
        try:
            return writer.set_float(name, within, unit, fallback=within)
        except SettingRefusedError as error:
            _log.warning("camera_setting_not_applied", reason=str(error))
    return float(writer.features.read(name))


def read_temperature_c(features: Features) -> float | None:
    """The camera's own temperature, if it tells one."""
    if not features.has("DeviceTemperature"):
        return None
    try:
        return float(features.read("DeviceTemperature"))
    except NodeRefusedError:
        return None


def _require_features(features: Features, serial: str, settings: CameraSettings) -> None:
    """Name at once all that the camera lacks, not one at a time."""
    wanted: list[tuple[str, ...]] = [
        ("PixelFormat",),
        ("Width",),
        ("Height",),
        ("TriggerMode",),
        ("TriggerSource",),
    ]
    if settings.trigger is None:
        wanted.append(("TriggerSoftware",))
    if settings.exposure_us is not None:
        wanted.append(_EXPOSURE_NAMES)
    lacks = [names[0] for names in wanted if not any(features.has(name) for name in names)]
    if lacks:
        msg = (
            f"camera {serial}: has no {', '.join(lacks)}: it cannot take one frame of a set"
            " exposure at a trigger, and dcam cannot use it"
        )
        raise SettingRefusedError(msg)


def _set_region(writer: _Writer, settings: CameraSettings) -> None:
    """Take the middle of the sensor: the optical axis stays in the middle of the image."""
    _require_upright(writer, settings)
    for size_name, offset_name, size_px in (
        ("Width", "OffsetX", settings.width_px),
        ("Height", "OffsetY", settings.height_px),
    ):
        writer.set_if_there(offset_name, 0)  # what is left of an offset limits the size
        whole_px = writer.set_integer(size_name, size_px)
        if writer.features.has(offset_name):
            step = max(1, writer.features.step(offset_name))
            writer.set_integer(offset_name, (whole_px - size_px) // 2 // step * step)


def _require_upright(writer: _Writer, settings: CameraSettings) -> None:
    """Raise SettingRefusedError for a size that would fit with width and height exchanged only."""
    for offset_name in ("OffsetX", "OffsetY"):  # what is left of an offset limits the size
        writer.set_if_there(offset_name, 0)
    wanted = (settings.width_px, settings.height_px)
    whole = tuple(int(writer.features.limits(name)[1]) for name in ("Width", "Height"))
    if _fits(wanted, whole) or not _fits(wanted[::-1], whole):
        return
    why = (
        f"the camera has {whole[0]} x {whole[1]} px; width_px and height_px look swapped in the"
        " config, exchange them"
    )
    names, value = "Width x Height", f"{wanted[0]} x {wanted[1]}"
    raise writer.refused(names, value, why)


def _fits(size_px: tuple[int, ...], whole_px: tuple[int, ...]) -> bool:
    return all(size <= whole for size, whole in zip(size_px, whole_px, strict=True))


def _set_exposure(writer: _Writer, exposure_us: float | None) -> float | None:
    name = writer.first(*_EXPOSURE_NAMES)
    if name is None:
        return None
    return writer.set_float(name, exposure_us, "us", fallback=DEFAULT_EXPOSURE_US)


def _set_gain(writer: _Writer, gain_db: float | None) -> float | None:
    writer.set_if_there("GainSelector", "All")
    name = writer.first(*_GAIN_NAMES)
    if name is not None:
        return writer.set_float(name, gain_db, "dB", fallback=float("-inf"))
    if gain_db is not None:
        why = "the camera counts gain in units of its own; leave it out of the config"
        raise writer.refused(name="Gain", value=gain_db, why=why)
    if writer.features.has("GainRaw"):
        writer.set_integer("GainRaw", int(writer.features.limits("GainRaw")[0]))
    return None


def _set_trigger(writer: _Writer, trigger: TriggerIn | None) -> None:
    """Leave the frame's trigger as the only one: by software, or by an edge on a line."""
    writer.set_if_there("AcquisitionMode", "Continuous")
    if writer.features.has("TriggerSelector"):
        for selector in writer.features.choices("TriggerSelector"):
            writer.set_if_there("TriggerSelector", selector)
            writer.set_if_there("TriggerMode", "Off")
        writer.set_required("TriggerSelector", "FrameStart")
    _switch_off_delay(writer)
    # Some cameras let the source be changed only while the trigger is off. And no look at the
    # access mode: Aravis takes the GS3's TriggerSource for read-only, which it is not (aravis#684).
    if trigger is None:
        writer.set_required("TriggerSource", "Software")
    else:
        _set_line_in(writer, trigger)
    writer.set_required("TriggerMode", "On")


def _switch_off_delay(writer: _Writer) -> None:
    """A delay between trigger and exposure would be a skew of the pair."""
    for name in ("TriggerDelayEnabled", "TriggerDelayEnable"):
        writer.set_if_there(name, value=False, foreign=True)
    delay = writer.first("TriggerDelay", "TriggerDelayAbs")
    if delay is not None and writer.features.limits(delay)[0] <= 0.0:
        writer.set_if_there(delay, 0.0, foreign=True)


def _set_line_in(writer: _Writer, trigger: TriggerIn) -> None:
    """Listen to an edge on a line."""
    if writer.features.has("LineSelector"):
        writer.set_required("LineSelector", trigger.line)
        if writer.features.has("LineMode"):
            writer.set_required("LineMode", "Input")
        writer.set_if_there("LineInverter", value=False)
    writer.set_required("TriggerSource", trigger.line)
    writer.set_required("TriggerActivation", trigger.activation)


def _set_line_out(writer: _Writer, out: LineOut) -> None:
    """Show on a line when the sensor exposes."""
    writer.set_required("LineSelector", out.line)
    if writer.features.has("LineMode"):
        writer.set_required("LineMode", "Output")
    writer.set_if_there("LineInverter", value=False)
    writer.set_required("LineSource", out.source)


class _Writer:
    """Writes features by name, and reads each back."""

    def __init__(self, features: Features, serial: str) -> None:
        self.features = features
        self._serial = serial
        self._foreign: dict[str, Value] = {}
        """What was found set that no camera has at power-up."""

    def first(self, *names: str) -> str | None:
        return next((name for name in names if self.features.has(name)), None)

    def refused(self, name: str, value: object, why: str) -> SettingRefusedError:
        return SettingRefusedError(f"camera {self._serial}: {name} = {value} refused: {why}")

    def say_foreign(self) -> None:
        """Log what another program, or a stored user set, has left in the camera."""
        if self._foreign:
            _log.warning("camera_left_by_another", serial=self._serial, found=self._foreign)

    def set_if_there(self, name: str, value: Value, *, foreign: bool = False) -> None:
        """Set what the camera may do without; a refusal is worth a warning only.

        foreign: another value than this one is worth a line, though it is set right.
        """
        if not self.features.has(name):
            return
        try:
            if foreign:
                self._note_foreign(name, value)
            actual = self._write(name, value)
        except SettingRefusedError as error:
            _log.warning("camera_setting_not_applied", serial=self._serial, reason=str(error))
            return
        if actual != value:
            self._log_difference(name, value, actual)

    def _note_foreign(self, name: str, value: Value) -> None:
        try:
            found = self.features.read(name)
        except NodeRefusedError:  # writing it will tell more
            return
        if found != value:
            self._foreign[name] = found

    def set_required(self, name: str, value: str) -> None:
        if not self.features.has(name):
            raise self.refused(name, value, "the camera has no such feature")
        try:
            actual = self._write(name, value)
        except SettingRefusedError as error:
            msg = f"{error}; it takes {', '.join(self.features.choices(name)) or 'nothing'}"
            raise SettingRefusedError(msg) from None
        if actual != value:
            raise self.refused(name, value, f"reads back as {actual}")

    def set_integer(self, name: str, value: int) -> int:
        """Set a number that must be met exactly, and give the largest there is."""
        if not self.features.has(name):
            raise self.refused(name, value, "the camera has no such feature")
        low, high = (int(limit) for limit in self.features.limits(name))
        step = max(1, self.features.step(name))
        if not low <= value <= high or (value - low) % step:
            raise self.refused(name, value, f"the camera takes {low} to {high} in steps of {step}")
        actual = self._write(name, value)
        if actual != value:
            raise self.refused(name, value, f"reads back as {actual}")
        return high

    def set_float(self, name: str, value: float | None, unit: str, fallback: float) -> float:
        """Set a number within the camera's limits; without one, the fallback brought into them."""
        low, high = self.features.limits(name)
        if value is None:
            value = min(max(fallback, low), high)
        elif not low <= value <= high:
            limits = f"the camera takes {low:g} to {high:g} {unit}"
            raise self.refused(name, f"{value:g} {unit}", limits)
        actual = float(self._write(name, float(value)))
        if abs(actual - value) > READBACK_TOLERANCE * max(abs(value), 1.0):
            self._log_difference(name, value, actual)
        return actual

    def _write(self, name: str, value: Value) -> Value:
        """Write and read back. A refusal names feature and value."""
        try:
            self.features.write(name, value)
            return self.features.read(name)
        except NodeRefusedError as error:
            if self._reads_as(name, value):  # fixed to what is wanted, as the mode of some lines
                return value
            raise self.refused(name, value, str(error)) from None

    def _reads_as(self, name: str, value: Value) -> bool:
        try:
            return self.features.read(name) == value
        except NodeRefusedError:
            return False

    def _log_difference(self, name: str, wanted: object, actual: object) -> None:
        _log.warning(
            "camera_setting_differs",
            serial=self._serial,
            feature=name,
            wanted=wanted,
            actual=actual,
        )
