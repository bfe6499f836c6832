"""The datum of a new calibration: the believed answer with the least sigma, and why."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from core.errors import CalibrationError
from core.results import Flag
from core.rig.reference_places import errors_at_reference
from core.site import MAIN, Site
from daemon.datum.candidates import (
    Candidate,
    by_fixed_targets,
    by_old_calibration,
    by_rows,
    by_same_reference,
    contradicted,
    gains_of,
    lost,
    measured_targets,
)
from daemon.datum.chain import offset_by, origin, targets_by
from daemon.datum.seen import Known, NewReference, SeenRow
from daemon.slots.measuring import (
    ActiveCalibration,
    PairFiles,
    active_calibration,
    measure,
    read_pair,
    row_moment,
)
from daemon.store.database import Store
from daemon.store.queries.columns import read_columns
from daemon.store.queries.datum_fields import offset_text
from daemon.store.records import CalibrationRecord, DatumMethod, DatumRecord, DatumStep
from daemon.store.rows.circumstances import circumstances_of
from daemon.store.rows.convert import measurement_record
from drivers.errors import DriverError
from drivers.frameset import FrameSetRow, read_frame_set

CONTRADICTION = 4.0
"""Sigmas between two answers, in x or in y, of which then the one by the board is wrong."""
ROWS_BACK = timedelta(days=60)
"""Of the record, to see how the bridge moves. Chosen: two months hold every lag that a calibration
leaves, and are read in seconds."""
_MOST_MEASURED = 12
"""Pairs of the old frame set that are measured where the record has no rows."""

OnStep = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Zero:
    """The datum of a new calibration, to be stored with it."""

    link: DatumRecord
    lines: tuple[str, ...]
    """For the report; none for the first calibration of a record."""


def find_zero(
    store: Store,
    site: Site,
    new: NewReference,
    created_utc: datetime,
    *,
    board_untouched: bool = False,
    on_step: OnStep = lambda _: None,
) -> Zero:
    """Find where a new reference lies in the record's zero. Raises StoreError."""
    new = replace(new, errors=errors_at_reference(new.calibration.calibrated, site.sub))
    record = store.active_calibration()
    if record is None or record.id is None:
        return Zero(origin(created_utc, new.slot_utc, new.errors), ())
    datums = {int(link.calibration_id or 0): link for link in store.datum_links()}
    same = _same_reference(store, datums, new)
    if same is not None:
        return _zero(same, [], [], datums, new, created_utc)
    active = active_calibration(store)
    known = None
    if active is not None:
        serials = circumstances_of(record.content).serials
        known = Known(active, reference_time(record, active), serials)
    rows = list(stored_rows(store, new.slot_utc - ROWS_BACK, new.slot_utc))
    if known is not None and (not rows or rows[-1].calibration_id != known.id):
        rows += _measured_rows(record, known, site, new.slot_utc, on_step)
    rows.sort(key=lambda row: row.slot_utc)
    candidates, notes = _candidates(known, new, site, rows, datums, board_untouched=board_untouched)
    chosen = choose(candidates)
    if chosen is None:
        chosen = lost(record.id, rows[-1] if rows else None, site, datums)
    return _zero(chosen, candidates, notes, datums, new, created_utc)


def _same_reference(
    store: Store, datums: Mapping[int, DatumRecord], new: NewReference
) -> Candidate | None:
    """The calibration that was made on the same reference, if there is one."""
    for number, link in sorted(datums.items()):
        if link.reference_utc != new.slot_utc:
            continue
        record = store.calibration(number)
        try:
            if record is None:
                continue
            earlier = Known(ActiveCalibration(number, record.calibration, link), new.slot_utc)
        except CalibrationError:  # of a version that this one cannot read
            continue
        same = by_same_reference(earlier, new)
        if same is not None:
            return same
    return None


def _candidates(
    known: Known | None,
    new: NewReference,
    site: Site,
    rows: Sequence[SeenRow],
    datums: dict[int, DatumRecord],
    *,
    board_untouched: bool,
) -> tuple[list[Candidate], list[str]]:
    found: list[Candidate] = []
    notes: list[str] = []
    if known is not None:
        old, why = by_old_calibration(known, new, site, board_untouched=board_untouched)
        if old is None:
            notes.append(why)
        else:
            found.append(old)
        through = by_fixed_targets(known, new, site, rows)
        if through is not None:
            found.append(through)
    by_record = by_rows(rows, datums, new.slot_utc)
    if by_record is not None:
        found.append(by_record)
    return judged(found), notes


def judged(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Doubt what rests on the board where something that does not contradicts it."""
    others = [one for one in candidates if one.step.method is not DatumMethod.OLD_CALIBRATION]
    found = []
    for one in candidates:
        by_board = one.step.method is DatumMethod.OLD_CALIBRATION
        against = [other for other in others if contradicted(one, other, CONTRADICTION)]
        doubts = [f"what is {other.words} contradicts it" for other in against if by_board]
        found.append(replace(one, doubts=(*one.doubts, *doubts)))
    return found


def choose(candidates: Sequence[Candidate]) -> Candidate | None:
    """The believed one with the least sigma; None where none is believed."""
    believed = [one for one in candidates if not one.doubts]
    return min(believed, key=lambda one: float(np.hypot(*one.sigma_mm)), default=None)


def reference_time(record: CalibrationRecord, active: ActiveCalibration) -> datetime:
    """When a calibration's reference was taken; when it was made, where that is not known."""
    link = active.datum
    if link is not None and link.reference_utc is not None:
        return link.reference_utc
    moment = active.calibration.reference
    return record.created_utc if moment is None else datetime.fromtimestamp(moment.utc_s, UTC)


def stored_rows(store: Store, since_utc: datetime, until_utc: datetime) -> Iterator[SeenRow]:
    """The good rows with since <= slot < until, in order, as they are stored."""
    for batch in read_columns(store.path, since_utc, until_utc, as_stored=True):
        for values in batch.rows():
            if values["flag"] != Flag.GOOD:
                continue
            row = measurement_record(values)
            assert row.measurement.corrected is not None  # noqa: S101 - as every good row has
            yield SeenRow(
                row.slot_utc,
                row.measurement.corrected,
                row.calibration_id,
                tuple(measured_targets(row.measurement)),
                row.measurement.motion,
                gains_of(row.measurement),
                row.measurement.closure,
            )


def _measured_rows(
    record: CalibrationRecord, known: Known, site: Site, until_utc: datetime, on_step: OnStep
) -> Iterator[SeenRow]:
    """The last `measure` rows of the frame set that the calibration before was made on."""
    try:
        frames = read_frame_set(Path(record.frames or ""))
    except (DriverError, OSError):
        return  # it was moved or removed since
    rows = [row for row in frames.rows_of("measure") if row.slot_utc <= until_utc]
    for row in rows[-_MOST_MEASURED:]:
        files = _files(frames.directory, row)
        measured = measure([read_pair(files, site)], site, known.active)
        on_step(f"measured {row.slot_utc:%Y-%m-%d %H:%M}")
        if measured.flag is Flag.GOOD and measured.corrected is not None:
            targets = tuple(measured_targets(measured))
            motion, gains = measured.motion, gains_of(measured)
            yield SeenRow(
                row.slot_utc, measured.corrected, known.id, targets, motion, gains, measured.closure
            )


def _files(directory: Path, row: FrameSetRow) -> PairFiles:
    main, sub = (directory / name if name else None for name in (row.main, row.sub))
    return PairFiles(main, sub, moment=row_moment(row))


def _of_other_targets(chosen: Candidate, candidates: Sequence[Candidate]) -> list[DatumStep]:
    """Where further targets that the chosen answer leaves out were, by the next best one."""
    known, steps = set(chosen.step.targets), []
    believed = [one for one in candidates if not one.doubts and one is not chosen]
    for one in sorted(believed, key=lambda one: float(np.hypot(*one.sigma_mm))):
        more = {name: seen for name, seen in one.step.targets.items() if name not in known}
        if more:
            steps.append(replace(one.step, offset=None, targets=more))
            known |= set(more)
    return steps


def _why(chosen: Candidate, candidates: Sequence[Candidate]) -> str:
    """Why this answer was taken, as the end of its line."""
    believed = [one for one in candidates if not one.doubts]
    if chosen.step.method is DatumMethod.OLD_CALIBRATION:
        why = "board, lenses and cameras are the same by all that is known"
    elif len(believed) == 1 < len(candidates):
        why = "nothing else is believed"
    else:
        why = ""
    if len(believed) > 1:
        why = f"{why}{', and ' if why else ''}of {len(believed)} answers it has the least sigma"
    return f" ({why})" if why else ""


def _zero(
    chosen: Candidate,
    candidates: Sequence[Candidate],
    notes: Sequence[str],
    datums: dict[int, DatumRecord],
    new: NewReference,
    created_utc: datetime,
) -> Zero:
    """The link of the chosen answer, and what is said of it and of the others."""
    further = _of_other_targets(chosen, candidates)
    solved = {MAIN: offset_by(chosen.step, datums.get(chosen.step.from_id or 0), new.errors)}
    for step in (chosen.step, *further):
        solved |= targets_by(step, datums.get(step.from_id or 0), new.errors)
    shared = {name: one.shared for name, one in solved.items() if one.shared is not None}
    offset = solved.pop(MAIN).offset
    link = DatumRecord(
        method=chosen.step.method,
        offset=offset,
        steps=(chosen.step, *further),
        created_utc=created_utc,
        reference_utc=new.slot_utc,
        targets={name: one.offset for name, one in solved.items()},
        errors=new.errors,
        shared=shared,
        detail=chosen.words,
    )
    others = [f"zero: not {one.words}: {'; '.join(one.doubts)}" for one in candidates if one.doubts]
    if chosen.step.method is DatumMethod.LOST:
        first = chosen.words
    else:
        first = f"zero: {offset_text(chosen.offset)}, {chosen.words}{_why(chosen, candidates)}"
    against = [
        f"zero: WARNING: {one.words} it is {offset_text(one.offset)}: one of the two is wrong, a "
        "surveyed value would tell (dcam-ctl datum set)"
        for one in candidates
        if not one.doubts and contradicted(one, chosen, CONTRADICTION)
    ]
    return Zero(link, (first, *against, *others, *(f"zero: not {note}" for note in notes)))
