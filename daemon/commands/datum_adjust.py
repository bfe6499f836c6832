"""`dcam-ctl datum adjust`: frames that two calibrations measure, and the chain fitted to them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from core.results import Displacement
from daemon.commands.options import Options
from daemon.commands.output import note, progress
from daemon.commands.reprocess import chosen_calibration
from daemon.datum.chain import NOTHING, relinked
from daemon.datum.choice import CONTRADICTION
from daemon.datum.overlap import FEWEST, overlap_step
from daemon.errors import UsageError, WorkFailedError
from daemon.reprocessing.frames import KeptFrames, SetFrames, SlotFrames, measure_alone
from daemon.slots.measuring import ActiveCalibration
from daemon.store.database import NEVER, Store
from daemon.store.datum_fields import offset_text
from daemon.store.records import DatumMethod, DatumRecord

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
    """The links that change when the frames' say is added. Raises WorkFailedError, UsageError."""
    if wanted.earlier_id >= wanted.later_id:
        msg = f"--with {wanted.earlier_id} is not earlier than calibration {wanted.later_id}"
        raise UsageError(msg)
    earlier, later = (
        chosen_calibration(options.config, options.state, number)
        for number in (wanted.earlier_id, wanted.later_id)
    )
    near_utc = _reference_time(store, later)
    site, slots = options.config.site(), _slots(options, wanted, near_utc)
    with progress(len(slots), "measuring with both") as steps:
        measured = []
        for slot in slots:
            by_earlier, by_later = (measure_alone(slot, site, one) for one in (earlier, later))
            measured.append((by_earlier, by_later))
            steps.next()
    step, count = overlap_step(measured, wanted.earlier_id)
    if step is None or step.offset is None:
        msg = (
            f"{count} of {len(slots)} pairs are good by both calibrations, {FEWEST} are needed: "
            "name others with --since and --until, or --from"
        )
        raise WorkFailedError(msg)
    if not wanted.board_untouched:
        _require_agreement(step.offset, links, wanted)
    note(f"{count} pairs measured by both: {offset_text(step.offset)} between the references")
    now_utc = datetime.now(UTC)
    unlinked = DatumRecord(DatumMethod.ADJUSTED, NOTHING, (), now_utc, near_utc)
    before = links.get(wanted.later_id, unlinked)
    link = replace(
        before,
        method=DatumMethod.ADJUSTED,
        steps=(*before.steps, step),
        detail=f"{count} pairs measured with calibration {wanted.earlier_id} too, adjusted",
    )
    return relinked(links, {wanted.later_id: link}, now_utc)


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
    step: Displacement, links: Mapping[int, DatumRecord], wanted: Wanted
) -> None:
    """Raise WorkFailedError where the present links contradict the frames."""
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
    variances = np.diag(known.covariance_mm2) + np.diag(step.covariance_mm2)
    if (np.abs(known.mm - step.mm) > CONTRADICTION * np.sqrt(variances)).any():
        msg = (
            f"the frames say {offset_text(step)}, the present link {offset_text(known)}: the "
            "board, a lens or a camera was touched between the two calibrations; if you know "
            "that none was, give --board-untouched"
        )
        raise WorkFailedError(msg)
