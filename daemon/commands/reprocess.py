"""`dcam-ctl reprocess`: measure kept frames or a frame set again; what was measured stays."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Protocol

import click

from core.calibration.calibrate import Calibration
from core.errors import CalibrationError
from core.quality.fixed_targets import HISTORY_ROWS, PastRow
from core.results import Flag, Measurement
from core.rig.learnt import Learnt
from core.rig.stability import Moment
from core.site import Site
from daemon.commands.options import (
    Options,
    common_options,
    json_option,
    output_option,
    pass_options,
    span_options,
)
from daemon.commands.output import note, print_json, progress
from daemon.commands.output_files import opened_table
from daemon.config.reading import Config
from daemon.errors import DatabaseMissingError, UsageError, WorkFailedError
from daemon.reports.table import write_results
from daemon.slots.learner import ComputedClosures, Learner
from daemon.slots.measuring import (
    ActiveCalibration,
    PairFiles,
    first_moment,
    load_pairs,
    measure,
    read_pair,
    row_moment,
)
from daemon.slots.row_history import RowHistory
from daemon.store.database import NEVER, open_store_readonly
from daemon.store.datum import in_record_zero
from daemon.store.frames.archive import FrameArchive
from daemon.store.json_fields import result_fields
from daemon.store.records import CalibrationRecord, DatumRecord
from daemon.times import EPOCH
from drivers.frameset import FrameSet, FrameSetRow, read_frame_set

Result = tuple[datetime, Measurement]


class MeasureJob(Protocol):
    """Measures a slot, given the rows before and what they taught."""

    def __call__(self, past: Sequence[PastRow], learnt: Learnt | None = None) -> PastRow:
        """Give the slot's row."""


Job = tuple[datetime, MeasureJob]
"""A slot, and how to measure it."""


@click.command(
    "reprocess",
    epilog="\b\nExample:\n"
    "  dcam-ctl reprocess --from /data/march --output march.csv\n"
    "  dcam-ctl reprocess --since 24h --calibration 3 --output day.csv",
)
@click.option(
    "--from",
    "directory",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Measure the rows of role measure of a frame set; without it the frames that were kept.",
)
@span_options
@click.option(
    "--calibration",
    "calibration_id",
    type=click.IntRange(min=1),
    metavar="ID",
    help="Use this calibration; default: the active one.",
)
@output_option
@json_option
@common_options
@pass_options
def command(
    options: Options,
    directory: Path | None,
    since: datetime | None,
    until: datetime | None,
    calibration_id: int | None,
    output: Path | None,
    as_json: bool,
) -> None:
    """Measure frames again, one line a pair, in order, whatever the images show.

    Values are in the record's zero: the datum of the calibration is in them, see dcam-ctl datum.
    The database is only read. A missing or damaged image gives a line with its flag and reason.
    flag: 1 good, 3 suspect (value given, reason named), 4 bad (value withheld), 9 missing.
    """
    if directory is not None and (since or until):
        msg = "--since and --until choose kept frames; leave them out with --from"
        raise UsageError(msg)
    calibration = chosen_calibration(options.config, options.state, calibration_id)
    site = options.config.site()
    jobs = (
        list(jobs_in_set(read_frame_set(directory), site, calibration))
        if directory is not None
        else list(jobs_kept(options.state, site, calibration, since or EPOCH, until or NEVER))
    )
    if not jobs:
        msg = f"{directory or options.state}: no frames to measure there"
        raise WorkFailedError(msg)
    results = []
    sequence = RowHistory(calibration, site.quality)
    past: deque[PastRow] = deque(maxlen=HISTORY_ROWS)
    learner, closures = Learner(), ComputedClosures()
    with progress(len(jobs), "measuring") as steps:
        for slot_utc, measure_job in jobs:
            alone = measure_job(past, learner.at(slot_utc, calibration, closures.hours))
            measurement = sequence.judge(slot_utc, alone.measurement)
            past.append(PastRow(alone.moment, measurement))
            closures.add(past[-1])
            results.append((slot_utc, in_record_zero(measurement, calibration.datum)))
            steps.next()
    targets = [extra.name for extra in site.extra_targets]
    tell(results, calibration.id, output, targets, as_json=as_json)


def chosen_calibration(
    config: Config, state: Path, calibration_id: int | None
) -> ActiveCalibration:
    """Read a calibration, or the active one. Raises WorkFailedError when there is none."""
    known: list[int | None] = []
    datum: DatumRecord | None = None
    try:
        with open_store_readonly(state) as store:
            record = (
                store.active_calibration()
                if calibration_id is None
                else store.calibration(calibration_id)
            )
            if record is None:
                known = [made.id for made in store.calibrations()]
            else:
                datum = store.datum(record.id)
    except DatabaseMissingError:
        record = None
    if record is None:
        which = "active calibration" if calibration_id is None else f"calibration {calibration_id}"
        todo = (
            f"those known are {', '.join(map(str, known))}: choose one with --calibration"
            if known
            else "run dcam-ctl calibrate with the same --state first"
        )
        msg = f"{state}: no {which}; {todo}"
        raise WorkFailedError(msg)
    if record.config_hash != config.config_hash():
        note(f"warning: the config has changed since calibration {record.id} was made")
    return ActiveCalibration(record.id, read_calibration(record), datum)


def read_calibration(record: CalibrationRecord) -> Calibration:
    """Give a stored calibration. Raises WorkFailedError when it cannot be read."""
    try:
        return record.calibration
    except CalibrationError as error:
        msg = f"calibration {record.id} in the database: {error}"
        raise WorkFailedError(msg) from error


def jobs_in_set(frames: FrameSet, site: Site, calibration: ActiveCalibration) -> Iterator[Job]:
    """The slots of a frame set's `measure` rows, in order."""
    for rows in frames.slots_of("measure"):
        files = [_files(frames, row) for row in rows]
        yield rows[0].slot_utc, partial(_measure_files, files, site, calibration)


def jobs_kept(
    state: Path, site: Site, calibration: ActiveCalibration, since: datetime, until: datetime
) -> Iterator[Job]:
    """The slots of the archive with since <= slot < until, in order."""
    archive = FrameArchive(state)
    for slot_utc in archive.stored_slots(since):
        if slot_utc < until:
            yield slot_utc, partial(_measure_kept, archive, slot_utc, site, calibration)


def _files(frames: FrameSet, row: FrameSetRow) -> PairFiles:
    main, sub = (frames.directory / name if name else None for name in (row.main, row.sub))
    return PairFiles(main, sub, row_moment(row), _skew_s(row))


def _measure_files(
    files: list[PairFiles],
    site: Site,
    calibration: ActiveCalibration,
    past: Sequence[PastRow],
    learnt: Learnt | None = None,
) -> PastRow:
    pairs = (read_pair(pair, site) for pair in files)
    return PastRow(files[0].moment, measure(pairs, site, calibration, past, learnt))


def _measure_kept(
    archive: FrameArchive,
    slot_utc: datetime,
    site: Site,
    calibration: ActiveCalibration,
    past: Sequence[PastRow],
    learnt: Learnt | None = None,
) -> PastRow:
    pairs, _ = load_pairs(archive, slot_utc)
    moment = first_moment(pairs) or Moment(slot_utc.timestamp())
    return PastRow(moment, measure(pairs, site, calibration, past, learnt))


def _skew_s(row: FrameSetRow) -> float | None:
    """The skew that the frame archive keeps in its tables; other sets have none."""
    try:
        return float(row.extra.get("skew_s", ""))
    except ValueError:
        return None


def tell(
    results: list[Result],
    calibration_id: int | None,
    output: Path | None,
    targets: Sequence[str],
    *,
    as_json: bool,
) -> None:
    """Write the table and a summary of the flags; with `--json` the rows on stdout."""
    if output is not None or not as_json:
        with opened_table(output) as table:
            bursts = any(measurement.spread_mm is not None for _, measurement in results)
            write_results(results, table, targets=targets, bursts=bursts)
    if as_json:
        rows = [result_fields(slot_utc, measurement) for slot_utc, measurement in results]
        print_json(
            {
                "command": "reprocess",
                "calibration": calibration_id,
                "output": output,
                "rows": rows,
            }
        )
    note(f"{len(results)} rows with calibration {calibration_id}: {count_flags(results)}")


def count_flags(results: Iterable[Result]) -> str:
    """How many rows have which flag, in words."""
    counts = Counter(measurement.flag for _, measurement in results)
    return ", ".join(f"{counts[flag]} {flag.name.lower()}" for flag in Flag if counts[flag])
