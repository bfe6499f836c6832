"""Measurements as Parquet and as NetCDF (CF conventions), for notebooks and archives."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable, Iterator
from datetime import datetime
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from core.results import Flag
from daemon.reports.table import EXTRA_COLUMNS
from daemon.store.convert import RESULT_COLUMNS, measurement_columns
from daemon.store.records import EPOCH, MeasurementRecord
from daemon.store.schema import kind_of
from daemon.version import VERSION
from drivers.errors import MissingLibraryError

COLUMNS = RESULT_COLUMNS + EXTRA_COLUMNS
BATCH = 5_000
"""Rows that stand in memory together: years never do."""


def batches(records: Iterable[MeasurementRecord]) -> Iterator[list[dict[str, Any]]]:
    """Rows as columns' values, many at a time."""
    rows = (measurement_columns(record) for record in records)
    while batch := list(islice(rows, BATCH)):
        yield batch


# ------------------------------------------------------------------------------------ Parquet


def write_parquet(records: Iterable[MeasurementRecord], path: Path) -> int:
    """Write a Parquet file with the columns of the CSV, times as UTC timestamps.

    Gives the number of rows. Raises MissingLibraryError, OSError.
    """
    if importlib.util.find_spec("pyarrow") is None:
        msg = "no Parquet: pyarrow is not installed; pip install 'dcam[parquet]'"
        raise MissingLibraryError(msg)
    import pyarrow as pa
    import pyarrow.parquet as pq

    types = {
        "time": pa.timestamp("us", tz="UTC"),
        "real": pa.float64(),
        "whole": pa.int64(),
        "truth": pa.bool_(),
        "text": pa.string(),
    }
    schema = pa.schema([(name, types[kind_of(name)]) for name in COLUMNS])
    count = 0
    with pq.ParquetWriter(path, schema) as file:
        for batch in batches(records):
            full = [{name: row.get(name) for name in COLUMNS} for row in batch]
            file.write_table(pa.Table.from_pylist(full, schema=schema))
            count += len(batch)
    return count


# ------------------------------------------------------------------------------------- NetCDF

UNITS = {"mm": "mm", "rad": "rad", "px": "1", "mm2": "mm2", "us": "us", "db": "dB", "c": "degC"}
"""UDUNITS of a column by the end of its name; a pixel is none that UDUNITS knows."""
LONG_NAMES = {
    "x_mm": "displacement of the target to the right, rig motion removed",
    "y_mm": "displacement of the target upwards, rig motion removed",
    "raw_x_mm": "displacement to the right as the main camera alone sees it",
    "raw_y_mm": "displacement upwards as the main camera alone sees it",
    "sigma_x_mm": "1 sigma of x_mm",
    "sigma_y_mm": "1 sigma of y_mm",
}
FLAGS = (Flag.GOOD, Flag.SUSPECT, Flag.BAD, Flag.MISSING)
TEXT_CHARS = 120
"""Longest text that a NetCDF variable of characters keeps; reasons are far shorter."""
_LEFT_OUT = {"motion_covariance"}
"""JSON of 21 numbers: for CSV and Parquet."""


def write_netcdf(records: Iterable[MeasurementRecord], path: Path, site: str) -> int:
    """Write a NetCDF 3 file, CF `timeSeries`: one station, its slots, flags with their meanings.

    Gives the number of rows. Raises OSError.
    """
    from scipy.io import netcdf_file

    count = 0
    with netcdf_file(path, "w", version=2) as file:
        _describe(file, site)
        names = [name for name in COLUMNS if name != "slot_utc" and name not in _LEFT_OUT]
        variables = {name: _variable(file, name) for name in names}
        time: Any = file.createVariable("time", "d", ("time",))
        time.units, time.calendar = "seconds since 1970-01-01 00:00:00 UTC", "standard"
        time.standard_name, time.long_name, time.axis = "time", "slot of the schedule", "T"
        for batch in batches(records):
            part = slice(count, count + len(batch))
            time[part] = [_seconds(row["slot_utc"]) for row in batch]
            for name, variable in variables.items():
                variable[part] = _values(name, [row.get(name) for row in batch])
            count += len(batch)
    return count


def _describe(file: Any, site: str) -> None:
    file.createDimension("time", None)
    file.createDimension("text", TEXT_CHARS)
    file.createDimension("name_chars", max(len(site.encode()), 1))
    file.Conventions, file.featureType = "CF-1.11", "timeSeries"
    file.title, file.source = f"Displacement of a bridge, {site}", f"dcam {VERSION}"
    station = file.createVariable("station", "c", ("name_chars",))
    station.cf_role, station.long_name = "timeseries_id", "site"
    station[:] = np.frombuffer(site.encode(), dtype="S1")


def _variable(file: Any, name: str) -> Any:
    kind = kind_of(name)
    if kind == "text":
        variable = file.createVariable(name, "c", ("time", "text"))
    elif name == "flag":
        variable = file.createVariable(name, "b", ("time",))
        variable.flag_values = np.array(FLAGS, dtype=np.int8)
        variable.flag_meanings = " ".join(flag.name.lower() for flag in FLAGS)
        variable.standard_name = "quality_flag"
    else:
        variable = file.createVariable(name, "d", ("time",))
        setattr(variable, "_FillValue", np.nan)  # noqa: B010 - the attribute's name in the file
        if kind == "time":
            variable.units, variable.calendar = "seconds since 1970-01-01 00:00:00 UTC", "standard"
        else:
            variable.units = UNITS.get(name.rpartition("_")[2], "1")
    variable.long_name = LONG_NAMES.get(name, name.replace("_", " "))
    variable.coordinates = "station"
    if name in {"x_mm", "y_mm", "raw_x_mm", "raw_y_mm"}:
        variable.ancillary_variables = "flag reasons" + ("" if "raw" in name else f" sigma_{name}")
    return variable


def _values(name: str, values: list[Any]) -> Any:
    kind = kind_of(name)
    if kind == "text":
        cells = np.array(
            [str(v or "").encode()[:TEXT_CHARS] for v in values], dtype=f"S{TEXT_CHARS}"
        )
        return cells.view("S1").reshape(len(values), TEXT_CHARS)
    if name == "flag":
        return np.array(values, dtype=np.int8)
    if kind == "time":
        return np.array([np.nan if v is None else _seconds(v) for v in values])
    return np.array([np.nan if v is None else float(v) for v in values])


def _seconds(when_utc: datetime) -> float:
    return (when_utc - EPOCH).total_seconds()
