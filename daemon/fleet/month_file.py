"""A month of rows as Parquet: every column but frames' names and checksums, small and for long.

Numbers stay doubles but are rounded far below their noise, to binary fractions, so that their last
bytes are zeros, which cost nothing: 110 bytes a row where all bits take 450.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from core.arrays import FloatArray
from daemon.store.queries import column_meanings
from daemon.store.queries.columns import Columns
from daemon.store.rows.targets import (
    stored_targets,
    target_of_column,
    values_of_targets,
)
from daemon.store.schema import Kind, MeasurementRow, kind_of

LAYOUT = 1
"""Of these files; another one has all months written again."""
STEPS_BITS = {"mm": 18, "rad": 32, "s": 20, "us": 3, "db": 7, "c": 7, "dn": 6}
"""Of numbers, by the unit that their names end in: they are multiples of 2**-bits."""
RELATIVE_BITS = 12
"""What is kept of sigmas, covariances, residuals and blur, whose sizes differ: 0.01 %."""
MOTION_BITS = 8
"""What is kept of the 21 covariances of the rig's motion: 0.2 %."""
_RELATIVE = ("sigma", "cov", "spread", "_px")
_LEFT_OUT = ("digest", "main_frame", "sub_frame", "targets", "motion_covariance")
"""Frames stay at the pier; the last two become columns."""
_MOTION = ("rx", "ry", "rz", "tx", "ty", "tz")
MOTION_PAIRS = tuple(f"{a}_{b}" for at, a in enumerate(_MOTION) for b in _MOTION[at:])
"""The upper triangle of the rig motion's covariance, row by row."""
_LEVEL = 9


def parquet_of_rows(batches: Iterable[Columns], site: str) -> bytes:
    """A month as the bytes of a Parquet file, the same for the same rows.

    Rows count from their own calibration's reference, as they were measured: the table `datum` says
    what to add, so that a later link changes no month.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    parts = [_table(batch) for batch in batches]
    table = pa.concat_tables(parts, promote_options="default").combine_chunks()
    layout = {"site": site, "layout": str(LAYOUT), "zero": "each calibration's own"}
    table = table.replace_schema_metadata(layout)
    output = io.BytesIO()
    pq.write_table(
        table,
        output,
        compression="zstd",
        compression_level=_LEVEL,
        row_group_size=len(table),
        use_dictionary=[field.name for field in table.schema if pa.types.is_string(field.type)],
        column_encoding=dict(_encodings(table.schema)),
        coerce_timestamps="us",
    )
    return output.getvalue()


def _encodings(schema: Any) -> Iterable[tuple[str, str]]:
    """What makes slowly changing numbers, and zeros at their ends, small."""
    import pyarrow as pa

    for field in schema:
        if pa.types.is_floating(field.type):
            yield field.name, "BYTE_STREAM_SPLIT"
        elif pa.types.is_struct(field.type):
            yield from ((f"{field.name}.{one}", "BYTE_STREAM_SPLIT") for one in MOTION_PAIRS)
        elif pa.types.is_timestamp(field.type) or pa.types.is_integer(field.type):
            yield field.name, "DELTA_BINARY_PACKED"


def _table(batch: Columns) -> Any:
    import pyarrow as pa

    values: dict[str, Sequence[Any]] = {
        name: column for name, column in batch.values.items() if name not in _LEFT_OUT
    }
    texts = batch.values["targets"]
    named = dict.fromkeys(one["name"] for text in texts for one in stored_targets(text))
    values |= values_of_targets(texts, list(named))
    fields, arrays = [], []
    for name, column in values.items():
        array = _array(name, column)
        fields.append(pa.field(name, array.type, metadata=_meaning(name)))
        arrays.append(array)
    motion = _motion(batch.values["motion_covariance"])
    meaning = {"meaning": "covariance of rx_rad to tz_mm"}
    fields.append(pa.field("motion_covariance", motion.type, metadata=meaning))
    return pa.table([*arrays, motion], schema=pa.schema(fields))


def _meaning(name: str) -> Mapping[str, str]:
    meaning = column_meanings.of(name)
    return {"unit": meaning.unit, "meaning": meaning.text}


def _array(name: str, column: Sequence[Any]) -> Any:
    import pyarrow as pa

    kind = _kind(name)
    if kind == "real":
        numbers = np.array(column, dtype=np.float64)
        return pa.array(rounded(name, numbers), mask=np.isnan(numbers))
    if kind == "time":
        return pa.array(column, type=pa.string()).cast(pa.timestamp("us", tz="UTC"))
    if kind == "truth":
        return pa.array(column, type=pa.int8()).cast(pa.bool_())
    return pa.array(column, type=pa.int32() if kind == "whole" else pa.string())


def _key(name: str) -> str:
    """A column's name without the further target's."""
    target = None if name in MeasurementRow.__table__.columns else target_of_column(name)
    return name if target is None else target[1]


def _kind(name: str) -> Kind:
    return "text" if _key(name) == "role" else kind_of(_key(name))


def rounded(name: str, values: FloatArray) -> FloatArray:
    """Values of a column without the bits that are noise; NaN stays."""
    key = _key(name)
    if any(word in key for word in _RELATIVE):
        return _relative(values, RELATIVE_BITS)
    bits = STEPS_BITS[key.rpartition("_")[2]]
    steps: FloatArray = np.ldexp(np.round(np.ldexp(values, bits)), -bits)
    return steps


def _relative(values: FloatArray, bits: int) -> FloatArray:
    mantissa, exponent = np.frexp(values)
    kept: FloatArray = np.ldexp(np.round(np.ldexp(mantissa, bits)), exponent - bits)
    return kept


def _motion(texts: Sequence[str | None]) -> Any:
    """The covariances as a struct of 21 numbers."""
    import pyarrow as pa

    nothing = [np.nan] * len(MOTION_PAIRS)
    rows = [nothing if text is None else json.loads(text) for text in texts]
    numbers = _relative(np.array(rows, dtype=np.float64), MOTION_BITS).astype(np.float32)
    missing = np.isnan(numbers[:, 0])
    parts = [pa.array(column, mask=missing) for column in numbers.T]
    return pa.StructArray.from_arrays(parts, names=list(MOTION_PAIRS), mask=pa.array(missing))


def parquet_of_small(rows: Sequence[Mapping[str, Any]]) -> bytes:
    """A small table as the bytes of a Parquet file; times are timestamps."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    names = [name for name in rows[0] if name != "digest"]
    columns = {}
    for name in names:
        array = pa.array([row[name] for row in rows])
        is_time = name.endswith("_utc")
        columns[name] = array.cast(pa.timestamp("us", tz="UTC")) if is_time else array
    output = io.BytesIO()
    pq.write_table(pa.table(columns), output, compression="zstd", coerce_timestamps="us")
    return output.getvalue()
