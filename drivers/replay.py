"""A frame set played as if two cameras took it: the `replay` backend."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

from drivers.errors import DeviceError, FrameSetError
from drivers.frameset import TEMPERATURES, FrameSetRow, optional_number, read_frame_set
from drivers.protocols import CapturedFrame, CapturedPair, Role


class ReplaySource:
    """Gives the `measure` rows of a frame set, a slot's for each slot; a `FramePairSource`.

    Asked again for the same slot, it gives the next pair of that row's burst.
    """

    def __init__(self, directory: Path) -> None:
        """Read the table. Raises FrameSetError when it is damaged or has no `measure` rows."""
        self._set = read_frame_set(directory)
        bursts = self._set.slots_of("measure")
        if not bursts:
            msg = f"{directory}: no 'measure' rows to replay; give a set that has some"
            raise FrameSetError(msg)
        self._bursts: Iterator[tuple[FrameSetRow, ...]] = iter(bursts)
        self._burst: Iterator[FrameSetRow] = iter(())
        self._slot: datetime | None = None
        self._number = 0

    def capture(self, slot_utc: datetime) -> CapturedPair:
        """Give the next pair. Raises DeviceError: an unusable image, or the end.

        A row that cannot be read is passed over by the next call.
        """
        if slot_utc != self._slot:
            self._slot, self._burst = slot_utc, iter(self._next_burst())
        row = next(self._burst, None)
        if row is None:
            msg = f"{self._set.directory}: no more pairs of this slot; set [schedule] burst lower"
            raise DeviceError(msg)
        self._number += 1
        number = self._number
        main, sub = self._frame("main", number, row), self._frame("sub", number, row)
        return CapturedPair(main, sub, skew_s=optional_number(row.extra.get("skew_s")) or 0.0)

    def _next_burst(self) -> tuple[FrameSetRow, ...]:
        burst = next(self._bursts, None)
        if burst is None:
            msg = f"{self._set.directory}: end of the set, all 'measure' rows are replayed"
            raise DeviceError(msg)
        return burst

    def prepare(self) -> None:
        """Open nothing: the table has been read."""

    def set_exposure(self, role: Role, exposure_us: float, gain_db: float | None) -> None:
        """Change nothing: the frames are taken."""

    def close(self) -> None:
        """Release nothing."""

    def _frame(self, role: Role, number: int, row: FrameSetRow) -> CapturedFrame:
        name = row.main if role == "main" else row.sub
        if name is None:
            msg = (
                f"{self._set.directory}: the {role} image of {row.slot_utc.isoformat()} is missing"
            )
            raise DeviceError(msg, role)
        try:
            image = self._set.read(name)
        except FrameSetError as error:
            raise DeviceError(str(error), role) from error
        return CapturedFrame(
            pixels=image.pixels,
            bits=image.bits,
            frame_id=number,
            camera_time_ns=round(row.slot_utc.timestamp() * 1e9),
            trigger_monotonic_s=0.0,
            exposure_us=optional_number(row.extra.get(f"exposure_{role}_us")),
            gain_db=optional_number(row.extra.get(f"gain_{role}_db")),
            temperature_c=optional_number(row.extra.get(TEMPERATURES[role])),
        )
