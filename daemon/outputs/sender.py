"""Passes rows on to one output, each once, as long as it is wanted."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from threading import Event

import structlog

from daemon.error_report import lines_of
from daemon.errors import StoreError
from daemon.outputs.backoff import Backoff
from daemon.outputs.cursor import Cursor, CursorError
from daemon.outputs.output import NotTakenError, Output
from daemon.store.queries.arrivals import open_arrivals

_log = structlog.get_logger("dcam.daemon")

LOOK_EVERY_S = 2.0
"""For new rows: reading where the table ends costs a millisecond."""
DIRECTORY = "send"
"""Below the state directory: how far each output has come."""


def cursor_path(state: Path, name: str) -> Path:
    """The file that says how far an output has come."""
    return state / DIRECTORY / f"{name}.json"


@dataclass(slots=True)
class Sender:
    """One output's way through the record."""

    state: Path
    output: Output
    again_since: datetime | None = None
    stop: Event = field(default_factory=Event)
    look_every_s: float = LOOK_EVERY_S
    backoff: Backoff = field(default_factory=Backoff)
    sent: int = 0
    _cursor: Cursor | None = None
    _said: str = ""

    def send_all(self) -> int:
        """Send what is there; give how many rows. Raises StoreError, NotTakenError, CursorError."""
        try:
            while self._step():
                pass
        finally:
            self.output.close()
        return self.sent

    def follow(self) -> None:
        """Send what is there and what comes until `stop` is set; wait for whatever is missing."""
        try:
            while not self.stop.is_set():
                try:
                    went_on = self._step()
                except (StoreError, NotTakenError, CursorError) as error:
                    self._tell(error)
                    self.stop.wait(self.backoff.next_s())
                else:
                    self._tell_well()
                    if not went_on:
                        self.stop.wait(self.look_every_s)
        finally:
            self.output.close()

    def _step(self) -> bool:
        """Pass some rows on; give whether there were any."""
        with open_arrivals(self.state) as arrivals:
            if self._cursor is None:
                cursor = Cursor(cursor_path(self.state, self.output.name))
                cursor.begin(arrivals, history=self.output.history, again_since=self.again_since)
                self._cursor = cursor
            rows = self._cursor.pending(arrivals, self.output.batch)
            latest = arrivals.latest()
        # The database is closed: a server that takes its time keeps nothing of it.
        taken = len(rows)
        try:
            self.output.send(rows, latest)
        except NotTakenError as error:
            taken = error.taken
            raise
        finally:
            self._cursor.advance(rows[:taken])
            self.sent += taken
        return bool(rows)

    def _tell(self, error: Exception) -> None:
        """Say what is wrong, once as long as it is the same."""
        text = "; ".join(lines_of(error))
        if text != self._said:
            _log.warning("not_sent", output=self.output.name, why=text)
        self._said = text

    def _tell_well(self) -> None:
        self.backoff.reset()
        if self._said:
            _log.info("sending_again", output=self.output.name)
        self._said = ""
