"""Which readings have begun to fail, and which are back: said once each."""

from __future__ import annotations

from collections.abc import Iterable

import structlog

from daemon.errors import StoreError
from daemon.store.database import Store
from daemon.store.records import READING_BACK, READING_FAILED, Reading
from drivers.protocols import Clock

_log = structlog.get_logger("dcam.daemon")

BACK_AFTER = 3
"""Values in a row: a loose contact is one fault, not hundreds."""


class Changes:
    """Follows the readings from row to row."""

    def __init__(self, store: Store, clock: Clock) -> None:
        self._store = store
        self._clock = clock
        self._good_since: dict[str, int] = {}
        """Of each reading that fails: how many values there have been since."""

    def begin(self) -> None:
        """Go on from the last row: what failed before a restart is not told again."""
        last = self._store.last_slot()
        record = self._store.measurement(last) if last is not None else None
        readings = record.readings if record else ()
        self._good_since = {one.name: 0 for one in readings if one.value is None}

    def note(self, readings: Iterable[Reading]) -> None:
        """Take the readings of a row that is written; log and enter what has changed."""
        for one in readings:
            if one.value is None and one.name in self._good_since:
                self._good_since[one.name] = 0
            elif one.value is None:
                self._good_since[one.name] = 0
                _log.warning(READING_FAILED, reading=one.name, cause=one.cause)
                self._enter(READING_FAILED, f"{one.name}: {one.cause}")
            elif one.name in self._good_since:
                self._good_since[one.name] += 1
                if self._good_since[one.name] >= BACK_AFTER:
                    del self._good_since[one.name]
                    _log.info(READING_BACK, reading=one.name, value=one.value, unit=one.unit)
                    self._enter(READING_BACK, f"{one.name}: {one.value:g} {one.unit}")

    def _enter(self, kind: str, detail: str) -> None:
        try:
            self._store.add_event(self._clock.now_utc(), kind, detail)
        except StoreError as error:
            _log.error("event_not_recorded", error=str(error))
