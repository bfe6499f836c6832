"""What dcamd measures is what `reprocess` makes of the same images, on time or late."""

import csv
import os
import sqlite3
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from daemon.config.reading import load_config
from daemon.store.database import open_store
from drivers.sim.frameset_writer import FrameSetPlan, write_frame_set
from drivers.sim.settings import SimSettings
from tests.laboratory import laboratory
from tests.programs import ran

SITE = (
    laboratory(320, "replay", square_mm=8.0)
    + """
[schedule]
period_s = 1
[replay]
directory = "frames"
"""
)
SLOTS = 3
VALUES = ("x_mm", "y_mm", "raw_x_mm", "raw_y_mm", "rx_rad", "ry_rad", "rz_rad", "tx_mm", "tz_mm")


def call(program: str, directory: Path, *arguments: str) -> str:
    site = {"DCAM_CONFIG": str(directory / "dcam.toml"), "DCAM_STATE": str(directory / "state")}
    result = ran(program, *arguments, env=os.environ | site)
    assert result.returncode == 0, result.stderr
    return result.stdout


def table(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text().splitlines()))


def measured(site: Path) -> list[dict[str, str]]:
    """The rows of slots that were measured: on a busy computer one may be missed, with its gap."""
    return [row for row in table(site / "rows.csv") if row["flag"] != "9"]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A calibrated small site, whose measure rows dcamd has replayed, one a second."""
    directory = tmp_path_factory.mktemp("site")
    (directory / "dcam.toml").write_text(SITE)
    config = load_config(directory / "dcam.toml")
    plan = FrameSetPlan(intrinsics=10, rig=14, measure=SLOTS)
    write_frame_set(directory / "frames", config.site(), SimSettings(), plan)
    call("daemon.ctl", directory, "calibrate", "--from", str(directory / "frames"), "--accept")
    call("daemon.main", directory, "--max-slots", str(SLOTS))
    call("daemon.ctl", directory, "export", "--output", str(directory / "rows.csv"))
    return directory


def test_rows_are_what_reprocess_makes_of_the_same_images(site: Path) -> None:
    output = site / "again.csv"
    call("daemon.ctl", site, "reprocess", "--from", str(site / "frames"), "--output", str(output))
    rows, again = measured(site), table(output)
    assert len(rows) == len(again) == SLOTS
    for row, other in zip(rows, again, strict=True):
        assert row["flag"] == other["flag"] == "1"
        for name in VALUES:
            assert float(row[name]) == pytest.approx(float(other[name]), abs=1e-9)


def test_rows_are_true_within_their_sigmas(site: Path) -> None:
    truth = [row for row in table(site / "frames" / "truth.csv") if row["role"] == "measure"]
    for row, true in zip(measured(site), truth, strict=True):
        for axis in ("x", "y"):
            error = float(row[f"{axis}_mm"]) - float(true[f"{axis}_mm"])
            assert abs(error) < 5 * float(row[f"sigma_{axis}_mm"])


def test_frames_on_the_disk_are_those_that_were_replayed(site: Path) -> None:
    import cv2

    given_rows = [row for row in table(site / "frames" / "frames.csv") if row["role"] == "measure"]
    for row, source in zip(measured(site), given_rows, strict=True):
        for role in ("main", "sub"):
            kept = cv2.imread(str(site / "state" / row[f"{role}_frame"]), cv2.IMREAD_UNCHANGED)
            given = cv2.imread(str(site / "frames" / source[role]), cv2.IMREAD_UNCHANGED)
            np.testing.assert_array_equal(kept, given)


def test_row_that_a_crash_took_is_measured_late_to_the_same_value(site: Path) -> None:
    with sqlite3.connect(site / "state" / "dcam.db") as database:
        query = "SELECT x_mm, y_mm FROM measurement ORDER BY id DESC LIMIT 1"
        measured_mm = list(database.execute(query).fetchone())
        database.execute("DELETE FROM measurement WHERE id = (SELECT max(id) FROM measurement)")
    database.close()
    lost = measured(site)[-1]

    call("daemon.main", site, "--max-slots", "1")

    with open_store(site / "state") as store:
        row = store.measurement(datetime.fromisoformat(lost["slot_utc"]))
    assert row.recorded_late
    assert row.measurement.corrected.mm.tolist() == measured_mm
    assert row.captured_utc == datetime.fromisoformat(lost["captured_utc"])
    assert row.captured_utc.tzinfo == UTC
