"""`dcam-ctl reprocess`: measure kept frames or a frame set again; what was measured stays."""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, TextIO

import click

from core.calibration.calibrate import Calibration
from core.errors import CalibrationError
from core.results import Flag, Measurement
from daemon.commands.options import (
    Options,
    common_options,
    json_option,
    output_option,
    pass_options,
    span_options,
)
from daemon.commands.output import Steps, note, print_json, progress
from daemon.commands.output_files import opened_table
from daemon.config.reading import Config
from daemon.errors import DatabaseMissingError, UsageError, WorkFailedError
from daemon.remote_path import is_url
from daemon.reports.table import write_results
from daemon.reprocessing.chunks import CHUNK_SLOTS, Work
from daemon.reprocessing.frames import Frames, KeptFrames, SeenSlot, frames_at
from daemon.reprocessing.in_order import InOrder
from daemon.reprocessing.parts import Parts
from daemon.reprocessing.running import WORTH_SHARING, seen_slots
from daemon.slots.measuring import ActiveCalibration
from daemon.store.database import NEVER, open_store_readonly
from daemon.store.queries.json_fields import result_fields
from daemon.store.records import CalibrationRecord, DatumRecord
from daemon.times import EPOCH

Result = tuple[datetime, Measurement]


@click.command(
    "reprocess",
    epilog="\b\nExample:\n"
    "  dcam-ctl reprocess --from /data/march --output march.csv\n"
    "  dcam-ctl reprocess --from s3://bridge/frames --scheduler tcp://host:8786 --output all.csv\n"
    "  dcam-ctl reprocess --since 24h --calibration 3 --output day.csv",
)
@click.option(
    "--from",
    "place",
    metavar="DIR|URL",
    help="Measure the rows of role measure of a frame set, or of an archive of them (YYYY/MM/DD), "
    "in a directory or at a URL that fsspec knows; without it the frames that were kept.",
)
@span_options
@click.option(
    "--calibration",
    "calibration_id",
    type=click.IntRange(min=1),
    metavar="ID",
    help="Use this calibration; default: the active one.",
)
@click.option(
    "--scheduler",
    metavar="ADDRESS",
    help="Share the work among the workers of this dask scheduler: tcp://host:8786; `local`: a "
    f"worker a core of this computer, the default from {WORTH_SHARING} slots on; `serial`: none.",
)
@output_option
@json_option
@common_options
@pass_options
def command(
    options: Options,
    place: str | None,
    since: datetime | None,
    until: datetime | None,
    calibration_id: int | None,
    scheduler: str | None,
    output: Path | None,
    as_json: bool,
) -> None:
    """Measure frames again, one line a pair, in order, whatever the images show.

    Values are in the record's zero: the datum of the calibration is in them, see dcam-ctl datum.
    The database is only read. A missing or damaged image gives a line with its flag and reason.
    flag: 1 good, 3 suspect (value given, reason named), 4 bad (value withheld), 9 missing.

    Results are the same to the last bit on one core and on many. A long run with --output that was
    interrupted goes on where it was when it is started again.
    """
    if place is not None and (since or until):
        msg = "--since and --until choose kept frames; leave them out with --from"
        raise UsageError(msg)
    calibration = chosen_calibration(options.config, options.state, calibration_id)
    site = options.config.site()
    frames: Frames = (
        KeptFrames(options.state, since or EPOCH, until or NEVER)
        if place is None
        else frames_at(place)
    )
    count, bursts = frames.counted()
    if not count:
        msg = f"{place or options.state}: no frames to measure there"
        raise WorkFailedError(msg)
    directory = None if place and is_url(place) else Path(place or options.state).absolute()
    work = Work(site, calibration, directory)
    targets = [extra.name for extra in site.extra_targets]
    in_order, counts = InOrder(site, calibration), Counter[Flag]()
    rows: list[dict[str, Any]] = []
    parts = Parts(output if _is_kept(output, count) else None)

    def measured(seen: Iterable[SeenSlot], steps: Steps) -> Iterator[Result]:
        for one in seen:
            measurement = in_order.measurement(one)
            counts[measurement.flag] += 1
            if as_json:
                rows.append(result_fields(one.slot_utc, measurement))
            steps.next()
            yield one.slot_utc, measurement

    with (
        _spooled(output, wanted=output is not None or not as_json) as table,
        progress(count, "measuring") as steps,
        seen_slots(work, frames, count, scheduler, parts, note) as seen,
    ):
        write_results(measured(seen, steps), table, targets=targets, bursts=bursts)
    parts.remove()
    if as_json:
        fields = {"command": "reprocess", "calibration": calibration.id, "output": output}
        print_json({**fields, "rows": rows})
    if parts.found:
        note(f"{parts.found} chunks of {CHUNK_SLOTS} slots were there from an interrupted run")
    note(f"{counts.total()} rows with calibration {calibration.id}: {count_flags(counts)}")


def _is_kept(output: Path | None, count: int) -> bool:
    """Whether what is done is kept beside the output for a run that goes on."""
    is_file = output is not None and (not output.exists() or output.is_file())
    return is_file and count >= WORTH_SHARING


@contextmanager
def _spooled(output: Path | None, *, wanted: bool) -> Iterator[TextIO]:
    """The output's table; what goes to stdout is written when all is measured."""
    if not wanted:
        with Path(os.devnull).open("w", encoding="utf-8") as nothing:
            yield nothing
    elif output is not None:
        with opened_table(output) as table:
            yield table
    else:
        with TemporaryFile("w+", encoding="utf-8", newline="") as spool:
            yield spool
            spool.seek(0)
            with opened_table(None) as table:
                shutil.copyfileobj(spool, table)


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


def count_flags(counts: Mapping[Flag, int]) -> str:
    """How many rows have which flag, in words."""
    return ", ".join(f"{counts[flag]} {flag.name.lower()}" for flag in Flag if counts[flag])
