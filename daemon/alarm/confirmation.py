"""A second measurement at once, where an alarm asks for one: by a running dcamd, between slots."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from daemon.config.alarm import ValueAlarm
from daemon.error_report import lines_of
from drivers.deadline import DeadlineExceededError, DeadlineThread

BOUND_S = 100.0
"""For dcamd to find room between two slots, take the pairs and measure them."""


class Outcome(Enum):
    """What a second measurement says."""

    CONFIRMED = "confirmed"
    CONTRADICTED = "contradicted"
    UNCONFIRMED = "unconfirmed"


@dataclass(frozen=True, slots=True)
class Confirmation:
    """The outcome, and a few words on it."""

    outcome: Outcome
    text: str


class SecondMeasurement:
    """One for all alarms of a look: a pair shows every target, and there is room for one only."""

    def __init__(self, state: Path) -> None:
        self._state = state
        self._answer: dict[str, Any] | str | None = None

    def confirm(self, alarm: ValueAlarm, limit: float) -> Confirmation:
        """Ask for it at the first call, for a while at most; never raises."""
        if self._answer is None:
            self._answer = _asked(self._state)
        if isinstance(self._answer, str):
            return _unconfirmed(self._answer)
        try:
            return _judged(alarm, limit, self._answer)
        except (KeyError, TypeError, AttributeError):
            return _unconfirmed("a dcamd of another version answered; restart dcamd")


def _asked(state: Path) -> dict[str, Any] | str:
    """Give the look, or why there is none."""
    try:
        look = DeadlineThread("dcam-confirm", lambda: None).call(lambda: _look(state), BOUND_S)
    except DeadlineExceededError:
        return f"no second measurement within {BOUND_S:.0f} s"
    except Exception as error:  # noqa: BLE001 - whatever it is, the alarm must go out
        return "; ".join(lines_of(error))
    return "no dcamd runs that could measure again" if look is None else look


def _judged(alarm: ValueAlarm, limit: float, look: dict[str, Any]) -> Confirmation:
    """Hold a second measurement against the limit."""
    row = look["measurement"]
    if alarm.target != "main":
        targets = {one["name"]: one for one in row.get("targets", [])}
        row = {"slot_utc": row["slot_utc"], **targets.get(alarm.target, {})}
    value, sigma = row.get(f"{alarm.axis}_mm"), row.get(f"sigma_{alarm.axis}_mm")
    if value is None or sigma is None:
        return _unconfirmed("the second measurement has no value")
    said = f"a second measurement of {row['slot_utc']}: {value:+.3f} ± {sigma:.3f} mm"
    is_beyond = value > limit if limit == alarm.above_mm else value < limit
    if is_beyond:
        return Confirmation(Outcome.CONFIRMED, f"confirmed by {said}")
    return Confirmation(Outcome.CONTRADICTED, f"contradicted by {said}")


def _look(state: Path) -> dict[str, Any] | None:
    from daemon.control.control_socket import ask_daemon

    answer = ask_daemon(state, "capture")
    return None if answer is None else answer.look


def _unconfirmed(why: str) -> Confirmation:
    return Confirmation(Outcome.UNCONFIRMED, f"unconfirmed: {why}")
