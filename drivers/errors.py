"""Errors of devices: each says which device, what happened, and what to do, in one line."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from drivers.protocols import Role


class DriverError(Exception):
    """Base of everything that `drivers` raises on purpose; the message is one line."""


class DeviceError(DriverError):
    """A camera could not give a frame this time."""

    def __init__(self, message: str, role: Role | None = None) -> None:
        super().__init__(message)
        self.role = role


class DeviceLostError(DeviceError):
    """The camera is gone: the object must be closed and opened again."""


class DeviceHangsError(DeviceLostError):
    """A call into the camera's library has not come back: only a fresh process may use it again."""


class FrameTimeoutError(DeviceError):
    """No frame came within the deadline."""


class IncompleteFrameError(DeviceError):
    """A frame came with pixels missing and was refused."""


class SettingRefusedError(DeviceError):
    """A configured value is outside what the camera accepts, or did not read back."""


class HeadError(DriverError):
    """The pan-tilt head did not do what was asked; it is halted, or the message says it is not."""


class HeadLimitError(HeadError):
    """An angle beyond a limit was asked for; nothing has moved."""


class HeadLostError(HeadError):
    """The line to the head is gone; the next call opens it again."""


class HeadUnreachedError(HeadLostError):
    """The port was never opened, as when another program has it: nothing was sent to the head."""


class FrameSetError(DriverError):
    """A frame set on disk is damaged or incomplete: which row or file, and what to do."""


class ImageMissingError(FrameSetError):
    """An image that the table of a frame set names is not there."""


class SensorError(DriverError):
    """A sensor gave no number this time; the message says why, and not always what to do."""


class MissingLibraryError(DriverError):
    """The library a backend needs is not installed; the message says how to install it."""
