"""Pan-tilt heads that speak ASCII: FLIR / Directed Perception D46, E46, D48E, D100E, D300E, PTU-5.

A command ends with a space, its answer with CR or CR LF: `*` is done, `* result` an answer,
`! message` a refusal; `!P` and `!T` come unasked when an axis runs into its limit switch.
Source: PTU-D300 User's Manual 2.19, chapter 4; E Series Command Reference Manual 6.00.
"""

from __future__ import annotations

import math
import re
import threading
from contextlib import suppress
from dataclasses import dataclass

import structlog

from drivers.errors import HeadError
from drivers.heads.moves import (
    Position,
    halted_on_error,
    renew,
    require_unmoved,
    require_within,
    wait_until_there,
)
from drivers.heads.serial_line import Line
from drivers.protocols import HeadReport, HeadSettings

_log = structlog.get_logger("dcam.drivers")

ATTEMPTS = 3
"""A question is asked so often before the head counts as silent, or as talking nonsense."""
QUIET_S = 0.2
"""A pause this long means that nothing more is on its way."""
MAX_NOISE_S = 2.0
ARCSEC_PER_DEG = 3600.0
OWN_LIMITS = "they are set in the head itself; ask for less"

GREETING = ("ED", "FT")
"""Echo off, short answers."""
MODES = ("I", "CI")
"""Moves begin at once (not at the next A), and a speed is a limit (not the motion itself). Another
program may have left the head otherwise; older units refuse the second."""
HOMING_SWINGS = "homing swings both axes over their whole travel, so clear the way first"
TAIL_BYTES = 400
"""Of what was heard last; more than the longest line of a head."""

_HOMED = re.compile(rb"(?:!T *){2}(?:!P *){2}|(?:!P *){2}(?:!T *){2}")
"""Both ends of both axes found: what a head says at the end of its homing."""
_BANNER = re.compile(rb"Pan-Tilt|Directed Perception|FLIR", re.IGNORECASE)
"""What a head says when it starts; in a line with `*` it is the answer to V."""
_UNASKED = re.compile(rb"!([PT])(?![A-Za-z])")
_ANSWER = re.compile(r"([*!])[ \t]*(.*)")
_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?![\d.])")


class _NoAnswerError(Exception):
    """Nothing, or nothing that can be read; ask again."""


class _RefusedError(Exception):
    """`! message`."""


class _RefusesError(HeadError):
    """It refused a command as often as it was asked."""


@dataclass(frozen=True, slots=True)
class _Axis:
    """One axis as the head describes it."""

    letter: str
    deg_per_count: float
    lowest: int
    """Counts."""
    highest: int

    @property
    def limits_deg(self) -> Position:
        return self.lowest * self.deg_per_count, self.highest * self.deg_per_count

    def counts(self, angle_deg: float, limits_deg: Position) -> int:
        """The nearest count within the limits."""
        low = max(math.ceil(limits_deg[0] / self.deg_per_count), self.lowest)
        high = min(math.floor(limits_deg[1] / self.deg_per_count), self.highest)
        return min(max(round(angle_deg / self.deg_per_count), low), high)


class PtuHead:
    """An ASCII pan-tilt unit on a serial line; implements `drivers.protocols.PanTiltHead`.

    Its position limits are read, not set: whoever mounted it may have set narrower ones.
    """

    reports_position = True

    def __init__(self, line: Line, settings: HeadSettings) -> None:
        self._line = line
        self._settings = settings
        self._who = f"pan-tilt head at {line.name}"
        self._axes: tuple[_Axis, _Axis] | None = None
        self._greeted = 0
        self._speeds: tuple[float, float] | None = None
        self._rested_deg: Position | None = None
        self._restarted = False
        self._tail = b""
        self._abort = threading.Event()
        self._talking = threading.RLock()
        self._limits_hit: set[str] = set()

    # ------------------------------------------------------------ the Protocol

    def move_to(self, pan_deg: float, tilt_deg: float) -> None:
        """Go to the nearest counts and wait until the head says that it is there."""
        settings, asked = self._settings, (pan_deg, tilt_deg)
        limits = (settings.pan_limits_deg, settings.tilt_limits_deg)
        require_within(self._who, limits, asked)
        self._abort.clear()
        with halted_on_error(self._who, self._stop):
            renew(self._line)
            self._greet_again_after_a_restart()
            pan, tilt = self._known_axes()
            rested_deg, self._rested_deg = self._rested_deg, None
            require_unmoved(self._who, rested_deg, self._position(), settings.tolerance_deg)
            require_within(self._who, (pan.limits_deg, tilt.limits_deg), asked, OWN_LIMITS)
            counts = pan.counts(pan_deg, limits[0]), tilt.counts(tilt_deg, limits[1])
            self._forget_unasked()
            self._ask(f"PP{counts[0]}")
            self._ask(f"TP{counts[1]}")
            target = counts[0] * pan.deg_per_count, counts[1] * tilt.deg_per_count
            wait_until_there(
                *(self._who, self._line, self._position_on_the_way, target, settings, self._abort),
                unasked=self._note_unasked,
            )
            self._rested_deg = self._position()

    def position_deg(self) -> Position:
        """Pan and tilt by the counts that the head reports."""
        renew(self._line)
        return self._position()

    def describe(self) -> HeadReport:
        """Ask version, position, limits, and voltage and temperature where the head knows."""
        renew(self._line)
        self._greet_again_after_a_restart()
        pan, tilt = self._known_axes()
        try:
            power: str | None = self._ask("O")
        except HeadError:  # not every model has the sensors
            power = None
        return HeadReport(
            name=self._ask("V"),
            position_deg=self._position(),
            limits_deg=(pan.limits_deg, tilt.limits_deg),
            power=_power_text(power) if power else None,
        )

    def halt(self) -> None:
        """Stop both axes; the move that goes on in another thread ends with HeadError."""
        self._abort.set()
        self._stop()

    def close(self) -> None:
        """Halt if the line was ever used, and release the port."""
        try:
            if self._line.openings:
                self.halt()
        except HeadError as error:
            _log.warning("head_not_halted", error=str(error))
        finally:
            self._line.close()

    # ------------------------------------------------------------ what is asked

    def _stop(self) -> None:
        self._ask("H")

    def _known_axes(self) -> tuple[_Axis, _Axis]:
        """Greet the head when it is new: set all that a move relies on, and ask who it is."""
        with self._talking:
            self._line.open()
            if self._axes is None or self._greeted != self._line.openings:
                for command in GREETING:
                    self._ask(command)
                for command in MODES:
                    with suppress(_RefusesError):
                        self._ask(command)
                self._greeted = self._line.openings
                self._axes = self._axis("P"), self._axis("T")
                self._speeds = self._reported_speeds()
                self._forget_unasked()
            return self._axes

    def _greet_again_after_a_restart(self) -> None:
        """Forget a head that was restarted since: it has its own speed, echo and modes again."""
        if self._axes is None or self._greeted != self._line.openings:
            return
        self._note_unasked(self._line.read(0.0))
        if self._restarted or self._reported_speeds() != self._speeds:
            _log.warning("head_restarted", head=self._who)
            self._axes = None

    def _reported_speeds(self) -> tuple[float, float]:
        return self._number("PS"), self._number("TS")

    def _axis(self, letter: str) -> _Axis:
        arcsec = self._number(f"{letter}R")
        low, high = self._number(f"{letter}N"), self._number(f"{letter}X")
        if not 0.0 < arcsec < ARCSEC_PER_DEG or not low < high:
            msg = (
                f"{self._who}: says {arcsec:g} arc seconds a count and limits {low:g} to {high:g} "
                f"on axis {letter}, which cannot be; reset it, check pan_tilt.backend"
            )
            raise HeadError(msg)
        axis = _Axis(letter, arcsec / ARCSEC_PER_DEG, round(low), round(high))
        speed_deg_s = self._settings.speed_deg_s
        if speed_deg_s is not None:
            self._ask(f"{letter}S{max(round(speed_deg_s / axis.deg_per_count), 1)}")
        elif self._number(f"{letter}S") <= 0.0:
            msg = f"{self._who}: its speed is set to 0, it will not move; set pan_tilt.speed_deg_s"
            raise HeadError(msg)
        return axis

    def _position(self) -> Position:
        pan, tilt = self._known_axes()
        return (
            self._number("PP") * pan.deg_per_count,
            self._number("TP") * tilt.deg_per_count,
        )

    def _position_on_the_way(self) -> Position:
        """Where it is; a limit switch hit in a move means that it has lost count of its steps."""
        position = self._position()
        if self._limits_hit:
            self._wait_for_quiet()  # the rest of a banner may be on its way
        if self._restarted:
            raise self._restart_error()
        if self._limits_hit:
            axes = " and ".join({"P": "pan", "T": "tilt"}[hit] for hit in sorted(self._limits_hit))
            msg = (
                f"{self._who}: ran into its {axes} limit switch, so it has lost count of its "
                "steps; free its cables and what else blocks it, and switch it off and on; its "
                f"{HOMING_SWINGS}"
            )
            raise HeadError(msg)
        return position

    def _restart_error(self) -> HeadError:
        self._axes = None
        return HeadError(
            f"{self._who}: restarted in the middle of a move, so it lost power for a moment, and "
            "homing swung the rig over its whole travel; check its supply and cables, look where "
            "the rig points, then begin again"
        )

    def _number(self, query: str) -> float:
        return float(self._ask(query, number=True))

    # ------------------------------------------------------------ one question, one answer

    def _ask(self, command: str, *, number: bool = False) -> str:
        """Give the answer's text after `*`, or its one number. Raises HeadError.

        What is asked can be asked again without harm, for positions are absolute: so noise on the
        line costs an attempt, whether it has hit the answer or the command.
        """
        with self._talking:
            heard, refusal = b"", ""
            for attempt in range(ATTEMPTS):
                self._line.open()
                if attempt:
                    self._wait_for_quiet()
                self._note_unasked(self._line.read(0.0))
                self._line.write(f"{command} ".encode())
                try:
                    return self._answer(number=number)
                except _RefusedError as error:
                    refusal = str(error)
                except _NoAnswerError as error:
                    heard = error.args[0] or heard
            raise self._failure(command, refusal, heard)

    def _failure(self, command: str, refusal: str, heard: bytes) -> HeadError:
        if refusal:
            advice = "lower pan_tilt.speed_deg_s or raise it" if command[1:2] == "S" else "reset it"
            return _RefusesError(f"{self._who}: refuses {command} ({refusal}); {advice}")
        is_new, self._axes = self._axes is None, None  # whatever it was, it is greeted again
        if self._restarted and not is_new:
            return self._restart_error()
        if heard:
            return HeadError(
                f"{self._who}: answers {command} with nonsense ({heard[:40]!r}); check "
                "pan_tilt.backend and baud, cable and earth"
            )
        waited_s = ATTEMPTS * self._settings.answer_timeout_s
        waking = "" if command == "H" else "; one just switched on answers after its homing only"
        return HeadError(
            f"{self._who}: no answer to {command} in {waited_s:g} s; check its power and cable, "
            f"pan_tilt.baud and backend{waking}"
        )

    def _answer(self, *, number: bool) -> str:
        """Read lines until one is an answer; what comes unasked is noted on the way."""
        deadline_s = self._line.monotonic_s() + self._settings.answer_timeout_s
        heard = b""
        while (left_s := deadline_s - self._line.monotonic_s()) > 0.0:
            new = self._line.read(left_s)
            self._note_unasked(new)
            heard += new
            *lines, _ = re.split(rb"[\r\n]+", heard)
            for line in lines:
                text = self._text_of(line)
                if text is None:
                    continue
                if not number:
                    return text
                numbers = _NUMBER.findall(text)
                if len(numbers) == 1:
                    return str(numbers[0])
                raise _NoAnswerError(heard)
        raise _NoAnswerError(heard)

    def _text_of(self, line: bytes) -> str | None:
        """Give what follows the `*` of one line, an echo before it; None if it is no answer."""
        rest = _UNASKED.sub(b"", line)
        text = "".join(chr(byte) for byte in rest if 0x20 <= byte < 0x7F)
        found = _ANSWER.search(text)
        if found is None:
            return None
        mark, message = found.groups()
        if mark == "!":
            raise _RefusedError(message.strip())
        return str(message).strip()

    def _note_unasked(self, heard: bytes) -> None:
        """Note `!P` and `!T` and the signs of a restart; each byte once, in whatever parts."""
        tail = self._tail + heard
        if len(tail) > TAIL_BYTES:
            tail = re.split(rb"[\r\n]", tail[-TAIL_BYTES:], maxsplit=1)[-1]
        self._tail = tail
        self._limits_hit.update(letter.decode() for letter in _UNASKED.findall(tail))
        for line in re.split(rb"[\r\n]+", tail):
            if _HOMED.search(line) or (b"*" not in line and _BANNER.search(line)):
                self._restarted = True

    def _forget_unasked(self) -> None:
        self._limits_hit.clear()
        self._tail, self._restarted = b"", False

    def _wait_for_quiet(self) -> None:
        until_s = self._line.monotonic_s() + MAX_NOISE_S
        while self._line.monotonic_s() < until_s and (heard := self._line.read(QUIET_S)):
            self._note_unasked(heard)


def _power_text(answer: str) -> str:
    """E Series: volts, then the temperatures of controller, pan and tilt motor, Fahrenheit."""
    fields = answer.split(",")
    try:
        volts, *degrees_f = (float(field) for field in fields)
    except ValueError:
        return answer
    warmth = ", ".join(f"{(value - 32.0) / 1.8:.0f}" for value in degrees_f)
    return f"{volts:g} V" + (f", {warmth} C" if warmth else "")
