"""`[exposure] mode = "auto"` as an operator meets it: values through the night, and no whims."""

import csv
import json
import re
import shutil
from collections.abc import Sequence
from datetime import timedelta
from pathlib import Path

import numpy as np

from core.results import Flag, Reason
from daemon.config.reading import load_config
from daemon.store.database import open_store_readonly
from daemon.store.records import MeasurementRecord
from drivers.sim.world import World
from tests.daemon.commands.conftest import SIMULATED, Ctl
from tests.programs import ran

AT_REST_BEFORE = timedelta(minutes=100)


def scenario(kind: str, start_min: float, end_min: float, more: str = "") -> str:
    window = f"start_min = {start_min}\nend_min = {end_min}\n{more}"
    return f'[[simulation.scenarios]]\nkind = "{kind}"\n{window}'


class Pier:
    """A calibrated site and its daemon, run for so many slots at a time."""

    def __init__(self, directory: Path, calibrated: Path, mode: str, story: str) -> None:
        self.state = Path(shutil.copytree(calibrated, directory / mode / "state"))
        self.toml = directory / mode / "dcam.toml"
        motion = (
            '[[simulation.scenarios]]\nkind = "drift"\n[[simulation.scenarios]]\nkind = "bridge"\n'
        )
        self.toml.write_text(f'{SIMULATED}{story}{motion}\n[exposure]\nmode = "{mode}"\n')

    def run(self, slots: int) -> list[MeasurementRecord]:
        """Run dcamd; give all rows there are then."""
        where = ("--config", self.toml, "--state", self.state)
        done = ran("daemon.main", *where, "--max-slots", slots)
        assert done.returncode == 0, done.stderr
        self.log = done.stderr
        with open_store_readonly(self.state) as store:
            return list(store.measurements())

    def errors_in_sigmas(self, rows: Sequence[MeasurementRecord]) -> list[float]:
        """How far each value is from the truth."""
        config = load_config(self.toml)
        world = World(config.site(), config.simulation.settings(), renders=False)
        reference_utc = config.simulation.start_utc - AT_REST_BEFORE
        away = []
        for row in rows:
            value = row.measurement.corrected
            assert value is not None
            error_mm = value.mm - world.truth(row.slot_utc, reference_utc).displacement_mm
            away.append(float(np.sqrt(error_mm @ np.linalg.solve(value.covariance_mm2, error_mm))))
        return away


def exposures(rows: Sequence[MeasurementRecord]) -> list[tuple[float | None, ...]]:
    return [
        (camera.exposure_us, camera.gain_db)
        for row in rows
        for camera in (row.main_camera, row.sub_camera)
    ]


NIGHT = "night_light = 0.02\ndusk_min = 10\n" + scenario("night", 1, 25)
"""The light falls to a fiftieth within ten minutes, four times as fast as dusk, and comes again."""


def test_through_dusk_night_and_dawn_values_stay_good(tmp_path: Path, calibrated: Path) -> None:
    """Longer exposure, then gain; the camera is lost for a while at night; nothing is biased."""
    lost = scenario("camera_loss", 13, 14, 'role = "sub"\n')
    pier = Pier(tmp_path, calibrated, "auto", NIGHT + lost)
    rows = pier.run(13)
    dark = rows[-1].main_camera, rows[-1].sub_camera
    rows = pier.run(14)  # after a restart, in the dark
    assert len(rows) == 26
    after_loss = rows[13]
    assert {row.measurement.flag for row in rows} == {Flag.GOOD}
    assert all(camera.exposure_us == 100_000.0 for camera in dark)
    assert all(3.0 < (camera.gain_db or 0.0) <= 12.0 for camera in dark)
    assert (after_loss.main_camera.exposure_us, after_loss.sub_camera.exposure_us) == (1e5, 1e5)
    assert all(
        (camera.exposure_us or 0.0) < 10_000.0
        for camera in (rows[-1].main_camera, rows[-1].sub_camera)
    )
    assert max(pier.errors_in_sigmas(rows)) < 4.0
    largest_mm = max(
        float(np.sqrt(np.diag(row.measurement.corrected.covariance_mm2)).max()) for row in rows
    )
    assert largest_mm < 0.07
    assert len(set(exposures(rows))) > 10
    with next(pier.state.glob("frames/**/frames.csv")).open(newline="") as table:
        kept = [
            (float(line["exposure_main_us"]), float(line["gain_main_db"]))
            for line in csv.DictReader(table)
        ]
    assert kept == [(row.main_camera.exposure_us, row.main_camera.gain_db) for row in rows]


def test_with_fixed_exposure_the_night_has_no_values(tmp_path: Path, calibrated: Path) -> None:
    rows = Pier(tmp_path, calibrated, "fixed", NIGHT).run(13)
    assert set(exposures(rows)) == {(5000.0, 0.0)}
    assert [row.measurement.flag for row in rows[-3:]] == [Flag.BAD] * 3
    assert all(Reason.TOO_DARK in row.measurement.reasons for row in rows[-3:])


def test_lamps_that_fail_and_come_again_cost_a_few_slots(tmp_path: Path, calibrated: Path) -> None:
    """Without any dusk: one slot to find the target again in the dark, one in the light."""
    story = "night_light = 0.02\n" + scenario("night", 2, 7)
    rows = Pier(tmp_path, calibrated, "auto", story).run(13)
    assert [row.measurement.corrected is not None for row in rows] == (
        [True, True] + [False] + [True] * 4 + [False] + [True] * 5
    )
    assert [row.measurement.flag for row in rows[-3:]] == [Flag.GOOD] * 3


def test_what_is_no_change_of_light_changes_no_exposure(tmp_path: Path, calibrated: Path) -> None:
    """An insect on either target, a web, a sheet before them; a wide glare by less than a stop."""
    kinds = ("insect_main", "insect_sub", "cobweb", "cover", "glare")
    story = "".join(scenario(kind, k, k + 1) for k, kind in enumerate(kinds, start=1))
    rows = Pier(tmp_path, calibrated, "auto", story).run(8)
    assert set(exposures(rows[:6])) == {(5000.0, 0.0)}
    assert all((exposure_us or 0.0) > 2500.0 for exposure_us, _ in exposures(rows))
    assert [row.measurement.flag for row in rows[-2:]] == [Flag.GOOD] * 2


def test_a_preview_follows_the_light(tmp_path: Path, calibrated: Path, ctl: Ctl) -> None:
    """From a start ten times too short, look by look."""
    pier = Pier(tmp_path, calibrated, "auto", "")
    pier.toml.write_text(pier.toml.read_text() + "main_us = 500.0\nsub_us = 500.0\n")
    done = ctl(
        *("--config", pier.toml, "--state", pier.state),
        *("preview", "--port", 0, "--looks", 4, "--interval", 0.1),
    )
    assert done.code == 0, done.err
    brightest = [re.findall(r"brightest (\d+)%", line) for line in done.out.splitlines()]
    assert len(brightest) == 4
    assert all(int(share) < 15 for share in brightest[0])
    assert all(60 < int(share) < 95 for share in brightest[-1])


def test_capture_settles_the_light_first(tmp_path: Path, calibrated: Path, ctl: Ctl) -> None:
    """With a start ten times too short a single capture still gives a value."""
    pier = Pier(tmp_path, calibrated, "auto", "")
    pier.toml.write_text(pier.toml.read_text() + "main_us = 500.0\nsub_us = 300.0\n")
    done = ctl("--config", pier.toml, "--state", pier.state, "capture", "--json")
    assert done.code == 0, done.err
    reported = json.loads(done.out)
    assert 2500.0 < reported["main"]["exposure_us"] < 7000.0
    assert 2500.0 < reported["sub"]["exposure_us"] < 7000.0
    assert reported["measurement"]["flag"] == 1
