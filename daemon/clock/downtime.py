"""Why there was no daemon for a while, from the marks that the last one left."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass

from daemon.store.database import Store
from daemon.store.records import GapCause, Mark


@dataclass(frozen=True, slots=True)
class Absence:
    """What a gap before this boot is put down to."""

    cause: GapCause
    detail: str
    boot_id: str
    """The boot that ended the absence."""
    is_open: bool = False
    """Whether its gap is still to be recorded: the clock of that boot was before the last slot."""


def why_absent(store: Store, boot_id: str) -> tuple[GapCause, str]:
    """Tell why there was no daemon until now. Raises StoreError."""
    last_boot_id = store.get_mark(Mark.BOOT_ID)
    stopped_utc = store.get_mark(Mark.CLEAN_STOP_UTC)
    seen_utc = store.get_mark(Mark.HEARTBEAT_UTC)
    before = read_absence(store)
    if before is not None and before.is_open:
        waiting = len(store.undated(before.boot_id))
        detail = f"{before.detail}; then a run with a wrong clock, {waiting} undated pairs are kept"
        return before.cause, before.detail if before.boot_id == boot_id else detail
    if stopped_utc is not None:
        return GapCause.STOPPED, f"stopped at {stopped_utc}"
    salvaged = store.get_mark(Mark.SALVAGED)
    if salvaged is not None and last_boot_id == boot_id:
        return GapCause.STORAGE_FAILED, salvaged
    if salvaged is not None and last_boot_id is None:
        return GapCause.UNKNOWN, salvaged
    if last_boot_id is None:
        return GapCause.STOPPED, "dcamd had not run before"
    if last_boot_id != boot_id:
        return GapCause.POWER_LOSS, f"the machine went down without a stop; last seen {seen_utc}"
    return GapCause.CRASH, f"dcamd ended without a stop; last seen {seen_utc}"


def read_absence(store: Store) -> Absence | None:
    """Give the one before the latest boot, None if there was none yet. Raises StoreError."""
    text = store.get_mark(Mark.ABSENCE)
    if text is None:
        return None
    fields = json.loads(text)
    return Absence(**(fields | {"cause": GapCause(fields["cause"])}))


def absence_text(absence: Absence) -> str:
    """What the mark holds."""
    return json.dumps(asdict(absence))
