"""What the fixed targets together showed, as means of the hours of one calibration.

Plain SQL and no numerics: a daemon asks once a day.
"""

from __future__ import annotations

from contextlib import closing
from datetime import datetime
from pathlib import Path

import numpy as np

from core.arrays import FloatArray
from core.results import Reason
from daemon.store.rows.known import KNOWN
from daemon.store.runs import next_second
from daemon.store.sqlite import connect_readonly, said_plainly
from daemon.times import slot_text

HOUR = len("2026-03-01T00")
"""Characters of a slot's text that name its hour."""


def hourly_closures(
    path: Path, calibration_id: int, since: datetime, until: datetime, before_id: int
) -> FloatArray:
    """(n, 4) hours with since <= slot < until: middle (s since 1970), temperature (C), x, y (mm).

    Of known rows of one calibration with a closure that the budget explains. Raises StoreError.
    """
    query = (
        "SELECT substr(slot_utc, 1, ?), avg(coalesce(main_temperature_c, sub_temperature_c)),"  # noqa: S608 - our own words
        " avg(closure_x_mm), avg(closure_y_mm) FROM measurement"
        " WHERE closure_x_mm IS NOT NULL AND slot_utc >= ? AND slot_utc < ?"
        " AND calibration_id = ? AND instr(reasons, ?) = 0"
        " AND coalesce(main_temperature_c, sub_temperature_c) IS NOT NULL"
        f" AND {KNOWN} GROUP BY 1 ORDER BY 1"
    )
    limits = [slot_text(next_second(time)) for time in (since, until)]
    values = (HOUR, *limits, calibration_id, Reason.CLOSURE_TOO_LARGE.value, before_id)
    with said_plainly(path), closing(connect_readonly(path)) as connection:
        rows = connection.execute(query, values).fetchall()
    hours = [(middle_of_hour_s(hour), *means) for hour, *means in rows]
    return np.array(hours, dtype=np.float64).reshape(-1, 4)


def middle_of_hour_s(hour: str) -> float:
    """The middle of an hour by its text, seconds since 1970."""
    return datetime.fromisoformat(f"{hour}:30:00Z").timestamp()
