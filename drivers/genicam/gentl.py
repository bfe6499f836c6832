"""GenICam cameras through their vendor's GenTL producer (`.cti`), by way of `harvesters`.

Each camera has a process of its own (`drivers.genicam.gentl_worker`). Measured with harvesters
1.4.3 and genicam 1.6.0: a producer's call holds Python's lock for as long as it lasts, so that in
the same process no deadline could be kept; `Harvester.update()`, needed to find a camera that comes
back, invalidates every other camera of the process; and a producer that crashes takes its process
along.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import cast

import structlog

from drivers.errors import DeviceError, DeviceLostError, MissingLibraryError
from drivers.genicam.gentl_calls import Call, Reply, Setup
from drivers.protocols import CameraSettings, CapturedFrame, Role

_log = structlog.get_logger("dcam.drivers")

PRODUCER_PATH = "GENICAM_GENTL64_PATH"
"""Where vendors' installers say their producers are: folders joined by colons (GenTL standard)."""
FETCH_MARGIN_S = 1.0
"""Time for the library to hand a frame over, on top of the caller's time-out."""
KILL_S = 2.0
"""How long a killed process may take to be gone."""
MAX_LEFT_BEHIND = 4
"""More processes than this, hanging in the kernel, are not added to."""


def find_producer(configured: Path | None, environ: Mapping[str, str] = os.environ) -> Path:
    """Give the producer: the one configured, else the only one the environment leads to.

    Raises MissingLibraryError that says what to set.
    """
    if configured is not None:
        if not configured.is_file():
            msg = f"{configured}: no such GenTL producer; set genicam.producer to the vendor's .cti"
            raise MissingLibraryError(msg)
        return configured
    folders = [Path(folder) for folder in environ.get(PRODUCER_PATH, "").split(":") if folder]
    found = sorted({cti.resolve() for folder in folders for cti in folder.glob("*.cti")})
    if len(found) == 1:
        return found[0]
    if found:
        names = ", ".join(map(str, found))
        msg = f"{PRODUCER_PATH} leads to several producers; set genicam.producer to one of {names}"
        raise MissingLibraryError(msg)
    msg = (
        "no GenTL producer; install the camera vendor's software and set genicam.producer to its"
        f" .cti file ({PRODUCER_PATH} is {environ.get(PRODUCER_PATH) or 'not set'})"
    )
    raise MissingLibraryError(msg)


@dataclass(frozen=True, slots=True)
class _Worker:
    process: subprocess.Popen[bytes]
    connection: Connection


class GentlCamera:
    """One camera, selected by serial number; one frame at each trigger.

    Implements `drivers.protocols.Camera`. When a call exceeds its deadline, or the device is lost,
    its process is killed and `open` starts again with another.
    """

    def __init__(
        self, serial: str, settings: CameraSettings, producer: Path, role: Role | None = None
    ) -> None:
        self._serial = serial
        self._settings = settings
        self._producer = producer
        self._role = role
        self._worker: _Worker | None = None
        self._left_behind: list[subprocess.Popen[bytes]] = []

    @property
    def serial(self) -> str:
        """The serial number the camera is selected by."""
        return self._serial

    @property
    def is_lost(self) -> bool:
        """Whether its process has ended; of the camera itself a producer does not tell."""
        worker = self._worker
        return worker is not None and worker.process.poll() is not None

    def open(self) -> None:
        """Find the camera, apply the settings, read them back, start acquisition.

        Raises DeviceLostError when it is not there or does not answer, SettingRefusedError with
        feature, value and limits, MissingLibraryError with what to install.
        """
        self.close()
        self._left_behind = [process for process in self._left_behind if process.poll() is None]
        if len(self._left_behind) > MAX_LEFT_BEHIND:
            msg = f"camera {self._serial}: {self._producer.name} hangs; restart the computer"
            raise DeviceLostError(msg, self._role)
        self._worker = _start_worker()
        self._worker.connection.send(Setup(self._serial, self._settings, self._producer))
        try:
            self._call("start", self._settings.open_timeout_s)
        except BaseException:
            self.close()  # not killed: it would be the camera's owner until that forgets it
            raise
        _log.info("camera_opened", serial=self._serial, role=self._role)

    def set_exposure(self, exposure_us: float, gain_db: float | None) -> None:
        """Expose the next frames so, as far as the camera can."""
        self._call("set_exposure", self._settings.command_timeout_s, exposure_us, gain_db)

    def arm(self) -> None:
        """Throw away stale frames, so that the next frame is the one triggered next."""
        self._call("arm", self._settings.command_timeout_s)

    def trigger(self) -> None:
        """Send the software trigger; where a line triggers, expect its frame from now on."""
        self._call("trigger", self._settings.command_timeout_s)

    def fetch(self, timeout_s: float) -> CapturedFrame:
        """Give the triggered frame.

        Raises FrameTimeoutError when none came, IncompleteFrameError when pixels are missing.
        """
        return cast("CapturedFrame", self._call("fetch", timeout_s + FETCH_MARGIN_S, timeout_s))

    def close(self) -> None:
        """Release the device; safe to call at any time, more than once."""
        if self._worker is not None:
            try:
                self._call("release", self._settings.close_timeout_s)
            except DeviceError as error:
                _log.info("camera_released", serial=self._serial, reason=str(error))
        self._discard()

    def _call(self, name: str, timeout_s: float, *arguments: float | None) -> object:
        worker = self._worker
        if worker is None:
            msg = f"camera {self._serial}: not open"
            raise DeviceLostError(msg, self._role)
        try:
            worker.connection.send(Call(name, arguments, timeout_s))
            if not worker.connection.poll(timeout_s):
                self._discard()
                msg = (
                    f"camera {self._serial}: no answer within {timeout_s:g} s to {name};"
                    " check power and cable"
                )
                raise DeviceLostError(msg, self._role)
            reply: Reply = worker.connection.recv()
        except (EOFError, OSError):
            self._discard()
            msg = (
                f"camera {self._serial}: {self._producer.name} {_end_of(worker.process)} in {name}"
            )
            raise DeviceLostError(msg, self._role) from None
        return self._value(reply)

    def _value(self, reply: Reply) -> object:
        for entry in reply.log:
            getattr(_log, entry.pop("level"))(**entry)
        if isinstance(reply.error, DeviceError):
            reply.error.role = self._role
        if isinstance(reply.error, DeviceLostError):
            self._discard()
        if reply.error is not None:
            raise reply.error
        return reply.value

    def _discard(self) -> None:
        """End the process, whatever it does."""
        worker, self._worker = self._worker, None
        if worker is None:
            return
        worker.connection.close()
        worker.process.kill()
        try:
            worker.process.wait(KILL_S)
        except subprocess.TimeoutExpired:
            self._left_behind.append(worker.process)


def _start_worker() -> _Worker:
    ours, its = socket.socketpair()
    with its:
        process = subprocess.Popen(  # noqa: S603  (our own module, by our own Python)
            [sys.executable, "-m", "drivers.genicam.gentl_worker", str(its.fileno())],
            pass_fds=[its.fileno()],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,  # producers chatter
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is ours to handle
        )
    return _Worker(process, Connection(ours.detach()))


def _end_of(process: subprocess.Popen[bytes]) -> str:
    """How a process ended that should not have."""
    try:
        code = process.wait(KILL_S)
    except subprocess.TimeoutExpired:
        return "fell silent"
    if code < 0:
        return f"crashed ({signal.Signals(-code).name})"
    return f"ended (exit code {code})"
