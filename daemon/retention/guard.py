"""A disk that fills up or fails: frames go before measurements, and it is reported once.

Space is used up in this order: the frames end where the reserve begins (`reserve_mb` free), rows go
on into that; when it is gone the reserve file is given up, and rows have as much again.
"""

from __future__ import annotations

import shutil
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import structlog

from daemon.errors import ArchiveError, DiskFullError, StoreError
from daemon.retention.event_kinds import KEPT_AGAIN, NOT_KEPT, RESERVE_BACK, RESERVE_GONE
from daemon.retention.reserve import Reserve
from daemon.retention.retention import Retention
from daemon.retention.rules import Rules
from daemon.store.database import Store
from daemon.store.frames.archive import FrameArchive
from daemon.store.sqlite import FILE_NAME
from daemon.times import slot_text
from drivers.protocols import Clock

_log = structlog.get_logger("dcam.daemon")

STEP_S = 1.0
"""The longest that a step between two slots may take."""
STEP_SHARE = 0.25
"""Of the time to the next slot."""
NEEDED_TO_OPEN_BYTES = 200_000
"""The log and its index that SQLite makes when it opens a database."""
MOST_UNTOLD = 32
"""Lines of the history that wait for a database that takes them."""


@dataclass(frozen=True, slots=True)
class _Line:
    time_utc: datetime
    kind: str
    detail: str


class DiskGuard:
    """Watches the room for one state directory; for the daemon's own thread only."""

    def __init__(self, store: Store, archive: FrameArchive, rules: Rules, clock: Clock) -> None:
        self._store = store
        self._state = archive.state
        self._rules = rules
        self._clock = clock
        self._retention = Retention(store, archive, rules, clock)
        self._reserve = Reserve(archive.state, rules.reserve_bytes)
        self._had_reserve = True
        self._refused: str | None = None
        """Why the last frames were not kept."""
        self._lost_slots = 0
        """Slots without their frames since then."""
        self._trouble: str | None = None
        """What kept the last step from being done."""
        self._untold: deque[_Line] = deque(maxlen=MOST_UNTOLD)

    # In a slot

    def require_room(self) -> None:
        """Refuse frames that would take what the rows need.

        Raises DiskFullError, and ArchiveError where the state directory has gone away.
        """
        if not (self._state / FILE_NAME).exists():
            msg = f"{self._state}: the database is not there: is the disk mounted?"
            raise ArchiveError(msg)
        size = self._rules.reserve_bytes
        wanted = size if self._reserve.is_whole else 2 * size
        try:
            free = shutil.disk_usage(self._state).free
        except OSError as error:
            msg = f"{self._state}: {error.strerror}: check the health of the disk"
            raise ArchiveError(msg) from error
        if free < wanted:
            msg = f"{self._state}: only {free / 1e6:.0f} MB are left: free some space"
            raise DiskFullError(msg)

    def frames_refused(self, slot_utc: datetime, error: StoreError) -> None:
        """Note that a slot goes without its frames; the first time it is reported."""
        self._lost_slots += 1
        if self._refused is None:
            _log.error("frames_not_kept", slot=slot_text(slot_utc), error=str(error))
            self._tell(NOT_KEPT, f"from slot {slot_text(slot_utc)}: {error}")
        self._refused = str(error)

    def frames_kept(self, slot_utc: datetime) -> None:
        """Note that a slot has its frames; the first time after some had not, it is reported."""
        if self._refused is None:
            return
        _log.info("frames_kept_again", slot=slot_text(slot_utc), slots_without=self._lost_slots)
        detail = f"from slot {slot_text(slot_utc)}, after {self._lost_slots} slots without"
        self._tell(KEPT_AGAIN, detail)
        self._refused, self._lost_slots = None, 0

    def with_room(self, write: Callable[[], None]) -> None:
        """Write to the database, into the reserve if there is no other room. Raises StoreError."""
        try:
            write()
        except DiskFullError:
            if not self._give_up_reserve():
                raise
            write()

    # Between slots

    def tend(self, slot_utc: datetime, room_s: float) -> None:
        """See to reserve and retention, within a share of the time to the next slot."""
        deadline_s = self._clock.monotonic_s() + min(STEP_S, STEP_SHARE * room_s)
        if room_s <= 0:
            return
        try:
            self._tend_reserve()
            self._retention.step(slot_utc, deadline_s)
            self._write_untold()
        except (StoreError, OSError) as error:
            if self._trouble is None:
                _log.error("disk_not_tended", error=str(error))
            self._trouble = str(error)
            return
        self._trouble = None

    def make_room(self, steps: int) -> None:
        """Before the first slot on a full disk: remove what the rules let go. Raises StoreError."""
        accounted = self._store.accounted()
        if accounted is None:
            return
        slot_utc = accounted[1]
        for _ in range(steps):
            if self._retention.free_bytes >= 2 * self._rules.reserve_bytes:
                return
            if not self._retention.step(slot_utc, float("inf")):
                return

    def _tend_reserve(self) -> None:
        size, free = self._rules.reserve_bytes, shutil.disk_usage(self._state).free
        if not self._reserve.is_whole and free >= 2 * size:
            self._reserve.make()
            if not self._had_reserve:
                self._tell(RESERVE_BACK, f"{size / 1e6:.0f} MB")
            self._had_reserve = True
        elif size and free < size / 4:
            self._give_up_reserve()

    def _give_up_reserve(self) -> bool:
        try:
            given = self._reserve.give_up()
        except OSError as error:
            _log.error("reserve_not_given_up", error=str(error))
            return False
        if given:
            self._had_reserve = False
            _log.warning("reserve_given_up", size_mb=self._rules.reserve_mb)
            self._tell(RESERVE_GONE, f"{self._rules.reserve_mb} MB, for rows: the disk is full")
        return given

    def _tell(self, kind: str, detail: str) -> None:
        self._untold.append(_Line(self._clock.now_utc(), kind, detail))

    def _write_untold(self) -> None:
        while self._untold:
            line = self._untold[0]
            self._store.add_event(line.time_utc, line.kind, line.detail)
            self._untold.popleft()


def relieve(state: Path) -> None:
    """Before the database is opened: give up the reserve of a disk that is full to the last."""
    try:
        if state.is_dir() and shutil.disk_usage(state).free < NEEDED_TO_OPEN_BYTES:
            Reserve(state, 1).give_up()
    except OSError as error:
        _log.error("reserve_not_given_up", error=str(error))
