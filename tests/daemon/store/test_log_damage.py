"""One bit of SQLite's write-ahead log changes, and not one acknowledged row is lost unnoticed.

What SQLite makes of each damaged log is asked of SQLite itself.
"""

from __future__ import annotations

import random
import shutil
import sqlite3
from collections.abc import Callable, Iterable
from contextlib import closing
from itertools import islice
from pathlib import Path

import pytest

from daemon.errors import DatabaseDamagedError
from daemon.store.damage_note import databases_set_aside
from daemon.store.database import open_store
from daemon.store.opening import open_checked_store
from daemon.store.records import GapCause, Mark
from daemon.store.salvage.damage import Depth, find_damage
from tests.daemon.store.examples import PERIOD_S, START, record, slot
from tests.exhaustive import one_of

ROWS = 2
HEADER, FRAME_HEADER, PAGE, SECTOR = 32, 24, 4096, 512
LOG = "dcam.db-wal"


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A state directory as SIGKILL left it: rows, a gap and an event are in the log alone."""
    root = tmp_path_factory.mktemp("killed")
    with open_store(root / "live"):
        pass  # the tables are in the file, the log begins now
    with open_store(root / "live") as store:
        for number in range(ROWS):
            store.add_measurement(record(slot(number)))
        store.record_gap(slot(ROWS), slot(ROWS + 3), GapCause.CRASH, period_s=PERIOD_S)
        store.add_event(START, "happened", "last of all")
        shutil.copytree(root / "live", root / "killed")
    return root / "killed"


@pytest.fixture(scope="module")
def log(killed: Path) -> bytes:
    content = (killed / LOG).read_bytes()
    assert (len(content) - HEADER) % (FRAME_HEADER + PAGE) == 0
    return content


class Trial:
    """A state directory whose log may be damaged over and over."""

    def __init__(self, killed: Path, directory: Path) -> None:
        self.state = Path(shutil.copytree(killed, directory))
        self._killed = killed

    def damage(self, log: bytes) -> None:
        (self.state / "dcam.db-shm").unlink(missing_ok=True)
        (self.state / LOG).write_bytes(log)

    def loses_rows(self) -> bool:
        """Whether SQLite would not give everything that was written."""
        for name in ("dcam.db", LOG):
            shutil.copy(self.state / name, self.state.with_name(f"asked-{name}"))
        asked = self.state.with_name("asked-dcam.db")
        with closing(sqlite3.connect(asked)) as connection:
            found = [
                connection.execute(f"SELECT count(*) FROM {table}").fetchone()[0]
                for table in ("measurement", "gap")
            ]
            (events,) = connection.execute(
                "SELECT count(*) FROM event WHERE kind = 'happened'"
            ).fetchone()
        return [*found, events] != [ROWS, 1, 1]

    def is_noticed(self) -> bool:
        return find_damage(self.state / "dcam.db", Depth.PAGES) is not None

    def restart(self) -> tuple[int, int, int]:
        """Start as dcamd does; how many rows, gaps and events are there then."""
        with open_checked_store(self.state) as store:
            counts = (
                len(store.measured_slots()),
                len(store.gaps()),
                len(store.events(kind="happened")),
            )
        for path in databases_set_aside(self.state):
            path.unlink()
        for name in ("dcam.db", "dcam.db-shm"):
            (self.state / name).unlink(missing_ok=True)
        shutil.copy(self._killed / "dcam.db", self.state)
        return counts


def with_bit(content: bytes, bit: int) -> bytes:
    changed = bytearray(content)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


def header_bits(log: bytes) -> Iterable[int]:
    """Every bit of the log's header and of its first and last two frames' headers.

    Of the frames between, every third, another third in each.
    """
    yield from range(8 * HEADER)
    frames = range(HEADER, len(log), FRAME_HEADER + PAGE)
    for number, frame in enumerate(frames):
        bits = range(8 * frame, 8 * (frame + FRAME_HEADER))
        between = 2 <= number < len(frames) - 2
        yield from bits[number % 3 :: 3] if between else bits


def test_no_bit_of_a_header_loses_anything_unnoticed(
    killed: Path, log: bytes, tmp_path: Path, tally: Callable[[str], None]
) -> None:
    """Bit by bit; every twentieth time the start is made and everything is there after it."""
    trial = Trial(killed, tmp_path / "state")
    harmful = unnoticed = starts = 0
    for number, bit in enumerate(islice(header_bits(log), 0, None, one_of(11))):
        trial.damage(with_bit(log, bit))
        if trial.loses_rows():
            harmful += 1
            unnoticed += not trial.is_noticed()
        if number % 20 == 0:
            starts += 1
            assert trial.restart() == (ROWS, 1, 1), f"bit {bit}"
    tally(
        f"write-ahead log, one bit of a header changed: {number + 1} bits, SQLite would lose rows "
        f"at {harmful}, unnoticed {unnoticed}, lost after {starts} starts: 0"
    )
    assert unnoticed == 0
    assert harmful > number / 2


def test_no_bit_of_a_page_loses_anything_either(killed: Path, log: bytes, tmp_path: Path) -> None:
    """The bit is put right by the frame's checksum, also in the last commit of all."""
    trial = Trial(killed, tmp_path / "state")
    rng = random.Random(7)
    frames = range(HEADER, len(log), FRAME_HEADER + PAGE)
    for frame in [*rng.sample(frames, 4), frames[-1]]:
        trial.damage(with_bit(log, 8 * (frame + FRAME_HEADER) + rng.randrange(8 * PAGE)))
        assert trial.restart() == (ROWS, 1, 1), f"frame at {frame}"


@pytest.mark.parametrize("offset", [3, 7, 10, 15, 18, HEADER + 9, HEADER + 13])
def test_the_damaged_log_is_set_aside_and_kept(
    killed: Path, log: bytes, tmp_path: Path, offset: int
) -> None:
    state = Path(shutil.copytree(killed, tmp_path / "state"))
    (state / "dcam.db-shm").unlink()
    damaged = with_bit(log, 8 * offset)
    (state / LOG).write_bytes(damaged)
    with open_checked_store(state) as store:
        assert store.measured_slots() == {slot(number) for number in range(ROWS)}
        (event,) = store.events(kind="database_salvaged")
        assert "log" in event.detail
        assert f"kept {ROWS} rows, 1 gaps" in event.detail
    (aside,) = databases_set_aside(state)
    assert aside.with_name(f"{aside.name}-wal").read_bytes() == damaged


def test_a_command_that_writes_refuses_a_damaged_log(
    killed: Path, log: bytes, tmp_path: Path
) -> None:
    """Only dcamd may set a database aside; anyone else's first commit would overwrite the log."""
    state = Path(shutil.copytree(killed, tmp_path / "state"))
    (state / "dcam.db-shm").unlink()
    (state / LOG).write_bytes(with_bit(log, 8 * 18))
    with pytest.raises(DatabaseDamagedError, match="restart dcamd"):
        open_store(state)


def test_random_bytes_for_a_log_are_damage(killed: Path, log: bytes, tmp_path: Path) -> None:
    trial = Trial(killed, tmp_path / "state")
    for seed in range(10):
        trial.damage(random.Random(seed).randbytes(random.Random(-seed).randrange(33, len(log))))
        assert trial.is_noticed(), f"seed {seed}"


@pytest.mark.parametrize("offset", [3, 6, 10, 17, 20, 25, 30])
def test_a_log_of_one_commit_is_found_behind_a_damaged_header(tmp_path: Path, offset: int) -> None:
    with open_store(tmp_path / "live"):
        pass
    with open_store(tmp_path / "live") as store:
        store.set_mark(Mark.BOOT_ID, "boot-2")
        shutil.copytree(tmp_path / "live", tmp_path / "killed")
    content = (tmp_path / "killed" / LOG).read_bytes()
    (tmp_path / "killed" / LOG).write_bytes(with_bit(content, 8 * offset))
    with open_checked_store(tmp_path / "killed") as store:
        assert store.get_mark(Mark.BOOT_ID) == "boot-2"


def test_frames_from_before_the_log_was_begun_again_are_no_damage(tmp_path: Path) -> None:
    """After a checkpoint SQLite writes over the log from its start; what is behind is old."""
    with open_store(tmp_path / "live") as store:
        for number in range(30):
            store.add_measurement(record(slot(number)))
        with closing(sqlite3.connect(store.path)) as connection:
            connection.execute("PRAGMA wal_checkpoint(RESTART)").fetchall()
        store.add_measurement(record(slot(30)))
        shutil.copytree(tmp_path / "live", tmp_path / "killed")
    assert find_damage(tmp_path / "killed/dcam.db", Depth.PAGES) is None
    with open_checked_store(tmp_path / "killed") as store:
        assert len(store.measured_slots()) == 31
    assert databases_set_aside(tmp_path / "killed") == []


def last_commit(directory: Path, *, begun_again: bool) -> tuple[bytes, bytes]:
    """The log before and after a row's commit; in `directory` what a kill before it left.

    Behind what was written since it was begun again lies the log from before.
    """
    with open_store(directory / "live") as store:
        for number in range(10):
            store.add_measurement(record(slot(number)))
        with closing(sqlite3.connect(store.path)) as connection:
            if begun_again:
                connection.execute("PRAGMA wal_checkpoint(RESTART)").fetchall()
            store.add_measurement(record(slot(10)))
            shutil.copytree(directory / "live", directory / "killed")
        log = store.path.with_name(LOG)
        before = log.read_bytes()
        store.add_measurement(record(slot(11)))
        after = log.read_bytes()
    (directory / "killed/dcam.db-shm").unlink()
    return before, after


def half_written(before: bytes, after: bytes) -> Iterable[bytes]:
    """The log with a part of the sectors of its last commit: all but one, the first ones, any."""
    sectors = [
        start
        for start in range(0, len(after), SECTOR)
        if before[start : start + SECTOR] != after[start : start + SECTOR]
    ]
    rng = random.Random(1)
    kept = [[other for other in sectors if other != missing] for missing in sectors]
    kept += [sectors[:count] for count in range(len(sectors))]
    kept += [rng.sample(sectors, rng.randrange(len(sectors))) for _ in range(20)]
    for starts in kept:
        image = bytearray(before.ljust(max(starts, default=0) + 1, b"\0"))
        for start in starts:
            image[start : start + SECTOR] = after[start : start + SECTOR]
        yield bytes(image)


@pytest.mark.parametrize("begun_again", [False, True])
def test_a_commit_that_a_cut_left_half_written_is_no_damage(
    tmp_path: Path, begun_again: bool
) -> None:
    """A disk writes sectors in any order; of rows that were acknowledged nothing is missing."""
    path = tmp_path / "killed/dcam.db"
    before, after = last_commit(tmp_path, begun_again=begun_again)
    for log in half_written(before, after):
        path.with_name(LOG).write_bytes(log)
        assert find_damage(path, Depth.NEWEST) is None
    with open_checked_store(path.parent) as store:
        assert len(store.measured_slots()) == 11
    assert databases_set_aside(path.parent) == []


def test_sectors_lost_of_an_earlier_commit_are_damage(tmp_path: Path) -> None:
    """Before the last commit began, all others were on the disk as a whole."""
    path = tmp_path / "killed/dcam.db"
    before, after = last_commit(tmp_path, begun_again=False)
    end = len(before) - PAGE - FRAME_HEADER
    for start in (end + FRAME_HEADER, end - PAGE):
        lost = after[:start] + bytes(SECTOR) + after[start + SECTOR :]
        path.with_name(LOG).write_bytes(lost)
        assert find_damage(path, Depth.NEWEST) is not None


@pytest.mark.parametrize("torn", [0, 7, 12, 20, 31])
def test_a_header_that_a_cut_left_half_written_is_no_damage(tmp_path: Path, torn: int) -> None:
    """The log was to begin over; the database has all that the old frames hold."""
    with open_store(tmp_path / "live") as store:
        for number in range(30):
            store.add_measurement(record(slot(number)))
        log = store.path.with_name(LOG)
        with closing(sqlite3.connect(store.path)) as connection:
            connection.execute("PRAGMA wal_checkpoint(RESTART)").fetchall()
            shutil.copytree(tmp_path / "live", tmp_path / "killed")
        before = log.read_bytes()
        store.add_measurement(record(slot(30)))
        after = log.read_bytes()
    torn_header = after[:torn] + before[torn:HEADER]
    (tmp_path / "killed" / LOG).write_bytes(torn_header + before[HEADER:])
    (tmp_path / "killed/dcam.db-shm").unlink()
    with open_checked_store(tmp_path / "killed") as store:
        assert len(store.measured_slots()) == 30
    assert databases_set_aside(tmp_path / "killed") == []
