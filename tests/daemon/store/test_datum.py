"""The links of calibrations to the record's zero: immutable, whole, and no bit where none is."""

from __future__ import annotations

import math
import os
import shutil
import signal
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import Engine, event

from core.arrays import FloatArray
from core.results import Displacement, Flag, Measurement, TargetMeasurement
from core.rig.reference_errors import ReferenceErrors
from core.site import MAIN, TargetRole
from daemon.store.database import ALWAYS, NEVER, open_store
from daemon.store.queries.chart_rows import chart_rows
from daemon.store.queries.columns import read_columns
from daemon.store.queries.overview import open_overview
from daemon.store.queries.point_rows import open_points, point_rows
from daemon.store.records import DatumMethod, DatumRecord, DatumStep
from daemon.store.rows.datum import read_datums
from tests.daemon.store.examples import START, calibration, datum, full_record, record, slot
from tests.daemon.store.writer import counted, die_at


def test_a_single_calibration_changes_no_bit(tmp_path: Path) -> None:
    none = Displacement(np.zeros(2), np.zeros((2, 2)))
    origin = DatumRecord(DatumMethod.ORIGIN, none, (), START)
    with open_store(tmp_path) as store:
        store.add_calibration(calibration(), origin, activate=True)
        store.add_measurement(full_record(slot(0), calibration_id=1))
        stored = next(store.measurements())
    (read,) = read_columns(tmp_path / "dcam.db", ALWAYS, NEVER)
    (kept,) = read_columns(tmp_path / "dcam.db", ALWAYS, NEVER, as_stored=True)
    assert read.values == kept.values
    with open_overview(tmp_path) as overview:
        assert repr(overview.last_row()) == repr(stored)


def test_a_link_comes_back_whole(tmp_path: Path) -> None:
    offset = Displacement(np.array([0.1, -0.2]), np.array([[0.04, 0.01], [0.01, 0.09]]))
    of_target = Displacement(np.array([0.3, 0.4]), np.array([[0.05, -0.01], [-0.01, 0.02]]))
    steps = (
        DatumStep(DatumMethod.FIXED_TARGETS, 1, offset, {"quarter": of_target}),
        DatumStep(DatumMethod.SURVEY, None, None, {}),
    )
    link = DatumRecord(
        DatumMethod.ADJUSTED, offset, steps, START, slot(1), {"quarter": of_target}, "why"
    )
    with open_store(tmp_path) as store:
        store.add_calibration(calibration())
        store.add_calibration(calibration(), link)
        (found,) = store.datum_links()
        assert store.datum(1) is None
    assert repr(found).replace("calibration_id=2, id=1", "calibration_id=None, id=None") == repr(
        link
    )


@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_a_datum_with_no_number_in_it_costs_nothing(tmp_path: Path, wrong: float) -> None:
    with open_store(tmp_path) as store:
        with pytest.raises(ValueError, match="datum: x_mm is"):
            store.add_calibration(calibration(), datum(wrong, 0.0), activate=True)
        assert store.calibrations() == []


def killed_at(state: Path, last_step: int) -> bool:
    """Store a second calibration in a process that is killed at a step; whether it came so far."""
    child = os.fork()
    if child == 0:
        with open_store(state) as store:
            step = die_at(last_step)
            os.fsync = counted(step, os.fsync)
            event.listen(Engine, "before_cursor_execute", step)
            event.listen(Engine, "commit", step)
            store.add_calibration(calibration({"method": "new"}), datum(1.0, 2.0), activate=True)
            os._exit(0)
    _, status = os.waitpid(child, 0)
    assert status in {0, signal.SIGKILL}
    return status != 0


def test_a_kill_leaves_the_old_calibration_or_the_new_one_with_its_datum(tmp_path: Path) -> None:
    before = tmp_path / "before"
    with open_store(before) as store:
        store.add_calibration(calibration(), activate=True)
        store.add_measurement(full_record(slot(0), calibration_id=1))
    found: Counter[tuple[int | None, bool]] = Counter()
    for last_step in range(1, 100):
        state = Path(shutil.copytree(before, tmp_path / str(last_step)))
        was_killed = killed_at(state, last_step)
        with open_store(state) as store:
            active = store.active_calibration()
            assert active is not None
            found[active.id, store.datum(2) is not None] += 1
            assert len(store.calibrations()) == active.id
        if not was_killed:
            break
    assert set(found) == {(1, False), (2, True)}
    assert found[1, False] >= 5


def with_plate(gain: list[list[float]] | None) -> Measurement:
    """A row from which a share of what a fixed plate shows is taken off."""
    found = Displacement(np.array([0.5, -1.25]), np.array([[0.01, 0.001], [0.001, 0.04]]))
    closure = Displacement(np.array([0.1, 0.2]), 1e-4 * np.eye(2))
    taken_off = None if gain is None else {MAIN: np.array(gain)}
    plate = TargetMeasurement(
        *("abutment", TargetRole.FIXED, Flag.GOOD, (), closure, closure), taken_off
    )
    return Measurement(Flag.GOOD, (), found, found, None, targets=(plate,), frames_used=1)


def with_errors(*names: str) -> DatumRecord:
    """A link that has measured its reference, whose noise is in all rows."""
    m = 4 * len(names)
    covariance = 0.004 * (np.eye(m) + 0.2)
    errors = ReferenceErrors(names, tuple(name != MAIN for name in names), covariance)
    shared = covariance[:, :2] - (0.5 * covariance[:, 4:6] if len(names) > 1 else 0.0)
    return replace(datum(0.3, 2.7, 0.12), errors=errors, shared={MAIN: shared})


GAIN = [[0.9, 0.0, 0.3, -0.4], [0.0, 0.8, 0.2, 0.1]]


@pytest.mark.parametrize(
    ("link", "gain", "by_errors"),
    [
        (with_errors(MAIN), None, np.eye(2, 4)),
        (
            with_errors(MAIN, "abutment"),
            GAIN,
            np.concatenate([np.eye(2, 4), -np.array(GAIN)], axis=1),
        ),
        (with_errors(MAIN, "abutment"), None, np.zeros((2, 8))),
    ],
    ids=["main target alone", "with a fixed plate", "of a version that kept no gain"],
)
def test_what_a_row_shares_with_its_datum_is_in_its_sigma_wherever_it_is_read(
    tmp_path: Path, link: DatumRecord, gain: list[list[float]] | None, by_errors: FloatArray
) -> None:
    measurement = with_plate(gain)
    if by_errors.shape == (2, 4):
        measurement = replace(measurement, targets=())
    with open_store(tmp_path) as store:
        store.add_calibration(calibration())
        store.add_calibration(calibration(), link, activate=True)
        store.add_measurement(replace(record(slot(0), measurement), calibration_id=2))
    one_way = by_errors @ link.shared[MAIN]
    assert measurement.corrected is not None
    expected = measurement.corrected.covariance_mm2 + link.offset.covariance_mm2
    expected = expected - one_way - one_way.T
    sigma_mm = np.sqrt(np.diag(expected))
    (read,) = read_columns(tmp_path / "dcam.db", ALWAYS, NEVER)
    for axis, letter in enumerate("xy"):
        assert read.values[f"sigma_{letter}_mm"][0] == pytest.approx(sigma_mm[axis], rel=1e-4)
        with open_points(tmp_path) as connection:
            (point,) = point_rows(connection, MAIN, letter, ALWAYS, NEVER).rows
        assert point.sigma == pytest.approx(sigma_mm[axis], rel=1e-4)
    assert read.values["cov_xy_mm2"][0] == pytest.approx(expected[0, 1], rel=1e-4, abs=1e-9)
    with open_overview(tmp_path) as overview:
        last = overview.last_row()
        assert last is not None
        assert last.measurement.corrected is not None
        assert last.measurement.corrected.covariance_mm2 == pytest.approx(expected, rel=1e-4)
    for wanted in (None, ("sigma_x_mm.main",)):
        with open_points(tmp_path) as connection:
            shown = chart_rows(connection, "2000", "3000", read_datums(connection), wanted)
        assert shown.values["sigma_x_mm.main"][0] == pytest.approx(sigma_mm[0], rel=1e-4)


def test_a_link_keeps_what_its_reference_does_to_rows(tmp_path: Path) -> None:
    link = with_errors(MAIN, "abutment")
    gains = {MAIN: {"abutment": np.array(GAIN)}}
    offset = link.offset
    steps = (DatumStep(DatumMethod.OLD_CALIBRATION, 1, offset, {}, gains, gains),)
    link = replace(link, method=DatumMethod.OLD_CALIBRATION, steps=steps)
    with open_store(tmp_path) as store:
        store.add_calibration(calibration())
        store.add_calibration(calibration(), link)
        (found,) = store.datum_links()
    assert repr(found).replace("calibration_id=2, id=1", "calibration_id=None, id=None") == repr(
        link
    )
