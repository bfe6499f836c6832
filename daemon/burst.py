"""The pairs of one slot, taken one after the other: what could be had of them in time."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta

import structlog

from daemon.times import slot_text
from drivers.errors import DeviceLostError, DriverError
from drivers.protocols import CapturedPair, Clock, FramePairSource

_log = structlog.get_logger("dcam.daemon")


@dataclass(frozen=True, slots=True)
class BurstPlan:
    """How many pairs a slot has, and when they are taken."""

    count: int = 1
    spacing_s: float = 0.5
    """From the beginning of one pair to that of the next."""
    limit_s: float = 60.0
    """No pair is begun later than this after the first."""


@dataclass(frozen=True, slots=True)
class Shot:
    """One pair of a burst."""

    number: int
    """From 1, in the order in which they were taken."""
    pair: CapturedPair
    captured_utc: datetime
    captured_s: float
    """On the clock's monotonic time."""


def take_burst(
    source: FramePairSource, clock: Clock, slot_utc: datetime, plan: BurstPlan
) -> list[Shot]:
    """Take the pairs of a slot, at least one.

    A pair that fails costs itself only; after a lost camera no more are tried. Raises what the
    driver raised when not even one could be had.
    """
    shots: list[Shot] = []
    failed: Exception | None = None
    began_s = clock.monotonic_s()
    for turn in range(plan.count):
        clock.pause(began_s + turn * plan.spacing_s - clock.monotonic_s())
        if turn and clock.monotonic_s() - began_s > plan.limit_s:
            _log.warning("burst_cut_short", slot=slot_text(slot_utc), pairs=len(shots))
            break
        before_utc, before_s = clock.now_utc(), clock.monotonic_s()
        try:
            pair = source.capture(slot_utc)
        except Exception as error:  # noqa: BLE001 - what was taken before is a slot all the same
            failed = error
            if plan.count > 1:
                _log.warning("pair_of_burst_failed", slot=slot_text(slot_utc), error=str(error))
            if isinstance(error, DeviceLostError) or not isinstance(error, DriverError):
                break
            continue
        # A replayed pair was triggered at no time of this clock; its capture's beginning counts.
        captured_s = max(before_s, pair.main.trigger_monotonic_s)
        ago_s = clock.monotonic_s() - captured_s
        captured_utc = max(before_utc, clock.now_utc() - timedelta(seconds=ago_s))
        shots.append(Shot(len(shots) + 1, pair, captured_utc, captured_s))
    if not shots and failed is not None:
        raise failed
    return shots
