"""Frames go by age and by size; rows stay, and so do events, the newest and what has no row."""

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from structlog.testing import capture_logs

from daemon.errors import DiskFullError
from daemon.retention import retention as retention_module
from daemon.retention.retention import Retention
from daemon.retention.rules import Rules, chosen
from daemon.store.frames import removal as frame_removal
from daemon.store.frames.removal import files_of_day
from daemon.store.records import Thinning
from drivers.errors import DeviceLostError
from drivers.frameset import read_frame_set
from tests.daemon.conftest import START, Station
from tests.daemon.rows import add_rows
from tests.daemon.store.examples import pair, record

PERIOD_S = 1800
A_DAY = 48
"""Slots."""


@pytest.fixture
def state() -> Iterator[Path]:
    """A state directory in memory: months of slots are synced a hundred thousand times."""
    with TemporaryDirectory(dir="/dev/shm") as directory:
        yield Path(directory) / "state"


KEEP_ALL = Rules(min_free_gb=0.0, reserve_mb=0)
SHRINKING = Rules(every_slot_days=1, hourly_days=2, frames_days=3, min_free_gb=0.0, reserve_mb=0)


@contextmanager
def stationed(state: Path, rules: Rules) -> Iterator[Station]:
    station = Station(state, PERIOD_S, rules)
    try:
        yield station
    finally:
        station.store.close()


def filled(station: Station, days: int, slots_a_day: int = A_DAY) -> None:
    """Days of slots with frames and rows, from midnight of the first; as a daemon leaves them."""
    first = START.replace(hour=0, minute=0, second=0)
    slots = [first + n * timedelta(days=1) / slots_a_day for n in range(days * slots_a_day)]
    for number, slot in enumerate(slots):
        station.archive.store(slot, pair(number % 7))
    add_rows(station.store, map(record, slots))


def retention(station: Station, rules: Rules) -> Retention:
    return Retention(station.store, station.archive, rules, station.clock)


def work_off(keeper: Retention, station: Station, steps: int = 100) -> None:
    last = station.store.last_slot()
    assert not all(keeper.step(last, float("inf")) for _ in range(steps)), "never comes to an end"


def kept(station: Station) -> dict[int, int]:
    """Day of March to how many slots have frames, from the files alone."""
    return dict(Counter(slot.day for slot in station.archive.stored_slots()))


def assert_distinguished(station: Station) -> None:
    """Each row's frames are there, or known to have been removed; tables name what is there."""
    there = set(station.archive.stored_slots())
    for row in station.store.measurements():
        assert (row.slot_utc in there) is not station.store.frames_removed(row.slot_utc)
    for day in station.archive.days():
        directory = station.archive.day_directory(day)
        listed = {row.slot_utc for row in read_frame_set(directory).rows}
        assert listed == {slot for slot in there if slot.date() == day}
        images = {slot.strftime("%H%M%S") for slot in listed}
        assert {path.name[:6] for path in directory.glob("*.png")} == images


def test_frames_thin_out_as_they_age_and_rows_stay(state: Path) -> None:
    """Of the newest day all, then one an hour, then one a day; the first began at noon."""
    with stationed(state, SHRINKING) as station:
        station.run(int(4.5 * A_DAY))
        assert len(station.minutes()) == 4.5 * A_DAY
        assert kept(station) == {3: 1, 4: 24, 5: A_DAY}
        assert_distinguished(station)
        assert not (station.state / "frames/2026/03/01").exists()
        reported = [event.detail for event in station.store.events(kind="frames_removed")]
        assert reported[0].startswith("2026-03-01: 12 slots removed in all, 12 kept (hourly)")
        assert len(reported) == 3 + 3 + 2 + 1


def test_an_hours_pair_is_a_good_one_and_a_days_one_of_daylight(state: Path) -> None:
    rows = {
        START.replace(hour=h, minute=m, second=0): "too_dark" for h in range(24) for m in (0, 30)
    }
    noon = START.replace(hour=20, minute=30, second=0)
    rows[noon] = rows[noon - timedelta(minutes=30)] = ""
    assert chosen(rows, Thinning.DAILY, ()) == {noon}
    hourly = chosen(rows, Thinning.HOURLY, {START.replace(hour=3, minute=0, second=0)})
    assert len(hourly) == 25
    assert noon in hourly


GONE = DeviceLostError("the main camera is gone", "main")


def test_pairs_beside_events_gaps_and_slips_stay(state: Path) -> None:
    """A camera is lost for two hours, and once for a slot; a calibration is activated."""

    def lost() -> None:
        raise GONE

    rules = Rules(1, 1, 1, min_free_gb=0.0, reserve_mb=0)
    with stationed(state, KEEP_ALL) as station:
        station.run(2 * A_DAY, dict.fromkeys((*range(4, 8), 16), lost))
        station.store.add_event(START + timedelta(hours=10), "calibration_activated", "1")
        work_off(retention(station, rules), station)
        first = [slot.strftime("%H:%M") for slot in station.archive.stored_slots()][:6]
        assert first == ["13:30", "16:00", "19:30", "20:30", "21:30", "22:00"]
        assert_distinguished(station)


def test_events_all_the_time_keep_no_more_than_one_an_hour_would(state: Path) -> None:
    with stationed(state, KEEP_ALL) as station:
        filled(station, 2)
        for number in range(100):
            station.store.add_event(
                station.store.last_slot() - timedelta(days=1, minutes=number), "x"
            )
        work_off(retention(station, Rules(1, 1, 1, min_free_gb=0.0, reserve_mb=0)), station)
        assert kept(station)[1] <= 24


def test_what_has_no_row_stays_whatever_its_age(state: Path) -> None:
    """Its frames are the only trace of a slot, until someone measures them."""
    with stationed(state, KEEP_ALL) as station:
        filled(station, 4)
        orphan = START.replace(hour=5, minute=10, second=0)
        station.archive.store(orphan, pair(1))
        work_off(retention(station, SHRINKING), station)
        assert kept(station) == {1: 1, 2: 1, 3: 24, 4: A_DAY}
        assert station.archive.orphans(station.store.measured_slots()) == [orphan]
        assert read_frame_set(station.state / "frames/2026/03/01").rows[0].slot_utc == orphan


@pytest.mark.parametrize("far", [timedelta(days=9000), -timedelta(days=9000)])
def test_a_clock_gone_wild_ages_nothing(state: Path, far: timedelta) -> None:
    """A day counts by those after it that have frames, not by what the clock says."""
    with stationed(state, KEEP_ALL) as station:
        filled(station, 2)
        wild = station.store.last_slot() + far
        station.archive.store(wild, pair(1))
        station.store.add_measurement(record(wild))
        rules = Rules(every_slot_days=3, hourly_days=3, min_free_gb=0.0, reserve_mb=0)
        keeper = retention(station, rules)
        for _ in range(50):
            keeper.step(wild, float("inf"))
        assert len(station.archive.stored_slots()) == 2 * A_DAY + 1


def test_a_long_absence_costs_no_frames(state: Path) -> None:
    with stationed(state, Rules(2, 2, 2, min_free_gb=0.0, reserve_mb=0)) as station:
        station.run(4)
        station.clock.advance(86_400 * 500)
        station.run(4)
        station.run(4)
        assert len(station.archive.stored_slots()) == 12


def test_too_large_an_archive_shrinks_in_proportion_and_keeps_the_newest(state: Path) -> None:
    """No term is up, but the frames may take no more than a part of what they do."""
    with stationed(state, KEEP_ALL) as station:
        filled(station, 8)
        keeper = retention(station, KEEP_ALL)
        work_off(keeper, station)
        whole = sum(day.bytes for day in station.store.frame_days())
        limit = Rules(8, 16, frames_max_gb=0.55 * whole / 1e9, min_free_gb=0.0, reserve_mb=0)
        work_off(retention(station, limit), station)
        counts = list(kept(station).values())
        assert counts == [1, 1, 1, 24, 24, A_DAY, A_DAY, A_DAY]
        assert sum(day.bytes for day in station.store.frame_days()) <= 0.55 * whole
        assert_distinguished(station)


def test_a_full_disk_takes_all_but_the_newest_hour_events_last(
    state: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Something else fills the disk: what could be removed is, and nothing is removed in vain."""
    with stationed(state, KEEP_ALL) as station:
        filled(station, 3)
        station.store.add_event(START, "started")
        keeper = retention(station, Rules(min_free_gb=1.0, reserve_mb=1))
        monkeypatch.setattr(Retention, "free_bytes", 1e8)
        work_off(keeper, station)
        # Noon of the first day is an event; of the last day the last hour stays as it is.
        assert kept(station) == {1: 2, 3: 25}
        assert_distinguished(station)
        monkeypatch.setattr(Retention, "free_bytes", 1e6)
        work_off(keeper, station)
        assert kept(station) == {3: 25}
        assert_distinguished(station)


def test_a_day_thinned_before_its_end_is_thinned_to_its_end(
    state: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with stationed(state, KEEP_ALL) as station:
        filled(station, 1)
        keeper = retention(station, Rules(1, 2, min_free_gb=1.0, reserve_mb=1))
        with monkeypatch.context() as full:
            full.setattr(Retention, "free_bytes", 1e8)
            keeper.step(START.replace(hour=12), float("inf"))
        assert kept(station) == {1: 12 + 24}
        monkeypatch.setattr(Retention, "free_bytes", 1e10)
        station.archive.store(START + timedelta(hours=18), pair())
        keeper.step(station.store.last_slot() + timedelta(days=1), float("inf"))
        assert kept(station) == {1: 24, 2: 1}
        assert_distinguished(station)


def test_removal_that_is_cut_anywhere_is_finished_by_the_next_daemon(state: Path) -> None:
    """Cut before each file, table and row: half a pair is never measured, none comes back."""

    class Cut(BaseException):
        pass

    def cutting(after: int) -> Callable[..., Callable[..., object]]:
        left = [after]

        def wrap(function: Callable[..., object]) -> Callable[..., object]:
            def call(*arguments: object, **options: object) -> object:
                left[0] -= 1
                if left[0] < 0:
                    raise Cut
                return function(*arguments, **options)

            return call

        return wrap

    rules = Rules(1, 1, 1, min_free_gb=0.0, reserve_mb=0)
    cuts = 0
    while True:
        with stationed(state / str(cuts), KEEP_ALL) as station:
            filled(station, 2, slots_a_day=6)
            filled_before = station.store.measured_slots()
            with pytest.MonkeyPatch.context() as patched:
                wrap = cutting(cuts)
                patched.setattr(Path, "unlink", wrap(Path.unlink))
                patched.setattr(Path, "rmdir", wrap(Path.rmdir))
                patched.setattr(frame_removal, "prune", wrap(frame_removal.prune))
                patched.setattr(
                    type(station.store), "put_frame_day", wrap(type(station.store).put_frame_day)
                )
                was_cut = False
                try:
                    work_off(
                        retention(station, Rules(1, 1, 1, min_free_gb=0.0, reserve_mb=0)), station
                    )
                except Cut:
                    was_cut = True
            station.archive.repair()
            assert station.archive.orphans(station.store.measured_slots()) == []
            work_off(retention(station, rules), station)
            assert kept(station) == {2: 6}
            assert_distinguished(station)
            assert station.store.measured_slots() == filled_before
        if not was_cut:
            break
        cuts += 1
    assert cuts > 12 + 3


FULL = DiskFullError("the disk is full")


def test_a_disk_too_full_for_the_ledger_is_freed_all_the_same(
    state: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As long as images take all the room, nothing can be written, not even what goes."""
    with stationed(state, KEEP_ALL) as station:
        filled(station, 2)
        real = station.store.put_frame_day

        def put(day: object) -> None:
            if len(list(station.state.rglob("*.png"))) > 2 * A_DAY * 2 - 10:
                raise FULL
            real(day)

        monkeypatch.setattr(station.store, "put_frame_day", put)
        monkeypatch.setattr(retention_module, "MOST_FILES", 8)
        keeper = retention(station, Rules(min_free_gb=1.0, reserve_mb=0))
        monkeypatch.setattr(Retention, "free_bytes", 1e8)
        for _ in range(3):
            keeper.step(station.store.last_slot(), float("inf"))
        work_off(keeper, station)
        assert kept(station) == {2: 25}
        assert_distinguished(station)


def test_no_file_is_begun_after_the_deadline(state: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A slow disk: a tenth of a second a file."""
    with stationed(state, KEEP_ALL) as station:
        filled(station, 3)
        unlink = Path.unlink

        def slow(path: Path, missing_ok: bool = False) -> None:
            station.clock.advance(0.1)
            unlink(path, missing_ok)

        monkeypatch.setattr(Path, "unlink", slow)
        keeper = retention(station, SHRINKING)
        begun_s = station.clock.monotonic_s()
        keeper.step(station.store.last_slot(), begun_s + 0.95)
        assert 0.9 < station.clock.monotonic_s() - begun_s < 1.05
        assert len(list(station.state.rglob("*.png"))) == 6 * A_DAY - 10
        assert len(station.archive.stored_slots()) == 3 * A_DAY - 5


def test_a_day_that_cannot_be_removed_stops_no_other(state: Path) -> None:
    """Its directory is immutable, or the disk bad there: reported once, not at each slot."""
    with stationed(state, KEEP_ALL) as station:
        filled(station, 4)
        bad = station.state / "frames/2026/03/01"
        unlink = Path.unlink
        with pytest.MonkeyPatch.context() as patched:

            def refuse(path: Path, missing_ok: bool = False) -> None:
                if path.parent == bad:
                    raise PermissionError(1, "Operation not permitted", str(path))
                unlink(path, missing_ok)

            patched.setattr(Path, "unlink", refuse)
            with capture_logs() as logs:
                work_off(retention(station, SHRINKING), station)
        assert kept(station) == {1: A_DAY, 2: 1, 3: 24, 4: A_DAY}
        errors = [log["event"] for log in logs if log["log_level"] == "error"]
        assert errors == ["day_not_thinned"]
        work_off(retention(station, SHRINKING), station)
        assert kept(station) == {2: 1, 3: 24, 4: A_DAY}


def test_a_link_that_leads_out_of_the_archive_is_not_followed(tmp_path: Path) -> None:
    """A day that somebody moved elsewhere, with a link in its place, is his to keep."""
    day = tmp_path / "state/frames/2026/03/01"
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "000000_main.png").write_bytes(b"1")
    day.parent.mkdir(parents=True)
    day.symlink_to(elsewhere)
    with pytest.raises(OSError, match="leads out of the archive"):
        files_of_day(day)


def test_an_archive_that_is_a_link_itself_is_the_archive(tmp_path: Path) -> None:
    """Frames on a larger disk: a common and a good arrangement."""
    (tmp_path / "disk/2026/03/01").mkdir(parents=True)
    (tmp_path / "disk/2026/03/01/000000_main.png").write_bytes(b"1")
    (tmp_path / "frames").symlink_to(tmp_path / "disk")
    assert len(files_of_day(tmp_path / "frames/2026/03/01").images) == 1
