"""What is known of a site right now, from its disk alone: the facts behind `status`.

Nothing here asks a camera or the daemon, so that looking never disturbs a slot.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from core.results import Flag
from daemon.config import Config
from daemon.lock import LOCK_NAME
from daemon.machine import clock_is_synchronised
from daemon.measuring import active_calibration
from daemon.sequence import stored_continuity
from daemon.store.database import Store
from daemon.store.frames import FrameArchive
from daemon.store.records import (
    CalibrationRecord,
    Coverage,
    GapCause,
    GapRecord,
    Mark,
    MeasurementRecord,
)

DAY = timedelta(days=1)
MONTH = timedelta(days=30)
CAMERA_CAUSES = frozenset({GapCause.CAMERA_LOST, GapCause.CAPTURE_FAILED})


@dataclass(frozen=True, slots=True)
class Disk:
    """Room for the state directory."""

    free_bytes: int
    total_bytes: int
    days_left: float | None
    """At the size of the last slot's frames, one a period; None as long as there are none."""


@dataclass(frozen=True, slots=True)
class Daemon:
    """What the last dcamd left behind."""

    running: bool | None
    """None where the kernel does not tell."""
    heartbeat_utc: datetime | None
    """Up to when every slot has its row or gap."""
    clean_stop_utc: datetime | None
    """None while it runs, and after it died."""


@dataclass(frozen=True, slots=True)
class Facts:
    """What was found, before anyone judges it."""

    site: str
    now_utc: datetime
    period_s: int
    first_slot_utc: datetime | None
    """The first slot that the database accounts for."""
    last: MeasurementRecord | None
    last_good: MeasurementRecord | None
    """Within 30 days before the last row."""
    calibration: CalibrationRecord | None
    misfit: float | None
    """How much worse the corners fit than at calibration, over the last rows; None of too few."""
    slipped_utc: datetime | None
    """The last row of a board that has slipped and is not back."""
    config_hash: str
    coverage_24h: Coverage
    coverage_30d: Coverage
    gaps: tuple[GapRecord, ...]
    """Of 30 days, in order."""
    daemon: Daemon
    disk: Disk
    frames_not_kept_24h: int
    """Rows of a captured pair that could not be stored."""
    simulated_clock: bool
    clock_synchronised: bool | None
    """None for a simulated clock, and where the kernel does not tell."""
    undated: int
    """Pairs taken under a wrong clock that wait for their slots."""


def look(config: Config, state: Path, store: Store, now_utc: datetime) -> Facts:
    """Collect the facts of a site as of a time. Raises StoreError, OSError."""
    accounted = store.accounted()
    first = accounted[0] if accounted else None
    last_slot = store.last_slot()
    last = store.measurement(last_slot) if last_slot else None
    simulated = has_stepped_clock(config)
    misfit, slipped_utc = _continuity(store, last)
    return Facts(
        site=config.name,
        now_utc=now_utc,
        period_s=config.schedule.period_s,
        first_slot_utc=first,
        last=last,
        last_good=_last_good(store, last),
        calibration=store.active_calibration(),
        misfit=misfit,
        slipped_utc=slipped_utc,
        config_hash=config.config_hash(),
        coverage_24h=_coverage(config, store, accounted, now_utc, DAY),
        coverage_30d=_coverage(config, store, accounted, now_utc, MONTH),
        gaps=tuple(store.gaps(now_utc - MONTH, now_utc)),
        daemon=Daemon(
            running=dcamd_runs(state),
            heartbeat_utc=_mark_time(store, Mark.HEARTBEAT_UTC),
            clean_stop_utc=_mark_time(store, Mark.CLEAN_STOP_UTC),
        ),
        disk=_disk(state, last, config.schedule.period_s),
        frames_not_kept_24h=store.rows_without_frames(now_utc - DAY, now_utc),
        simulated_clock=simulated,
        clock_synchronised=None if simulated else clock_is_synchronised(),
        undated=store.undated_count(),
    )


def _continuity(
    store: Store, last: MeasurementRecord | None
) -> tuple[float | None, datetime | None]:
    """How well the corners have fitted of late, and the last row of a slipped board."""
    calibration = active_calibration(store)
    if last is None or calibration is None:
        return None, None
    known = stored_continuity(store, calibration, last.slot_utc + timedelta(seconds=1))
    if known.slip is None:
        return known.misfit, None
    return known.misfit, datetime.fromtimestamp(known.slip.last.time_s, UTC)


def has_stepped_clock(config: Config) -> bool:
    """Tell whether the site's time is simulated and not the machine's."""
    return config.camera.main.backend == "simulated" and config.simulation.clock == "stepped"


def dcamd_runs(state: Path) -> bool | None:
    """Tell whether a dcamd holds this state directory; None where the kernel does not tell.

    Read from /proc/locks: to try the lock would stop a dcamd that starts at the same instant.
    """
    try:
        inode = (state / LOCK_NAME).stat().st_ino
    except OSError:
        return False
    try:
        locks = Path("/proc/locks").read_text(encoding="ascii")
    except OSError:
        return None
    return any(f":{inode} " in line and "FLOCK" in line for line in locks.splitlines())


def _coverage(
    config: Config,
    store: Store,
    accounted: tuple[datetime, datetime] | None,
    now_utc: datetime,
    span: timedelta,
) -> Coverage:
    """Account for the slots of a span; the one in progress does not count yet."""
    schedule = config.schedule
    since = until = now_utc - timedelta(seconds=schedule.period_s - 1)
    if accounted is not None:
        first, last = accounted
        since = max(first, now_utc - span)
        until = min(max(until, last + timedelta(seconds=1)), now_utc + timedelta(seconds=1))
    return store.coverage(since, until, period_s=schedule.period_s, offset_s=schedule.offset_s)


def _mark_time(store: Store, mark: Mark) -> datetime | None:
    text = store.get_mark(mark)
    return None if text is None else datetime.fromisoformat(text).replace(microsecond=0)


def _last_good(store: Store, last: MeasurementRecord | None) -> MeasurementRecord | None:
    """The latest row flagged good, found in steps that double: mostly it is the last one."""
    if last is None or last.measurement.flag is Flag.GOOD:
        return last
    until, hours = last.slot_utc, 1
    while hours <= MONTH // timedelta(hours=1):
        since = until - timedelta(hours=hours)
        good = [
            row for row in store.measurements(since, until) if row.measurement.flag is Flag.GOOD
        ]
        if good:
            return good[-1]
        until, hours = since, 2 * hours
    return None


def _disk(state: Path, last: MeasurementRecord | None, period_s: int) -> Disk:
    usage = shutil.disk_usage(state)
    pair_bytes = sum(_sizes(state, last))
    bytes_per_day = pair_bytes * DAY.total_seconds() / period_s
    return Disk(
        free_bytes=usage.free,
        total_bytes=usage.total,
        days_left=usage.free / bytes_per_day if bytes_per_day else None,
    )


def _sizes(state: Path, last: MeasurementRecord | None) -> Iterator[int]:
    """The images of the last slot: a burst has several pairs."""
    for name in (last.main_frame, last.sub_frame) if last else ():
        if name is not None and (state / name).exists():
            pairs = len(FrameArchive(state).numbers(last.slot_utc)) if last else 1
            yield (state / name).stat().st_size * max(pairs, 1)
