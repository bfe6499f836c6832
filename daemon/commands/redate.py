"""`dcam-ctl redate`: put right the times of what was taken while the clock was wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import groupby

import click

from daemon.clock.machine import read_boot_id, uptime_s
from daemon.commands.options import (
    Options,
    common_options,
    json_option,
    pass_options,
    tz_option,
    utc_time,
)
from daemon.commands.output import print_json, print_table, say
from daemon.errors import ExitCode, UsageError
from daemon.schedule import Schedule
from daemon.slots.time_correction import Books, Redated, TrueTime, account_for_moved, redate
from daemon.store.database import Store, open_store, open_store_readonly
from daemon.store.records import MeasurementRecord, RedatedRecord
from daemon.text import utc_text
from daemon.times import slot_text

Undated = Sequence[tuple[int, MeasurementRecord]]


@dataclass(frozen=True, slots=True)
class Wanted:
    """What is to be dated again, and how."""

    rows: list[MeasurementRecord]
    undated: Undated
    true_utc: TrueTime


@click.command(
    "redate",
    epilog="\b\nExample:\n  dcam-ctl redate\n"
    "  dcam-ctl redate --boot 7c9f8a3e --booted 2026-03-01T14:01:30Z\n"
    "  dcam-ctl redate --boot this --clock-is-right\n"
    "  dcam-ctl redate --since 2026-03-02T06:00 --until 2026-03-02T07:30 --shift -3600",
)
@click.option("--boot", metavar="BOOT", help="Undated pairs of this boot: its name, or `this`.")
@click.option("--booted", callback=utc_time, metavar="TIME", help="The boot truly began then.")
@click.option("--clock-is-right", is_flag=True, help="The clock is right now (--boot this).")
@click.option("--since", callback=utc_time, metavar="TIME", help="Rows of the record from here on.")
@click.option("--until", callback=utc_time, metavar="TIME", help="And before here.")
@click.option("--shift", type=float, metavar="SECONDS", help="True time minus the clock's.")
@click.option("--done", is_flag=True, help="List what was dated: as it was measured, and as it is.")
@click.option("--dry-run", is_flag=True, help="Tell what would be done; change nothing.")
@json_option
@tz_option
@common_options
@pass_options
def command(
    options: Options,
    boot: str | None,
    booted: datetime | None,
    clock_is_right: bool,
    since: datetime | None,
    until: datetime | None,
    shift: float | None,
    done: bool,
    dry_run: bool,
    as_json: bool,
) -> int:
    """Give pairs that were taken under a wrong clock their true slots.

    Without options: list the pairs that wait for theirs. They get them by themselves once NTP or
    PTP disciplines the clock in the same boot; else say when the boot began, or how far the clock
    was off. Nothing is overwritten: what has another row in its slot stays undated, every row
    keeps the slot that it had first (redated_from_utc), and the history tells of it.

    dcamd measures rows that were dated once more from their images, between its slots: sigma
    depends on the time. --done lists what they were and what they are.
    """
    if done:
        with open_store_readonly(options.state) as store:
            _list_done(store, as_json=as_json)
        return ExitCode.DONE
    if boot is None and since is None:
        _require(booted is None and shift is None and not clock_is_right, "name --boot or --since")
        with open_store_readonly(options.state) as store:
            _list(store.undated(), as_json=as_json)
        return ExitCode.DONE
    schedule = options.config.schedule.schedule()
    now_utc = datetime.now(UTC)
    with open_store(options.state, create=False, migrate=False) as store:
        if boot is not None:
            _require(since is None and until is None, "give --boot or --since, not both")
            how = (booted is not None) + (shift is not None) + clock_is_right
            _require(how == 1, "with --boot give one of --booted, --shift, --clock-is-right")
            wanted = _of_boot(store, boot, _true_time(boot, booted, shift, now_utc))
        else:
            _require(shift is not None and booted is None, "with --since give --until and --shift")
            _require(until is not None, "with --since give --until and --shift")
            wanted = _of_record(store, since, until, shift or 0.0)
        _require_past(wanted, now_utc)
        if dry_run:
            came = _predict(store, schedule, wanted)
        else:
            books = Books(store, options.state, schedule, unseen=1)
            came = redate(books, wanted.rows, wanted.undated, wanted.true_utc)
            account_for_moved(books, wanted.rows, wanted.true_utc, now_utc)
            detail = f"by hand: {came.dated} dated, {came.moved} moved, {came.left} left"
            store.add_event(now_utc, "redated", detail)
    _tell(came, dry_run=dry_run, as_json=as_json)
    return ExitCode.FAILED if came.left else ExitCode.DONE


def _require(condition: bool, problem: str) -> None:
    if not condition:
        raise UsageError(problem)


def _true_time(
    boot: str, booted: datetime | None, shift: float | None, now_utc: datetime
) -> TrueTime:
    if shift is not None:
        return _shifted(shift)
    _require(booted is not None or boot == "this", "--clock-is-right is for --boot this only")
    began_utc = booted or now_utc - timedelta(seconds=uptime_s())
    return lambda record: began_utc + timedelta(seconds=record.uptime_s or 0.0)


def _shifted(shift_s: float) -> TrueTime:
    return lambda record: (record.captured_utc or record.slot_utc) + timedelta(seconds=shift_s)


def _of_boot(store: Store, boot: str, true_utc: TrueTime) -> Wanted:
    name = read_boot_id() if boot == "this" else boot
    found = [
        (number, record)
        for number, record in store.undated()
        if str(record.boot_id).startswith(name)
    ]
    _require(len({record.boot_id for _, record in found}) <= 1, f"--boot {boot}: several; say more")
    _require(bool(found), f"--boot {boot}: no undated pairs; dcam-ctl redate lists those there are")
    return Wanted([], found, true_utc)


def _of_record(
    store: Store, since: datetime | None, until: datetime | None, shift_s: float
) -> Wanted:
    if since is None or until is None:
        raise AssertionError
    rows = list(store.measurements(since, until))
    _require(bool(rows), f"no rows from {utc_text(since)} to {utc_text(until)}")
    return Wanted(rows, [], _shifted(shift_s))


def _require_past(wanted: Wanted, now_utc: datetime) -> None:
    records = [*wanted.rows, *(record for _, record in wanted.undated)]
    latest_utc = max(wanted.true_utc(record) for record in records)
    _require(latest_utc <= now_utc, f"the last pair would be of {utc_text(latest_utc)}: the future")


def _predict(store: Store, schedule: Schedule, wanted: Wanted) -> Redated:
    """What would come of it, as far as slots that are taken now can tell."""
    leaving = {row.slot_utc for row in wanted.rows}

    def is_free(record: MeasurementRecord) -> bool:
        slot_utc = schedule.nearest(wanted.true_utc(record))
        return slot_utc in leaving or store.measurement(slot_utc) is None

    dated = sum(is_free(record) for _, record in wanted.undated)
    moved = sum(is_free(row) for row in wanted.rows)
    return Redated(dated, moved, len(wanted.undated) + len(wanted.rows) - dated - moved)


def _list(undated: Undated, *, as_json: bool) -> None:
    boots = [
        (boot_id, [record for _, record in records])
        for boot_id, records in groupby(undated, key=lambda pair: pair[1].boot_id)
    ]
    if as_json:
        fields = [_boot_fields(str(boot_id), records) for boot_id, records in boots]
        print_json({"command": "redate", "undated": fields})
    elif not boots:
        say("no undated pairs")
    else:
        print_table(
            ("boot", "pairs", "the clock said", "to", "s after the boot", "to"),
            [tuple(map(str, _boot_fields(str(b), records).values())) for b, records in boots],
        )
        say("date them with --boot BOOT and --booted TIME or --shift SECONDS; see --help")


def _list_done(store: Store, *, as_json: bool) -> None:
    """All that was dated, as it was measured under the wrong clock, and as it is now."""
    rows = [
        (entry, store.measurement(entry.slot_utc))
        for entry in store.redated()
        if entry.slot_utc is not None
    ]
    fields = [_done_fields(entry, now) for entry, now in rows]
    if as_json:
        print_json({"command": "redate", "done": fields})
    elif not fields:
        say("nothing was dated")
    else:
        heads = ("slot", "first", "measured again", *("y, mm", "now", "sigma y, mm", "now"))
        cells = [tuple("-" if one is None else str(one) for one in row.values()) for row in fields]
        print_table(heads, cells)


def _done_fields(entry: RedatedRecord, now: MeasurementRecord | None) -> dict[str, object]:
    """Values count from the reference of the row's calibration, as they are stored."""
    y_mm, sigma_y_mm = _y_mm(entry.before)
    now_mm, now_sigma_mm = (None, None) if now is None else _y_mm(now)
    return {
        "slot_utc": None if entry.slot_utc is None else slot_text(entry.slot_utc),
        "from_slot_utc": slot_text(entry.before.slot_utc),
        "measured_again": "waits" if entry.again is None else entry.again.value,
        "before_y_mm": y_mm,
        "y_mm": now_mm,
        "before_sigma_y_mm": sigma_y_mm,
        "sigma_y_mm": now_sigma_mm,
    }


def _y_mm(record: MeasurementRecord) -> tuple[float | None, float | None]:
    """The corrected y and its sigma."""
    found = record.measurement.corrected
    if found is None:
        return None, None
    return round(float(found.mm[1]), 6), round(float(found.covariance_mm2[1, 1]) ** 0.5, 6)


def _boot_fields(boot_id: str, records: Sequence[MeasurementRecord]) -> dict[str, object]:
    return {
        "boot_id": boot_id,
        "pairs": len(records),
        "first_clock_utc": slot_text(records[0].slot_utc),
        "last_clock_utc": slot_text(records[-1].slot_utc),
        "first_uptime_s": round(records[0].uptime_s or 0.0),
        "last_uptime_s": round(records[-1].uptime_s or 0.0),
    }


def _tell(done: Redated, *, dry_run: bool, as_json: bool) -> None:
    if as_json:
        fields = {"dated": done.dated, "moved": done.moved, "left": done.left}
        print_json({"command": "redate", "dry_run": dry_run, **fields})
        return
    would = "would be " if dry_run else ""
    say(f"{done.dated} undated pairs {would}dated, {done.moved} rows {would}moved")
    if done.left:
        say(f"{done.left} left undated: their slots have other rows")
    if not dry_run and done.dated + done.moved:
        say("dcamd will measure them again as of their true times, between its slots")
