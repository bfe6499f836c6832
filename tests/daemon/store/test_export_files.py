"""Parquet and NetCDF hold what the rows hold, readable by other programs."""

from __future__ import annotations

import csv
import io
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import h5netcdf
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from daemon.reports.files import write_arrow, write_parquet
from daemon.reports.netcdf import write_netcdf
from daemon.reports.slot_table import COLUMNS, SlotTable, kind_of_column, slot_table
from daemon.reports.table import write_slots
from daemon.store.database import ALWAYS, NEVER, open_store
from daemon.store.queries.sensors import sensors_within
from daemon.store.records import GapCause, Reading
from tests.daemon.store.examples import START, calibration, full_record, record, slot
from tests.exhaustive import one_of


@pytest.fixture
def slots(tmp_path: Path) -> Iterator[SlotTable]:
    with three_slots(tmp_path) as table:
        yield table


@contextmanager
def three_slots(directory: Path) -> Iterator[SlotTable]:
    """A row with everything, one with nothing, a slot in a gap; from the database `state`."""
    with open_store(directory / "state") as store:
        store.add_calibration(calibration())
        store.add_measurement(full_record(slot(0), calibration_id=1))
        store.add_measurement(record(slot(1)))
        store.record_gap(slot(2), slot(2), GapCause.POWER_LOSS, "the plug", period_s=60)
        yield slot_table(store, ALWAYS, NEVER, lambda _done, _total: None)


@pytest.fixture(scope="module")
def netcdf(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, tuple[str, ...]]:
    """The same as NetCDF, beside its `state`, and the names of its columns; not to be changed."""
    directory = tmp_path_factory.mktemp("netcdf")
    with three_slots(directory) as slots:
        assert write_netcdf(slots, directory / "a.nc", "pier-3") == 3
        return directory / "a.nc", slots.columns


def test_parquet_has_every_column_with_its_type(slots: SlotTable, tmp_path: Path) -> None:
    assert write_parquet(slots, tmp_path / "a.parquet") == 3
    full, bare, missed = pq.read_table(tmp_path / "a.parquet").to_pylist()
    assert (full["slot_utc"], bare["slot_utc"]) == (slot(0), slot(1))
    assert full["captured_utc"] == full_record(slot(0)).captured_utc
    assert (full["flag"], full["x_mm"], full["sub_exposure_us"]) == (3, 0.1, 800.25)
    assert full["reasons"] == "too_dark+main_target_partly_hidden"
    assert (full["recorded_late"], full["calibration_id"]) == (True, 1)
    assert (bare["x_mm"], bare["calibration_id"]) == (None, None)
    assert (full["quarter-span_flag"], bare["quarter-span_flag"]) == (3, None)
    assert (full["quarter-span_x_mm"], full["abutment_raw_x_mm"]) == (0.7, 2.5)
    assert (full["abutment_role"], full["abutment_reasons"]) == ("fixed", "")
    known = {name: value for name, value in missed.items() if value is not None}
    assert known == {"slot_utc": slot(2), "flag": 9, "reasons": "power_loss", "detail": "the plug"}


def test_netcdf_is_a_cf_time_series_with_flag_meanings(netcdf: tuple[Path, object]) -> None:
    with h5netcdf.File(netcdf[0]) as file:
        assert file.attrs["Conventions"].startswith("CF-")
        assert file.attrs["featureType"] == "timeSeries"
        assert file["station"][...].item().decode() == "pier-3"
        assert file["station"].attrs["cf_role"] == "timeseries_id"
        times = file["time"]
        assert times.attrs["units"] == "seconds since 1970-01-01 00:00:00 UTC"
        assert times[...].tolist() == [START.timestamp() + 60 * k for k in range(3)]
        assert file["flag"].attrs["flag_values"].tolist() == [1, 3, 4, 9]
        assert file["flag"].attrs["flag_meanings"] == "good suspect bad missing"
        assert file["flag"][...].tolist() == [3, 4, 9]
        assert file["x_mm"][...].tolist()[0] == 0.1
        assert np.isnan(file["x_mm"][...][1:]).all()
        assert file["x_mm"].attrs["ancillary_variables"] == "flag reasons sigma_x_mm"
        assert file["raw_y_mm"].attrs["ancillary_variables"] == "flag reasons raw_sigma_y_mm"
        assert [text.decode() for text in file["reasons"][...]] == [
            "too_dark+main_target_partly_hidden",
            "main_target_not_found",
            "power_loss",
        ]
        late = file["recorded_late"]
        assert late[...].tolist() == [1, 0, late.attrs["_FillValue"]]


def test_netcdf_has_variables_of_each_further_target(netcdf: tuple[Path, object]) -> None:
    with h5netcdf.File(netcdf[0]) as file:
        value, flag = file["quarter-span_x_mm"], file["quarter-span_flag"]
        assert value[...].tolist()[0] == 0.7
        assert value.attrs["long_name"].startswith("target quarter-span: corrected displacement")
        assert value.attrs["ancillary_variables"] == (
            "quarter-span_flag quarter-span_reasons quarter-span_sigma_x_mm"
        )
        assert flag.attrs["standard_name"] == "quality_flag"
        assert flag[...].tolist() == [3, *[flag.attrs["_FillValue"]] * 2]
        assert file["abutment_role"][...].tolist() == [b"fixed", b"", b""]


def test_every_netcdf_variable_says_what_it_is_and_has_its_cf_unit(
    netcdf: tuple[Path, tuple[str, ...]],
) -> None:
    """Unit by unit, as UDUNITS knows them; what is no quantity has none."""
    path, columns = netcdf
    by_ending = {
        "mm": "mm", "mm2": "mm2", "rad": "rad", "s": "s", "us": "us", "db": "1", "c": "degC",
        "px": "1", "dn": "1", "air": "degC", "steel-2": "degC",
    }  # fmt: skip
    with h5netcdf.File(path) as file:
        for name in columns:
            attributes = file["time" if name == "slot_utc" else name].attrs
            assert len(attributes["long_name"]) > 10
            kind, unit = kind_of_column(name), attributes.get("units")
            if kind == "real":
                assert unit == by_ending[name.rpartition("_")[2]], name
            elif kind == "time":
                assert str(unit).startswith("seconds since"), name
            elif kind == "whole" and not name.endswith("flag"):
                assert unit == "1", name
            else:
                assert unit is None, name


def test_an_empty_record_is_an_empty_table(tmp_path: Path) -> None:
    empty = SlotTable(COLUMNS, iter(()))
    assert write_parquet(empty, tmp_path / "a.parquet") == 0
    assert write_netcdf(empty, tmp_path / "a.nc", "pier-3") == 0
    assert pq.read_table(tmp_path / "a.parquet").column_names == list(COLUMNS)


def test_readings_are_columns_with_their_units(tmp_path: Path) -> None:
    """In their order; of a sensor whose unit was changed the older part stands apart."""
    given = [
        (Reading("air", "degF", 70.25),),
        (Reading("steel-2", "degC", None, "outside limits (85 degC)"), Reading("air", "degC", 2.5)),
        (Reading("steel-2", "degC", 7.0), Reading("air", "degC", None, "no answer for 5 s")),
        (),
    ]
    with open_store(tmp_path / "state") as store:
        for number, readings in enumerate(given):
            store.add_measurement(replace(record(slot(number)), readings=readings))
        assert sensors_within(store.path, slot(1), slot(2))[0].column == "reading_steel-2"

        def table() -> SlotTable:
            return slot_table(store, ALWAYS, NEVER, lambda _done, _total: None)

        write_parquet(table(), tmp_path / "a.parquet")
        write_netcdf(table(), tmp_path / "a.nc", "pier-3")
        text = io.StringIO()
        write_slots(table(), text)
    columns = {
        "reading_air_in_degF": [70.25, None, None, None],
        "reading_steel-2": [None, None, 7.0, None],
        "reading_air": [None, 2.5, None, None],
        "readings_missing": [
            *(None, "steel-2: outside limits (85 degC)", "air: no answer for 5 s", None)
        ],
    }
    found = pq.read_table(tmp_path / "a.parquet").to_pydict()
    assert {name: found[name] for name in columns} == columns
    assert list(found)[-6:] == [*columns, "excluded", "detail"]
    (head, *lines) = csv.reader(text.getvalue().splitlines())
    at = head.index("reading_air")
    assert [line[at] for line in lines] == ["", "2.5", "", ""]
    with h5netcdf.File(tmp_path / "a.nc") as file:
        assert [file[name].attrs["units"] for name in list(columns)[:3]] == ["degF", "degC", "degC"]
        assert file["reading_steel-2"].attrs["long_name"] == "reading steel-2"
        assert file["reading_steel-2"][...].tolist()[2] == 7.0


def test_netcdf_says_where_the_station_is(slots: SlotTable, tmp_path: Path) -> None:
    """CF's checker takes a time series for one only with the place of its station."""
    few = replace(slots, columns=("slot_utc", "flag", "x_mm", "main_gain_db"))
    write_netcdf(few, tmp_path / "a.nc", "pier-3", (52.5, 13.4))
    with h5netcdf.File(tmp_path / "a.nc") as file:
        assert (file["lat"][...].item(), file["lon"][...].item()) == (52.5, 13.4)
        assert file["lat"].attrs["units"] == "degrees_north"
        assert file["x_mm"].attrs["coordinates"] == "lat lon station"
        assert file["main_gain_db"].attrs["units"] == "1"  # UDUNITS has no dB


def stored_rows(state: Path) -> list[dict[str, object]]:
    """The measured rows as SQLite holds them, in the order of their slots."""
    with closing(sqlite3.connect(state / "dcam.db")) as connection:
        connection.row_factory = sqlite3.Row
        return [
            dict(row) for row in connection.execute("SELECT * FROM measurement ORDER BY slot_utc")
        ]


def same(read: object, stored: object) -> bool:
    """Whether a value is that of the database: numbers to the last bit."""
    if stored is None:
        return read is None or read != read or read == ""  # noqa: PLR0124 - NaN, NaT
    if isinstance(read, datetime):
        return read.timestamp() == datetime.fromisoformat(str(stored)).timestamp()
    return bool(read == stored)


COMPARED = [name for name in COLUMNS if name not in {"excluded", "detail", "motion_covariance"}]
"""What stands in the rows; the rest is made of other tables, or has its own test."""


def test_pandas_reads_from_parquet_what_the_database_holds(
    slots: SlotTable, tmp_path: Path
) -> None:
    pandas = pytest.importorskip("pandas")
    write_parquet(slots, tmp_path / "a.parquet", "pier-3")
    table = pandas.read_parquet(tmp_path / "a.parquet")
    assert str(table["reasons"].dtype) == "category"
    rows = stored_rows(tmp_path / "state")
    for name in COMPARED:
        for read, row in zip(table[name], rows, strict=False):
            assert same(read, row[name]), name


def test_xarray_reads_from_netcdf_what_the_database_holds(slots: SlotTable, tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray")
    rows = stored_rows(tmp_path / "state")
    some = COMPARED[1 :: one_of(3)]  # the library takes seconds to open a file with all
    columns = (COMPARED[0], *some) if one_of(3) > 1 else slots.columns
    write_netcdf(replace(slots, columns=columns), tmp_path / "a.nc", "pier-3")
    with xarray.open_dataset(tmp_path / "a.nc", engine="h5netcdf") as dataset:
        assert dataset.attrs["featureType"] == "timeSeries"
        times = [datetime.fromisoformat(str(row["slot_utc"])).timestamp() for row in rows]
        assert (dataset["time"].values[:2].astype("datetime64[s]").astype(int) == times).all()
        for name in some:
            if kind_of_column(name) == "time":
                continue  # to the nanosecond of a float: see the test of microseconds
            for read, row in zip(dataset[name].values.tolist(), rows, strict=False):
                assert same(read, row[name]), name


def test_an_arrow_stream_has_units_and_meanings(slots: SlotTable) -> None:
    stream = io.BytesIO()
    assert write_arrow(slots, stream, "pier-3") == 3
    stream.seek(0)
    table = pa.ipc.open_stream(stream).read_all()
    assert table.schema.metadata[b"site"] == b"pier-3"
    field = table.schema.field("x_mm")
    assert field.metadata[b"unit"] == b"mm"
    assert field.metadata[b"meaning"].startswith(b"corrected displacement")
    assert table.schema.field("flag").metadata[b"flag_values"] == b"1 3 4 9"
    assert table.schema.field("flag").metadata[b"flag_meanings"] == b"good suspect bad missing"
    assert pa.types.is_dictionary(table.schema.field("reasons").type)
    assert table["flag"].to_pylist() == [3, 4, 9]
    assert table["reasons"].to_pylist()[2] == "power_loss"
