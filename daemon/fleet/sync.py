"""A pier's record to the central database, each row once, through outages on either side."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event

from daemon.outputs.backoff import Backoff
from daemon.store.central.connecting import Central, CentralAwayError, open_central
from daemon.store.central.writing import BATCH, SiteFacts, announce, mirror, put_events, put_rows

MOST_FAILURES = 6
"""In a row, before a run ends: the timer starts the next one."""

Tell = Callable[[int, int | None], None]


@dataclass(slots=True)
class Copied:
    """What one run copied."""

    site_id: int = 0
    rows: int = 0
    events: int = 0
    others: int = 0
    """Gaps, calibrations, datums, ledger entries, marks that were new or had changed."""
    outages: int = 0


@dataclass(slots=True)
class Sync:
    """One run for one pier."""

    url: str
    password: str | None
    state: Path
    facts: SiteFacts
    tell: Tell = lambda _done, _total: None
    batch: int = BATCH
    backoff: Backoff = field(default_factory=lambda: Backoff(1.0, 30.0))
    stop: Event = field(default_factory=Event)
    copied: Copied = field(default_factory=Copied)

    def run(self, last: Callable[[Central, int], None] | None = None) -> Copied:
        """Copy what there is; `last` is called once all is copied.

        A server that goes away is asked again, ever more seldom as long as it stays away. Raises
        CentralAwayError, StoreError.
        """
        failures, done = 0, -1
        while True:
            try:
                self._copy(last)
            except CentralAwayError:
                failures = 0 if self._count() > done else failures + 1
                done = self._count()
                self.copied.outages += 1
                if failures >= MOST_FAILURES or self.stop.is_set():
                    raise
                if failures == 0:
                    self.backoff.reset()
                self.stop.wait(self.backoff.next_s())
            else:
                return self.copied

    def _count(self) -> int:
        return self.copied.rows + self.copied.events + self.copied.others

    def _copy(self, last: Callable[[Central, int], None] | None) -> None:
        central = open_central(self.url, self.password)
        try:
            site_id = self.copied.site_id = announce(central, self.state, self.facts)
            # What rows name goes before them.
            self.copied.others += mirror(central, self.state, site_id)
            while rows := put_rows(central, self.state, site_id, self.batch):
                self.copied.rows += rows
                self.tell(self.copied.rows, None)
            while events := put_events(central, self.state, site_id, self.batch):
                self.copied.events += events
            if last is not None:
                last(central, site_id)
        finally:
            central.close()
