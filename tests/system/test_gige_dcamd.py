"""A real dcamd on two GigE Vision cameras: rows on their slots, and a camera that goes and comes.

Outside are two camera processes that serve images rendered by the simulator, one pair a slot; the
programs are started as a user starts them, and judged by their database, files and exit codes.
"""

from __future__ import annotations

import csv
import itertools
import signal
import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from daemon.config.reading import load_config
from drivers.frameset import FrameSetRow, format_slot, write_table
from drivers.sim.frameset_writer import FrameSetPlan, write_frame_set
from drivers.sim.settings import SimSettings
from tests.drivers.genicam.gige.bench import gige_network, image_index, read_pixels, running
from tests.drivers.genicam.gige.loopback import ADDRESSES
from tests.drivers.genicam.gige.process import CameraProcess
from tests.laboratory import laboratory
from tests.programs import Program, ran
from tests.waiting import PATIENCE_S

PERIOD_S = 2
N_SCENES = 8
SERIALS = {"main": "15290000", "sub": "15290001"}

CONFIG = (
    laboratory(320, "aravis", square_mm=8.0)
    + """
[schedule]
period_s = 2
[exposure]
main_us = 3000.0
sub_us = 20000.0
[quality]
max_skew_ms = 1000.0   # a loaded machine must not turn a good row into a suspect one
"""
)

VALUES = ("x_mm", "y_mm", "sigma_x_mm", "sigma_y_mm", "raw_x_mm", "raw_y_mm")
MOTION = ("rx_rad", "ry_rad", "rz_rad", "tx_mm", "ty_mm", "tz_mm")


@dataclass(frozen=True, slots=True)
class Place:
    """The site on this machine: its config, its state, and the images the cameras serve."""

    config: Path
    state: Path
    frames: Path
    scenes: dict[str, list[Path]]

    def run(self, *arguments: str | Path) -> str:
        """Run dcam-ctl on the site; it must succeed."""
        done = ran("daemon.ctl", *self.where(), *arguments)
        assert done.returncode == 0, done.stderr
        return done.stdout

    def where(self) -> list[str]:
        return ["--config", str(self.config), "--state", str(self.state)]

    def query(self, sql: str) -> list[tuple[str, ...]]:
        with closing(sqlite3.connect(f"file:{self.state}/dcam.db?mode=ro", uri=True)) as database:
            return database.execute(sql).fetchall()

    def scene(self, role: str, frame: str) -> int:
        """Which scene a frame on disk shows, pixel for pixel."""
        found = image_index(read_pixels(self.state / frame), self.scenes[role])
        assert found is not None, f"{frame} is none of the images that were served"
        return found

    def slots(self) -> list[datetime]:
        rows = self.query("SELECT slot_utc FROM measurement ORDER BY slot_utc")
        return [datetime.fromisoformat(row[0]) for row in rows]


@pytest.fixture(scope="module")
def network() -> Iterator[None]:
    with gige_network():
        yield


@pytest.fixture(scope="module")
def place(network: None, tmp_path_factory: pytest.TempPathFactory) -> Place:
    """A site that has been calibrated on a simulated frame set, and the scenes to be served."""
    directory = tmp_path_factory.mktemp("site")
    config = directory / "dcam.toml"
    config.write_text(CONFIG)
    frames = directory / "frames"
    plan = FrameSetPlan(intrinsics=10, rig=14, measure=N_SCENES)
    write_frame_set(frames, load_config(config).site(), SimSettings(), plan)
    with (frames / "frames.csv").open(newline="") as table:
        measure = [row for row in csv.DictReader(table) if row["role"] == "measure"]
    scenes = {role: [frames / row[role] for row in measure] for role in SERIALS}
    made = Place(config, directory / "state", frames, scenes)
    made.run("calibrate", "--from", frames, "--accept")
    return made


@pytest.fixture(scope="module")
def cameras(place: Place) -> Iterator[dict[str, CameraProcess]]:
    """Both cameras show the scene of the moment, so that they agree whenever they are started."""
    processes = {
        role: CameraProcess(
            address, SERIALS[role], place.scenes[role], ["--period-s", str(PERIOD_S)]
        )
        for role, address in zip(SERIALS, ADDRESSES, strict=True)
    }
    with running(*processes.values()):
        yield processes


@pytest.fixture(scope="module")
def history(place: Place, cameras: dict[str, CameraProcess]) -> dict[str, datetime]:
    """Run dcamd through the loss of a camera; tells when what happened."""
    log = place.state.parent / "dcamd.log"
    with Program("daemon.main", *place.where(), stderr=log) as dcamd:
        try:
            when = _lose_and_give_back(place, cameras["main"], dcamd)
            dcamd.send_signal(signal.SIGTERM)
            assert dcamd.wait(PATIENCE_S) == 0
        finally:
            dcamd.kill()
    return when


def _lose_and_give_back(place: Place, camera: CameraProcess, dcamd: Program) -> dict[str, datetime]:
    def wait_for(what: str, condition: Callable[[], bool]) -> datetime:
        deadline_s = time.monotonic() + PATIENCE_S
        while not condition():
            log = place.state.parent / "dcamd.log"
            assert dcamd.poll() is None, f"dcamd ended:\n{log.read_text()}"
            assert time.monotonic() < deadline_s, f"no {what}:\n{log.read_text()}"
            time.sleep(0.05)  # between two looks at the database
        return datetime.now(UTC)

    wait_for("rows", lambda: len(place.slots()) >= 4)
    camera.kill()
    killed = datetime.now(UTC)
    wait_for("gap", lambda: bool(_losses(place, killed)))
    camera.start()
    back = datetime.now(UTC)
    wait_for("rows after the gap", lambda: sum(slot > back for slot in place.slots()) >= 4)
    return {"killed": killed, "back": back}


def _losses(place: Place, since: datetime) -> list[str]:
    """What is said of the camera losses that began at the slot of a moment, or later."""
    first = format_slot((since - timedelta(seconds=2 * PERIOD_S)).replace(microsecond=0))
    causes = "SELECT detail FROM gap WHERE cause = 'camera_lost' AND start_utc > '{}'"
    return [detail for (detail,) in place.query(causes.format(first))]


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as table:
        return list(csv.DictReader(table))


def test_every_slot_has_its_row_or_lies_in_a_gap(
    place: Place, history: dict[str, datetime]
) -> None:
    slots = place.slots()
    assert len(set(slots)) == len(slots)
    assert all(slot.timestamp() % PERIOD_S == 0 for slot in slots)
    gaps = [
        (datetime.fromisoformat(start), datetime.fromisoformat(end), int(count))
        for start, end, count in place.query("SELECT start_utc, end_utc, slots FROM gap")
    ]
    step = timedelta(seconds=PERIOD_S)
    assert all((end - start) / step + 1 == count for start, end, count in gaps)
    missed = [start + k * step for start, _, count in gaps for k in range(count)]
    accounted = sorted(slots + missed)
    assert all(b - a == step for a, b in itertools.pairwise(accounted)), accounted


def test_a_lost_camera_is_a_gap_with_its_cause_and_rows_come_again(
    place: Place, history: dict[str, datetime]
) -> None:
    losses = _losses(place, history["killed"])
    assert losses
    assert all(SERIALS["main"] in detail for detail in losses)
    assert place.slots()[0] < history["killed"]
    assert place.slots()[-1] > history["back"]
    starts = place.query("SELECT count(*) FROM event WHERE kind = 'started'")
    assert starts == [(1,)]  # the daemon was not restarted
    assert "camera_lost" in place.run("gaps")


def test_frames_on_disk_are_what_the_cameras_served(
    place: Place, history: dict[str, datetime]
) -> None:
    rows = place.query("SELECT main_frame, sub_frame FROM measurement ORDER BY slot_utc")
    assert len(rows) >= 8
    scenes = [(place.scene("main", main), place.scene("sub", sub)) for main, sub in rows]
    assert len(set(scenes)) > 4  # not one and the same


def test_values_are_those_of_reprocess_on_the_same_images(
    place: Place, history: dict[str, datetime], tmp_path: Path
) -> None:
    """Twice: from the frames that dcamd kept, and from the very files that the cameras served."""
    exported = tmp_path / "export.csv"
    place.run("export", "--output", exported)
    measured = [row for row in _rows(exported) if row["flag"] != "9"]  # those lie in gaps
    kept = tmp_path / "kept.csv"
    place.run("reprocess", "--output", kept)
    served = tmp_path / "served.csv"
    place.run("reprocess", "--from", _served_set(place, tmp_path / "served"), "--output", served)
    for again in (_rows(kept), _rows(served)):
        assert [row["slot_utc"] for row in again] == [row["slot_utc"] for row in measured]
        for one, other in zip(measured, again, strict=True):
            assert one["flag"] == other["flag"] == "1", (one, other)
            for name in VALUES + MOTION:
                assert float(one[name]) == pytest.approx(float(other[name]), rel=0, abs=1.1e-6)


def test_values_are_true(place: Place, history: dict[str, datetime]) -> None:
    """Against the simulator's truth of the scene that was in front of the cameras."""
    truth = [row for row in _rows(place.frames / "truth.csv") if row["role"] == "measure"]
    z, sigmas_mm, false_mm = [], [], []
    rows = place.query(
        "SELECT main_frame, sub_frame, x_mm, y_mm, sigma_image_x_mm, sigma_image_y_mm"
        " FROM measurement"
    )
    for main, sub, *values in rows:
        x_mm, y_mm, *sigma_mm = map(float, values)
        scene = place.scene("main", main)
        if place.scene("sub", sub) == scene:  # not triggered just when the scene changed
            true = truth[scene]
            errors_mm = x_mm - float(true["x_mm"]), y_mm - float(true["y_mm"])
            z += [abs(error) / sigma for error, sigma in zip(errors_mm, sigma_mm, strict=True)]
            sigmas_mm += sigma_mm
            false_mm.append(abs(float(true["false_y_mm"])))
    assert len(false_mm) >= len(rows) - 1
    assert max(z) < 4.5
    assert max(sigmas_mm) < 0.3
    assert max(false_mm) > 2.0  # or there was nothing to compensate


def test_each_row_says_how_it_was_taken(place: Place, history: dict[str, datetime]) -> None:
    rows = place.query(
        "SELECT main_exposure_us, sub_exposure_us, main_gain_db, main_temperature_c, skew_s,"
        " calibration_id FROM measurement"
    )
    for main_us, sub_us, gain_db, temperature_c, skew_s, calibration in rows:
        assert (main_us, sub_us, gain_db, temperature_c) == (3000.0, 20000.0, 0.0, 41.5)
        assert abs(float(skew_s)) < 0.5
        assert calibration == 1


def _served_set(place: Place, directory: Path) -> Path:
    """A frame set of the served files, each under the slots at which it was taken."""
    directory.mkdir()
    rows = []
    taken = place.query("SELECT slot_utc, main_frame, sub_frame FROM measurement ORDER BY 1")
    for slot, *frames in taken:
        names = []
        for role, frame in zip(SERIALS, frames, strict=True):
            names.append(f"{slot.replace(':', '')}_{role}.png")
            (directory / names[-1]).symlink_to(place.scenes[role][place.scene(role, frame)])
        slot_utc = datetime.fromisoformat(slot)
        rows.append(FrameSetRow(slot_utc, "measure", *names, pan_deg=None, tilt_deg=None))
    write_table(directory, rows)
    return directory
