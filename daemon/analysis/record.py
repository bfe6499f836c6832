"""One point of a record as the analysis reads it: good rows, with the readings beside them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np

from core.arrays import FloatArray
from core.results import Flag
from core.site import MAIN, TargetRole
from daemon.errors import UsageError, WorkFailedError
from daemon.store.ledger.exclusion import ExcludedRows, Exclusion, read_exclusion
from daemon.store.queries.columns import Columns, Tell, read_columns, target_roles
from daemon.store.queries.sensors import Sensor, sensor_columns, sensors_within
from daemon.store.rows.targets import values_of_targets
from daemon.time_arrays import utc_array

CAMERAS = {"main-camera": "main_temperature_c", "sub-camera": "sub_temperature_c"}
"""What the cameras say of their own temperatures, and its columns."""
CELSIUS = "degC"


@dataclass(frozen=True, slots=True)
class Channel:
    """A reading beside the displacement."""

    name: str
    unit: str


@dataclass(frozen=True, slots=True)
class Record:
    """The rows of a point; a value only where a row is good and not excluded."""

    point: str
    times_s: FloatArray
    """(rows,) seconds since 1970, UTC."""
    values_mm: FloatArray
    """(rows, 2) x, y; NaN where the row is not good, or left out."""
    readings: FloatArray
    """(rows, channels); NaN where there is none."""
    channels: tuple[Channel, ...]
    excluded: ExcludedRows


class RecordReader:
    """A point's record, put together of rows as they are read, here or by somebody else."""

    def __init__(
        self,
        path: Path,
        since: datetime,
        until: datetime,
        *,
        point: str = MAIN,
        readings: Sequence[str] = (),
        with_excluded: bool = False,
    ) -> None:
        """Look for the point and the readings named in the span; without a name, those in degC.

        What the quality ledger excludes is left out unless `with_excluded`.
        Raises UsageError for a name that is none, StoreError.
        """
        _require_point(path, since, until, point)
        self._path, self._span, self._point = path, (since, until), point
        self._chosen = _channels(path, since, until, readings)
        self._sensors = [sensor for sensor in self._chosen if isinstance(sensor, Sensor)]
        self._exclusion = read_exclusion(path, point, with_excluded=with_excluded)
        self._times: list[FloatArray] = []
        self._values: list[FloatArray] = []
        self._said: list[FloatArray] = []

    def add(self, rows: Columns) -> None:
        """Take rows, in the order of their slots."""
        seconds = utc_array(rows.values["slot_utc"]).astype("datetime64[s]")
        self._times.append(seconds.astype(np.float64))
        self._values.append(_values(rows, self._point, self._exclusion))
        sensors = self._sensors
        by_sensor = sensor_columns(rows.values["readings"], sensors) if sensors else {}
        columns = [
            by_sensor[one.column] if isinstance(one, Sensor) else rows.values[CAMERAS[one]]
            for one in self._chosen
        ]
        said = np.array(columns, dtype=np.float64).T
        self._said.append(said.reshape(len(rows), len(self._chosen)))

    def read(self, tell: Tell = lambda _done, _total: None) -> Record:
        """Read the rows. Raises WorkFailedError without any row, StoreError."""
        for rows in read_columns(self._path, *self._span, tell):
            self.add(rows)
        return self.record()

    def record(self) -> Record:
        """Give what was taken. Raises WorkFailedError without any row."""
        if not self._times:
            msg = f"{self._path}: no row in this span"
            raise WorkFailedError(msg)
        channels = tuple(
            Channel(one.name, one.unit) if isinstance(one, Sensor) else Channel(one, CELSIUS)
            for one in self._chosen
        )
        return Record(
            self._point,
            np.concatenate(self._times),
            np.vstack(self._values),
            np.vstack(self._said),
            channels,
            self._exclusion.found(),
        )


def _values(rows: Columns, point: str, exclusion: Exclusion) -> FloatArray:
    """(rows, 2) x, y of the good rows that stay."""
    if point == MAIN:
        flags, values = np.array(rows.values["flag"]), rows.numbers("x_mm", "y_mm")
    else:
        keys = ("flag", "x_mm", "y_mm")
        found = values_of_targets(rows.values["targets"], [point], keys)
        columns = np.array(list(found.values()), dtype=np.float64)
        flags, values = columns[0], columns[1:].T
    kept = exclusion.keep(rows.values["slot_utc"], flags == Flag.GOOD)
    return np.where(kept[:, None], values, np.nan)


def _require_point(path: Path, since: datetime, until: datetime, point: str) -> None:
    if point == MAIN:
        return
    roles = target_roles(path, since, until)
    measured = [name for name, role in roles.items() if role == TargetRole.MEASURED]
    if point not in measured:
        names = ", ".join([MAIN, *measured])
        msg = f"--point {point}: no measured point of this name in the span; there are: {names}"
        raise UsageError(msg)


def _channels(
    path: Path, since: datetime, until: datetime, names: Sequence[str]
) -> list[Sensor | str]:
    """The sensors and cameras that are named, else all in degC, else the main camera."""
    sensors = sensors_within(path, since, until)
    known: dict[str, Sensor | str] = {name: name for name in CAMERAS}
    known |= {sensor.name: sensor for sensor in sensors}  # of two units the newer stays
    if unknown := [name for name in names if name not in known]:
        msg = f"--reading {unknown[0]}: no reading of this name in the span; there are: "
        raise UsageError(msg + ", ".join(known))
    if names:
        return [known[name] for name in names]
    warm: list[Sensor | str] = [sensor for sensor in sensors if sensor.unit == CELSIUS]
    return warm or ["main-camera"]
