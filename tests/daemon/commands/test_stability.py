"""`dcam-ctl stability` from outside: what a record shows of its rig against its config."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from core.calibration.calibrate import Calibration
from core.images import GreyImage
from core.moment import Moment
from core.quality.fixed_targets import PastRow
from core.results import Displacement, Flag, Measurement, TargetMeasurement
from core.rig.calibrated_target import CalibratedTarget
from core.site import ExtraTarget, TargetRole
from daemon.burst import BurstPlan, take_burst
from daemon.config.reading import load_config
from daemon.slots.learner import ComputedClosures, Learner
from daemon.slots.measuring import active_calibration
from daemon.slots.pipeline import SlotContext, run_slot
from daemon.slots.snapshot import measure_look
from daemon.store.database import open_store
from daemon.store.records import CameraState, MeasurementRecord
from drivers.frameset import read_frame_set, read_image
from drivers.protocols import CapturedPair
from tests.daemon.commands.conftest import GOOD, Ctl, Ran
from tests.daemon.conftest import ScriptedSource, Station, SteppedClock
from tests.daemon.rows import add_rows

REFERENCE = datetime(2026, 4, 1, tzinfo=UTC)
LATER = REFERENCE + timedelta(days=20, hours=1)
DISTANCE_MM = 21_500.0
C_URAD_PER_K = (3.0, -4.0)
WARM_C = 20.0
"""When the fixed target is hidden; 12 at the reference."""


class Watched:
    """A calibrated state with a fixed target in the calibration, and rows made by hand."""

    def __init__(self, bench: Path, calibrated: Path, directory: Path, ctl: Ctl) -> None:
        self.any_ctl, self.config = ctl, bench / "dcam.toml"
        self.state = Path(shutil.copytree(calibrated, directory / "state"))
        self.number = self.calibrate()
        self.walk_urad = np.zeros(2)
        """Where the creep has come to."""

    def calibrate(self) -> int:
        """Add a calibration whose reference shows a fixed target; its number."""
        with open_store(self.state) as store:
            active = store.active_calibration()
            assert active is not None
            made = active.calibration.calibrated
            plate = CalibratedTarget(
                "abutment",
                TargetRole.FIXED,
                made.reference_discs_px + 100.0,
                np.zeros(len(made.reference_discs_px)),
                made.B,
                DISTANCE_MM,
                20.0,
            )
            calibration = Calibration(
                active.calibration.method,
                replace(made, further=(plate,)),
                Moment(REFERENCE.timestamp(), 12.0),
            )
            record = replace(active, content=calibration.to_dict(), id=None)
            store.add_calibration(record, activate=True)
            added = store.active_calibration()
            assert added is not None
            assert added.id is not None
            return added.id

    def watch(
        self, days: int, *, swing_k: float = 5.0, rise_k: float = 0.02, celsius: bool = True
    ) -> None:
        """A row an hour, the rig turning by so much for each kelvin, and creeping."""
        rng = np.random.default_rng(1)
        walk_urad = self.walk_urad
        rows = []
        for hour in range(1, 24 * days):
            slot = REFERENCE + timedelta(hours=hour)
            warmth_k = swing_k * math.sin(2.0 * math.pi * hour / 24.0) + rise_k * hour
            walk_urad += rng.normal(0.0, 0.2, 2)
            urad = np.multiply(C_URAD_PER_K, warmth_k) + walk_urad + rng.normal(0.0, 0.1, 2)
            camera = CameraState(temperature_c=12.0 + warmth_k if celsius else None)
            rows.append(
                MeasurementRecord(
                    *(slot, seen(1e-6 * DISTANCE_MM * urad), "hash", "1.0"),
                    main_camera=camera,
                    calibration_id=self.number,
                )
            )
        with open_store(self.state) as store:
            add_rows(store, rows)

    def ctl(self, *arguments: object) -> Ran:
        return self.any_ctl("--config", self.config, "--state", self.state, "stability", *arguments)


def seen(mm: np.ndarray) -> Measurement:
    """A row whose fixed target seems to have moved by so much."""
    closure = Displacement(mm, np.eye(2) * 0.2**2, image_mm2=np.eye(2) * 0.003**2)
    plate = TargetMeasurement("abutment", TargetRole.FIXED, Flag.GOOD, (), closure, closure)
    return replace(GOOD, closure=closure, targets=(plate,))


class Replayed(ScriptedSource):
    """Cameras that give a stored pair, at a temperature."""

    def __init__(self, clock: SteppedClock, pair: tuple[GreyImage, GreyImage]) -> None:
        super().__init__(clock)
        self._pair = pair

    def capture(self, slot_utc: datetime) -> CapturedPair:
        captured = super().capture(slot_utc)
        main, sub = (
            replace(frame, pixels=image.pixels, bits=image.bits, temperature_c=WARM_C)
            for frame, image in zip((captured.main, captured.sub), self._pair, strict=True)
        )
        return replace(captured, main=main, sub=sub)


def without_its_plate(watched: Watched, bench: Path) -> tuple[SlotContext, Replayed]:
    """What dcamd would measure: a pair that does not show the site's fixed target."""
    station = Station(watched.state)
    site = load_config(bench / "dcam.toml").site()
    plate = ExtraTarget("abutment", TargetRole.FIXED, site.main_target)
    context = replace(station.context, site=replace(site, extra_targets=(plate,)))
    row = read_frame_set(bench / "set").slots_of("measure")[0][0]
    assert row.main is not None
    assert row.sub is not None
    pair = (read_image(bench / "set" / row.main), read_image(bench / "set" / row.sub))
    return context, Replayed(station.clock, pair)


def measured(watched: Watched, bench: Path) -> MeasurementRecord:
    """The row that dcamd makes of such a pair, 20 days after the reference."""
    context, source = without_its_plate(watched, bench)
    record = run_slot(context, LATER, source)
    assert isinstance(record, MeasurementRecord)
    assert record.measurement.closure is None
    return record


@pytest.fixture
def watched(bench: Path, calibrated: Path, tmp_path: Path, ctl: Ctl) -> Watched:
    return Watched(bench, calibrated, tmp_path, ctl)


def test_the_rigs_coefficients_are_shown_against_the_config(watched: Watched) -> None:
    watched.watch(20)
    ran = watched.ctl("--json")
    assert ran.code == 0, ran.err
    document = json.loads(ran.out)
    assert document["schema"] == 1
    for axis, c in zip("xy", C_URAD_PER_K, strict=True):
        found = document["joined"][axis]["urad_per_k"]
        assert found["value"] == pytest.approx(c, abs=4.0 * found["sigma"])
        assert 0.0 < found["sigma"] < 0.1
    assert document["joined"]["urad_per_sqrt_day"]["value"] == pytest.approx(0.98, rel=0.2)
    assert list(document["calibrations"]) == [str(watched.number)]
    said = watched.ctl().out
    assert "turning with temperature: the record shows 3.5 ± 0.0" in said
    assert ": widen it" in said
    assert "warming and cooling: no difference is shown" in said


def test_the_lines_can_be_pasted_and_then_fit_the_record(watched: Watched, tmp_path: Path) -> None:
    watched.watch(20)
    lines = watched.ctl().out.partition("[stability]\n")[2]
    pasted = tmp_path / "pasted.toml"
    pasted.write_text(watched.config.read_text() + "\n[stability]\n" + lines)
    ran = watched.any_ctl("--config", pasted, "--state", watched.state, "stability", "--json")
    assert ran.code == 0, ran.err
    warmth, creep, _ = json.loads(ran.out)["verdicts"]
    for verdict in (warmth, creep):
        assert verdict["allowed"] == pytest.approx(verdict["shown"]["value"], rel=0.1)
        assert verdict["text"].endswith("leave it")


def test_two_calibrations_are_fitted_each_and_together(watched: Watched) -> None:
    watched.watch(10)
    said = watched.ctl("--until", "2026-04-09").out
    assert f"calibrations {watched.number - 1} and {watched.number}: the rig's angles" in said
    assert "within their sigma" in said


@pytest.mark.parametrize(
    ("make", "missing"),
    [
        (lambda _: None, "no row with a good fixed target and the camera's temperature"),
        (lambda one: one.watch(9, celsius=False), "no row with a good fixed target"),
        (lambda one: one.watch(3), "seen in 71 hours of 2.9 days: needs 72 hours within 7 days"),
        (lambda one: one.watch(9, swing_k=0.1, rise_k=0.0), "temperature changed by 0.2 K only"),
    ],
)
def test_what_is_missing_is_one_clear_line(
    watched: Watched, make: Callable[[Watched], None], missing: str
) -> None:
    make(watched)
    ran = watched.ctl()
    assert ran.code == 1
    assert missing in ran.err
    assert len(ran.err.strip().splitlines()) == 1


def test_what_was_learnt_corrects_rows_while_the_fixed_target_is_hidden(
    watched: Watched, bench: Path, calibrated: Path, tmp_path: Path, ctl: Ctl
) -> None:
    watched.watch(20)
    with_it = measured(watched, bench).measurement.corrected
    ignorant = Watched(bench, calibrated, tmp_path / "ignorant", ctl)
    without = measured(ignorant, bench).measurement.corrected
    assert with_it is not None
    assert without is not None
    turn_urad = np.multiply(C_URAD_PER_K, WARM_C - 12.0) + watched.walk_urad
    main_mm = load_config(bench / "dcam.toml").site().main_target.distance_mm
    taken_off_mm = without.mm - with_it.mm
    sigma_mm = np.sqrt(np.diag(with_it.covariance_mm2))
    assert np.all(np.abs(taken_off_mm - 1e-6 * main_mm * turn_urad) < 3.0 * sigma_mm)
    assert np.all(np.abs(taken_off_mm) > 5.0 * sigma_mm)
    assert np.all(sigma_mm < 0.5 * np.sqrt(np.diag(without.covariance_mm2)))


def test_capture_measures_as_the_row_would(watched: Watched, bench: Path) -> None:
    """What was learnt of the rig is in it too."""
    watched.watch(20)
    context, source = without_its_plate(watched, bench)
    calibration = active_calibration(context.store)
    shots = take_burst(source, context.clock, LATER, BurstPlan())
    look = measure_look(shots, LATER, context.site, calibration, context.store, Learner())
    context.store.close()
    row = measured(watched, bench).measurement
    assert look.corrected is not None
    assert row.corrected is not None
    np.testing.assert_allclose(look.corrected.mm, row.corrected.mm, atol=1e-4)
    np.testing.assert_allclose(
        look.corrected.covariance_mm2, row.corrected.covariance_mm2, rtol=0.05
    )


def test_reprocess_learns_from_the_same_numbers_as_dcamd(watched: Watched) -> None:
    watched.watch(9)
    closures = ComputedClosures()
    since, until = REFERENCE + timedelta(days=1), REFERENCE + timedelta(days=8)
    with open_store(watched.state) as store:
        for record in store.measurements():
            closures.add(PastRow(record.moment, record.measurement))
        stored = store.hourly_closures(watched.number, since, until)
    assert len(stored) == 7 * 24
    np.testing.assert_allclose(closures.hours(since, until), stored, rtol=1e-12)
