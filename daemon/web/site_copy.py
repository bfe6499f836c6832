"""A copy of a site's record that is kept up to date while its page is looked at."""

from __future__ import annotations

import threading
import time

from daemon.config.outputs import FleetSection
from daemon.error_report import lines_of
from daemon.errors import DcamError
from daemon.fleet.site import FetchedSite, fetch

REFRESH_S = 60.0
"""From one look at the central database to the next; piers come every 5 minutes."""


class SiteCopy(threading.Thread):
    """One site's copy. What cannot be had is tried again; until then the last one is shown."""

    def __init__(self, settings: FleetSection, name: str) -> None:
        super().__init__(name=f"copy of {name}", daemon=True)
        self.site = name
        self.found: FetchedSite | None = None
        self.trouble = ""
        self.rows = 0
        """So far, of what is being fetched."""
        self.looked_s = time.monotonic()
        self.first = threading.Event()
        """Set when the first try is over."""
        self._settings = settings
        self._ended = threading.Event()

    def run(self) -> None:
        """Fetch, and fetch again."""
        while not self._ended.is_set():
            try:
                self.found = fetch(self._settings, self.site, self._tell)
                self.trouble = ""
            except (DcamError, OSError) as error:
                self.trouble = "; ".join(lines_of(error))
            self.first.set()
            self._ended.wait(REFRESH_S)

    def _tell(self, done: int, _total: int) -> None:
        self.rows = done

    def stop(self) -> None:
        """End after the present fetch."""
        self._ended.set()
