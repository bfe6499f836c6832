"""The verdict on a site: one level for each thing that can go wrong, as Nagios knows them."""

from __future__ import annotations

import math

from daemon.error_report import lines_of
from daemon.errors import DatabaseDamagedError
from daemon.status.coverage import coverage_text
from daemon.status.facts import CAMERA_CAUSES, DAY, Daemon, Disk, Facts
from daemon.status.item import Item, Level
from daemon.status.targets import judge_targets
from daemon.store.queries.datum_fields import offset_text
from daemon.store.queries.overview import ActiveCalibrationSummary
from daemon.store.records import Coverage, DatumMethod
from daemon.text import bytes_text, count_of, span_text, utc_text
from daemon.value_text import value_text

LATE_SLOTS, LOST_SLOTS = 3, 10
"""Periods without a row before that is a warning, and critical."""
MANY_STARTS = 5
"""Of dcamd within 24 h: more is a warning."""
STALE_GOOD_S, LOST_GOOD_S = 2 * 3600.0, 24 * 3600.0
"""Time without a good value before that is a warning, and critical: a dark night warns."""
LOW_COVERAGE, LOST_COVERAGE = 0.95, 0.5
DRIFTING = 1.5
"""Residuals of the corners over their level at calibration, the median of many rows."""
LOW_DISK_BYTES, FULL_DISK_BYTES = 1e9, 200e6
"""Free space that is too little whatever the rate: the database needs room as well."""
LOW_DISK_SHARE = 0.05
"""Of the disk, as long as no pair was kept that would tell for how many days it lasts."""


def no_verdict(error: Exception) -> Item:
    """Say why nothing else can be said."""
    level = Level.CRITICAL if isinstance(error, DatabaseDamagedError) else Level.UNKNOWN
    return Item("status", level, "; ".join(lines_of(error)))


def judge(facts: Facts) -> list[Item]:
    """Give each thing its level and a line."""
    return [
        _measurement(facts),
        _good_value(facts),
        _daemon(facts),
        _supervision(facts),
        _cameras(facts),
        *_readings(facts),
        _calibration(facts),
        *judge_targets(facts),
        *([Item("stability", Level.OK, facts.largest_term)] if facts.largest_term else []),
        *_zero(facts.calibration),
        _coverage("coverage 24 h", facts.coverage_24h),
        _coverage("coverage 30 d", facts.coverage_30d),
        _gaps(facts),
        _disk(facts.disk),
        _database(facts),
        _frames(facts),
        _clock(facts),
    ]


def _measurement(facts: Facts) -> Item:
    name = "measurement"
    if facts.last is None:
        todo = "wait for the first slot" if facts.daemon.running else "start dcamd"
        return Item(name, Level.WARNING, f"none yet; {todo}")
    slot_utc = facts.last.slot_utc
    age_s = (facts.now_utc - slot_utc).total_seconds()
    text = f"{value_text(facts.last.measurement)}, {span_text(age_s)} ago ({utc_text(slot_utc)})"
    if age_s < 0:
        return Item(name, Level.CRITICAL, f"{text}: in the future, is the clock wrong?")
    return Item(name, _by_age(age_s / facts.period_s, LATE_SLOTS, LOST_SLOTS), text)


def _good_value(facts: Facts) -> Item:
    name = "last good value"
    if facts.last is None:
        return Item(name, Level.WARNING, "none yet")
    if facts.last_good_utc is None:
        return Item(name, Level.CRITICAL, "none in 30 days; see export for the reasons")
    age_s = (facts.now_utc - facts.last_good_utc).total_seconds()
    if age_s < 0:
        when = utc_text(facts.last_good_utc)
        text = f"{span_text(age_s)} in the future ({when}): is the clock wrong?"
        return Item(name, Level.CRITICAL, text)
    return Item(name, _by_age(age_s, STALE_GOOD_S, LOST_GOOD_S), f"{span_text(age_s)} ago")


def _by_age(age: float, warning: float, critical: float) -> Level:
    if age > critical:
        return Level.CRITICAL
    return Level.WARNING if age > warning else Level.OK


def _daemon(facts: Facts) -> Item:
    daemon = facts.daemon
    if daemon.running:
        return _running_daemon(daemon)
    if daemon.running is None:
        return Item("daemon", Level.UNKNOWN, "unknown: /proc does not say who holds its lock")
    if daemon.clean_stop_utc is not None:
        return Item("daemon", Level.WARNING, f"stopped in order, {utc_text(daemon.clean_stop_utc)}")
    if daemon.heartbeat_utc is None:
        return Item("daemon", Level.WARNING, "never ran here; systemctl start dcamd")
    text = (
        f"not running, died after {utc_text(daemon.heartbeat_utc)}; journalctl -u dcamd tells why"
    )
    return Item("daemon", Level.CRITICAL, text)


def _running_daemon(daemon: Daemon) -> Item:
    """What it says itself, and whether it has been silent for longer than a cycle may take."""
    says, silent = daemon.says, span_text(daemon.silent_s)
    if says is None:
        return Item("daemon", Level.OK, "running")
    if says.patience_s is not None and daemon.silent_s > says.patience_s:
        text = f"hangs: no slot has ended for {silent}; journalctl -u dcamd, then restart it"
        return Item("daemon", Level.CRITICAL, text)
    text = says.phase if says.phase == "running" else f"{says.phase}, {silent} ago"
    if says.reason:
        text += f": {says.reason}"
    if says.phase == "running" and says.last is not None:
        last = says.last
        text += f", slot {last.slot}: " + " ".join(filter(None, (last.outcome, last.cause)))
    return Item("daemon", Level.OK, text)


def _supervision(facts: Facts) -> Item:
    """Slots that fail in a row, and a daemon that is started again and again."""
    daemon = facts.daemon
    failed = daemon.says.failed_in_a_row if daemon.says else 0
    level = _by_age(max(failed / LATE_SLOTS, daemon.starts_24h / MANY_STARTS), 1.0, math.inf)
    text = f"{count_of(failed, 'slot')} in a row without a row" if failed else "no slot failing"
    if failed and daemon.says and daemon.says.last:
        text += f" ({daemon.says.last.cause}: {daemon.says.last.detail})"
    text += f", {count_of(daemon.starts_24h, 'start')} in 24 h"
    if daemon.starts_24h > MANY_STARTS:
        text += "; journalctl -u dcamd tells why"
    return Item("supervision", level, text)


def _cameras(facts: Facts) -> Item:
    """Lost by what the daemon says, or as long as the newest thing known of it is a gap."""
    says = facts.daemon.says
    if says is not None and says.lost:
        telling = (
            f"{role} lost since slot {camera.since}: {camera.error}"
            for role, camera in says.lost.items()
        )
        return Item("cameras", Level.CRITICAL, "; ".join(telling))
    lost = [gap for gap in facts.gaps if gap.cause in CAMERA_CAUSES]
    if not lost:
        return Item("cameras", Level.OK, _temperatures(facts) or "no loss in 30 days")
    gap = lost[-1]
    slots = count_of(gap.slots, "slot")
    what = f"{gap.cause.value} {utc_text(gap.first_slot_utc)}, {slots}: {gap.detail}"
    if facts.last is None or facts.last.slot_utc < gap.first_slot_utc:
        return Item("cameras", Level.CRITICAL, what)
    return Item("cameras", Level.OK, f"both there; last loss: {what}")


def _temperatures(facts: Facts) -> str:
    if facts.last is None:
        return ""
    cameras = (("main", facts.last.main_camera), ("sub", facts.last.sub_camera))
    known = [f"{n} {c.temperature_c:.1f} °C" for n, c in cameras if c.temperature_c is not None]
    return f"no loss in 30 days, {', '.join(known)}" if known else ""


def _readings(facts: Facts) -> list[Item]:
    """The sensors at the last row; none, no line."""
    said = {one.name: one for one in facts.last.readings} if facts.last else {}
    if facts.last is None or not (said or facts.sensors):
        return []
    texts, missing = [], []
    for name, one in said.items():
        if one.value is not None:
            texts.append(f"{name} {one.value:g} {one.unit}")
            continue
        since_utc = facts.readings_failed.get(name)
        since = f" since {utc_text(since_utc.replace(microsecond=0))}" if since_utc else ""
        missing.append(f"{name} without a value{since}: {one.cause}")
    unread = [name for name in facts.sensors if name not in said]
    if unread:
        missing.append(f"{', '.join(unread)} not read yet: dcam-ctl reload")
    level = Level.WARNING if missing else Level.OK
    return [Item("readings", level, "; ".join([*missing, *texts]))]


def _calibration(facts: Facts) -> Item:
    record = facts.calibration
    if record is None:
        return Item("calibration", Level.CRITICAL, "none active; run dcam-ctl calibrate")
    age_s = (facts.now_utc - record.created_utc).total_seconds()
    text = f"{record.id}, method {record.method}, {span_text(age_s)} old"
    if record.config_hash != facts.config_hash:
        text += "; the config has changed since: calibrate again"
    elif facts.slipped_utc is not None:
        text += (
            f"; the board has slipped, last seen so {utc_text(facts.slipped_utc)}: look at it, "
            "then calibrate again"
        )
    elif facts.residual_ratio is not None and facts.residual_ratio > DRIFTING:
        text += (
            f"; drifting: the corners fit {facts.residual_ratio:.1f} times worse than at "
            "calibration: look at board, lens and bracket, clean the glass, calibrate again"
        )
    elif not record.passed:
        text += f"; accepted although it did not pass: {record.verdict}"
    else:
        return Item("calibration", Level.OK, text)
    return Item("calibration", Level.WARNING, text)


def _zero(calibration: ActiveCalibrationSummary | None) -> list[Item]:
    """Where the calibration's reference lies in the record's zero, unless it is the zero."""
    if calibration is None:
        return []
    link, name = calibration.datum, "zero"
    if link is None:
        text = (
            f"calibration {calibration.id} is not linked to those before, rows jump where it "
            "begins: dcam-ctl datum set or adjust"
        )
        return [] if calibration.is_first else [Item(name, Level.WARNING, text)]
    if link.method is DatumMethod.LOST:
        text = (
            "the zero is lost: enter a surveyed value with dcam-ctl datum set; until then "
            f"{offset_text(link.offset)}"
        )
        return [Item(name, Level.WARNING, text)]
    if link.method is DatumMethod.ORIGIN:
        return []
    return [Item(name, Level.OK, f"reference at {offset_text(link.offset)}, {link.method.value}")]


def _coverage(name: str, coverage: Coverage) -> Item:
    if not coverage.expected:
        return Item(name, Level.OK, "no slot yet")
    share = coverage.measured / coverage.expected
    level = Level.OK if share >= LOW_COVERAGE else Level.WARNING
    return Item(name, level if share >= LOST_COVERAGE else Level.CRITICAL, coverage_text(coverage))


def _gaps(facts: Facts) -> Item:
    recent = [gap for gap in facts.gaps if gap.last_slot_utc >= facts.now_utc - DAY]
    slots = sum(gap.slots for gap in recent)
    if not facts.gaps:
        return Item("gaps", Level.OK, "none in 30 days")
    last = facts.gaps[-1]
    text = (
        f"{len(recent)} in 24 h ({slots} slots), {len(facts.gaps)} in 30 d; "
        f"last: {last.cause.value} until {utc_text(last.last_slot_utc)}"
    )
    return Item("gaps", Level.OK, text)


def _disk(disk: Disk) -> Item:
    """Retention keeps the frames within the disk: only what leaves rows no room is an alarm."""
    text = f"{bytes_text(disk.free_bytes)} of {bytes_text(disk.total_bytes)} free"
    if disk.archive_days:
        days = count_of(disk.archive_days, "day")
        text += f", frames of {days} take {bytes_text(disk.archive_bytes)}"
    if disk.frames_fit:
        text += ", all that retention keeps has room"
    elif disk.days_left:
        days = count_of(round(disk.days_left), "day")
        text += f", {days} until frames are thinned before their time"
    elif disk.days_left == 0:
        text += ", frames are thinned before their time"
    low = disk.free_bytes < LOW_DISK_BYTES
    if disk.frames_fit is None:
        low = low or disk.free_bytes < LOW_DISK_SHARE * disk.total_bytes
    if disk.free_bytes < FULL_DISK_BYTES:
        return Item("disk", Level.CRITICAL, f"{text}: free some space")
    if low:
        return Item("disk", Level.WARNING, f"{text}: free some space")
    return Item("disk", Level.OK, text)


def _database(facts: Facts) -> Item:
    """A database that was set aside is reported until somebody has moved it away."""
    if facts.damage_noted is not None:
        text = f"{facts.damage_noted}; restart dcamd, it saves what can be read"
        return Item("database", Level.CRITICAL, text)
    if facts.set_aside:
        text = (
            f"was damaged; {facts.set_aside[-1]} is set aside, what could be read was saved: see "
            "dcam-ctl gaps, then move that file elsewhere"
        )
        return Item("database", Level.CRITICAL, text)
    return Item("database", Level.OK, "no damage met")


def _frames(facts: Facts) -> Item:
    """Rows whose frames found no room are measured, but can never be measured again."""
    count = facts.frames_not_kept_24h
    if facts.disk.frames_refused is not None:
        text = f"not kept {facts.disk.frames_refused}; rows go on, {count} without frames in 24 h"
        return Item("frames", Level.WARNING, text)
    if not count:
        return Item("frames", Level.OK, "all kept in 24 h")
    text = f"{count_of(count, 'row')} in 24 h without their frames; journalctl -u dcamd tells why"
    return Item("frames", Level.WARNING, text)


def _clock(facts: Facts) -> Item:
    if facts.undated:
        text = f"{facts.undated} pairs taken under a wrong clock have no slot yet: dcam-ctl redate"
        return Item("clock", Level.WARNING, text)
    again = ""
    if facts.to_measure_again:
        rows = count_of(facts.to_measure_again, "row")
        again = f"; {rows} of a wrong clock left to measure again"
    if facts.simulated_clock:
        return Item("clock", Level.OK, f"simulated{again}")
    if facts.clock_synchronised is None:
        return Item("clock", Level.UNKNOWN, "the kernel does not tell whether it is synchronised")
    if not facts.clock_synchronised:
        text = "not synchronised; check chronyc tracking or timedatectl"
        return Item("clock", Level.WARNING, text)
    return Item("clock", Level.OK, f"synchronised{again}")
