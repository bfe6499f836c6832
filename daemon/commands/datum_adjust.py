"""`dcam-ctl datum adjust`: the chain fitted to frames that two calibrations measure, or to rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from core.results import Displacement
from core.rig.reference_places import errors_at_reference
from daemon.commands.options import Options
from daemon.commands.output import note, progress
from daemon.commands.reprocess import chosen_calibration
from daemon.datum.across import WITHIN, Across, by_rows_across, replacing
from daemon.datum.candidates import camera_changes
from daemon.datum.chain import NOTHING, relinked
from daemon.datum.choice import CONTRADICTION, ROWS_BACK, stored_rows
from daemon.datum.overlap import FEWEST, overlap_step
from daemon.errors import UsageError, WorkFailedError
from daemon.reprocessing.frames import KeptFrames, SetFrames, SlotFrames, measure_alone
from daemon.slots.measuring import ActiveCalibration
from daemon.store.database import NEVER, Store
from daemon.store.queries.datum_fields import offset_text
from daemon.store.records import DatumMethod, DatumRecord, DatumStep
from daemon.store.rows.circumstances import circumstances_of

MOST_PAIRS = 24
"""Kept pairs that are measured; more than some tens change nothing."""
NEAR = timedelta(days=2)
"""How far from the later reference they may be, unless said otherwise."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """What is to be measured with what."""

    earlier_id: int
    later_id: int
    directory: Path | None
    since: datetime | None
    until: datetime | None
    board_untouched: bool


def adjusted(
    options: Options, store: Store, links: Mapping[int, DatumRecord], wanted: Wanted
) -> dict[int, DatumRecord]:
    """The links that change when frames and rows have their say.

    Raises WorkFailedError, UsageError.
    """
    if wanted.earlier_id >= wanted.later_id:
        msg = f"--with {wanted.earlier_id} is not earlier than calibration {wanted.later_id}"
        raise UsageError(msg)
    earlier, later = (
        chosen_calibration(options.config, options.state, number)
        for number in (wanted.earlier_id, wanted.later_id)
    )
    site = options.config.site()
    near_utc, now_utc = _reference_time(store, later), datetime.now(UTC)
    unlinked = DatumRecord(DatumMethod.ADJUSTED, NOTHING, (), now_utc, near_utc)
    before = links.get(wanted.later_id, unlinked)
    by_rows = _by_rows(store, near_utc, wanted)
    step, why = _by_frames(options, store, (earlier, later), wanted, near_utc)
    if step is not None and step.offset is not None:
        if not wanted.board_untouched:
            _require_agreement(step.offset, links, by_rows, wanted)
        steps, words = (*before.steps, step), f"{why}, adjusted"
    else:
        steps, words = _with_rows(before, by_rows, wanted, why)
    errors = before.errors or errors_at_reference(later.calibration.calibrated, site.sub)
    link = replace(before, method=DatumMethod.ADJUSTED, steps=steps, detail=words, errors=errors)
    return relinked(links, {wanted.later_id: link}, now_utc)


def _by_frames(
    options: Options,
    store: Store,
    both: tuple[ActiveCalibration, ActiveCalibration],
    wanted: Wanted,
    near_utc: datetime,
) -> tuple[DatumStep | None, str]:
    """What frames say that both calibrations measure, and how; None and why where they cannot."""
    made = [store.calibration(one.id or 0) for one in both]
    serials = [circumstances_of(one.content).serials for one in made if one is not None]
    changes = camera_changes(*serials)
    if changes:
        return None, "; ".join(changes)
    site, slots = options.config.site(), _slots(options, wanted, near_utc)
    measured = []
    with progress(len(slots), "measuring with both") as steps:
        for slot in slots:
            by_earlier, by_later = (measure_alone(slot, site, one) for one in both)
            measured.append((by_earlier, by_later))
            steps.next()
    step, count = overlap_step(measured, wanted.earlier_id)
    if step is None or step.offset is None:
        return None, (
            f"{count} of {len(slots)} pairs are good by both calibrations, {FEWEST} are needed: "
            "name others with --since and --until, or --from"
        )
    note(f"{count} pairs measured by both: {offset_text(step.offset)} between the references")
    return step, f"{count} pairs measured with calibration {wanted.earlier_id} too"


def _by_rows(store: Store, near_utc: datetime, wanted: Wanted) -> Across | None:
    """What the last rows by the earlier calibration and the first by the later one say."""
    rows = list(stored_rows(store, near_utc - ROWS_BACK, near_utc + WITHIN))
    before = [row for row in rows if row.slot_utc < near_utc]
    after = [row for row in rows if row.slot_utc > near_utc]
    return by_rows_across(
        [row for row in before if row.calibration_id == wanted.earlier_id],
        [row for row in after if row.calibration_id == wanted.later_id],
        wanted.earlier_id,
    )


def _with_rows(
    before: DatumRecord, by_rows: Across | None, wanted: Wanted, why: str
) -> tuple[tuple[DatumStep, ...], str]:
    """The link's steps with the rows' say, where they say more. Raises WorkFailedError."""
    if by_rows is None or by_rows.step.offset is None:
        msg = f"{why}; and no rows by calibrations {wanted.earlier_id} and {wanted.later_id} tell"
        raise WorkFailedError(msg)
    found = by_rows.step.offset
    note(f"not by frames: {why}")
    note(f"{by_rows.words}: {offset_text(found)} between the references")
    present = [step.offset for step in before.steps if step.offset is not None]
    if any(np.trace(one.covariance_mm2) <= np.trace(found.covariance_mm2) for one in present):
        msg = (
            f"the present link is known better ({offset_text(before.offset)}): it is left as it is"
        )
        raise WorkFailedError(msg)
    return replacing(before.steps, by_rows.step), f"{by_rows.words}, adjusted"


def _reference_time(store: Store, calibration: ActiveCalibration) -> datetime:
    if calibration.datum is not None and calibration.datum.reference_utc is not None:
        return calibration.datum.reference_utc
    made = store.calibration(calibration.id or 0)
    assert made is not None  # noqa: S101 - it was read a moment ago
    return made.created_utc


def _slots(options: Options, wanted: Wanted, near_utc: datetime) -> Sequence[SlotFrames]:
    """The slots to be measured, those next to the later reference."""
    if wanted.directory is not None:
        return list(SetFrames((wanted.directory,)).slots())
    since, until = wanted.since or near_utc - NEAR, wanted.until or near_utc + NEAR
    kept = KeptFrames(options.state, since, min(until, NEVER)).slots()
    return sorted(kept, key=lambda slot: abs(slot.slot_utc - near_utc))[:MOST_PAIRS]


def _require_agreement(
    step: Displacement,
    links: Mapping[int, DatumRecord],
    by_rows: Across | None,
    wanted: Wanted,
) -> None:
    """Raise WorkFailedError where the present links, or the rows, contradict the frames."""
    if by_rows is not None and by_rows.step.offset is not None:
        _require_no_contradiction(step, by_rows.step.offset, "the rows on both sides")
    earlier, later = (links.get(number) for number in (wanted.earlier_id, wanted.later_id))
    if later is None:
        return
    base = NOTHING if earlier is None else earlier.offset
    present = [own.offset for own in later.steps if own.from_id == wanted.earlier_id and own.offset]
    known = present[0] if present else None
    if known is None:
        known = Displacement(
            later.offset.mm - base.mm, later.offset.covariance_mm2 + base.covariance_mm2
        )
    _require_no_contradiction(step, known, "the present link")


def _require_no_contradiction(step: Displacement, known: Displacement, whose: str) -> None:
    variances = np.diag(known.covariance_mm2) + np.diag(step.covariance_mm2)
    if (np.abs(known.mm - step.mm) > CONTRADICTION * np.sqrt(variances)).any():
        msg = (
            f"the frames say {offset_text(step)}, {whose} {offset_text(known)}: the "
            "board, a lens or a camera was touched between the two calibrations; if you know "
            "that none was, give --board-untouched"
        )
        raise WorkFailedError(msg)
