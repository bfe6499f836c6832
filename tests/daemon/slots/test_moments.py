"""What sensors said goes with a pair to where its sigma is computed, whatever way it comes."""

from __future__ import annotations

from pathlib import Path

from core.moment import Moment
from daemon.slots.measuring import image_pair, row_moment
from daemon.store.database import open_store
from daemon.store.queries.overview import open_overview
from drivers.frameset import FrameSetRow
from tests.daemon.store.examples import READINGS, calibration, full_record, pair, slot

SAID = {"steel-2": -3.25}
"""Of the readings that have a value."""


def test_a_pair_as_taken_has_the_readings_of_its_slot() -> None:
    taken = image_pair(pair(), slot(0), READINGS)
    assert taken.moment == Moment(slot(0).timestamp(), 41.5, SAID)


def test_a_stored_row_has_them() -> None:
    assert full_record(slot(1)).moment == Moment(slot(1).timestamp(), 41.5, SAID)


def test_a_row_of_a_frame_set_has_them() -> None:
    cells = {"temperature_main_c": "41.5", "reading_steel-2": "-3.25", "reading_air": ""}
    row = FrameSetRow(slot(2), "measure", "a.png", "b.png", extra=cells)
    assert row_moment(row) == Moment(slot(2).timestamp(), 41.5, SAID)


def test_the_reference_of_the_calibration_in_use_has_them(tmp_path: Path) -> None:
    reference = Moment(slot(0).timestamp(), 41.5, SAID)
    content = {"method": "rigid", "reference": reference.to_dict()}
    with open_store(tmp_path) as store:
        store.add_calibration(calibration(content), activate=True)
    with open_overview(tmp_path) as overview:
        found = overview.calibration()
    assert found is not None
    assert found.reference == reference
