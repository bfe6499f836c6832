"""Pan-tilt heads that speak Pelco-D, with or without answers where they are.

A message is `FF address command1 command2 data1 data2 sum`, the sum that of bytes 2 to 6 modulo
256. Angles are hundredths of a degree, 0 to 359.99, high byte first. Source: Pelco TF-0002, D
Protocol Manual, version 2, revision 1.
"""

from __future__ import annotations

import math
import threading

import structlog

from drivers.errors import HeadError
from drivers.heads.moves import (
    AXES,
    Position,
    halted_on_error,
    listen,
    renew,
    require_unmoved,
    require_within,
    wait_until_there,
)
from drivers.heads.serial_line import Line
from drivers.protocols import HeadReport, HeadSettings

_log = structlog.get_logger("dcam.drivers")

SYNC = 0xFF
RIGHT, LEFT, UP, DOWN, STOP = 0x02, 0x04, 0x08, 0x10, 0x00
SET_PAN, SET_TILT, ASK_PAN, ASK_TILT, PAN_IS, TILT_IS = 0x4B, 0x4D, 0x51, 0x53, 0x59, 0x5B
FASTEST = 0x3F

ATTEMPTS = 3
STOPS = 3
"""Stop is said so often: it has no answer, and one that noise has hit leaves the head turning."""
STOP_PAUSE_S = 0.1
"""Between two of them, longer than most bursts of noise."""
FULL_TURN = 36_000
"""Hundredths of a degree."""


def message(address: int, command1: int, command2: int, data1: int, data2: int) -> bytes:
    """Give the seven bytes of one message, its checksum computed."""
    body = bytes([address, command1, command2, data1, data2])
    return bytes([SYNC, *body, sum(body) % 256])


def angle_message(address: int, command: int, angle_deg: float) -> bytes:
    """Give a message with an angle as data; one below zero goes round: -1 deg is 359 deg."""
    high, low = divmod(round(angle_deg * 100.0) % FULL_TURN, 256)
    return message(address, 0, command, high, low)


def angle_in(heard: bytes, address: int, command: int) -> float | None:
    """Find an answer with this command among what was heard; degrees, above -180 to 180.

    Whatever does not begin with FF, has another address or a wrong sum is passed over: noise,
    echoes, and the short general answer (`FF address alarms sum`). Some heads leave out FF and
    command1: `address command2 data1 data2 sum`. None if there is none, or not whole yet.
    """
    for start in range(len(heard)):
        rest = heard[start:]
        whole = rest[:7]
        if len(whole) == 7 and whole[:2] == bytes([SYNC, address]) and whole[3] == command:
            body, total = whole[1:6], whole[6]
        elif len(rest) >= 5 and rest[:2] == bytes([address, command]):
            body, total = rest[:4], rest[4]
        else:
            continue
        hundredths = int.from_bytes(body[-2:], "big")
        if sum(body) % 256 == total and hundredths < FULL_TURN:
            return (hundredths if hundredths <= FULL_TURN // 2 else hundredths - FULL_TURN) / 100.0
    return None


class PelcoHead:
    """A Pelco-D head that answers where it is; implements `drivers.protocols.PanTiltHead`."""

    reports_position = True

    def __init__(self, line: Line, settings: HeadSettings, address: int = 1) -> None:
        self._talk = _Talk(line, address)
        self._settings = settings
        self._who = f"Pelco-D head {address} at {line.name}"
        self._line = line
        self._asking = threading.RLock()
        self._rested_deg: Position | None = None

    def move_to(self, pan_deg: float, tilt_deg: float) -> None:
        """Go to the nearest hundredths of a degree and wait until the head says it is there."""
        _require_within(self._who, self._settings, (pan_deg, tilt_deg))
        talk, target = self._talk, (round(pan_deg, 2), round(tilt_deg, 2))
        talk.abort.clear()
        with halted_on_error(self._who, talk.stop):
            renew(self._line)
            rested_deg, self._rested_deg = self._rested_deg, None
            # A head that does not answer is known before it moves.
            require_unmoved(self._who, rested_deg, self._position(), self._settings.tolerance_deg)
            talk.send(angle_message(talk.address, SET_PAN, target[0]))
            talk.send(angle_message(talk.address, SET_TILT, target[1]))
            wait_until_there(
                self._who, self._line, self._position, target, self._settings, talk.abort
            )
            self._rested_deg = self._position()

    def position_deg(self) -> Position:
        """Pan and tilt as the head answers, above -180 to 180 deg."""
        renew(self._line)
        return self._position()

    def describe(self) -> HeadReport:
        """Pelco-D knows no version, limits or voltage."""
        return HeadReport("Pelco-D", self.position_deg(), limits_deg=None, power=None)

    def halt(self) -> None:
        """Stop both axes; the move that goes on in another thread ends with HeadError."""
        self._talk.abort.set()
        self._talk.stop()

    def close(self) -> None:
        """Halt if the line was ever used, and release the port."""
        self._talk.close()

    def _position(self) -> Position:
        return self._angle(ASK_PAN, PAN_IS), self._angle(ASK_TILT, TILT_IS)

    def _angle(self, ask: int, answer: int) -> float:
        """Ask for one angle. Raises HeadError."""
        heard, anything = b"", b""
        with self._asking:
            for _ in range(ATTEMPTS):
                self._line.open()
                self._line.read(0.0)
                self._talk.send(message(self._talk.address, 0, ask, 0, 0))
                heard = b""
                deadline_s = self._line.monotonic_s() + self._settings.answer_timeout_s
                while (left_s := deadline_s - self._line.monotonic_s()) > 0.0:
                    heard += self._line.read(left_s)
                    angle_deg = angle_in(heard, self._talk.address, answer)
                    if angle_deg is not None:
                        return angle_deg
                anything = heard or anything
        raise self._failure(AXES[ask == ASK_TILT], anything)

    def _failure(self, axis: str, heard: bytes) -> HeadError:
        if heard:
            return HeadError(
                f"{self._who}: answers where its {axis} is with nonsense ({heard[:20].hex(' ')}); "
                "check pan_tilt.baud and address, cable and termination"
            )
        waited_s = ATTEMPTS * self._settings.answer_timeout_s
        return HeadError(
            f"{self._who}: no answer where its {axis} is in {waited_s:g} s; check power, cable, "
            "pan_tilt.baud and address; a head that never answers needs reports_position = false"
        )


class TimedPelcoHead:
    """A Pelco-D head that answers nothing; implements `drivers.protocols.PanTiltHead`.

    It is turned at a known speed for a computed time, one axis after the other. Where it then is,
    nobody knows but the sub-camera: `position_deg` is None. Angles count from where the head stood
    when this object was made, and the limits are held against them.
    """

    reports_position = False

    def __init__(
        self, line: Line, settings: HeadSettings, address: int = 1, speed_level: int = 1
    ) -> None:
        if settings.speed_deg_s is None:
            msg = "a head without answers is moved by time; set pan_tilt.speed_deg_s"
            raise HeadError(msg)
        self._talk = _Talk(line, address)
        self._settings = settings
        self._speed_deg_s = settings.speed_deg_s
        self._level = speed_level
        self._who = f"Pelco-D head {address} at {line.name}"
        self._line = line
        self._reckoned_deg = [0.0, 0.0]

    def move_to(self, pan_deg: float, tilt_deg: float) -> None:
        """Turn for as long as the way takes at the configured speed."""
        asked = (pan_deg, tilt_deg)
        _require_within(self._who, self._settings, asked)
        way_s = [
            abs(a - b) / self._speed_deg_s for a, b in zip(asked, self._reckoned_deg, strict=True)
        ]
        if sum(way_s) > self._settings.move_timeout_s:
            msg = (
                f"{self._who}: {sum(way_s):.0f} s on the way at {self._speed_deg_s:g} deg/s is "
                f"more than pan_tilt.move_timeout_s = {self._settings.move_timeout_s:g}; raise it"
            )
            raise HeadError(msg)
        self._talk.abort.clear()
        with halted_on_error(self._who, self._talk.stop):
            renew(self._line)
            for axis, angle_deg in enumerate(asked):
                self._turn(axis, angle_deg - self._reckoned_deg[axis])

    def position_deg(self) -> None:
        """Nobody knows."""

    def describe(self) -> HeadReport:
        """Pelco-D knows no version, limits or voltage; opens the port and stops the head."""
        renew(self._line)
        self._talk.stop()
        return HeadReport("Pelco-D without answers", None, limits_deg=None, power=None)

    def halt(self) -> None:
        """Stop both axes; the move that goes on in another thread ends with HeadError."""
        self._talk.abort.set()
        self._talk.stop()

    def close(self) -> None:
        """Halt if the line was ever used, and release the port."""
        self._talk.close()

    def _turn(self, axis: int, way_deg: float) -> None:
        """Turn one axis, and reckon with the time that it truly turned."""
        if abs(way_deg) < 1e-9:
            return
        talk, line = self._talk, self._line
        command = ((LEFT, RIGHT), (DOWN, UP))[axis][way_deg > 0.0]
        speeds = (self._level, 0) if axis == 0 else (0, self._level)
        talk.send(message(talk.address, 0, command, *speeds))
        start_s = line.monotonic_s()
        try:
            listen(line, abs(way_deg) / self._speed_deg_s, talk.abort)
            aborted = talk.abort.is_set()
        finally:
            turned_s = line.monotonic_s() - start_s
            self._reckoned_deg[axis] += math.copysign(turned_s * self._speed_deg_s, way_deg)
        if aborted:
            msg = f"{self._who}: halted while its {AXES[axis]} turned"
            raise HeadError(msg)
        talk.stop()


class _Talk:
    """One address on the line, and how to stop it."""

    def __init__(self, line: Line, address: int) -> None:
        self.address = address
        self.abort = threading.Event()
        self._line = line
        self._sending = threading.RLock()

    def send(self, data: bytes) -> None:
        """Send one message, whole. Raises HeadLostError."""
        with self._sending:
            self._line.open()
            self._line.write(data)

    def stop(self) -> None:
        """Stop both axes. Raises HeadLostError."""
        for count in range(STOPS):
            if count:
                listen(self._line, STOP_PAUSE_S, threading.Event())
            self.send(message(self.address, 0, STOP, 0, 0))

    def close(self) -> None:
        """Halt if the line was ever used, and release the port."""
        self.abort.set()
        try:
            if self._line.openings:
                self.stop()
        except HeadError as error:
            _log.warning("head_not_halted", error=str(error))
        finally:
            self._line.close()


def _require_within(who: str, settings: HeadSettings, asked_deg: Position) -> None:
    require_within(who, (settings.pan_limits_deg, settings.tilt_limits_deg), asked_deg)
