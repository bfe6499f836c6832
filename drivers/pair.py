"""Two cameras as one source of frame pairs: armed, then triggered together, within deadlines."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from datetime import datetime
from typing import TypeVar

import structlog

from drivers.deadline import DeadlineThread
from drivers.errors import (
    DeviceError,
    DeviceHangsError,
    DeviceLostError,
    FrameTimeoutError,
    IncompleteFrameError,
)
from drivers.frame_check import require_frame
from drivers.protocols import Camera, CapturedFrame, CapturedPair, Clock, Role

_T = TypeVar("_T")
_log = structlog.get_logger("dcam.drivers")

OPEN_TIMEOUT_S = 20.0
"""Deadline to open and arm both cameras, above what a driver allows itself."""
GRACE_S = 6.0
"""What trigger and fetch may take beyond the time-out they are given."""
MEET_S = 1.0
"""How long the two trigger threads wait for each other."""
FIRST_BACK_OFF_S = 1.0
LAST_BACK_OFF_S = 30.0
FAILURES_TO_REOPEN = 3
"""After so many frames missed in a row a camera is opened again though it did not say "lost"."""
CLOSE_TIMEOUT_S = 5.0
BETWEEN = "it was gone between two pairs"
WATCH_EVERY_S = 0.5
"""How often the cameras are looked at between two pairs."""
WATCH_PAUSE_S = 5.0
"""From one attempt to open a camera again between two pairs to the next."""


class SynchronizedPair:
    """A main and a sub-camera, triggered at once; implements `FramePairSource`.

    Each camera lives in a thread of its own. Both are opened and armed, meet, and are triggered by
    software; or the main camera is, where `main_triggers_sub`, and its line triggers the other. A
    call that hangs is left behind with its thread at the deadline, and the camera is not touched
    before the call returns; a lost camera is opened again, with a growing pause between the
    attempts, so that a dead one costs a slot its deadline at most, and usually nothing. One that
    says between two pairs that it was lost is opened again at once, so that it costs none.
    """

    def __init__(
        self,
        main: Camera,
        sub: Camera,
        clock: Clock,
        *,
        timeout_s: float = 5.0,
        open_timeout_s: float = OPEN_TIMEOUT_S,
        grace_s: float = GRACE_S,
        main_triggers_sub: bool = False,
        sizes_px: tuple[tuple[int, int], tuple[int, int]] | None = None,
        make_thread: Callable[[str, Callable[[], None]], DeadlineThread] = DeadlineThread,
    ) -> None:
        """Take two cameras, not opened yet.

        sizes_px: width and height of main and sub frames. make_thread: of a name and what to do at
        its end; in a test with other deadlines than those of the clock.
        """
        main_px, sub_px = sizes_px or (None, None)
        self._lanes = (
            _Lane(main, "main", clock, main_px, make_thread),
            _Lane(sub, "sub", clock, sub_px, make_thread, waits_for_line=main_triggers_sub),
        )
        self._main_triggers_sub = main_triggers_sub
        self._timeout_s = timeout_s
        self._open_timeout_s = open_timeout_s
        self._grace_s = grace_s
        self._watch: _Watch | None = None

    def prepare(self) -> None:
        """Open and arm both cameras. Raises DeviceError, within `open_timeout_s`."""
        if self._watch is None:
            self._watch = _Watch(self._lanes)
        self._both(_Lane.open_and_arm, "opening", self._open_timeout_s)

    def set_exposure(self, role: Role, exposure_us: float, gain_db: float | None) -> None:
        """Have a camera expose so from the next frame on, also after it was opened again."""
        self._lanes[role == "sub"].expose(exposure_us, gain_db)

    def capture(self, slot_utc: datetime) -> CapturedPair:
        """Take both frames now.

        Raises DeviceError, its `role` naming the camera, or None when both failed. Returns or
        raises within `open_timeout_s + timeout_s + grace_s`.
        """
        self.prepare()
        meeting = threading.Barrier(len(self._lanes))
        main, sub = self._both(
            lambda lane: lane.trigger_and_fetch(meeting, self._timeout_s),
            "the exposure",
            self._timeout_s + self._grace_s,
        )
        # Through a line the sub-camera follows within microseconds, or not at all. The host sees
        # neither edge, and the cameras' clocks do not agree: no number is better than a wrong one.
        skew_s = None
        if not self._main_triggers_sub:
            skew_s = sub.trigger_monotonic_s - main.trigger_monotonic_s
        _log.debug("pair_captured", slot=slot_utc.isoformat(), skew_s=skew_s)
        return CapturedPair(main, sub, skew_s)

    def close(self) -> None:
        """Release both cameras, or leave behind one that hangs."""
        watch, self._watch = self._watch, None
        if watch is not None:
            watch.end()
        for lane in self._lanes:
            lane.close()

    def _both(self, step: Callable[[_Lane], _T], what: str, timeout_s: float) -> list[_T]:
        """Take a step with both cameras at once; raise only after both have ended theirs."""
        deadline_s = time.monotonic() + timeout_s
        started: list[tuple[_Lane, Future[_T]]] = []
        results: list[_T] = []
        errors: list[DeviceError] = []
        for lane in self._lanes:
            try:
                started.append((lane, lane.start(step)))
            except DeviceError as error:
                errors.append(error)
        for lane, future in started:
            try:
                results.append(lane.finish(future, what, timeout_s, deadline_s))
            except DeviceError as error:
                errors.append(error)
        if self._main_triggers_sub and len(errors) > 1:
            # A main camera that did not expose is why the sub-camera saw no edge.
            errors = [error for error in errors if not _is_unanswered(error, "sub")] or errors
        if len(errors) > 1:
            # Once, where both have the same to say.
            both = type(errors[0])("; ".join(dict.fromkeys(map(str, errors))), None)
            raise both from errors[0]
        if errors:
            raise errors[0]
        return results


def _as_text(error: BaseException) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


def _is_unanswered(error: DeviceError, role: Role) -> bool:
    return isinstance(error, FrameTimeoutError) and error.role == role


class _Watch:
    """Looks between two pairs whether a camera was lost, and has it opened again."""

    def __init__(self, lanes: Sequence[_Lane]) -> None:
        self._lanes = lanes
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="cameras-watch", daemon=True)
        self._thread.start()

    def end(self) -> None:
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._ended.wait(WATCH_EVERY_S):
            for lane in self._lanes:
                lane.look_after()


class _Lane:
    """One camera, its thread, and whether and when it may be used."""

    def __init__(
        self,
        camera: Camera,
        role: Role,
        clock: Clock,
        size_px: tuple[int, int] | None,
        make_thread: Callable[[str, Callable[[], None]], DeadlineThread],
        *,
        waits_for_line: bool = False,
    ) -> None:
        self._camera = camera
        self._size_px = size_px
        self._make_thread = make_thread
        self._waits_for_line = waits_for_line
        self._role: Role = role
        self._clock = clock
        self._thread: DeadlineThread | None = None
        self._left_behind: DeadlineThread | None = None
        self._open = False
        self._wanted: tuple[float, float | None] | None = None
        """Exposure and gain; None: those that the camera is opened with."""
        self._set: tuple[float, float | None] | None = None
        """The wish that the open camera knows of."""
        self._seen: tuple[int, int] | None = None
        """The last frame's number and camera time."""
        self._away = False
        """Whether the camera was lost between two pairs and is not back."""
        self._look_again_s = 0.0
        """Monotonic time of the next attempt to open it between two pairs."""
        self._failures = 0
        self._pause_s = 0.0
        self._not_before_s = 0.0
        self._trouble = ""

    # ------------------------------------------------------------ in the camera's thread

    def open_and_arm(self) -> None:
        """Open the camera if need be, tell it its exposure if that changed, and arm it."""
        if self._open and self._camera.is_lost:
            self.release()
            self._open = False
        if not self._open:
            self._camera.open()
            self._open, self._away, self._set = True, False, None
            if self._seen is not None and self._seen[1] == 0:
                self._seen = None  # without a clock the numbers alone count, from one again
        wanted = self._wanted
        if wanted is not None and wanted != self._set:
            self._camera.set_exposure(*wanted)
            self._set = wanted
        self._camera.arm()

    def reopen(self) -> None:
        """Open again, between two pairs, a camera that is lost or still away."""
        if self._open and self._camera.is_lost:
            _log.warning("camera_lost", role=self._role, serial=self._camera.serial, error=BETWEEN)
            self.release()
            self._open, self._away = False, True
        if self._open or not self._away:
            return
        try:
            self.open_and_arm()
        except Exception as error:  # noqa: BLE001 - the next pair meets and reports it too
            _log.info("camera_still_away", role=self._role, error=_as_text(error))
            self.release()
        else:
            _log.info("camera_back", role=self._role, serial=self._camera.serial)

    def trigger_and_fetch(self, meeting: threading.Barrier, timeout_s: float) -> CapturedFrame:
        """Trigger together with the other camera, or through it, and fetch."""
        with suppress(threading.BrokenBarrierError):  # the other camera is late: its skew will say
            if self._waits_for_line:  # its frame is expected before the edge can come
                self._camera.trigger()
            meeting.wait(MEET_S)
        if not self._waits_for_line:
            self._camera.trigger()
        return self._new(self._camera.fetch(timeout_s))

    def release(self) -> None:
        """Close the camera, which is given up or has ended: its refusal is nobody's trouble."""
        try:
            self._camera.close()
        except Exception as error:  # noqa: BLE001 - whatever a vendor's library throws
            _log.warning("camera_not_closed", serial=self._camera.serial, error=_as_text(error))

    def _new(self, found: object) -> CapturedFrame:
        """Give the frame if it is whole and was not seen before."""
        name = f"{self._role} camera {self._camera.serial}"
        frame = require_frame(found, self._size_px, name)
        seen, self._seen = self._seen, (frame.frame_id, frame.camera_time_ns)
        if seen == self._seen:
            msg = f"{name}: gave frame {frame.frame_id} a second time"
            raise IncompleteFrameError(msg, self._role)
        return frame

    # ------------------------------------------------------------ in the caller's thread

    def look_after(self) -> None:
        """Have a lost camera opened again; for any thread, and at once."""
        thread, now_s = self._thread, time.monotonic()
        wanted = self._camera.is_lost or (self._away and not self._open)
        if thread is not None and wanted and now_s >= self._look_again_s:
            self._look_again_s = now_s + WATCH_PAUSE_S
            thread.submit(self.reopen)

    def expose(self, exposure_us: float, gain_db: float | None) -> None:
        """Note how the next frames are to be exposed."""
        self._wanted = exposure_us, gain_db

    def start(self, step: Callable[[_Lane], _T]) -> Future[_T]:
        """Begin a step. Raises DeviceLostError at once while the camera is not to be touched."""
        if self._left_behind is not None:
            if self._left_behind.alive:
                msg = f"{self._trouble}, and still has not; restart the program if it stays so"
                raise DeviceHangsError(self._named(msg), self._role)
            self._left_behind, self._open = None, False  # whatever it opened, it closed
        left_s = self._not_before_s - self._clock.monotonic_s()
        if not self._open and left_s > 0.0:
            msg = f"{self._trouble}; next attempt in {left_s:.0f} s"
            raise DeviceLostError(self._named(msg), self._role)
        if self._thread is None:
            self._thread = self._make_thread(f"{self._role}-camera", self.release)
        return self._thread.submit(lambda: step(self))

    def finish(self, future: Future[_T], what: str, timeout_s: float, deadline_s: float) -> _T:
        """Give what the step gave, by the deadline (monotonic); note what a failure means."""
        left_s = max(deadline_s - time.monotonic(), 0.0)
        if self._thread is None or not self._thread.wait(future, left_s):
            future.cancel()  # behind a call that hangs it is not to be made any more
            self._abandon()
            self._give_up(f"{what} did not end within {timeout_s:g} s")
            raise DeviceLostError(self._named(self._trouble), self._role)
        try:
            result = future.result()
        except DeviceError as error:
            error.role = error.role or self._role
            self._failures += 1
            lost = isinstance(error, DeviceLostError) or not self._open
            if lost or self._failures >= FAILURES_TO_REOPEN:
                self._give_up(str(error))
            raise
        except BaseException as error:
            # No more than this attempt, whatever a library throws. What state it is in, who knows.
            msg = f"{self._role} camera {self._camera.serial}: its driver broke ({_as_text(error)})"
            _log.error("driver_broke", serial=self._camera.serial, error=_as_text(error))
            self._give_up(msg)
            raise DeviceError(msg, self._role) from error
        if isinstance(result, CapturedFrame):
            if self._trouble:
                _log.info("camera_back", role=self._role, serial=self._camera.serial)
            self._failures, self._pause_s, self._trouble = 0, 0.0, ""
        return result

    def close(self) -> None:
        """Release the camera, waiting a few seconds at most."""
        thread, self._thread = self._thread, None
        self._open = False
        if thread is not None:
            thread.end(CLOSE_TIMEOUT_S)
            self._left_behind = thread
            if thread.alive:
                self._trouble = f"closing did not end within {CLOSE_TIMEOUT_S:g} s"

    def _abandon(self) -> None:
        """Leave the thread to the call it hangs in; it closes the camera when it comes back."""
        if self._thread is not None:
            self._thread.end()
            self._left_behind, self._thread = self._thread, None

    def _give_up(self, trouble: str) -> None:
        """Have the camera opened again, after a pause that grows while that fails."""
        _log.warning("camera_lost", role=self._role, serial=self._camera.serial, error=trouble)
        self._open = False
        self._failures = 0
        self._trouble = trouble
        self._pause_s = min(max(2.0 * self._pause_s, FIRST_BACK_OFF_S), LAST_BACK_OFF_S)
        self._not_before_s = self._clock.monotonic_s() + self._pause_s
        if self._thread is not None:
            self._thread.submit(self.release)

    def _named(self, trouble: str) -> str:
        if self._camera.serial in trouble:
            return trouble
        return f"{self._role} camera {self._camera.serial}: {trouble}"
