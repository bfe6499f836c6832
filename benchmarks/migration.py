"""How long a database of an older version takes to be brought up to date.

    python -m benchmarks.migration --rows 1000000 --revision 0006

The rows are those of a site of the version before further targets; each is read back after.
"""

from __future__ import annotations

import argparse
import sqlite3
import tempfile
import time
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path

from alembic import command

from daemon.store import migrate
from daemon.store.database import open_store
from daemon.store.engine import make_engine
from daemon.store.integrity.checksum import row_digest
from daemon.store.queries.columns import read_columns
from daemon.times import slot_text

BEGIN = datetime(2024, 3, 1, tzinfo=UTC)
_BATCH = 10_000


def write_old(path: Path, revision: str, rows: int, begin_utc: datetime = BEGIN) -> None:
    """A database of a revision, a row a minute."""
    engine = make_engine(path)
    config = migrate.alembic_config()
    with engine.execution_options(dcam_begin="IMMEDIATE").begin() as connection:
        config.attributes["connection"] = connection
        command.upgrade(config, revision)
    engine.dispose()
    with closing(sqlite3.connect(path)) as database:
        for first in range(0, rows, _BATCH):
            made = [
                old_row(number, begin_utc) for number in range(first, min(first + _BATCH, rows))
            ]
            names, places = ", ".join(made[0]), ", ".join("?" * len(made[0]))
            statement = f"INSERT INTO measurement ({names}) VALUES ({places})"
            database.executemany(statement, [tuple(row.values()) for row in made])
            database.commit()


def old_row(number: int, begin_utc: datetime = BEGIN) -> dict[str, object]:
    """A row as revision 0006 has it, with its checksum."""
    row: dict[str, object] = {
        "id": number + 1,
        "slot_utc": slot_text(begin_utc + timedelta(minutes=number)),
        "flag": 1,
        "reasons": "",
        "x_mm": 0.25 + 1e-6 * number,
        "y_mm": 0.5,
        "sigma_x_mm": 0.1,
        "sigma_y_mm": 0.2,
        "cov_xy_mm2": 0.001,
        "discs_found": 5,
        "corners_used": 900,
        "frames_used": 1,
        "recorded_late": 0,
        "config_hash": "c0ffee",
        "version": "0.1",
    }
    row["digest"] = row_digest("measurement", row)
    return row


def main() -> None:
    """Print the seconds, and whether all rows read the same."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--revision", default="0006")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        state = Path(directory)
        write_old(state / "dcam.db", asked.revision, asked.rows)
        wall_s, cpu_s = time.monotonic(), time.process_time()
        with open_store(state, now_utc=BEGIN):
            pass
        wall_s, cpu_s = time.monotonic() - wall_s, time.process_time() - cpu_s
        until = BEGIN + timedelta(minutes=asked.rows)
        same = sum(
            values["x_mm"] == 0.25 + 1e-6 * (values["id"] - 1) and values["sigma_y_mm"] == 0.2
            for batch in read_columns(state / "dcam.db", BEGIN, until)
            for values in batch.rows()
        )
    print(
        f"{asked.rows} rows of revision {asked.revision} brought up to date in {wall_s:.1f} s, "
        f"{cpu_s:.1f} s of CPU; {same} read the same"
    )


if __name__ == "__main__":
    main()
