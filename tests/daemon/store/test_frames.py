"""The frame archive: a frame set a day, pixel-exact, in order, mended after a cut."""

from __future__ import annotations

import errno
import os
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest

from daemon import durable
from daemon.errors import ArchiveError, DiskFullError, SlotTakenError
from daemon.store.frames.archive import FrameArchive, StoredPair
from daemon.store.records import CameraState
from drivers.errors import FrameSetError, ImageMissingError
from drivers.frameset import read_frame_set, read_image
from tests.daemon.store.examples import START, pair, slot

DAY = Path("frames/2026/03/01")


@pytest.fixture
def archive(tmp_path: Path) -> FrameArchive:
    return FrameArchive(tmp_path)


def listed(state: Path, day: Path = DAY) -> list[datetime]:
    """The slots of a day's table, as any reader of frame sets sees them."""
    return [row.slot_utc for row in read_frame_set(state / day).rows]


def test_a_pair_comes_back_pixel_for_pixel_with_its_circumstances(archive: FrameArchive) -> None:
    taken = START + timedelta(microseconds=2500)
    stored = archive.store(slot(0), pair(1), taken)
    assert stored == StoredPair(slot(0), f"{DAY}/000000_main.png", f"{DAY}/000000_sub.png")
    read = archive.load(slot(0))
    assert np.array_equal(read.main.pixels, pair(1).main.pixels)
    assert np.array_equal(read.sub.pixels, pair(1).sub.pixels)
    assert (read.main.pixels.dtype, read.main.bits) == (np.uint16, 12)
    assert (read.sub.pixels.dtype, read.sub.bits) == (np.uint8, 8)
    assert (read.skew_s, read.captured_utc) == (-0.0012, taken)
    assert read.main_camera == CameraState(10_000.5, 3.0, 41.5)
    assert read.sub_camera == CameraState(800.25, None, None)
    assert read.stored == stored


def test_a_day_is_a_frame_set(archive: FrameArchive, tmp_path: Path) -> None:
    for number in range(3):
        archive.store(slot(number), pair(number), START)
    table = tmp_path / DAY / "frames.csv"
    assert table.read_text().startswith("slot_utc,role,main,sub,pan_deg,tilt_deg,skew_s,")
    frame_set = read_frame_set(tmp_path / DAY)
    assert [row.role for row in frame_set.rows] == ["measure"] * 3
    for number, row in enumerate(frame_set.rows):
        assert row.slot_utc == slot(number)
        assert np.array_equal(frame_set.read(row.main).pixels, pair(number).main.pixels)
        assert np.array_equal(frame_set.read(row.sub).pixels, pair(number).sub.pixels)


def test_the_pairs_of_a_burst_stand_together(archive: FrameArchive, tmp_path: Path) -> None:
    """One slot, three pairs, each with its own line and circumstances; then the next slot."""
    for number in (1, 2, 3):
        there = replace(pair(number), skew_s=1e-3 * number)
        stored = archive.store(slot(0), there, START, number)
    archive.store(slot(1), pair(7))
    assert stored.main_path == f"{DAY}/000000_03_main.png"
    assert archive.stored_slots() == [slot(0), slot(1)]
    assert (archive.numbers(slot(0)), archive.numbers(slot(1))) == ([1, 2, 3], [1])
    assert archive.numbers(slot(2)) == []
    read = archive.load(slot(0), 2)
    assert np.array_equal(read.sub.pixels, pair(2).sub.pixels)
    assert read.skew_s == 2e-3
    rows = read_frame_set(tmp_path / DAY).rows
    assert [(row.slot_utc, row.burst) for row in rows] == [
        *((slot(0), number) for number in (1, 2, 3)),
        (slot(1), 1),
    ]
    with pytest.raises(SlotTakenError):
        archive.store(slot(0), pair(9), START, 2)


def test_a_burst_whose_lines_were_lost_is_mended(archive: FrameArchive, tmp_path: Path) -> None:
    """From the names of the images; a pair whose sub image is missing is none."""
    for number in (1, 2, 3):
        archive.store(slot(0), pair(number), START, number)
    (tmp_path / DAY / "000000_03_sub.png").unlink()
    cut(tmp_path / DAY / "frames.csv", 330)
    assert archive.repair() == [slot(0)]
    assert [row.burst for row in read_frame_set(tmp_path / DAY).rows] == [1, 2]
    assert archive.numbers(slot(0)) == [1, 2]
    assert archive.orphans([]) == [slot(0)]


def test_a_table_from_before_bursts_goes_on(archive: FrameArchive, tmp_path: Path) -> None:
    """Tables without the column get it with their next line."""
    archive.store(slot(0), pair(0), START)
    table = tmp_path / DAY / "frames.csv"
    table.write_text("\n".join(line.rpartition(",")[0] for line in table.read_text().splitlines()))
    with table.open("a") as file:
        file.write("\n")
    assert archive.load(slot(0)).skew_s == -0.0012
    archive.store(slot(1), pair(1), START)
    assert [row.burst for row in read_frame_set(tmp_path / DAY).rows] == [1, 1]
    assert archive.load(slot(0)).skew_s == -0.0012


def test_days_are_those_of_utc(archive: FrameArchive, tmp_path: Path) -> None:
    local = datetime(2026, 3, 2, 0, 30, tzinfo=timezone(timedelta(hours=1)))
    stored = archive.store(local, pair())
    assert stored.main_path == f"{DAY}/233000_main.png"
    assert archive.stored_slots() == [datetime(2026, 3, 1, 23, 30, tzinfo=UTC)]
    assert archive.load(local).skew_s == -0.0012


def test_a_slots_pair_is_never_overwritten(archive: FrameArchive, tmp_path: Path) -> None:
    archive.store(slot(0), pair(1))
    with pytest.raises(SlotTakenError, match="2026-03-01T00:00:00Z has a pair already"):
        archive.store(slot(0), pair(2))
    assert np.array_equal(archive.load(slot(0)).main.pixels, pair(1).main.pixels)
    assert listed(tmp_path) == [slot(0)]


def test_a_pair_that_comes_late_stands_at_its_place(archive: FrameArchive, tmp_path: Path) -> None:
    for number in (0, 3, 1, 5, 2):
        archive.store(slot(number), pair(number))
    assert listed(tmp_path) == [slot(number) for number in (0, 1, 2, 3, 5)]
    assert archive.load(slot(2)).skew_s == -0.0012


def test_orphans_are_complete_pairs_nobody_knows(archive: FrameArchive, tmp_path: Path) -> None:
    days = [slot(0), slot(1), slot(0) + timedelta(days=1), slot(0) + timedelta(days=40)]
    for there in days:
        archive.store(there, pair())
    (tmp_path / DAY / "000200_main.png").touch()
    (tmp_path / DAY / "999999_main.png").touch()
    (tmp_path / DAY / "999999_sub.png").touch()
    (tmp_path / "frames/2026/02/31").mkdir(parents=True)
    assert archive.stored_slots() == days
    assert archive.stored_slots(days[1]) == days[1:]
    assert archive.stored_slots(days[3] + timedelta(seconds=1)) == []
    assert archive.orphans({days[0], days[2]}) == [days[1], days[3]]
    assert FrameArchive(tmp_path / "nowhere").stored_slots() == []


def cut(path: Path, bytes_lost: int) -> None:
    """What a power cut leaves of the last line."""
    with path.open("r+b") as file:
        file.truncate(path.stat().st_size - bytes_lost)


@pytest.mark.parametrize("bytes_lost", [1, 30, 190])
def test_a_torn_line_is_mended_from_the_images(
    archive: FrameArchive, tmp_path: Path, bytes_lost: int
) -> None:
    for number in range(3):
        archive.store(slot(number), pair(number), START)
    whole = (tmp_path / DAY / "frames.csv").read_text().splitlines()
    cut(tmp_path / DAY / "frames.csv", bytes_lost)
    assert archive.load(slot(2)).skew_s is None
    assert archive.stored_slots() == [slot(0), slot(1), slot(2)]

    assert archive.repair() == [slot(2)]

    mended = (tmp_path / DAY / "frames.csv").read_text().splitlines()
    assert mended[:3] == whole[:3]
    assert listed(tmp_path) == [slot(0), slot(1), slot(2)]
    assert archive.repair() == []


def test_a_pair_stored_after_a_torn_line_leaves_a_whole_table(
    archive: FrameArchive, tmp_path: Path
) -> None:
    for number in range(2):
        archive.store(slot(number), pair(number))
    cut(tmp_path / DAY / "frames.csv", 30)
    archive.store(slot(2), pair(2))
    assert listed(tmp_path) in ([slot(0), slot(2)], [slot(0), slot(1), slot(2)])
    archive.repair()
    assert listed(tmp_path) == [slot(0), slot(1), slot(2)]


@pytest.mark.parametrize(
    "damage", [b"", b"slot_utc,role\n", b"\0" * 5000, b"x" * 9000, b"slot_utc,ro"]
)
def test_a_damaged_table_is_set_aside_and_written_again(
    archive: FrameArchive, tmp_path: Path, damage: bytes
) -> None:
    for number in range(2):
        archive.store(slot(number), pair(number))
    table = tmp_path / DAY / "frames.csv"
    table.write_bytes(damage)
    archive.store(slot(2), pair(2))
    archive.repair()
    assert listed(tmp_path) == [slot(0), slot(1), slot(2)]
    assert (tmp_path / DAY / "frames.csv.damaged-1").exists()
    assert archive.load(slot(2)).skew_s == -0.0012


def test_a_table_of_another_version_keeps_its_columns(
    archive: FrameArchive, tmp_path: Path
) -> None:
    archive.store(slot(0), pair(0))
    table = tmp_path / DAY / "frames.csv"
    table.write_text(
        "slot_utc,role,main,sub,pan_deg,tilt_deg,wind\n"
        "2026-03-01T00:00:00Z,measure,000000_main.png,000000_sub.png,,,strong\n"
    )
    archive.store(slot(1), pair(1))
    rows = read_frame_set(tmp_path / DAY).rows
    assert [row.extra["wind"] for row in rows] == ["strong", ""]
    assert [row.extra["skew_s"] for row in rows] == ["", "-0.0012"]


def test_leftovers_of_interrupted_writes_go(archive: FrameArchive, tmp_path: Path) -> None:
    archive.store(slot(0), pair())
    (tmp_path / DAY / ".000100_main.png.tmp").write_bytes(b"half an im")
    archive.repair()
    assert sorted(path.name for path in (tmp_path / DAY).iterdir()) == [
        "000000_main.png",
        "000000_sub.png",
        "frames.csv",
    ]


def test_a_damaged_image_is_an_error_and_not_a_picture(
    archive: FrameArchive, tmp_path: Path
) -> None:
    archive.store(slot(0), pair(0))
    archive.store(slot(1), pair(1))
    main = tmp_path / DAY / "000000_main.png"
    content = main.read_bytes()
    main.write_bytes(content[:-20])
    with pytest.raises(FrameSetError, match="000000_main"):
        archive.load(slot(0))
    main.write_bytes((tmp_path / DAY / "000100_main.png").read_bytes())
    with pytest.raises(FrameSetError, match="not the image that was stored"):
        archive.load(slot(0))
    main.unlink()
    with pytest.raises(ImageMissingError):
        archive.load(slot(0))
    main.write_bytes(content)
    assert np.array_equal(archive.load(slot(0)).main.pixels, pair(0).main.pixels)


def test_a_table_that_cannot_be_read_is_an_error_of_the_pair(
    archive: FrameArchive, tmp_path: Path
) -> None:
    archive.store(slot(0), pair(0))
    (tmp_path / DAY / "frames.csv").unlink()
    (tmp_path / DAY / "frames.csv").mkdir()
    with pytest.raises(FrameSetError, match=r"frames\.csv: cannot be read"):
        archive.load(slot(0))


def test_a_damaged_cell_does_not_cost_the_pair(archive: FrameArchive, tmp_path: Path) -> None:
    archive.store(slot(0), pair(0), START)
    table = tmp_path / DAY / "frames.csv"
    table.write_text(table.read_text().replace("-0.0012", "-0.0x12").replace("10000.5", "?"))
    read = archive.load(slot(0))
    assert read.skew_s is None
    assert read.main_camera == CameraState(None, 3.0, 41.5)


@pytest.mark.parametrize(
    ("number", "error", "words"),
    [
        (errno.ENOSPC, DiskFullError, "the disk is full"),
        (errno.EIO, ArchiveError, "check permissions and the health of the disk"),
    ],
)
def test_a_disk_that_refuses_leaves_no_half_image(
    archive: FrameArchive,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    number: int,
    error: type[Exception],
    words: str,
) -> None:
    archive.store(slot(0), pair(0))

    def refuse(_descriptor: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(durable.os, "fsync", refuse)
    with pytest.raises(error, match=words):
        archive.store(slot(1), pair(1))
    monkeypatch.undo()
    assert archive.stored_slots() == [slot(0)]
    assert not list((tmp_path / DAY).glob(".*"))
    archive.store(slot(1), pair(1))
    assert listed(tmp_path) == [slot(0), slot(1)]


def test_a_place_that_is_no_directory_is_named(tmp_path: Path) -> None:
    (tmp_path / "frames").touch()
    with pytest.raises(ArchiveError, match="frames"):
        FrameArchive(tmp_path).store(slot(0), pair())


def test_numbers_of_numpy_are_written_as_numbers(archive: FrameArchive, tmp_path: Path) -> None:
    archive.store(slot(0), replace(pair(), skew_s=np.float64(0.25)))
    assert ",0.25," in (tmp_path / DAY / "frames.csv").read_text()
    assert read_image(tmp_path / DAY / "000000_sub.png").bits == 8


def test_readings_stand_beside_their_pair(archive: FrameArchive, tmp_path: Path) -> None:
    """A column each; empty where a sensor gave nothing; also for whoever reads the frame set."""
    archive.store(slot(0), pair(0), readings={"air": 21.5, "steel-1": None})
    archive.store(slot(1), pair(1), readings={"air": -3.25, "steel-1": 8.0})
    rows = read_frame_set(tmp_path / DAY).rows
    assert [row.readings for row in rows] == [{"air": 21.5}, {"air": -3.25, "steel-1": 8.0}]
    assert [row.main_temperature_c for row in rows] == [41.5, 41.5]
    assert [row.sub_temperature_c for row in rows] == [None, None]
    assert archive.load(slot(1)).readings == {"air": -3.25, "steel-1": 8.0}


def test_readings_may_come_and_go_within_a_day(archive: FrameArchive, tmp_path: Path) -> None:
    """As when the config is read again: every line keeps what it had."""
    given = [{}, {"air": 1.0}, {"air": 2.0, "water": 3.0}, {"water": 4.0}, {}]
    for number, readings in enumerate(given):
        archive.store(slot(number), pair(number), readings=readings)
    archive.store(slot(2), pair(2), number=2, readings={"air": 2.5})
    rows = read_frame_set(tmp_path / DAY).rows
    assert [row.readings for row in rows] == [*given[:3], {"air": 2.5}, *given[3:]]
    assert [archive.load(slot(number)).readings for number in range(5)] == given


def test_a_table_with_readings_is_not_written_again_for_a_line(
    archive: FrameArchive, tmp_path: Path
) -> None:
    """The file stays the same one, whether a slot has all of its readings or not."""
    archive.store(slot(0), pair(0), readings={"air": 1.0, "water": 2.0})
    before = (tmp_path / DAY / "frames.csv").stat().st_ino
    archive.store(slot(1), pair(1), readings={"air": None, "water": 2.0})
    archive.store(slot(2), pair(2), readings={"water": 2.0})
    archive.store(slot(3), pair(3))
    assert (tmp_path / DAY / "frames.csv").stat().st_ino == before
