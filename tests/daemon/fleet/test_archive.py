"""Closed months as Parquet in S3, read back with DuckDB: the database's values, each row once."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import duckdb
import fsspec
import numpy as np
import pytest
from sqlalchemy import text

from daemon.fleet.month_file import MOTION_PAIRS, RELATIVE_BITS, STEPS_BITS
from daemon.store.central.connecting import connect_central
from daemon.store.database import ALWAYS, NEVER, open_store
from daemon.store.ledger.entries import LedgerEntry, LedgerKind
from daemon.store.queries.columns import read_columns
from daemon.store.records import GapCause
from tests.daemon.fleet.conftest import row_at, sync
from tests.daemon.fleet.postgres import Server
from tests.daemon.fleet.test_commands import ctl, with_url
from tests.daemon.store.examples import calibration, datum, slot

MARCH_END = datetime(2026, 3, 31, 23, 50, tzinfo=UTC)
QUERY = """
SELECT m.site, m.slot_utc, m.flag,
       m.x_mm + coalesce(d.x_mm, 0) AS x_mm, m.y_mm + coalesce(d.y_mm, 0) AS y_mm,
       sqrt(m.sigma_y_mm ** 2 + coalesce(d.var_y_mm2, 0)) AS sigma_y_mm
FROM read_parquet('s3://bridges/dcam/measurement/*/*/*/*.parquet', union_by_name = true) AS m
LEFT JOIN (
  SELECT DISTINCT ON (site, calibration_id) *
  FROM read_parquet('s3://bridges/dcam/datum/*/*.parquet') ORDER BY site, calibration_id, id DESC
) AS d USING (site, calibration_id)
ORDER BY m.site, m.slot_utc
"""
"""As docs/fleet.md has it."""


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A bucket on a server of S3, as fsspec finds it by the environment."""
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer("127.0.0.1", 0)
    server.start()
    host, port = server.get_host_and_port()
    for name, value in {
        "AWS_ACCESS_KEY_ID": "any",
        "AWS_SECRET_ACCESS_KEY": "any",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_ENDPOINT_URL": f"http://{host}:{port}",
    }.items():
        monkeypatch.setenv(name, value)
    storage = fsspec.filesystem("s3", skip_instance_cache=True, use_listings_cache=False)
    storage.mkdir("bridges")
    yield storage
    server.stop()


def minutes(state: Path, numbers: range, calibration_id: int | None = None) -> None:
    with open_store(state) as store:
        for number in numbers:
            store.add_measurement(row_at(slot(number, MARCH_END), calibration_id))


@pytest.fixture
def state(tmp_path: Path) -> Path:
    """Ten minutes before the end of March and three after it, the last five by a second zero."""
    with open_store(tmp_path / "pier") as store:
        first = store.add_calibration(calibration(), activate=True)
        second = store.add_calibration(calibration(), activate=True)
        store.add_datums({second: datum(2.5, -3.5)})
        store.record_gap(
            slot(-9, MARCH_END), slot(-8, MARCH_END), GapCause.POWER_LOSS, "", period_s=60
        )
    minutes(tmp_path / "pier", range(8), first)
    minutes(tmp_path / "pier", range(8, 13), second)
    return tmp_path / "pier"


def files(bucket: Any, table: str = "measurement") -> dict[str, bytes]:
    found = bucket.find(f"bridges/dcam/{table}")
    return {path.removeprefix("bridges/dcam/"): bucket.cat_file(path) for path in found}


def query(bucket: Any, words: str) -> list[dict[str, Any]]:
    """What DuckDB reads; its own access to S3 is an extension that it would fetch."""
    with duckdb.connect() as connection:
        connection.execute("SET TimeZone = 'UTC'")
        connection.register_filesystem(bucket)
        found = connection.execute(words)
        names = [column[0] for column in found.description]
        return [dict(zip(names, row, strict=True)) for row in found.fetchall()]


def test_closed_months_in_s3_are_the_databases_rows(
    server: Server,
    central: str,
    state: Path,
    bucket: Any,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    config, url = tmp_path / "dcam.toml", server.url(central)
    config.write_text(with_url(url))
    archive = ["--config", config, "archive", "--to", "s3://bridges/dcam"]
    sync(url, state, "pier / 1")
    code, _, err = ctl(capsys, *archive)
    assert code == 0, err
    march = "measurement/site=pier%20%2F%201/year=2026/month=03/rows.parquet"
    first = files(bucket)
    assert list(first) == [march]  # April goes on

    # DuckDB reads what export writes, in the record's zero, and the place says which site.
    table = io.StringIO(ctl(capsys, "--config", config, "--state", state, "export")[1])
    exported = [row for row in csv.DictReader(table) if row["flag"] == "3"][:10]
    found = query(bucket, QUERY)
    assert {row["site"] for row in found} == {"pier / 1"}
    assert [f"{row['slot_utc']:%Y-%m-%dT%H:%M:%SZ}" for row in found] == [
        row["slot_utc"] for row in exported
    ]
    for name, share in (("x_mm", 0.0), ("y_mm", 0.0), ("sigma_y_mm", 2.0**-RELATIVE_BITS)):
        there, here = (np.array([row[name] for row in rows], float) for rows in (found, exported))
        assert np.allclose(there, here, atol=1e-5, rtol=share), name
    assert np.ptp([row["x_mm"] for row in found]) > 2.0  # two zeros

    # Every column as it is stored, to the digits that are kept.
    stored = next(iter(read_columns(state / "dcam.db", ALWAYS, NEVER, as_stored=True))).values
    (whole,) = [query(bucket, f"SELECT * FROM read_parquet('s3://bridges/dcam/{march}')")]
    for name in set(stored) - {"digest", "main_frame", "sub_frame", "targets", "motion_covariance"}:
        there, here = [row[name] for row in whole], stored[name][:10]
        if name.endswith("_utc"):
            there = [moment and moment.replace(tzinfo=None) for moment in there]
            here = [moment and datetime.fromisoformat(moment[:-1]) for moment in here]
        if isinstance(here[0], float):
            step = 2.0 ** -STEPS_BITS.get(name.rpartition("_")[2], 99)
            there, here = np.array(there), np.array(here)
            assert (np.abs(there - here) <= np.maximum(step, np.abs(here) / 2**RELATIVE_BITS)).all()
        else:
            assert there == list(here), name
    fixed = [row["abutment_y_mm"] for row in whole]
    assert np.allclose(fixed, -0.04, atol=4e-6)
    assert set(whole[0]["motion_covariance"]) == set(MOTION_PAIRS)
    assert whole[0]["motion_covariance"]["rx_ry"] == pytest.approx(1.0, rel=4e-3)

    # Again: nothing is written. A later link, a ledger entry: their tables alone.
    assert "0 months of sites written with 0 rows; 1 were there; 0 t" in ctl(capsys, *archive)[2]
    with open_store(state) as store:
        store.add_datums({2: datum(20.0, 0.0)})
        entry = LedgerEntry(
            LedgerKind.EXCLUDE, "me", MARCH_END, "paint", MARCH_END, slot(1, MARCH_END)
        )
        store.add_ledger_entry(entry)
    sync(url, state, "pier / 1")
    assert "0 months of sites written with 0 rows; 1 were there; 2 t" in ctl(capsys, *archive)[2]
    assert files(bucket) == first
    assert max(row["x_mm"] for row in query(bucket, QUERY)) == pytest.approx(20.1, abs=1e-5)

    # A month whose rows no sync has changed is not read again.
    database = connect_central(url, None)
    with database.transaction() as connection:
        connection.execute(text("UPDATE measurement SET digest = digest + 1"))
    database.close()
    assert "0 months of sites written with 0 rows; 1 were there; 0 t" in ctl(capsys, *archive)[2]

    # Written again from nothing: the same bytes.
    bucket.rm_file("bridges/dcam/written/pier%20%2F%201.json")
    assert "1 months" in ctl(capsys, *archive)[2]
    assert files(bucket) == first

    # A row that comes late: the month as a whole.
    minutes(state, range(-2, -1), 1)
    sync(url, state, "pier / 1")
    assert "1 months of sites written with 11 rows" in ctl(capsys, *archive)[2]
    assert len(query(bucket, QUERY)) == 11

    # A month that was taken out of PostgreSQL stays, also when a late row comes.
    database = connect_central(url, None)
    with database.transaction() as connection:
        connection.execute(text("DROP TABLE measurement_2026_03"))
    database.close()
    minutes(state, range(-4, -3), 1)
    sync(url, state, "pier / 1")
    assert "its file stays" in ctl(capsys, *archive)[2]
    assert len(query(bucket, QUERY)) == 11
