"""Measurements as Parquet and as an Arrow stream, for notebooks and data pipelines."""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

from core.results import Flag
from daemon.reports.slot_table import SlotTable, kind_of_column
from daemon.store.queries import column_meanings
from daemon.store.queries.columns import Columns
from daemon.store.queries.sensors import Sensor
from daemon.version import VERSION
from drivers.libraries import require_library

_FEW_WORDS = ("reasons", "boot_id", "config_hash", "version", "role")
"""What the names of texts end in that are the same in many rows: they are written as numbers."""


def write_parquet(slots: SlotTable, path: Path, site: str | None = None) -> int:
    """Write a Parquet file with the columns of the CSV, times as UTC timestamps.

    Units, meanings and the flags' words are in the metadata. Gives the number of rows. Raises
    MissingLibraryError, OSError.
    """
    require_library("pyarrow", "Parquet")
    import pyarrow.parquet as pq

    schema = _schema(slots, site)
    with pq.ParquetWriter(path, schema) as file:
        return _write(slots, schema, file)


def write_arrow(slots: SlotTable, output: BinaryIO, site: str | None = None) -> int:
    """Write an Arrow IPC stream with the same columns and metadata, batch by batch.

    Gives the number of rows. Raises MissingLibraryError, OSError.
    """
    require_library("pyarrow", "Arrow")
    import pyarrow as pa

    schema = _schema(slots, site)
    with pa.ipc.new_stream(output, schema) as stream:
        return _write(slots, schema, stream)


def meaning_of(slots: SlotTable, name: str) -> column_meanings.Meaning:
    """What a column of a table holds, those of its sensors too."""
    sensors = {sensor.column: _sensor_meaning(sensor) for sensor in slots.sensors}
    return sensors.get(name) or column_meanings.of(name)


def _sensor_meaning(sensor: Sensor) -> column_meanings.Meaning:
    return column_meanings.Meaning(sensor.unit, f"reading {sensor.name}")


def _schema(slots: SlotTable, site: str | None) -> Any:
    import pyarrow as pa

    fields = []
    for name in slots.columns:
        meaning = meaning_of(slots, name)
        more = {"unit": meaning.unit, "meaning": meaning.text}
        if name == "flag" or name.endswith("_flag"):
            more["flag_values"] = " ".join(str(int(flag)) for flag in Flag)
            more["flag_meanings"] = " ".join(flag.name.lower() for flag in Flag)
        fields.append(pa.field(name, _type(name), metadata=more))
    source = {"source": f"dcam {VERSION}", "zero": "the record's"}
    return pa.schema(fields, metadata=source if site is None else source | {"site": site})


def _type(name: str) -> Any:
    import pyarrow as pa

    if kind_of_column(name) == "text" and name.endswith(_FEW_WORDS):
        return pa.dictionary(pa.int32(), pa.string())
    types = {
        "time": pa.timestamp("us", tz="UTC"),
        "real": pa.float64(),
        "whole": pa.int64(),
        "truth": pa.bool_(),
        "text": pa.string(),
    }
    return types[kind_of_column(name)]


def _write(slots: SlotTable, schema: Any, file: Any) -> int:
    count = 0
    for batch in slots.batches:
        file.write_batch(_record_batch(batch, schema))
        count += len(batch)
    return count


def _record_batch(batch: Columns, schema: Any) -> Any:
    import pyarrow as pa

    # SQLite holds times as text, truths as 0 and 1: Arrow converts many at once.
    stored = {pa.timestamp("us", tz="UTC"): pa.string(), pa.bool_(): pa.int8()}
    columns = []
    for field in schema:
        written = stored.get(field.type)
        column = pa.array(batch.values[field.name], type=written or field.type)
        columns.append(column.cast(field.type) if written else column)
    return pa.record_batch(columns, schema=schema)
