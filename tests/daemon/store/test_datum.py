"""The links of calibrations to the record's zero: immutable, whole, and no bit where none is."""

from __future__ import annotations

import math
import os
import shutil
import signal
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import Engine, event

from core.results import Displacement
from daemon.store.database import ALWAYS, NEVER, open_store
from daemon.store.queries.columns import read_columns
from daemon.store.queries.overview import open_overview
from daemon.store.records import DatumMethod, DatumRecord, DatumStep
from tests.daemon.store.examples import START, calibration, datum, full_record, slot
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
