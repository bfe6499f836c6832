"""`dcam-ctl verify`: everything that was recorded, read and checked."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict
from datetime import datetime
from typing import TYPE_CHECKING

import click

from core.errors import digits
from daemon.commands.options import (
    Options,
    common_options,
    json_option,
    pass_options,
    tz_option,
    utc_time,
)
from daemon.commands.output import Steps, note, print_json, progress, say
from daemon.commands.priority import lowest_priority
from daemon.error_report import lines_of
from daemon.errors import DatabaseDamagedError, DcamError, ExitCode
from daemon.status.archive_check import ArchiveCheck, Removed
from daemon.store.accounting import ScheduleEpoch, read_epochs
from daemon.store.damage_note import databases_set_aside, note_damage
from daemon.store.database import Store, open_store_readonly
from daemon.store.records import Mark
from daemon.store.verification import (
    SALVAGE,
    Counted,
    Finding,
    page_findings,
    reference_findings,
    row_findings,
    slot_findings,
)
from daemon.text import count_of

if TYPE_CHECKING:  # the numerics are loaded by who rebuilds rows
    from daemon.slots.rebuilding import Compared, Rebuilt

_WHY_NOT_AGAIN = {
    "waits": "dcamd will measure them again as of their true times, between its slots",
    "no_frames": "with values as of its time, as their images were not kept or are removed",
    "frames_unreadable": "with values as of its time, as their images cannot be read",
    "no_calibration": "measured without a calibration, or with one that is lost",
    "broke": "with values as of its time: measuring them again failed, the log says why",
}


@click.command("verify", epilog="\b\nExample:\n  dcam-ctl verify --since 30d")
@click.option(
    "--since",
    callback=utc_time,
    metavar="TIME",
    help="Slots and frames from this time on: 2026-03-01, 24h, 30d.",
)
@click.option(
    "--rebuild",
    type=click.IntRange(min=1),
    metavar="N",
    help="Also make N rows, chosen at random, once more from their frames: each must come out "
    "the same to the last bit. Rows that other numerics made (the version that a row names says "
    "so) may differ: how many and how far is said.",
)
@json_option
@tz_option
@common_options
@pass_options
def command(options: Options, since: datetime | None, rebuild: int | None, *, as_json: bool) -> int:
    """Read everything: each row and frame against its checksum, and each slot exactly once.

    Looks at the database's pages, every row, the calibrations, the slots since the first (each has
    one row or lies in one gap), the frames that rows name and those without a row, and databases
    set aside. Changes nothing and may run beside dcamd, at the lowest priority; frames take about
    as long as copying them.
    Exit code 0 when all is well, 1 with findings.
    """
    counted, rebuilt = Counted(), None
    with (
        lowest_priority(),
        open_store_readonly(options.state) as store,
        progress(1, "reading") as steps,
    ):
        findings = list(_findings(options, store, since, steps, counted))
        if rebuild is not None:
            rebuilt, differing = _rebuild(options, store, rebuild, since, steps)
            findings += differing
    _have_it_looked_at(options, findings)
    if as_json:
        print_json(
            {
                "command": "verify",
                **asdict(counted),
                "rebuilt": None if rebuilt is None else asdict(rebuilt),
                "findings": [asdict(finding) for finding in findings],
            }
        )
    else:
        for finding in findings:
            say(f"{finding.what}: {finding.where}: {finding.text}; {finding.todo}")
        say(count_of(len(findings), "finding") if findings else "all well")
        for line in _what_was_looked_at(counted):
            say(line)
        if rebuilt is not None:
            for line in _what_was_rebuilt(rebuilt):
                say(line)
    return ExitCode.FAILED if findings else ExitCode.DONE


def _what_was_looked_at(counted: Counted) -> Iterator[str]:
    """Say what the numbers count."""
    yield (
        f"{counted.rows} rows of the database read: measurements, gaps, calibrations, events and "
        "all else it keeps"
    )
    yield f"{counted.slots} slots of the schedule looked for: each must have one row or one gap"
    yield f"{counted.images} images read and compared with their checksums"
    if counted.slots_with_frames_removed:
        yield f"{counted.slots_with_frames_removed} slots without images, removed to make room"


def _what_was_rebuilt(rebuilt: Rebuilt) -> Iterator[str]:
    rows = count_of(rebuilt.rows, "row")
    yield f"{rows} made once more from their frames and compared to the last bit"
    if rebuilt.other.rows:
        kind = (
            "of other numerics (another version of dcam or of its libraries, or another processor)"
        )
        yield _what_was_compared(rebuilt.other, kind)
    if rebuilt.redated.rows:
        kind = "that a wrong clock had dated, with values as of its time still,"
        yield _what_was_compared(rebuilt.redated, kind)
    for why, count in rebuilt.not_again.items():
        yield f"{count_of(count, 'row')} of a wrong clock: {_WHY_NOT_AGAIN[why]}"
    if rebuilt.beside.rows:
        kind = "measured while rows of a wrong clock stood before them, which have gone elsewhere,"
        yield _what_was_compared(rebuilt.beside, kind)
    if rebuilt.skipped:
        rows = count_of(rebuilt.skipped, "row")
        yield f"{rows} passed over: of another config, or without calibration"


def _what_was_compared(compared: Compared, kind: str) -> str:
    text = (
        f"{count_of(compared.rows, 'row')} {kind} made once more: {compared.differing} come out "
        "otherwise now"
    )
    if compared.differing:
        text += f", by {digits(compared.largest_mm, 2)} mm at most"
    if compared.flags:
        text += f", {compared.flags} with another flag or reason"
    return text


def _rebuild(
    options: Options, store: Store, wanted: int, since: datetime | None, steps: Steps
) -> tuple[Rebuilt, list[Finding]]:
    """Make rows once more; how many, and those that differ."""
    from daemon.slots.rebuilding import Rebuilding, Rebuilt
    from daemon.store.frames.archive import FrameArchive

    config, rebuilt = options.config, Rebuilt()
    archive = FrameArchive(options.state)
    look = Rebuilding(store, archive, config.site(), config.config_hash())
    steps.begin("rows once more")
    return rebuilt, list(look.findings(wanted, since, rebuilt, steps.at))


def _findings(
    options: Options, store: Store, since: datetime | None, steps: Steps, counted: Counted
) -> Iterator[Finding]:
    """Look at one thing after the other, each with its own progress."""

    def slots() -> Iterator[Finding]:
        return slot_findings(store.path, _eras(options, store), since, counted, steps.at)

    def frames() -> Iterator[Finding]:
        accounted = store.accounted()
        if accounted is not None:
            look = ArchiveCheck(store.path, _removed(store), accounted[1], counted)
            yield from look.findings(since, steps.at)

    looks: tuple[tuple[str, Callable[[], Iterator[Finding]]], ...] = (
        ("pages", lambda: page_findings(store.path)),
        ("rows", lambda: row_findings(store.path, since, counted, steps.at)),
        ("calibrations", lambda: reference_findings(store.path)),
        ("slots", slots),
        ("frames, day by day", frames),
    )
    for what, look in looks:
        steps.begin(what)
        try:
            yield from look()
        except DatabaseDamagedError as error:
            yield Finding("database", store.path.name, str(error), SALVAGE, is_damage=True)
    for path in databases_set_aside(options.state):
        text = "a database that was damaged; what could be read of it was saved"
        yield Finding("set aside", path.name, text, "look at it, then move it elsewhere")


def _removed(store: Store) -> Removed:
    """Tell slots whose frames were removed on purpose; retention may go on meanwhile."""
    ledger = {known.day: known for known in store.frame_days()}

    def removed(slot_utc: datetime) -> bool:
        known = ledger.get(slot_utc.date())
        if known is not None and known.has_removed(slot_utc):
            return True
        return store.frames_removed(slot_utc)

    return removed


def _eras(options: Options, store: Store) -> list[ScheduleEpoch]:
    """The site's schedules: as dcamd noted them, else that of the config."""
    epochs = read_epochs(store.get_mark(Mark.SCHEDULES))
    if not epochs:
        try:
            schedule = options.config.schedule
        except DcamError as error:
            why = "; ".join(lines_of(error))
            note(f"slots are not looked at: dcamd noted no schedule yet, and {why}")
            return []
        epochs = [ScheduleEpoch(None, schedule.period_s, schedule.offset_s)]
    return epochs


def _have_it_looked_at(options: Options, findings: list[Finding]) -> None:
    """Have the next start of dcamd look at everything, or it might not meet what was met here."""
    damage = next((finding for finding in findings if finding.is_damage), None)
    if damage is None:
        return
    try:
        note_damage(options.state, damage.text)
    except OSError as error:
        note(
            f"{options.state}: cannot be written ({error.strerror}): run verify as the user of "
            "dcamd, then its next start looks at everything"
        )
