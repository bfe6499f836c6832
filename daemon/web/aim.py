"""What `/api/aim` gives: what both cameras see, live or as the last stored slot shows it."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from datetime import datetime
from typing import Any

from daemon.plain import plain
from daemon.preview.shown import Shown
from daemon.store.queries.record_view import last_slot_with_frames
from daemon.times import slot_text
from daemon.web.record import Record
from daemon.web.worker import Worker

HOW_LIVE = "for the live view run dcam-ctl preview; dcamd pauses meanwhile"


class StoredLook:
    """The look at the last stored pair, worked out once for each."""

    def __init__(self, record: Record, worker: Worker) -> None:
        self._record = record
        self._worker = worker
        self._slot_utc: datetime | None = None
        self._fields: dict[str, Any] = {}
        self.pictures: dict[str, bytes] = {}

    def newest(self) -> tuple[datetime, dict[str, str]] | None:
        """The newest slot whose frames are there, and where they lie."""
        with self._record.reading() as connection:
            slot_utc = last_slot_with_frames(connection)
        if slot_utc is None:
            return None
        paths = {role: self._record.frame(slot_utc, role) for role in ("main", "sub")}
        found = {role: str(path) for role, path in paths.items() if path is not None}
        return (slot_utc, found) if len(found) == 2 else None

    async def fields(self, newest: tuple[datetime, dict[str, str]] | None) -> dict[str, Any]:
        """The answer. Raises WorkerError."""
        if newest is None:
            trouble = f"no stored frames; {HOW_LIVE}"
            return {"schema": 1, "live": False, "time": None, "trouble": trouble, "cameras": {}}
        slot_utc, paths = newest
        if slot_utc != self._slot_utc:
            asked = {"what": "look", "time": slot_utc.isoformat(), **paths}
            said = await self._worker.ask(asked)
            self.pictures = {
                name: base64.b64decode(data) for name, data in said["pictures"].items()
            }
            self._fields = said["look"]
            self._slot_utc = slot_utc
        return _answer(self._fields, slot_text(slot_utc), HOW_LIVE, is_live=False)


def live_fields(shown: Shown) -> dict[str, Any]:
    """The latest look of cameras that this process holds."""
    look, trouble = shown.now()
    if look is None:
        return {"schema": 1, "live": True, "time": None, "trouble": trouble, "cameras": {}}
    fields = plain(look.fields())
    return _answer(fields, fields["time_utc"], trouble, is_live=True)


def _answer(look: Mapping[str, Any], time: str, trouble: str, *, is_live: bool) -> dict[str, Any]:
    cameras = {
        role: {
            **camera,
            "frame": f"/aim/{role}.jpg?at={time}",
            "detail": f"/aim/{role}_detail.png?at={time}",
        }
        for role, camera in look["cameras"].items()
    }
    return {"schema": 1, "live": is_live, "time": time, "trouble": trouble, "cameras": cameras}
