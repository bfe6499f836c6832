"""Replay gives the measure rows of a frame set in order, then says that it is at its end."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from drivers.errors import DeviceError, FrameSetError
from drivers.frameset import FrameSetRow, encode_png, write_table
from drivers.replay import ReplaySource

SLOT = datetime(2026, 3, 1, tzinfo=UTC)


def later(minutes: int) -> datetime:
    return SLOT + timedelta(minutes=minutes)


def _write(directory: Path, *roles: str, slots: tuple[int, ...] = (), **extra: str) -> None:
    rows: list[FrameSetRow] = []
    for number, role in enumerate(roles):
        names = [f"{number}_{camera}.png" for camera in ("main", "sub")]
        for grey, name in enumerate(names, start=10 * number):
            (directory / name).write_bytes(encode_png(np.full((4, 6), grey, np.uint8)))
        slot = later(slots[number] if slots else number)
        if slots:
            extra = extra | {"burst": str(sum(row.slot_utc == slot for row in rows) + 1)}
        rows.append(FrameSetRow(slot, role, *names, extra=extra))
    write_table(directory, rows)


def test_measure_rows_come_in_order(tmp_path: Path) -> None:
    """Only measure rows, first to last; then an error that names the end."""
    _write(tmp_path, "reference", "rig", "measure", "measure")
    source = ReplaySource(tmp_path)
    pairs = [source.capture(later(0)), source.capture(later(1))]
    assert [(p.main.pixels[0, 0], p.sub.pixels[0, 0]) for p in pairs] == [(20, 21), (30, 31)]
    assert [p.main.frame_id for p in pairs] == [1, 2]
    assert (pairs[0].main.bits, pairs[0].skew_s) == (8, 0.0)
    for _ in range(2):
        with pytest.raises(DeviceError, match="end of the set"):
            source.capture(later(2))
    source.close()


def test_the_pairs_of_a_burst_come_within_their_slot(tmp_path: Path) -> None:
    """Asked again for a slot: its next pair; another slot has the next row, whatever was left."""
    _write(tmp_path, "measure", "measure", "measure", "measure", slots=(0, 0, 0, 1))
    source = ReplaySource(tmp_path)
    greys = [source.capture(later(0)).main.pixels[0, 0] for _ in range(2)]
    assert [*greys, source.capture(later(1)).main.pixels[0, 0]] == [0, 10, 30]
    with pytest.raises(DeviceError, match="no more pairs of this slot"):
        source.capture(later(1))


def test_what_the_archive_noted_comes_along(tmp_path: Path) -> None:
    """Skew, exposure, gain and temperature of an archived set are given back."""
    _write(tmp_path, "measure", skew_s="0.004", exposure_main_us="2000.0", temperature_sub_c="")
    pair = ReplaySource(tmp_path).capture(SLOT)
    assert (pair.skew_s, pair.main.exposure_us, pair.sub.temperature_c) == (0.004, 2000.0, None)


def test_a_damaged_row_fails_alone(tmp_path: Path) -> None:
    """A missing, damaged or unnamed image fails its slot with its role; the next row comes."""
    _write(tmp_path, "measure", "measure", "measure")
    (tmp_path / "0_main.png").unlink()
    (tmp_path / "1_sub.png").write_bytes((tmp_path / "1_sub.png").read_bytes()[:40])
    source = ReplaySource(tmp_path)
    with pytest.raises(DeviceError, match=r"0_main\.png: not there") as caught:
        source.capture(later(0))
    assert caught.value.role == "main"
    with pytest.raises(DeviceError, match=r"1_sub\.png: truncated") as caught:
        source.capture(later(1))
    assert caught.value.role == "sub"
    assert source.capture(later(2)).main.frame_id == 3


def test_a_set_without_measure_rows_is_refused(tmp_path: Path) -> None:
    """There is nothing to replay in a calibration set; a damaged table is refused as ever."""
    _write(tmp_path, "reference")
    with pytest.raises(FrameSetError, match="no 'measure' rows to replay"):
        ReplaySource(tmp_path)
    (tmp_path / "frames.csv").write_text("")
    with pytest.raises(FrameSetError, match="empty"):
        ReplaySource(tmp_path)
