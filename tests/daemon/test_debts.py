"""What the database did not take: bounded while it refuses, recorded when it takes it."""

from datetime import timedelta

import pytest

from daemon import debts as debts_module
from daemon.debts import Debts
from daemon.schedule import MissedSlots
from daemon.store.errors import DatabaseUnwritableError
from daemon.store.records import GapCause
from tests.daemon.conftest import START, Station
from tests.store.examples import pair

FIRST = START + timedelta(seconds=30)


def one(number: int) -> MissedSlots:
    slot = FIRST + timedelta(minutes=number)
    return MissedSlots(slot, slot, 1)


def test_months_of_refusal_take_no_memory(station: Station, monkeypatch) -> None:
    """Causes that change with each slot among them; no slot is forgotten."""
    monkeypatch.setattr(debts_module, "MOST_OWED", 50)
    debts = Debts(station.line, station.schedule)
    for number in range(10_000):
        debts.owe(one(number), GapCause.STORAGE_FAILED, "EROFS")
    for number in range(10_000, 10_200):
        debts.owe(one(number), list(GapCause)[number % 5], "flickers")
    assert len(debts._owed) <= 50
    debts.settle()
    assert debts.are_settled
    first = station.store.gaps()[0]
    assert (first.slots, first.detail) == (10_000, "EROFS")
    assert sum(gap.slots for gap in station.store.gaps()) == 10_200


def test_many_kept_pairs_are_measured_a_few_between_two_slots(station: Station) -> None:
    """All were kept while the database refused; the first gap is whole, then it shrinks."""
    for number in range(30):
        station.archive.store(one(number).first_utc, pair(number))
    debts = Debts(station.line, station.schedule)
    debts.owe(MissedSlots(one(0).first_utc, one(29).first_utc, 30), GapCause.STORAGE_FAILED, "")
    debts.settle()
    assert station.minutes() == list(range(20))
    assert station.gaps() == [(20, 29, "storage_failed")]
    debts.settle()
    assert station.minutes() == list(range(30))
    assert station.gaps() == []


def test_a_late_pair_waits_for_a_database_that_takes_it(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    station.archive.store(one(0).first_utc, pair())
    debts = Debts(station.line, station.schedule)
    debts.owe(one(0), GapCause.STORAGE_FAILED, "")
    refused = DatabaseUnwritableError("EIO")

    def refuse(_record: object) -> None:
        raise refused

    with monkeypatch.context() as failing:
        failing.setattr(station.store, "add_measurement", refuse)
        debts.settle()
        debts.settle()
    assert station.gaps() == [(0, 0, "storage_failed")]
    debts.settle()
    assert (station.minutes(), station.gaps()) == ([0], [])
