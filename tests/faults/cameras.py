"""Cameras that fail in every way a camera can, and an account of how they were treated."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from daemon.store.records import GapCause
from drivers.errors import (
    DeviceLostError,
    FrameTimeoutError,
    IncompleteFrameError,
    SettingRefusedError,
)
from drivers.protocols import CapturedFrame, Clock
from tests.drivers.hang import Hang

SIZE = (48, 64)
"""Height and width."""
CALLS = ("open", "arm", "trigger", "fetch")

LOST, FAILED = GapCause.CAMERA_LOST, GapCause.CAPTURE_FAILED

ERRORS: dict[str, tuple[Exception | BaseException, GapCause]] = {
    "lost": (DeviceLostError("it is gone"), LOST),
    "silent": (FrameTimeoutError("no frame came"), LOST),
    "torn": (IncompleteFrameError("12 of 100 packets"), FAILED),
    "refusing": (SettingRefusedError("no such exposure"), FAILED),
    "broken value": (ValueError("a driver's bug"), FAILED),
    "broken system": (OSError(19, "No such device"), FAILED),
    "broken exit": (SystemExit("a library thinks that it is a program"), FAILED),
}
"""What a call raises, and the cause of a gap that comes of it."""

GARBAGE: dict[str, Callable[[CapturedFrame], object]] = {
    "nothing": lambda _: None,
    "text": lambda _: "frame",
    "half": lambda frame: replace(frame, pixels=frame.pixels[: SIZE[0] // 2]),
    "empty": lambda frame: replace(frame, pixels=frame.pixels[:0]),
    "colour": lambda frame: replace(frame, pixels=np.stack([frame.pixels] * 3, axis=2)),
    "fractions": lambda frame: replace(frame, pixels=frame.pixels / 255.0),
    "wide": lambda frame: replace(frame, pixels=frame.pixels.astype(np.uint16)),
    "too deep": lambda frame: replace(frame, bits=64),
}
"""What a fetch gives instead of the frame."""


@dataclass(frozen=True, slots=True)
class Fault:
    """What is wrong with a camera for a while."""

    kind: str
    """A key of ERRORS or GARBAGE, or `hang`, or `stale`."""
    at: str = "fetch"
    """Call in which it shows, or the next one made."""
    on_close: str = ""
    """How `close` fails as well: `raise` or `hang`."""

    @property
    def causes(self) -> set[GapCause]:
        """Causes that a gap may have which comes of it."""
        shows = ERRORS[self.kind][1] if self.kind in ERRORS else FAILED
        lost = self.kind == "hang" or self.on_close == "hang"
        return {LOST} if self.kind == "hang" else {shows, LOST} if lost else {shows}


class FaultyCamera:
    """A camera with a handle of its own, that notes when it is misused."""

    def __init__(self, serial: str, clock: Clock) -> None:
        self.serial = serial
        self.is_lost = False
        self.fault: Fault | None = None
        self.misused: list[str] = []
        self.hang = Hang()
        self._clock = clock
        self._busy = threading.Lock()
        self._handle: int | None = None
        self._frames = 0
        self._last: CapturedFrame | None = None

    # ------------------------------------------------------------ drivers.protocols.Camera

    def open(self) -> None:
        with self._call("open"):
            if self._handle is not None:
                self.misused.append("opened twice without a close between")
            self._handle = os.open(os.devnull, os.O_RDONLY)
            self._fail("open")

    def arm(self) -> None:
        with self._call("arm"):
            self._fail("arm")

    def set_exposure(self, exposure_us: float, gain_db: float | None) -> None:
        with self._call("arm"):
            self._fail("arm")

    def trigger(self) -> None:
        with self._call("trigger"):
            self._fail("trigger")

    def fetch(self, timeout_s: float) -> object:
        with self._call("fetch"):
            self._fail("fetch")
            fault = self.fault
            if fault is not None and fault.kind == "stale":
                return self._last
            frame = self._frame()
            if fault is not None:
                return GARBAGE[fault.kind](frame)
            self._last = frame
            return frame

    def close(self) -> None:
        with self._call("close"):
            handle, self._handle = self._handle, None
            if handle is not None:
                os.close(handle)
            fault = self.fault
            if fault is not None and fault.on_close == "hang":
                self.hang.block()
            if fault is not None and fault.on_close == "raise":
                raise OSError(5, "Input/output error")

    # ------------------------------------------------------------ the test's side

    def release(self) -> None:
        """End the fault: a call that hangs returns."""
        self.fault = None
        self.hang.release()

    def restart(self) -> None:
        """Be the camera of another process, which knows of no frame."""
        self._last = None

    def _frame(self) -> CapturedFrame:
        self._frames += 1
        pixels = np.full(SIZE, self._frames % 251, np.uint8)
        now_s = self._clock.monotonic_s()
        return CapturedFrame(pixels, 8, self._frames, round(now_s * 1e9), now_s, 5000.0)

    @contextmanager
    def _call(self, name: str):
        alone = self._busy.acquire(blocking=False)
        if not alone:
            self.misused.append(f"{name} while another call has not returned")
        try:
            if name not in {"open", "close"} and self._handle is None:
                msg = f"{self.serial}: not open"
                raise DeviceLostError(msg)
            yield
        finally:
            if alone:
                self._busy.release()

    def _fail(self, call: str) -> None:
        fault = self.fault
        if fault is None or CALLS.index(call) < CALLS.index(fault.at):
            return
        if fault.kind == "hang":
            self.hang.block()
        elif fault.kind in ERRORS:
            raise ERRORS[fault.kind][0]
