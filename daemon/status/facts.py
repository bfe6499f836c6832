"""What is known of a site right now, from its files alone: the facts behind `status`.

Nothing here asks a camera or the daemon, so that looking never disturbs a slot.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

from core.quality.residual_ratio import WINDOW_ROWS, median_residual_ratio, residual_ratio
from core.results import Flag
from daemon.clock.machine import read_boot_id, uptime_s
from daemon.clock.time_sync import clock_is_synchronised
from daemon.config.reading import Config
from daemon.control.run_state import RunState, is_alive, read_run_state, runtime_directory
from daemon.lock import LOCK_NAME
from daemon.retention.event_kinds import KEPT_AGAIN, NOT_KEPT
from daemon.retention.outlook import Archive, days_until_short
from daemon.store.damage_note import databases_set_aside, read_note
from daemon.store.queries.overview import (
    ActiveCalibrationSummary,
    ClosureSummary,
    Overview,
    TargetSummary,
    open_overview,
)
from daemon.store.records import (
    BELIEVED,
    READING_FAILED,
    SLIPPED,
    Coverage,
    GapCause,
    GapRecord,
    Mark,
    MeasurementRecord,
)
from daemon.store.runs import schedule_slots

DAY = timedelta(days=1)
MONTH = timedelta(days=30)
CAMERA_CAUSES = frozenset({GapCause.CAMERA_LOST, GapCause.CAPTURE_FAILED})


@dataclass(frozen=True, slots=True)
class Disk:
    """Room for the state directory."""

    free_bytes: int
    total_bytes: int
    archive_days: int
    """Days with frames, as far as they have been counted."""
    archive_bytes: int
    """What they take; the newest day as of its last hour."""
    frames_fit: bool | None
    """Whether what `[retention]` keeps by age fits for ever; None as long as no pair was kept."""
    days_left: float | None
    """Until frames are thinned sooner than their age says; None where that never comes."""
    frames_refused: str | None
    """Since when frames are not kept, and why."""


@dataclass(frozen=True, slots=True)
class Daemon:
    """What the last dcamd left behind."""

    running: bool | None
    """None where the kernel does not tell."""
    heartbeat_utc: datetime | None
    """Up to when every slot has its row or gap."""
    clean_stop_utc: datetime | None
    """None while it runs, and after it died."""
    starts_24h: int
    says: RunState | None
    """What the one that runs says of itself; None where none runs, or it cannot write its file."""
    silent_s: float
    """How long ago it said so."""


@dataclass(frozen=True, slots=True)
class Facts:
    """What was found, before anyone judges it."""

    site: str
    now_utc: datetime
    period_s: int
    first_slot_utc: datetime | None
    """The first slot that the database accounts for."""
    last: MeasurementRecord | None
    last_good_utc: datetime | None
    """Within 30 days before the last row."""
    last_good: MeasurementRecord | None
    """The row of that slot, in the record's zero."""
    calibration: ActiveCalibrationSummary | None
    residual_ratio: float | None
    """How much worse the corners fit than at calibration, over the last rows; None of too few."""
    slipped_utc: datetime | None
    """The last row of a board that has slipped and is not back."""
    closure_24h: ClosureSummary | None
    closure_30d: ClosureSummary | None
    """None without a fixed target that is believed."""
    targets: tuple[TargetSummary, ...]
    """The further targets, counted over 24 hours."""
    largest_term: str | None
    """What makes most of the last value's sigma, where no fixed target corrects it."""
    config_hash: str
    coverage_24h: Coverage
    coverage_30d: Coverage
    gaps: tuple[GapRecord, ...]
    """Of 30 days, in order."""
    daemon: Daemon
    disk: Disk
    damage_noted: str | None
    """What dcamd, or a verification, met of damage in the database; until the next start."""
    set_aside: tuple[str, ...]
    """Damaged databases that still lie in the state directory, oldest first."""
    frames_not_kept_24h: int
    """Rows of a captured pair that could not be stored."""
    simulated_clock: bool
    clock_synchronised: bool | None
    """None for a simulated clock, and where the kernel does not tell."""
    undated: int
    """Pairs taken under a wrong clock that wait for their slots."""
    to_measure_again: int
    """Rows taken under a wrong clock, in their slots, with values as of the wrong time still."""
    sensors: tuple[str, ...]
    """The readings that the config names."""
    readings_failed: Mapping[str, datetime]
    """Of the readings without a value in the last row: when that began, where it is known."""


def collect_facts(
    config: Config, state: Path, now_utc: datetime, *, with_budget: bool = True
) -> Facts:
    """Collect the facts of a site as of a time. Raises StoreError, OSError.

    What makes most of the sigma needs Numba, 120 MB: not for what runs all the time.
    """
    simulated = config.has_stepped_clock
    with open_overview(state) as overview:
        accounted, last = overview.accounted(), overview.last_row()
        calibration = overview.calibration()
        residual_ratio, slipped_utc = _fit_and_slip(overview, last, calibration)
        last_good = _last_good(overview, last)
        note, until_utc = read_note(state), now_utc + timedelta(seconds=1)
        return Facts(
            site=config.name,
            now_utc=now_utc,
            period_s=config.schedule.period_s,
            first_slot_utc=accounted[0] if accounted else None,
            last=last,
            last_good_utc=last_good.slot_utc if last_good else None,
            last_good=last_good,
            calibration=calibration,
            residual_ratio=residual_ratio,
            slipped_utc=slipped_utc,
            closure_24h=overview.closure(now_utc - DAY, until_utc),
            closure_30d=overview.closure(now_utc - MONTH, until_utc),
            targets=tuple(overview.targets(now_utc - DAY, until_utc)),
            largest_term=_largest_term(config, last, calibration) if with_budget else None,
            config_hash=config.config_hash(),
            coverage_24h=_coverage(config, overview, accounted, now_utc, DAY),
            coverage_30d=_coverage(config, overview, accounted, now_utc, MONTH),
            gaps=tuple(overview.gaps(now_utc - MONTH, now_utc)),
            daemon=_daemon(overview, state, now_utc),
            disk=_disk(config, overview, state, last),
            damage_noted=note.why if note else None,
            set_aside=tuple(path.name for path in databases_set_aside(state)),
            frames_not_kept_24h=overview.rows_without_frames(now_utc - DAY, now_utc),
            simulated_clock=simulated,
            clock_synchronised=None if simulated else clock_is_synchronised(),
            undated=overview.undated(),
            to_measure_again=overview.to_measure_again(),
            sensors=tuple(section.name for section in config.reading),
            readings_failed=_readings_failed(overview, last),
        )


def _last_good(overview: Overview, last: MeasurementRecord | None) -> MeasurementRecord | None:
    """The newest good row of a month, which is mostly the last row."""
    if last is None or last.measurement.flag is Flag.GOOD:
        return last
    slot_utc = overview.last_good_slot(last.slot_utc - MONTH)
    return None if slot_utc is None else overview.row(slot_utc)


def _readings_failed(overview: Overview, last: MeasurementRecord | None) -> dict[str, datetime]:
    names = [one.name for one in last.readings if one.value is None] if last else []
    found = {name: overview.last_event_of(READING_FAILED, name) for name in names}
    return {name: since_utc for name, since_utc in found.items() if since_utc is not None}


def _daemon(overview: Overview, state: Path, now_utc: datetime) -> Daemon:
    running = dcamd_runs(state)
    says = read_run_state(runtime_directory(state)) if running is not False else None
    if says is not None and not is_alive(says, read_boot_id()):
        says = None  # what a dcamd left that is no more
    return Daemon(
        running=running,
        heartbeat_utc=_mark_time(overview, Mark.HEARTBEAT_UTC),
        clean_stop_utc=_mark_time(overview, Mark.CLEAN_STOP_UTC),
        starts_24h=overview.events("started", now_utc - DAY),
        says=says,
        silent_s=uptime_s() - says.reported_s if says else 0.0,
    )


def _fit_and_slip(
    overview: Overview, last: MeasurementRecord | None, calibration: ActiveCalibrationSummary | None
) -> tuple[float | None, datetime | None]:
    """How well the corners have fitted of late, and the last row of a board that has slipped."""
    if last is None or calibration is None:
        return None, None
    since = last.slot_utc - MONTH
    believed = overview.fits(calibration.id, BELIEVED, since, WINDOW_ROWS)
    if not believed:
        return None, None
    slipped = overview.fits(calibration.id, SLIPPED, believed[-1].slot_utc, 1)
    levels = calibration.sub_rms_px, calibration.sub_contrast_dn
    if levels[0] is None or levels[1] is None:
        return None, slipped[-1].slot_utc if slipped else None
    residual_ratios = [
        residual_ratio(levels[0], levels[1], fit.sub_residual_px, fit.sub_contrast_dn)
        for fit in believed
    ]
    return median_residual_ratio(residual_ratios), slipped[-1].slot_utc if slipped else None


def dcamd_runs(state: Path) -> bool | None:
    """Tell whether a dcamd holds this state directory; None where the kernel does not tell.

    Read from /proc/locks: to try the lock would stop a dcamd that starts at the same instant.
    """
    try:
        held = _name_in_locks(state / LOCK_NAME)
    except FileNotFoundError:
        return False
    except (OSError, ValueError):
        return None
    try:
        locks = Path("/proc/locks").read_text(encoding="ascii")
    except OSError:
        return None
    return any(f" {held} " in line and "FLOCK" in line for line in locks.splitlines())


def _name_in_locks(path: Path) -> str:
    """How /proc/locks names a file: MAJOR:MINOR:INODE, the numbers of the device in hexadecimal.

    The device is its file system's, which mountinfo gives (proc(5)). `stat` has another one for a
    part of a btrfs. The inode alone would do for no other file system than the one it lies on.
    """
    with path.open("rb") as file:
        inode = os.fstat(file.fileno()).st_ino
        about = Path(f"/proc/self/fdinfo/{file.fileno()}").read_text(encoding="ascii")
    mount = next(line.split()[1] for line in about.splitlines() if line.startswith("mnt_id:"))
    mounts = Path("/proc/self/mountinfo").read_text(encoding="utf-8", errors="replace")
    device = next(
        (line.split()[2] for line in mounts.splitlines() if line.split(" ", 1)[0] == mount), None
    )
    if device is None:
        msg = f"/proc/self/mountinfo does not list mount {mount} of {path}"
        raise ValueError(msg)
    major, minor = map(int, device.split(":"))
    return f"{major:02x}:{minor:02x}:{inode}"


def _coverage(
    config: Config,
    overview: Overview,
    accounted: tuple[datetime, datetime] | None,
    now_utc: datetime,
    span: timedelta,
) -> Coverage:
    """Account for the last slots that fill a span; the one in progress does not count yet."""
    schedule = config.schedule
    since = until = now_utc - timedelta(seconds=schedule.period_s - 1)
    if accounted is not None:
        first, last = accounted
        until = min(max(until, last + timedelta(seconds=1)), now_utc + timedelta(seconds=1))
        since = max(first, until - span)
    return overview.coverage(schedule_slots(since, until, schedule.period_s, schedule.offset_s))


def _mark_time(overview: Overview, mark: Mark) -> datetime | None:
    text = overview.mark(mark)
    return None if text is None else datetime.fromisoformat(text).replace(microsecond=0)


def _disk(config: Config, overview: Overview, state: Path, last: MeasurementRecord | None) -> Disk:
    usage = shutil.disk_usage(state)
    slots_a_day = DAY.total_seconds() / config.schedule.period_s
    day_bytes = sum(_sizes(state, last)) * slots_a_day
    archive, days_left = Archive(*overview.archive_size()), None
    if day_bytes:
        rules = config.retention.rules()
        days_left = days_until_short(rules, archive, day_bytes, slots_a_day, usage.free)
    refused = overview.last_event(NOT_KEPT, KEPT_AGAIN)
    return Disk(
        free_bytes=usage.free,
        total_bytes=usage.total,
        archive_days=archive.days,
        archive_bytes=archive.bytes,
        frames_fit=days_left is None if day_bytes else None,
        days_left=days_left,
        frames_refused=refused[2] if refused and refused[0] == NOT_KEPT else None,
    )


def _sizes(state: Path, last: MeasurementRecord | None) -> Iterator[int]:
    """The images of the last slot: a burst has several pairs, `HHMMSS_02_main.png` and so on."""
    for name in (last.main_frame, last.sub_frame) if last else ():
        if name is not None:
            first = state / name
            slot, _, role = first.name.partition("_")
            yield from (path.stat().st_size for path in first.parent.glob(f"{slot}*{role}"))


def _largest_term(
    config: Config,
    last: MeasurementRecord | None,
    calibration: ActiveCalibrationSummary | None,
) -> str | None:
    """What makes most of the last value's sigma; None where a fixed target corrects it."""
    if last is None or calibration is None or calibration.reference is None:
        return None
    corrected = last.measurement.corrected
    if corrected is None or corrected.image_mm2 is None or last.measurement.closure is not None:
        return None
    site, image_mm = config.site(), float(np.sqrt(np.diag(corrected.image_mm2).max()))
    scale = site.nominal_px_per_mm
    from core.rig.stability import budget_sentence, stability_terms  # loads Numba

    terms = stability_terms(site, scale, calibration.reference, last.moment)
    return budget_sentence(terms, scale, image_mm)
