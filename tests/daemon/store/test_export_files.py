"""Parquet and NetCDF hold what the rows hold, readable by other programs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.io import netcdf_file

from daemon.reports.files import BATCH, write_netcdf, write_parquet
from tests.daemon.store.examples import START, full_record, record, slot


def test_parquet_has_every_column_with_its_type(tmp_path: Path) -> None:
    rows = [full_record(slot(0), calibration_id=7), record(slot(1))]
    assert write_parquet(iter(rows), tmp_path / "a.parquet") == 2
    full, bare = pq.read_table(tmp_path / "a.parquet").to_pylist()
    assert (full["slot_utc"], bare["slot_utc"]) == (slot(0), slot(1))
    assert full["captured_utc"] == rows[0].captured_utc
    assert (full["flag"], full["x_mm"], full["sub_exposure_us"]) == (3, 0.1, 800.25)
    assert full["reasons"] == "too_dark+main_target_partly_hidden"
    assert (full["recorded_late"], full["calibration_id"]) == (True, 7)
    assert (bare["x_mm"], bare["calibration_id"]) == (None, None)


def test_parquet_of_more_rows_than_stand_in_memory(tmp_path: Path) -> None:
    count = BATCH + 3
    written = write_parquet((record(slot(n)) for n in range(count)), tmp_path / "a.parquet")
    assert written == pq.read_metadata(tmp_path / "a.parquet").num_rows == count


def test_netcdf_is_a_cf_time_series_with_flag_meanings(tmp_path: Path) -> None:
    rows = [full_record(slot(0), calibration_id=7), record(slot(1))]
    assert write_netcdf(iter(rows), tmp_path / "a.nc", "pier-3") == 2
    with netcdf_file(tmp_path / "a.nc", mmap=False) as file:
        assert file.Conventions.startswith(b"CF-")
        assert file.featureType == b"timeSeries"
        found = file.variables
        assert b"".join(found["station"][:]) == b"pier-3"
        assert found["station"].cf_role == b"timeseries_id"
        assert found["time"].units == b"seconds since 1970-01-01 00:00:00 UTC"
        assert found["time"][:].tolist() == [START.timestamp(), START.timestamp() + 60]
        assert found["flag"].flag_values.tolist() == [1, 3, 4, 9]
        assert found["flag"].flag_meanings == b"good suspect bad missing"
        assert found["flag"][:].tolist() == [3, 4]
        assert found["x_mm"].units == b"mm"
        assert found["x_mm"][0] == pytest.approx(0.1, abs=0)
        assert np.isnan(found["x_mm"][1])
        assert b"".join(found["reasons"][0]).rstrip(b"\0") == b"too_dark+main_target_partly_hidden"
        assert found["x_mm"].ancillary_variables == b"flag reasons sigma_x_mm"
