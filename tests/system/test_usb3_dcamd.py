"""A real dcamd on two USB3 cameras that fail at random; the long run is benchmarks.usb3."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.usb3 import OF_CAMERAS, measure_usb3
from tests.drivers.genicam.gige.bench import gige_network
from tests.drivers.genicam.usb3.bench import require_bus


@pytest.fixture(autouse=True)
def network() -> Iterator[None]:
    require_bus()
    with gige_network():
        yield


def test_each_slot_is_a_row_or_a_gap_with_its_cause_and_rows_come_again(tmp_path: Path) -> None:
    outcome = measure_usb3(tmp_path, n_before=8, n_faults=8, seed=3)
    assert outcome.unexplained == 0
    assert not outcome.missed_before.keys() & OF_CAMERAS, outcome
    assert outcome.lost_after == 0, outcome
    assert outcome.missed.keys() & OF_CAMERAS, "no fault was seen"
    for before, after in zip(outcome.settled[:2], outcome.end[:2], strict=True):
        assert after <= before + 1, outcome  # open files and threads
