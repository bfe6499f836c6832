"""A simulated ASCII pan-tilt unit: its commands, answers and motion, as a pure machine.

Faithful to the manuals of the D46 and D300 and to what was reported from real units, so that a
client that nobody here wrote can drive it: Hamlib's `rotctl -m 2501` ends its commands with LF,
puts `PP97 TP-97` on one line and reads one answer.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from drivers.sim.head_axis import Axis

DELIMITERS = b" \r\n"
END = b"\r\n"
ILLEGAL = "Illegal Command Entered"
NAMES = {"P": "Pan", "T": "Tilt"}
RESET = "R"
VERSION = "Pan-Tilt Controller v2.12.1, simulated by dcam"


@dataclass(frozen=True, slots=True)
class PtuModel:
    """A pan-tilt unit; the defaults are those of a D46 with microstepping."""

    arcsec_per_count: float = 23.142857
    """As read from a real unit; a D46 in half steps has 185.1428."""
    pan_limits_deg: tuple[float, float] = (-159.0, 159.0)
    tilt_limits_deg: tuple[float, float] = (-46.6, 31.0)
    speed_deg_s: float = 6.0
    accel_deg_s2: float = 12.0
    echo: bool = True
    """As after power-on; a client turns it off with ED."""
    leading_lf: bool = False
    """Some units begin each answer with a line feed."""
    limit_hit_at_move: int | None = None
    """Sends `!P` in the middle of that move, counted from 1, and stops: it has lost its steps."""
    jam_at_move: int | None = None
    """Is blocked from the middle of that move, counted from 1; an axis is a move of its own."""
    slaved: bool = False
    """As a program that sent S has left it: moves wait for the next A."""
    velocity_control: bool = False
    """As a program that sent CV has left it: it takes positions and does not go there."""
    modes: bool = True
    """Whether it knows CI and CV; older units refuse them."""


class PtuMachine:
    """Implements `drivers.sim.head_machine.HeadMachine`."""

    def __init__(self, model: PtuModel) -> None:
        self._model = model
        self._deg = model.arcsec_per_count / 3600.0
        make = (model.speed_deg_s, model.accel_deg_s2)
        self.pan = Axis(model.pan_limits_deg, *make)
        self.tilt = Axis(model.tilt_limits_deg, *make)
        self.commands = 0
        self._moves = 0
        self._echo, self._verbose, self._limited = model.echo, True, True
        self._slaved, self._velocity_control = model.slaved, model.velocity_control
        self._held: list[tuple[Axis, float]] = []
        self._typed = b""
        self._waiting: str | None = None
        self._queue: deque[str] = deque()
        self._strike_s: float | None = None
        self._strike_said = False

    def receive(self, data: bytes, now_s: float) -> bytes:
        """Take typed characters; each command that a delimiter ends is answered in turn."""
        said = b""
        for byte in data:
            character = bytes([byte])
            if character not in DELIMITERS:
                self._typed += character
                said += character if self._echo else b""
                continue
            typed, self._typed = self._typed, b""
            if not typed:
                continue
            said += b" " if self._echo else b""
            self.commands += 1
            command = typed.decode("ascii", "replace").upper()
            if command == "H":  # does not wait for its turn
                self._queue.clear()
                waited, self._waiting = self._waiting, None
                said += (self._line("*") if waited else b"") + self._do(command, now_s)
            else:
                self._queue.append(command)
                said += self.advance(now_s)
        return said

    def advance(self, now_s: float) -> bytes:
        """Let time pass: a limit struck, an await over, the commands behind it."""
        said = b""
        if self._strike_s is not None and now_s >= self._strike_s:
            self._strike_s = None
            said += self.hit_limit(now_s)
        while True:
            if self._waiting is not None:
                if self._moves_now(now_s):
                    return said
                said += self._line("!T!T!P!P*" if self._waiting == RESET else "*")
                self._waiting = None
            if not self._queue:
                return said
            said += self._do(self._queue.popleft(), now_s)

    def angles_deg(self, now_s: float) -> tuple[float, float]:
        """Where pan and tilt truly are."""
        return self.pan.at_deg(now_s), self.tilt.at_deg(now_s)

    # ------------------------------------------------------------ commands

    def _do(self, command: str, now_s: float) -> bytes:
        """Carry out one command and give its answer."""
        if command in {"A", RESET}:
            if command == RESET:
                self._limited = True
                self._held = [(axis, 0.0) for axis in (self.pan, self.tilt)]
            for axis, target_deg in self._held:
                axis.go(target_deg, now_s)
            self._held = []
            self._waiting = command
            return self.advance(now_s)
        if command == "H":
            for axis in (self.pan, self.tilt):
                axis.stop(now_s)
            return self._line("*")
        if command in {"ED", "EE"}:
            self._echo = command == "EE"
            return self._line("*")
        if command in {"FT", "FV"}:
            self._verbose = command == "FV"
            return self._line("*")
        if command in {"LE", "LD"}:
            self._limited = command == "LE"
            return self._line("*")
        if command in {"I", "S"}:
            self._slaved = command == "S"
            return self._line("*")
        if command in {"CI", "CV"} and self._model.modes:
            self._velocity_control = command == "CV"
            return self._line("*")
        if command == "V":
            return self._line(f"* {VERSION}")
        if command == "O":
            return self._line("* Input 24.9 VDC @ 91 degF" if self._verbose else "* 24.9,91,84,84")
        if command == "L":
            state = "ENABLED (soft limits enabled)" if self._limited else "DISABLED"
            return self._line(f"* Limit bounds are {state}")
        if command[0] in NAMES and len(command) > 1:
            return self._do_axis(command[0], command[1], command[2:], now_s)
        return self.refusal(ILLEGAL)

    def _do_axis(self, letter: str, what: str, argument: str, now_s: float) -> bytes:
        axis, name = (self.pan if letter == "P" else self.tilt), NAMES[letter]
        low, high = self._counts(axis.limits_deg[0]), self._counts(axis.limits_deg[1])
        if argument:
            try:
                value = int(argument)
            except ValueError:
                return self.refusal(ILLEGAL)
            return self.set_value(axis, name, what, value, now_s)
        here = self._counts(axis.at_deg(now_s))
        speed, accel = (round(v / self._deg) for v in (axis.speed_deg_s, axis.accel_deg_s2))
        answers = {
            "P": (f"Current {name} position is ", f"{here}", ""),
            "O": (f"Target {name} position is ", f"{self._counts(axis.target_deg)}", ""),
            "R": ("", f"{self._model.arcsec_per_count:.6f}", " seconds arc per position"),
            "N": (f"Minimum {name} position is ", f"{low}", ""),
            "X": (f"Maximum {name} position is ", f"{high}", ""),
            "S": (f"Target {name} speed is ", f"{speed}", " positions/sec"),
            "A": (f"{name} acceleration is ", f"{accel}", " positions/sec^2"),
        }
        if what not in answers:
            return self.refusal(ILLEGAL)
        before, value_text, after = answers[what]
        return self._line(f"* {before}{value_text}{after}" if self._verbose else f"* {value_text}")

    def set_value(self, axis: Axis, name: str, what: str, value: int, now_s: float) -> bytes:
        """Take a speed, an acceleration or a position to go to, or refuse it."""
        if what in {"S", "A"}:
            if value <= 0:
                return self.refusal(f"Minimum allowable {name} value is 1")
            if what == "S":
                axis.speed_deg_s = value * self._deg
            else:
                axis.accel_deg_s2 = value * self._deg
            return self._line("*")
        if what not in {"P", "O"}:
            return self.refusal(ILLEGAL)
        if what == "O":
            value += self._counts(axis.at_deg(now_s))
        low, high = self._counts(axis.limits_deg[0]), self._counts(axis.limits_deg[1])
        if self._limited and not low <= value <= high:
            bound, limit = ("Maximum", high) if value > high else ("Minimum", low)
            return self.refusal(f"{bound} allowable {name} position is {limit}")
        if self._velocity_control:
            return self._line("*")
        if self._slaved:
            self._held.append((axis, value * self._deg))
            return self._line("*")
        axis.go(value * self._deg, now_s)
        self._moves += 1
        if self._moves in {self._model.jam_at_move, self._model.limit_hit_at_move}:
            self._strike_s = now_s + _half_way_s(axis, now_s)
            self._strike_said = self._moves == self._model.limit_hit_at_move
        return self._line("*")

    def hit_limit(self, now_s: float) -> bytes:
        """Be blocked in the middle of a move; some say so."""
        for axis in (self.pan, self.tilt):
            axis.jam(now_s)
        return self._line("!P") if self._strike_said else b""

    # ------------------------------------------------------------ answers

    def _moves_now(self, now_s: float) -> bool:
        return self.pan.moves(now_s) or self.tilt.moves(now_s)

    def _counts(self, angle_deg: float) -> int:
        """Truncated, but for a hair that is the arithmetic's own."""
        return math.trunc(angle_deg / self._deg + math.copysign(1e-6, angle_deg))

    def refusal(self, message: str) -> bytes:
        """Say why a command is not carried out."""
        return self._line(f"! {message}")

    def _line(self, text: str) -> bytes:
        return (b"\n" if self._model.leading_lf else b"") + text.encode() + END


def _half_way_s(axis: Axis, now_s: float) -> float:
    way_deg = abs(axis.target_deg - axis.at_deg(now_s))
    return math.sqrt(way_deg / axis.accel_deg_s2) / 2.0
