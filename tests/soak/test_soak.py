"""Two days of slots with a power failure; the whole soak is `python -m benchmarks.soak`."""

import tempfile
from datetime import timedelta
from pathlib import Path

import pytest

from benchmarks import soak, soak_history
from benchmarks.soak_history import History
from tests.programs import Forked

HISTORY = History.of(2, 1.3, bright_days=0.6, period=timedelta(minutes=4))
"""Each camera is lost once and somebody calibrates once before the power fails."""
PAUSE_MIN = 400
"""Early, so that 75 slots lie between the calibration and the first camera that is lost."""
MEASURE_EVERY, FAIR_MIN = 60, 120
"""An image every two hours: to render and measure one takes as long as ten slots."""


def test_two_days_with_a_power_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each slot with power and cameras has its row, each other one its gap with the cause."""
    monkeypatch.setattr(soak, "subprocess", Forked)
    monkeypatch.setattr(soak, "STATUS_RUNS", 1)  # a figure of the benchmark
    monkeypatch.setattr(soak_history, "PAUSE_MIN", PAUSE_MIN)
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as directory:
        result = soak.run(HISTORY, Path(directory), MEASURE_EVERY, FAIR_MIN)
    assert result.wrong == []
    assert result.slots == 720
    assert result.gaps["power_loss"] == result.slots - result.powered
    assert result.rows == result.powered - result.gaps["camera_lost"] - result.gaps["calibration"]
    assert result.gaps["camera_lost"] == 3
    assert min(result.flags.values()) > 0
