"""A simulated Pelco-D head: messages, answers and motion, as a pure machine."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.heads.pelco_d import (
    ASK_PAN,
    ASK_TILT,
    DOWN,
    FASTEST,
    FULL_TURN,
    LEFT,
    PAN_IS,
    RIGHT,
    SET_PAN,
    SET_TILT,
    SYNC,
    TILT_IS,
    UP,
    message,
)
from drivers.sim.head_axis import Axis

LENGTH = 7


@dataclass(frozen=True, slots=True)
class PelcoModel:
    """A Pelco-D head."""

    address: int = 1
    pan_limits_deg: tuple[float, float] = (-170.0, 170.0)
    tilt_limits_deg: tuple[float, float] = (-90.0, 45.0)
    speed_deg_s: float = 6.0
    """To a set position, and at the highest speed level; others in proportion."""
    accel_deg_s2: float = 60.0
    feedback: bool = True
    """Whether it answers where it is."""
    short_answers: bool = False
    """Answers in five bytes, without FF and command1."""
    general_answers: bool = False
    """Answers every order with the four bytes `FF address alarms sum`."""
    jam_at_move: int | None = None
    """Is blocked soon after that order to move, counted from 1; an axis is an order of its own."""


class PelcoMachine:
    """Implements `drivers.sim.head_machine.HeadMachine`."""

    def __init__(self, model: PelcoModel) -> None:
        self._model = model
        make = (model.speed_deg_s, model.accel_deg_s2)
        self.pan = Axis(model.pan_limits_deg, *make)
        self.tilt = Axis(model.tilt_limits_deg, *make)
        self.commands = 0
        self._moves = 0
        self._jam_s: float | None = None
        self._heard = b""

    def receive(self, data: bytes, now_s: float) -> bytes:
        """Take bytes, step over what is no message, and answer each message in turn."""
        self.advance(now_s)
        self._heard += data
        said = b""
        while (start := self._heard.find(SYNC)) >= 0 and len(self._heard) - start >= LENGTH:
            whole = self._heard[start : start + LENGTH]
            if sum(whole[1:6]) % 256 != whole[6]:
                self._heard = self._heard[start + 1 :]
                continue
            self._heard = self._heard[start + LENGTH :]
            if whole[1] == self._model.address:
                self.commands += 1
                said += self._do(whole, now_s)
        if start < 0:
            self._heard = b""
        return said

    def advance(self, now_s: float) -> bytes:
        """Let time pass; it never speaks unasked."""
        if self._jam_s is not None and now_s >= self._jam_s:
            self._jam_s = None
            for axis in (self.pan, self.tilt):
                axis.jam(now_s)
        return b""

    def angles_deg(self, now_s: float) -> tuple[float, float]:
        """Where pan and tilt truly are."""
        return self.pan.at_deg(now_s), self.tilt.at_deg(now_s)

    def _do(self, whole: bytes, now_s: float) -> bytes:
        _, address, command1, command2, data1, data2, total = whole
        hundredths = data1 * 256 + data2
        if command2 in {ASK_PAN, ASK_TILT}:
            if not self._model.feedback:
                return b""
            axis, answer = (self.pan, PAN_IS) if command2 == ASK_PAN else (self.tilt, TILT_IS)
            return self.angle_answer(answer, axis.at_deg(now_s))
        if command2 in {SET_PAN, SET_TILT}:
            if not self._model.feedback:  # a head that knows where it is could answer it too
                return b""
            axis = self.pan if command2 == SET_PAN else self.tilt
            angle = hundredths % FULL_TURN
            axis.go((angle if angle <= FULL_TURN // 2 else angle - FULL_TURN) / 100.0, now_s)
            self._count_move(now_s)
        elif command2 & 1 == 0 and command1 == 0:
            self._jog(self.pan, command2 & RIGHT, command2 & LEFT, data1, now_s)
            self._jog(self.tilt, command2 & UP, command2 & DOWN, data2, now_s)
        if not self._model.general_answers:
            return b""
        return bytes([SYNC, address, 0, total])

    def _jog(self, axis: Axis, up: int, down: int, level: int, now_s: float) -> None:
        if up or down:
            speed_deg_s = axis.speed_deg_s * min(level, FASTEST) / FASTEST
            axis.go(axis.limits_deg[1] if up else axis.limits_deg[0], now_s, speed_deg_s)
            self._count_move(now_s)
        elif axis.moves(now_s):
            axis.stop(now_s)

    def _count_move(self, now_s: float) -> None:
        self._moves += 1
        if self._moves == self._model.jam_at_move:
            self._jam_s = now_s + 0.05

    def angle_answer(self, command: int, angle_deg: float) -> bytes:
        """Say where an axis is."""
        high, low = divmod(round(angle_deg * 100.0) % FULL_TURN, 256)
        whole = message(self._model.address, 0, command, high, low)
        if not self._model.short_answers:
            return whole
        body = bytes([self._model.address, *whole[3:6]])
        return bytes([*body, sum(body) % 256])
