"""How far an output has come in the record, kept on the disk: what was acknowledged stays so."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

from daemon.durable import make_directory_durable, write_durable
from daemon.errors import HardwareError
from daemon.file_errors import file_error_text
from daemon.store.queries.arrivals import Arrival, Arrivals
from daemon.store.queries.progress import Progress


class CursorError(HardwareError):
    """The file that says what was sent cannot be used."""


@dataclass(slots=True)
class Cursor:
    """What one output was given."""

    path: Path
    progress: Progress = field(default_factory=Progress)

    def begin(self, arrivals: Arrivals, *, history: bool, again_since: datetime | None) -> None:
        """Begin where the file says; without one at the record's beginning, or at its end.

        `again_since` goes back to the first row that was written of slots from then on. Raises
        CursorError.
        """
        if not self._read():
            self.progress.start(arrivals, history=history)
        if again_since is not None:
            before = arrivals.id_before(again_since)
            self.progress.row_id = min(self.progress.row_id, before)
        self._write()

    def pending(self, arrivals: Arrivals, limit: int) -> list[Arrival]:
        """The next rows to pass on, in order; first those whose time was put right since."""
        return self.progress.pending(arrivals, limit)

    def advance(self, rows: Sequence[Arrival]) -> None:
        """Note that rows, the first of the pending ones, were acknowledged. Raises CursorError."""
        if rows:
            self.progress.note(rows)
            self._write()

    def _read(self) -> bool:
        try:
            content = json.loads(self.path.read_bytes())
        except FileNotFoundError:
            return False
        except OSError as error:
            raise CursorError(file_error_text(error)) from error
        except ValueError:
            content = None
        try:
            self.progress.take(content)
        except (KeyError, TypeError, ValueError, AttributeError):
            msg = (
                f"{self.path}: damaged: remove it, and send --again-since the time of the last rows"
            )
            raise CursorError(msg) from None
        return True

    def _write(self) -> None:
        content = json.dumps(self.progress.content()).encode()
        try:
            make_directory_durable(self.path.parent)
            write_durable(self.path, content)
        except OSError as error:
            raise CursorError(file_error_text(error)) from error
