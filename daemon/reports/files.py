"""Measurements as Parquet, for notebooks."""

from __future__ import annotations

import importlib.util
from pathlib import Path

from daemon.reports.slot_table import SlotTable, kind_of_column
from drivers.errors import MissingLibraryError


def write_parquet(slots: SlotTable, path: Path) -> int:
    """Write a Parquet file with the columns of the CSV, times as UTC timestamps.

    Gives the number of rows. Raises MissingLibraryError, OSError.
    """
    require_library("pyarrow", "parquet", "Parquet")
    import pyarrow as pa
    import pyarrow.parquet as pq

    types = {
        "time": pa.timestamp("us", tz="UTC"),
        "real": pa.float64(),
        "whole": pa.int64(),
        "truth": pa.bool_(),
        "text": pa.string(),
    }
    schema = pa.schema([(name, types[kind_of_column(name)]) for name in slots.columns])
    count = 0
    with pq.ParquetWriter(path, schema) as file:
        for batch in slots.batches:
            columns = []
            for field in schema:
                values = batch.values[field.name]
                # SQLite holds times as text, truths as 0 and 1: Arrow converts many at once.
                written = {types["time"]: pa.string(), types["truth"]: pa.int8()}.get(field.type)
                column = pa.array(values, type=written or field.type)
                columns.append(column.cast(field.type) if written else column)
            file.write_batch(pa.record_batch(columns, schema=schema))
            count += len(batch)
    return count


def require_library(library: str, extra: str, what: str) -> None:
    """Raise MissingLibraryError, which names the extra to install, unless a library is there."""
    if importlib.util.find_spec(library) is None:
        msg = f"no {what}: {library} is not installed; pip install 'dcam[{extra}]'"
        raise MissingLibraryError(msg)
