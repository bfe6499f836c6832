"""The central database has each row of each pier once, through cuts, restarts and kills."""

from __future__ import annotations

import sqlite3
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from sqlalchemy import Table, select, text

from daemon.errors import DatabaseNewerError, DatabaseOlderError, StoreError
from daemon.store.central.connecting import connect_central, open_central, prepare
from daemon.store.central.site_table import SITE
from daemon.store.central.tables import (
    CALIBRATION,
    CENTRAL,
    DATUM,
    EVENT,
    GAP,
    LEDGER,
    MEASUREMENT,
    to_sqlite,
)
from daemon.store.database import open_store
from daemon.store.ledger.entries import LedgerEntry, LedgerKind
from daemon.store.records import GapCause
from tests.daemon.fleet.conftest import Pier, add_rows, row_at, sync
from tests.daemon.fleet.postgres import Proxy, Server, cut_at_random
from tests.daemon.store.examples import START, calibration, datum, slot

COPIED = (MEASUREMENT, GAP, CALIBRATION, DATUM, LEDGER, EVENT)


def rows_here(state: Path, table: Table) -> list[dict[str, Any]]:
    """The rows of a pier's own database."""
    with closing(sqlite3.connect(state / "dcam.db")) as connection:
        connection.row_factory = sqlite3.Row
        found = connection.execute(f"SELECT * FROM {table.name} ORDER BY id")
        return [dict(row) for row in found]


def rows_there(url: str, table: Table, name: str = "pier-1") -> list[dict[str, Any]]:
    """The rows that the central database has of a site, as the pier's would hold them."""
    central = connect_central(url, None)
    with central.transaction() as connection:
        query = select(table).join(SITE, SITE.c.id == table.c.site_id).where(SITE.c.name == name)
        found = connection.execute(query.order_by(table.c.id)).mappings().all()
    central.close()
    return [to_sqlite(table, dict(row)) for row in found]


def test_what_a_pier_has_is_there_to_the_last_bit(server: Server, central: str, pier: Pier) -> None:
    state = pier("one", 60, START.replace(month=2, day=28, hour=23, minute=30))  # two months
    with open_store(state) as store:
        number = store.add_calibration(calibration(), datum(1.5, -2.5), activate=True)
        store.add_measurement(row_at(slot(200), number))
        store.record_gap(slot(300), slot(320), GapCause.POWER_LOSS, period_s=60)
        store.add_event(slot(5), "started", "with a ± in it")
        store.add_ledger_entry(
            LedgerEntry(LedgerKind.EXCLUDE, "ann", slot(9), "ladder", slot(1), slot(3), "main")
        )
    copied = sync(server.url(central), state)
    assert copied.rows == 61
    for table in COPIED:
        assert rows_there(server.url(central), table) == rows_here(state, table) != []
    assert sync(server.url(central), state).rows == 0  # the next time there is nothing to do


def test_each_row_is_there_once_whatever_is_cut_and_restarted(
    server: Server, central: str, pier: Pier
) -> None:
    names = ["pier-1", "pier-2", "pier-3"]
    states = [pier(name, 150) for name in names]

    def restart(number: int) -> None:
        if number in {5, 12}:
            server.stop()
            server.start()

    line = Proxy(server.port, cut_at_random(7, cuts=20, most_bytes=60_000, after=restart))
    url = server.url(central, line.port)
    with ThreadPoolExecutor(3) as pool:
        copies = [pool.submit(sync, url, *one, batch=10) for one in zip(states, names, strict=True)]
        for copy in copies:
            copy.result()
    line.close()
    assert line.cuts >= 20
    for state, name in zip(states, names, strict=True):
        found = rows_there(server.url(central), MEASUREMENT, name)
        assert found == rows_here(state, MEASUREMENT)


def test_one_run_goes_on_by_itself_after_a_cut(server: Server, central: str, pier: Pier) -> None:
    state = pier("one", 60)
    line = Proxy(server.port, cut_at_random(1, cuts=1, most_bytes=60_000))
    copied = sync(server.url(central, line.port), state, batch=10, tries=1)
    line.close()
    assert (line.cuts, copied.outages) == (1, 1)
    assert rows_there(server.url(central), MEASUREMENT) == rows_here(state, MEASUREMENT)


def test_copying_all_again_changes_nothing(server: Server, central: str, pier: Pier) -> None:
    state, url = pier("one", 20), server.url(central)
    sync(url, state)
    database = connect_central(url, None)
    with database.transaction() as connection:
        connection.execute(SITE.update().values(progress=None, event_id=0))
    database.close()
    assert sync(url, state).rows == 20
    assert rows_there(url, MEASUREMENT) == rows_here(state, MEASUREMENT)


def test_rows_that_come_later_and_late_are_copied(server: Server, central: str, pier: Pier) -> None:
    state = pier("one", 5)
    sync(server.url(central), state)
    add_rows(state, range(-40_000, -39_998))  # of a month before
    add_rows(state, range(5, 8))
    assert sync(server.url(central), state).rows == 5
    assert rows_there(server.url(central), MEASUREMENT) == rows_here(state, MEASUREMENT)


def test_rows_whose_times_were_put_right_are_there_under_their_true_slots_alone(
    server: Server, central: str, pier: Pier
) -> None:
    state = pier("one", 12)
    sync(server.url(central), state)
    with open_store(state) as store:  # each to where the next one was: backwards, as slots are free
        for minute in reversed(range(4, 12)):
            moved = replace(row_at(slot(minute + 1)), redated_from_utc=slot(minute))
            store.move_row(slot(minute), moved)
    sync(server.url(central), state, batch=3)  # several transactions
    assert rows_there(server.url(central), MEASUREMENT) == rows_here(state, MEASUREMENT)


@pytest.mark.parametrize("told_between", [False, True])
def test_rows_that_were_measured_again_are_there_once(
    server: Server, central: str, pier: Pier, *, told_between: bool
) -> None:
    """A measured-again row has another id, whether the centre had heard of its true slot or not."""
    state = pier("one", 12)
    sync(server.url(central), state)
    with open_store(state) as store:
        for minute in range(4, 12):
            moved = replace(row_at(slot(minute + 100)), redated_from_utc=slot(minute))
            store.move_row(slot(minute), moved)
        if told_between:
            sync(server.url(central), state)
        add_rows(state, range(12, 14))
        while (waiting := store.next_to_measure_again()) is not None:
            number, slot_utc = waiting
            measured = replace(row_at(slot_utc), redated_from_utc=slot_utc - slot(100) + slot(0))
            store.measured_again(number, measured)
    sync(server.url(central), state, batch=3)
    assert rows_there(server.url(central), MEASUREMENT) == rows_here(state, MEASUREMENT)


def test_gaps_that_grow_and_go_are_followed(server: Server, central: str, pier: Pier) -> None:
    state = pier("one", 1)
    with open_store(state) as store:
        store.record_gap(slot(10), slot(20), GapCause.POWER_LOSS, period_s=60)
        store.record_gap(slot(30), slot(40), GapCause.CRASH, period_s=60)
    sync(server.url(central), state)
    with open_store(state) as store:
        store.record_gap(slot(21), slot(25), GapCause.POWER_LOSS, period_s=60)
        store.cut_gaps_after(slot(28))
    sync(server.url(central), state)
    assert rows_there(server.url(central), GAP) == rows_here(state, GAP)
    assert len(rows_here(state, GAP)) == 1


def test_a_central_database_that_was_put_back_is_filled_again(
    server: Server, central: str, pier: Pier
) -> None:
    state = pier("one", 20)
    url = server.url(central)
    sync(url, state)
    database = connect_central(url, None)
    with database.transaction() as connection:
        before = connection.execute(select(SITE)).mappings().one()
    add_rows(state, range(20, 30))
    sync(url, state)
    with database.transaction() as connection:  # as a backup of between would have it
        connection.execute(MEASUREMENT.delete().where(MEASUREMENT.c.id > 20))
        connection.execute(SITE.update().values(progress=before["progress"]))
    database.close()
    assert sync(url, state).rows == 10
    assert rows_there(url, MEASUREMENT) == rows_here(state, MEASUREMENT)


def test_two_piers_of_one_name_are_refused(server: Server, central: str, pier: Pier) -> None:
    sync(server.url(central), pier("one", 1))
    with pytest.raises(StoreError, match="the name 'pier-1' is another database's"):
        sync(server.url(central), pier("two", 1))


def test_central_tables_are_those_of_the_models(server: Server, central: str) -> None:
    database = connect_central(server.url(central), None)
    with database.transaction() as connection:
        options = {"compare_type": True, "include_name": _not_a_month}
        context = MigrationContext.configure(connection, opts=options)
        assert compare_metadata(context, CENTRAL) == []
    database.close()


def _not_a_month(name: str | None, kind: str, _parents: object) -> bool:
    return not (kind == "table" and str(name).startswith("measurement_"))


@pytest.mark.parametrize(
    ("revision", "error", "says"),
    [
        ("0000", DatabaseNewerError, "install that version here"),
        (None, DatabaseOlderError, "run dcam-ctl sync --prepare"),
    ],
)
def test_another_revision_of_the_central_tables_is_one_clear_line(
    server: Server, central: str, revision: str | None, error: type[StoreError], says: str
) -> None:
    database = connect_central(server.url(central), None)
    with database.transaction() as connection:
        if revision is None:
            connection.execute(text("DROP TABLE alembic_version"))
        else:
            connection.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    database.close()
    with pytest.raises(error, match=says) as found:
        open_central(server.url(central), None)
    assert "\n" not in str(found.value)


def test_tables_are_made_once(server: Server, empty: str) -> None:
    database = connect_central(server.url(empty), None)
    assert prepare(database)[0] is None
    before, now = prepare(database)
    assert before == now
    database.close()
