"""Gaps: every slot is measured or missed, exactly once, whatever happened in which order."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime, timedelta
from itertools import count, groupby, pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daemon.errors import SlotTakenError
from daemon.store.database import Store, open_store
from daemon.store.records import Coverage, GapCause, GapRecord
from daemon.store.runs import overlap, without
from tests.daemon.store.examples import BAD, PERIOD_S, full_measurement, record, slot

SLOTS = 24
CAUSES = (GapCause.CRASH, GapCause.CAMERA_LOST)
_STARTS = (datetime(2026, 1, 1, tzinfo=UTC) + timedelta(days=day) for day in count())
"""Each example has a day of its own, so that all may share one database."""

NUMBERS = st.integers(0, SLOTS - 1)
STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("measured"), NUMBERS, st.sampled_from(["bad", "suspect"])),
        st.tuples(st.sampled_from(CAUSES), NUMBERS, NUMBERS),
    ),
    max_size=12,
)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    with open_store(tmp_path_factory.mktemp("gaps")) as opened:
        yield opened


@pytest.fixture
def empty(tmp_path: Path) -> Iterator[Store]:
    with open_store(tmp_path) as opened:
        yield opened


def play(store: Store, start: datetime, steps: list[tuple]) -> dict[int, str]:
    """Do the steps to the store, and to a dictionary of slots beside it."""
    fate: dict[int, str] = {}
    for kind, one, other in steps:
        if kind == "measured":
            measurement = BAD if other == "bad" else full_measurement()
            try:
                store.add_measurement(record(slot(one, start), measurement))
            except SlotTakenError:
                assert fate[one] in {"bad", "suspect"}
            else:
                fate[one] = other
        else:
            first, last = sorted((one, other))
            new = [number for number in range(first, last + 1) if number not in fate]
            first_slot, last_slot = slot(first, start), slot(last, start)
            written = store.record_gap(first_slot, last_slot, kind, period_s=PERIOD_S)
            assert written == len(new)
            fate |= dict.fromkeys(new, kind.value)
    return fate


def accounts(path: Path, start: datetime) -> list[tuple[str, str]]:
    """Every (slot, fate) that the file holds for a day, as another program reads it."""
    day = start.strftime("%Y-%m-%d%%")
    with closing(sqlite3.connect(path)) as connection:
        rows = connection.execute(
            "SELECT slot_utc, CASE flag WHEN 4 THEN 'bad' ELSE 'suspect' END"
            " FROM measurement WHERE slot_utc LIKE ?",
            [day],
        ).fetchall()
        for first, last, slots, period_s, cause in connection.execute(
            "SELECT start_utc, end_utc, slots, period_s, cause FROM gap WHERE start_utc LIKE ?",
            [day],
        ):
            times = [
                datetime.fromisoformat(first) + timedelta(seconds=period_s * k)
                for k in range(slots)
            ]
            assert times[-1] == datetime.fromisoformat(last)
            rows += [(time.strftime("%Y-%m-%dT%H:%M:%SZ"), cause) for time in times]
    return sorted(rows)


@settings(max_examples=60)
@given(steps=STEPS)
def test_every_slot_has_one_fate(store: Store, steps: list[tuple]) -> None:
    start = next(_STARTS)
    fate = play(store, start, steps)
    expected = [(f"{slot(n, start):%Y-%m-%dT%H:%M:%SZ}", fate[n]) for n in sorted(fate)]
    assert accounts(store.path, start) == expected


@settings(max_examples=60)
@given(steps=STEPS)
def test_neighbours_of_one_cause_are_one_gap(store: Store, steps: list[tuple]) -> None:
    start = next(_STARTS)
    fate = play(store, start, steps)
    audit_slots = groupby(range(SLOTS), key=fate.get)
    runs = [(cause, list(numbers)) for cause, numbers in audit_slots if cause in CAUSES]
    assert store.gaps(start, start + timedelta(days=1)) == [
        GapRecord(slot(run[0], start), slot(run[-1], start), PERIOD_S, GapCause(cause))
        for cause, run in runs
    ]


@settings(max_examples=60)
@given(steps=STEPS, since=NUMBERS, until=NUMBERS)
def test_coverage_counts_each_slot_once(
    store: Store, steps: list[tuple], since: int, until: int
) -> None:
    start = next(_STARTS)
    fate = play(store, start, steps)
    audit_slots = [fate.get(number) for number in range(since, until)]
    found = store.coverage(slot(since, start), slot(until, start), period_s=PERIOD_S)
    assert found == Coverage(
        expected=len(audit_slots),
        good=0,
        suspect=audit_slots.count("suspect"),
        bad=audit_slots.count("bad"),
        missing=0,
        gaps={cause: audit_slots.count(cause) for cause in CAUSES if cause in audit_slots},
        unaccounted=audit_slots.count(None),
    )
    assert found.measured + found.missed + found.unaccounted == found.expected


RUNS = st.builds(
    lambda start, step, slots: range(start, start + step * slots, step),
    st.integers(0, 40),
    st.integers(1, 9),
    st.integers(1, 20),
)


@given(run=RUNS, taken=st.sets(st.integers(0, 250)))
def test_what_is_left_of_a_run(run: range, taken: set[int]) -> None:
    left = list(without(run, taken))
    assert [slot for rest in left for slot in rest] == [slot for slot in run if slot not in taken]
    assert all(one[-1] + run.step < other[0] for one, other in pairwise(left))


@given(one=RUNS, other=RUNS)
def test_what_two_runs_share(one: range, other: range) -> None:
    assert overlap(one, other) == len(set(one) & set(other))


def test_a_late_row_splits_its_gap_or_nothing_happens(empty: Store) -> None:
    empty.record_gap(slot(0), slot(4), GapCause.POWER_LOSS, "no mains", period_s=PERIOD_S)
    with closing(sqlite3.connect(empty.path, isolation_level=None)) as connection:
        connection.execute(
            "CREATE TRIGGER broken BEFORE INSERT ON measurement"
            " BEGIN SELECT RAISE(ABORT, 'no room'); END"
        )
        with pytest.raises(Exception, match="no room"):
            empty.add_measurement(record(slot(2)))
        assert [gap.slots for gap in empty.gaps()] == [5]
        connection.execute("DROP TRIGGER broken")
    empty.add_measurement(record(slot(2)))
    found = [(gap.first_slot_utc, gap.last_slot_utc, gap.detail) for gap in empty.gaps()]
    assert found == [(slot(0), slot(1), "no mains"), (slot(3), slot(4), "no mains")]


def test_a_growing_gap_keeps_its_first_detail(empty: Store) -> None:
    for number, detail in enumerate(("sub camera silent", "still silent")):
        there = slot(number)
        empty.record_gap(there, there, GapCause.CAMERA_LOST, detail, period_s=PERIOD_S)
    (gap,) = empty.gaps()
    assert (gap.slots, gap.detail) == (2, "sub camera silent")


def test_slots_of_another_period_are_not_in_a_gap(empty: Store) -> None:
    """After a change of the period, the times between the old slots are nobody's."""
    empty.record_gap(slot(0), slot(9), GapCause.STOPPED, period_s=PERIOD_S)
    between = slot(3) + timedelta(seconds=30)
    empty.add_measurement(record(between))
    (gap,) = empty.gaps()
    assert gap.slots == 10
    found = empty.coverage(slot(0), slot(10), period_s=30)
    assert (found.expected, found.bad, found.missed, found.unaccounted) == (20, 1, 10, 9)


def test_coverage_follows_the_offset(empty: Store) -> None:
    empty.add_measurement(record(slot(0) + timedelta(seconds=7)))
    empty.add_measurement(record(slot(1)))
    found = empty.coverage(slot(0), slot(2), period_s=PERIOD_S, offset_s=7)
    assert (found.expected, found.bad, found.unaccounted) == (2, 1, 1)


def test_a_run_must_fit_its_period(empty: Store) -> None:
    crooked = slot(1) + timedelta(seconds=1)
    for first, last in ((slot(0), crooked), (slot(2), slot(1))):
        with pytest.raises(ValueError, match="is not a run of slots 60 s apart"):
            empty.record_gap(first, last, GapCause.CRASH, period_s=PERIOD_S)


def test_the_file_itself_refuses_a_slot_both_measured_and_missed(empty: Store) -> None:
    empty.add_measurement(record(slot(0)))
    empty.record_gap(slot(1), slot(2), GapCause.CRASH, period_s=PERIOD_S)
    with closing(sqlite3.connect(empty.path, isolation_level=None)) as connection:
        with pytest.raises(sqlite3.IntegrityError, match="the slot lies in a gap"):
            connection.execute(
                "INSERT INTO measurement (slot_utc, flag, reasons, discs_found, corners_used,"
                " recorded_late, config_hash, version)"
                " VALUES ('2026-03-01T00:02:00Z', 4, '', 0, 0, 0, '', '')"
            )
        with pytest.raises(sqlite3.IntegrityError, match="a slot of the gap was measured"):
            connection.execute("UPDATE gap SET start_utc = '2026-03-01T00:00:00Z', slots = 3")
        with pytest.raises(sqlite3.IntegrityError, match="gap_slots"):
            connection.execute("UPDATE gap SET slots = 3")


def test_what_is_accounted_for_reaches_from_first_to_last(empty: Store) -> None:
    assert empty.accounted() is None
    empty.record_gap(slot(0), slot(1), GapCause.CRASH, period_s=PERIOD_S)
    empty.add_measurement(record(slot(2)))
    assert empty.accounted() == (slot(0), slot(2))
    assert empty.last_slot() == slot(2)
