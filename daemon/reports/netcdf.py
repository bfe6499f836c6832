"""Measurements as NetCDF 4 with CF's conventions, for archives."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from core.results import Flag
from daemon.reports.files import meaning_of
from daemon.reports.slot_table import SlotTable, kind_of_column
from daemon.store.queries import column_meanings
from daemon.store.queries.columns import BATCH
from daemon.store.queries.sensors import is_reading
from daemon.store.rows.targets import target_of_column
from daemon.time_arrays import utc_array
from daemon.version import VERSION
from drivers.libraries import require_library

FLAGS = (Flag.GOOD, Flag.SUSPECT, Flag.BAD, Flag.MISSING)
TIME_UNITS = "seconds since 1970-01-01 00:00:00 UTC"
UNITLESS = {"px", "dn", "dB", ""}
"""CF's list of units, UDUNITS, has no pixels, grey values and decibels: plain numbers to it."""

COVARIANCE = "motion_covariance"
_COVARIANCE_SIZE = 21
_NO_INTEGER, _NO_BYTE = -2147483647, -127
"""What stands for no value, as the NetCDF library itself has it."""


def write_netcdf(
    slots: SlotTable, path: Path, site: str, position_deg: tuple[float, float] | None = None
) -> int:
    """Write a CF `timeSeries`: one station, its slots, flags with their meanings.

    `position_deg` is the site's latitude and longitude, which CF wants of a station.

    Gives the number of rows. Raises MissingLibraryError, OSError.
    """
    require_library("h5netcdf", "NetCDF")
    import h5netcdf

    count = 0
    with h5netcdf.File(path, "w") as file:
        places = _describe(file, site, position_deg)
        variables = {
            name: _variable(file, name, meaning_of(slots, name), places) for name in slots.columns
        }
        for batch in slots.batches:
            part = slice(count, count + len(batch))
            file.resize_dimension("time", part.stop)
            for name, variable in variables.items():
                variable[part] = _stored(name, batch.values[name])
            count += len(batch)
    return count


def _describe(file: Any, site: str, position_deg: tuple[float, float] | None) -> str:
    """Describe the file and the station; give the names of the station's coordinates."""
    import h5py

    file.dimensions = {"time": None, "covariance": _COVARIANCE_SIZE}
    file.attrs["Conventions"], file.attrs["featureType"] = "CF-1.11", "timeSeries"
    file.attrs["title"] = f"Displacement of a bridge, {site}"
    file.attrs["source"] = f"dcam {VERSION}"
    file.attrs["history"] = f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ} exported by dcam {VERSION}"
    station = file.create_variable("station", (), dtype=h5py.string_dtype())
    station.attrs["cf_role"], station.attrs["long_name"] = "timeseries_id", "site"
    station[...] = site
    if position_deg is None:
        return "station"
    axes = (("lat", "latitude", "degrees_north"), ("lon", "longitude", "degrees_east"))
    for (name, standard, unit), value in zip(axes, position_deg, strict=True):
        place = file.create_variable(name, (), dtype=np.float64)
        place.attrs["standard_name"], place.attrs["units"] = standard, unit
        place.attrs["long_name"] = f"{standard} of the site"
        place[...] = value
    return "lat lon station"


def _variable(file: Any, name: str, meaning: column_meanings.Meaning, places: str) -> Any:
    """A variable over the slots, empty; the slots themselves are the coordinate `time`."""
    kind = kind_of_column(name)
    _, key = _split(name)
    if name == "slot_utc":
        variable = _create(file, "time", np.float64)
        variable.attrs["standard_name"], variable.attrs["axis"] = "time", "T"
        variable.attrs["units_metadata"] = "leap_seconds: none"
    elif name == COVARIANCE:
        variable = _create(file, name, np.float64, ("time", "covariance"), np.nan)
    elif key == "flag":
        variable = _create(file, name, np.int8, fill=None if name == key else _NO_BYTE)
        variable.attrs["standard_name"] = "quality_flag"
        variable.attrs["flag_values"] = np.array(FLAGS, dtype=np.int8)
        variable.attrs["flag_meanings"] = " ".join(flag.name.lower() for flag in FLAGS)
    elif kind == "text":
        variable = _create_text(file, name)
    elif kind == "whole":
        variable = _create(file, name, np.int32, fill=_NO_INTEGER)
    elif kind == "truth":
        variable = _create(file, name, np.int8, fill=_NO_BYTE)
        variable.attrs["flag_values"] = np.array([0, 1], dtype=np.int8)
        variable.attrs["flag_meanings"] = "no yes"
    else:
        variable = _create(file, name, np.float64, fill=np.nan)
    _annotate(variable, name, meaning, places)
    return variable


def _annotate(variable: Any, name: str, meaning: column_meanings.Meaning, places: str) -> None:
    variable.attrs["long_name"] = meaning.text
    kind, (prefix, key) = kind_of_column(name), _split(name)
    if kind == "time":
        variable.attrs["units"], variable.attrs["calendar"] = TIME_UNITS, "standard"
    elif kind in {"real", "whole"} and key != "flag":
        variable.attrs["units"] = "1" if meaning.unit in UNITLESS else meaning.unit
    if name != "slot_utc":
        variable.attrs["coordinates"] = places
    if key in {"x_mm", "y_mm", "raw_x_mm", "raw_y_mm"}:
        sigma = key.replace("x_mm", "sigma_x_mm").replace("y_mm", "sigma_y_mm")
        others = [prefix + other for other in ("flag", "reasons", sigma)]
        variable.attrs["ancillary_variables"] = " ".join(others)


def _split(name: str) -> tuple[str, str]:
    """Of a further target's column what stands before its key, and the key."""
    own = name in column_meanings.MEANINGS or is_reading(name)
    target = None if own else target_of_column(name)
    return ("", name) if target is None else (f"{target[0]}_", target[1])


def _create(
    file: Any,
    name: str,
    kind: type,
    dimensions: tuple[str, ...] = ("time",),
    fill: float | None = None,
) -> Any:
    chunks = (BATCH, *(file.dimensions[other].size for other in dimensions[1:]))
    return file.create_variable(
        name,
        dimensions,
        dtype=kind,
        fillvalue=fill,
        chunks=chunks,
        compression="gzip",
        compression_opts=1,
        shuffle=True,
    )


def _create_text(file: Any, name: str) -> Any:
    import h5py

    return file.create_variable(name, ("time",), dtype=h5py.string_dtype(), chunks=(BATCH,))


def _stored(name: str, values: Sequence[Any]) -> npt.NDArray[Any]:
    kind = kind_of_column(name)
    if name == COVARIANCE:
        nothing = [np.nan] * _COVARIANCE_SIZE
        return np.array([nothing if text is None else json.loads(text) for text in values])
    if kind == "text":
        return np.array([value or "" for value in values], dtype=object)
    if kind == "time":
        return (utc_array(values) - np.datetime64(0, "us")) / np.timedelta64(1, "s")
    if kind == "real":
        return np.array(values, dtype=np.float64)
    is_byte = kind == "truth" or _split(name)[1] == "flag"
    missing, dtype = (_NO_BYTE, np.int8) if is_byte else (_NO_INTEGER, np.int32)
    return np.array([missing if value is None else value for value in values], dtype=dtype)
