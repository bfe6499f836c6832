"""A slot of several pairs in hot air: taken, kept, combined, recovered and measured again alike."""

from __future__ import annotations

import json
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from core.arrays import FloatArray
from core.results import Flag
from daemon.commands.demo import truth_mm
from daemon.config.reading import find_installation
from daemon.main import serve
from daemon.store.database import open_store_readonly
from daemon.store.frames.archive import FrameArchive
from daemon.store.records import MeasurementRecord
from tests.daemon.commands.conftest import SIMULATED, Ctl, rows_of

PAIRS, SLOTS, HAZE_MM = 6, 3, 0.4
BURST = f"[schedule]\nburst = {PAIRS}\nburst_spacing_s = 0.25\n"
HAZE = f'haze_mm = {HAZE_MM}\n[[simulation.scenarios]]\nkind = "haze"\n'
VALUES = ("x_mm", "y_mm", "sigma_x_mm", "sigma_y_mm", "raw_x_mm", "rx_rad", "tz_mm", "spread_x_mm")


@pytest.fixture(scope="module")
def hazy(calibrated: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A site on a hot day whose dcamd has run for three slots; not to be changed."""
    directory = tmp_path_factory.mktemp("hazy")
    shutil.copytree(calibrated, directory / "state")
    (directory / "dcam.toml").write_text(f"{SIMULATED}{HAZE}{BURST}")
    serve(find_installation(directory / "dcam.toml", directory / "state"), max_slots=SLOTS)
    return directory


def records(directory: Path) -> list[MeasurementRecord]:
    with open_store_readonly(directory / "state") as store:
        return list(store.measurements())


def errors_mm(directory: Path, rows: list[MeasurementRecord]) -> FloatArray:
    site = find_installation(directory / "dcam.toml", directory / "state")
    values = np.array([row.measurement.corrected.mm for row in rows])
    return values - truth_mm(site, rows)


def test_each_slot_is_one_row_that_tells_the_haze(hazy: Path) -> None:
    rows = records(hazy)
    assert [row.measurement.frames_used for row in rows] == [PAIRS] * SLOTS
    spread = np.array([row.measurement.spread_mm for row in rows])
    assert np.sqrt(np.mean(spread**2)) == pytest.approx(HAZE_MM, rel=0.3)


def test_the_mean_is_nearer_to_the_truth_and_knows_by_how_much(hazy: Path) -> None:
    """Haze of 0.4 mm a pair; six pairs leave 0.16 mm, and the rows' sigmas say so."""
    rows = records(hazy)
    off = errors_mm(hazy, rows)
    sigma = np.sqrt([np.diag(row.measurement.corrected.covariance_mm2) for row in rows])
    assert np.sqrt(np.mean(off**2)) < 0.6 * HAZE_MM
    assert 0.3 < np.sqrt(np.mean((off / sigma) ** 2)) < 2.0


def test_every_pair_is_kept_and_measured_again_to_the_same_row(
    hazy: Path, ctl: Ctl, tmp_path: Path
) -> None:
    archive = FrameArchive(hazy / "state")
    slots = archive.stored_slots()
    assert [archive.numbers(slot) for slot in slots] == [list(range(1, PAIRS + 1))] * SLOTS
    site = ("--config", hazy / "dcam.toml", "--state", hazy / "state")
    day = hazy / "state" / f"frames/{slots[0]:%Y/%m/%d}"
    ctl(*site, "export", "--output", tmp_path / "stored.csv")
    for source in ([], ["--from", day]):
        ran = ctl(*site, "reprocess", *source, "--output", tmp_path / "again.csv")
        assert ran.code == 0, ran.err
        stored, again = rows_of(tmp_path / "stored.csv"), rows_of(tmp_path / "again.csv")
        assert len(again) == SLOTS
        for one, other in zip(stored, again, strict=True):
            for name in ("slot_utc", "flag", "reasons", "frames_used"):
                assert other[name] == one[name]
            for name in VALUES:
                assert float(other[name]) == pytest.approx(float(one[name]), abs=1e-9)


def test_a_burst_without_its_row_is_measured_late_as_a_whole(hazy: Path, tmp_path: Path) -> None:
    """What a kill between frames and row leaves; one pair was cut off by it."""
    shutil.copytree(hazy, tmp_path / "hazy")
    state = tmp_path / "hazy" / "state"
    before = records(hazy)[-1]
    with closing(sqlite3.connect(state / "dcam.db")) as database, database:
        database.execute("DELETE FROM measurement WHERE id = (SELECT max(id) FROM measurement)")
    serve(find_installation(tmp_path / "hazy" / "dcam.toml", state), max_slots=1)
    with open_store_readonly(state) as store:
        late = store.measurement(before.slot_utc)
    assert late is not None
    assert late.recorded_late
    assert late.measurement.frames_used == PAIRS
    assert late.measurement.corrected.mm == pytest.approx(before.measurement.corrected.mm, abs=1e-9)
    assert late.measurement.spread_mm == pytest.approx(before.measurement.spread_mm, abs=1e-9)


def test_a_damaged_pair_costs_itself_only(hazy: Path, ctl: Ctl, tmp_path: Path) -> None:
    shutil.copytree(hazy, tmp_path / "hazy")
    state = tmp_path / "hazy" / "state"
    slot = FrameArchive(state).stored_slots()[0]
    image = state / f"frames/{slot:%Y/%m/%d/%H%M%S}_02_sub.png"
    image.write_bytes(image.read_bytes()[:100])
    ran = ctl("--config", hazy / "dcam.toml", "--state", state, "reprocess", "--json")
    rows = json.loads(ran.out)["rows"]
    assert [row["frames_used"] for row in rows] == [PAIRS - 1] + [PAIRS] * (SLOTS - 1)


def test_capture_takes_a_burst_and_prints_its_spread(hazy: Path, ctl: Ctl) -> None:
    site = ("--config", hazy / "dcam.toml", "--state", hazy / "state")
    document = json.loads(ctl(*site, "capture", "--json").out)
    assert document["pairs"] == document["measurement"]["frames_used"] == PAIRS
    assert 0.05 < document["measurement"]["spread_x_mm"] < 1.5
    assert f"of {PAIRS} pairs" in ctl(*site, "capture").out


def test_vibration_is_compensated_but_for_what_the_cameras_do_apart(
    calibrated: Path, tmp_path: Path
) -> None:
    """The rig shakes by 0.05 mrad, 0.5 mm at the target; a tenth of that the main camera alone."""
    shutil.copytree(calibrated, tmp_path / "state")
    shaking = '[[simulation.scenarios]]\nkind = "vibration"\n'
    (tmp_path / "dcam.toml").write_text(f"{SIMULATED}{shaking}{BURST}")
    serve(find_installation(tmp_path / "dcam.toml", tmp_path / "state"), max_slots=2)
    for row in records(tmp_path):
        assert row.measurement.flag is Flag.GOOD
        assert 0.02 < np.abs(row.measurement.spread_mm).max() < 0.25


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ("burst = 33", "schedule.burst: must be at most 32"),
        ("burst = 0", "schedule.burst: must be at least 1"),
        ("burst = 5\nperiod_s = 4", "schedule.burst: 5 pairs 0.5 s apart may take 4"),
        ("burst = 2\nburst_spacing_s = 60.0", "schedule.burst: 2 pairs 60 s apart may take 62"),
        ("burst = 2\nburst_spacing_s = 0.004", "schedule.burst_spacing_s: must be longer than the"),
        ("burst_space_s = 0.1", "schedule.burst_space_s"),
    ],
)
def test_a_burst_that_does_not_fit_its_slot_is_refused(
    ctl: Ctl, tmp_path: Path, changes: str, message: str
) -> None:
    (tmp_path / "dcam.toml").write_text(f"{SIMULATED}[schedule]\n{changes}\n")
    ran = ctl("--config", tmp_path / "dcam.toml", "--state", tmp_path / "state", "check")
    assert ran.code == 3
    assert len(ran.err.strip().splitlines()) == 1
    assert message in ran.err
