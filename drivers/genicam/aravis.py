"""GenICam cameras on GigE Vision and USB3 Vision, through Aravis, without the vendor's software."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import structlog

from drivers.deadline import DeadlineExceededError, DeadlineThread
from drivers.errors import DeviceError, DeviceHangsError, DeviceLostError
from drivers.genicam.aravis_device import AravisDevice
from drivers.genicam.session import Session
from drivers.protocols import CameraSettings, CapturedFrame, Role

_T = TypeVar("_T")
_log = structlog.get_logger("dcam.drivers")

FETCH_MARGIN_S = 1.0
"""Time for the library to hand a frame over, on top of the caller's time-out."""
MAX_LEFT_BEHIND = 4
"""More threads than this, hanging in the library, are not added to."""


@dataclass(frozen=True, slots=True)
class _Opened:
    session: Session
    thread: DeadlineThread


class AravisCamera:
    """One camera, selected by serial number; one frame at each software trigger.

    Implements `drivers.protocols.Camera`. Everything of the library happens in a thread of the
    open device's own; when a call exceeds its deadline, or the device is lost, that thread is left
    to release the device in its own time and `open` starts again with another.
    """

    def __init__(self, serial: str, settings: CameraSettings, role: Role | None = None) -> None:
        self._serial = serial
        self._settings = settings
        self._role = role
        self._opened: _Opened | None = None
        self._left_behind: list[DeadlineThread] = []

    @property
    def serial(self) -> str:
        """The serial number the camera is selected by."""
        return self._serial

    @property
    def is_lost(self) -> bool:
        """Whether Aravis has said so since the camera was opened."""
        opened = self._opened
        return opened is not None and opened.session.is_lost

    def open(self) -> None:
        """Find the camera, apply the settings, read them back, start acquisition.

        Raises DeviceLostError when it is not there or does not answer, SettingRefusedError with
        feature, value and limits, MissingLibraryError with what to install.
        """
        self.close()
        self._left_behind = [thread for thread in self._left_behind if thread.alive]
        if len(self._left_behind) > MAX_LEFT_BEHIND:
            msg = f"camera {self._serial}: calls into Aravis hang; restart the program"
            raise DeviceHangsError(msg, self._role)
        device = AravisDevice(self._serial, self._settings.open_timeout_s)
        session = Session(device, self._serial, self._settings)
        thread = DeadlineThread(f"aravis-{self._serial}", session.release)
        self._opened = _Opened(session, thread)
        try:
            self._call("open", Session.start, self._settings.open_timeout_s)
        except BaseException:
            self._discard(0.0)
            raise
        _log.info("camera_opened", serial=self._serial, role=self._role)

    def set_exposure(self, exposure_us: float, gain_db: float | None) -> None:
        """Expose the next frames so, as far as the camera can."""
        self._call(
            "set the exposure",
            lambda session: session.set_exposure(exposure_us, gain_db),
            self._settings.command_timeout_s,
        )

    def arm(self) -> None:
        """Throw away stale frames, so that the next frame is the one triggered next."""
        self._call("arm", Session.arm, self._settings.command_timeout_s)

    def trigger(self) -> None:
        """Send the software trigger."""
        self._call("trigger", Session.trigger, self._settings.command_timeout_s)

    def fetch(self, timeout_s: float) -> CapturedFrame:
        """Give the triggered frame.

        Raises FrameTimeoutError when none came, IncompleteFrameError when pixels are missing.
        """
        return self._call(
            "fetch", lambda session: session.fetch(timeout_s), timeout_s + FETCH_MARGIN_S
        )

    def close(self) -> None:
        """Release the device; safe to call at any time, more than once."""
        self._discard(self._settings.close_timeout_s)

    def _call(self, what: str, function: Callable[[Session], _T], timeout_s: float) -> _T:
        opened = self._opened
        if opened is None:
            msg = f"camera {self._serial}: not open"
            raise DeviceLostError(msg, self._role)
        try:
            return opened.thread.call(lambda: function(opened.session), timeout_s)
        except DeadlineExceededError:
            self._discard(0.0)
            msg = (
                f"camera {self._serial}: no answer within {timeout_s:g} s to {what};"
                " check power and cable"
            )
            raise DeviceLostError(msg, self._role) from None
        except DeviceError as error:
            error.role = self._role
            if isinstance(error, DeviceLostError):
                self._discard(0.0)
            raise

    def _discard(self, wait_s: float) -> None:
        """Let the device's thread release it, without waiting for a lost one."""
        opened, self._opened = self._opened, None
        if opened is None:
            return
        opened.thread.end(0.0 if opened.session.is_lost else wait_s)
        if opened.thread.alive:
            self._left_behind.append(opened.thread)
